"""Small parts of the Modelica Standard Library 4.1.0 beside our own ones, each by its closed form.

Values at two times, and the derivatives by all parameters that are named, where no waves jump. `MODELICA_LIBRARY` names
the folder of the library; without it the tests are skipped.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from device_library import standard_library
from open_classes import run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate
from jaxonomy_dae.library import electrical, rotational, thermal, translational
from jaxonomy_dae.library.signal import Constant
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow
END = 0.8


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


class Plants:
    """A diagram, and what is known of its variables: a closed form of time and of the parameters that it names."""

    def __init__(self, library):
        self.library, self.ev, self.d, self.known = library, EqnEnv(), AcausalDiagram(), []
        self.values: dict[str, float] = {}

    def part(self, path, name, *, structure=None, start=None, tried=(), **given):
        """A part of the library; `tried` are the parameters by which there are derivatives."""
        Class = self.library.component(f"Modelica.{path}", **(structure or {}))
        x = Class(self.ev, name, **given, **({"start": start} if start else {}))
        self.values |= {f"{name}.{p}": given[p] for p in tried}
        self.d.add(x)
        return x

    def ours(self, x):
        self.d.add(x)
        return x

    def level(self, name, k, tried=False):
        if tried:
            self.values[f"{name}.k"] = k
        return self.ours(Constant(self.ev, name, k)).y

    def expect(self, variable, form):
        """`form(t, p)` is the value, with `p[name]` for parameters."""
        self.known.append((variable, form))

    def compiled(self):
        return AcausalCompiler(self.ev, self.d)()

    def agree(self, found, ts):
        for name, form in self.known:
            np.testing.assert_allclose(
                found[name], [form(t, self.values) for t in ts], rtol=1e-7, atol=1e-9, err_msg=name
            )

    def agree_with_slopes(self):
        ts, names = np.array([0.3, END]), [n for n, _ in self.known]
        found, slopes = run_with_slopes(self.compiled(), self.values, ts, names, names)
        self.agree(found, ts)
        by_hand = jax.grad(lambda p: sum(jnp.asarray(form(END, p), float) for _, form in self.known))(self.values)
        for name, expected in by_hand.items():
            assert slopes[name] == pytest.approx(float(expected), rel=1e-5, abs=1e-8), name


def test_sources_and_signals(library):
    """Waves, their sums and products, and what switches between them: their values."""
    plants = Plants(library)
    part, d, expect = plants.part, plants.d, plants.expect
    sources = "Blocks.Sources"
    for name, path, given, form in (
        ("ramp", "Ramp", {"height": 2.0, "duration": 0.5, "startTime": 0.2, "offset": 0.1},
         lambda t, p: p["offset"] + p["height"] * jnp.clip((t - p["startTime"]) / p["duration"], 0, 1)),
        ("cosine", "Cosine", {"amplitude": 2.0, "f": 1.5, "phase": 0.4, "offset": 0.1},
         lambda t, p: p["offset"] + p["amplitude"] * jnp.cos(2 * jnp.pi * p["f"] * t + p["phase"])),
        ("damped", "ExpSine", {"amplitude": 2.0, "f": 1.5, "damping": 0.7, "startTime": 0.1},
         lambda t, p: p["amplitude"] * jnp.exp(-p["damping"] * (t - p["startTime"]))
         * jnp.sin(2 * jnp.pi * p["f"] * (t - p["startTime"]))),
        ("rises", "Exponentials", {"outMax": 2.0, "riseTime": 0.5, "riseTimeConst": 0.2, "fallTimeConst": 0.4},
         lambda t, p: p["outMax"] * (1 - jnp.exp(-jnp.minimum(t, p["riseTime"]) / p["riseTimeConst"]))
         * jnp.exp(-jnp.maximum(t - p["riseTime"], 0) / p["fallTimeConst"])),
        ("saw", "SawTooth", {"amplitude": 2.0, "period": 0.25, "offset": 0.1},
         lambda t, p: p["offset"] + p["amplitude"] * (t / p["period"] - jnp.floor(t / 0.25))),
        ("pulse", "Pulse", {"amplitude": 2.0, "width": 30.0, "period": 0.25},
         lambda t, p: p["amplitude"] * ((t / 0.25) % 1 < 0.3)),
        # At 0.3 it is a third of the way down, and at 0.8 at its height.
        ("trapezoid", "Trapezoid", {"amplitude": 2.0, "rising": 0.1, "width": 0.1, "falling": 0.3, "period": 0.65},
         lambda t, p: p["amplitude"] * (2 / 3 if t == 0.3 else 1.0)),
        ("sweep", "LogFrequencySweep", {"wMin": 1.0, "wMax": 20.0, "duration": 2.0},
         lambda t, p: p["wMin"] * (p["wMax"] / p["wMin"]) ** (t / p["duration"])),
    ):  # fmt: skip
        part(f"{sources}.{path}", name, tried=() if name in ("pulse", "trapezoid") else given, **given)
        expect(f"{name}.y", lambda t, p, n=name, g=given, f=form: f(t, {k: p.get(f"{n}.{k}", v) for k, v in g.items()}))
    u, v, w = plants.level("u", 0.7, True), plants.level("v", -0.4, True), plants.level("w", 3.9, True)

    def block(path, name, form, inputs, structure=None, **given):
        x = part(f"Blocks.{path}", name, structure=structure, tried=given, **given)
        for n, signal in inputs.items():
            d.connect(signal, x[n])
        expect(f"{name}.y", form)
        return x

    block(
        "Math.LinearDependency", "mix", lambda t, p: p["mix.y0"] + p["mix.k1"] * p["u.k"] + p["mix.k2"] * p["v.k"],
        {"u1": u, "u2": v}, y0=0.3, k1=2.0, k2=-1.5,
    )  # fmt: skip
    block("Math.Power", "power", lambda t, p: 2.5 ** p["u.k"], {"u": u}, {"base": 2.5})
    block("Math.Sign", "sign", lambda t, p: -1.0, {"u": v})
    block("Math.WrapAngle", "wrap", lambda t, p: p["w.k"] - 2 * jnp.pi, {"u": w})
    block(
        "Math.MultiSum", "sum", lambda t, p: 2 * p["u.k"] - p["v.k"] + 0.5 * p["w.k"],
        {"u[1]": u, "u[2]": v, "u[3]": w}, {"nu": 3, "k": [2.0, -1.0, 0.5]},
    )  # fmt: skip
    block(
        "Math.MultiProduct", "product", lambda t, p: p["u.k"] * p["v.k"] * p["w.k"],
        {"u[1]": u, "u[2]": v, "u[3]": w}, {"nu": 3},
    )  # fmt: skip
    block("Routing.RealPassThrough", "through", lambda t, p: p["u.k"], {"u": u})
    block("Nonlinear.VariableLimiter", "cut", lambda t, p: p["u.k"], {"u": w, "limit1": u, "limit2": v})
    gain = part("Blocks.Math.MatrixGain", "gain", K=[[1.0, 2.0], [3.0, -1.0]])
    both, apart = part("Blocks.Routing.Multiplex2", "both"), part("Blocks.Routing.DeMultiplex2", "apart")
    d.connect(u, both["u1[1]"])
    d.connect(v, both["u2[1]"])
    for k in (1, 2):
        d.connect(both[f"y[{k}]"], gain[f"u[{k}]"])
        d.connect(gain[f"y[{k}]"], apart[f"u[{k}]"])
    expect("apart.y1[1]", lambda t, p: p["u.k"] + 2 * p["v.k"])
    expect("apart.y2[1]", lambda t, p: 3 * p["u.k"] - p["v.k"])
    # y is the greater of two signals, by a comparison, a negation and a switch.
    greater, negated, switch = (part(f"Blocks.Logical.{n}", n.lower()) for n in ("Greater", "Not", "Switch"))
    above, either, number = (
        part("Blocks.Logical.GreaterThreshold", "above", threshold=0.5),
        part("Blocks.Logical.Or", "either"),
        part("Blocks.Math.BooleanToReal", "number", realTrue=3.0, realFalse=-2.0, tried=("realTrue",)),
    )
    both_of = part("Blocks.Logical.And", "and_")
    d.connect(u, greater.u1, switch.u1, above.u)
    d.connect(v, greater.u2, switch.u3)
    d.connect(greater.y, negated.u, switch.u2, either.u1, both_of.u1)
    d.connect(negated.y, either.u2)
    d.connect(above.y, both_of.u2)
    d.connect(both_of.y, number.u)
    expect("switch.y", lambda t, p: p["u.k"])
    expect("number.y", lambda t, p: p["number.realTrue"])
    ts = jnp.array([0.3, END])
    plants.agree(
        simulate(plants.compiled().with_parameters(plants.values), END, ts=ts, rtol=1e-9, atol=1e-11), ts.tolist()
    )


def test_circuits_shafts_and_heat(library):
    """Controlled sources, sensors and converters of the library on our resistors; loads on our shafts; heat."""
    plants = Plants(library)
    part, d, expect, ours, ev = plants.part, plants.d, plants.expect, plants.ours, plants.ev
    analog, g = "Electrical.Analog", ours(electrical.Ground(plants.ev, "g"))

    def loaded(name, plus, minus, R):
        r = ours(electrical.Resistor(ev, name, R=R))
        plants.values[f"{name}.R"] = R
        d.connect(plus, r.p)
        d.connect(minus, r.n)
        return r

    sine = part(f"{analog}.Sources.SineVoltage", "sine", V=5.0, f=1.2, phase=0.3, offset=0.5, tried=("V", "f", "phase"))
    ramp = part(f"{analog}.Sources.RampVoltage", "ramp", V=4.0, duration=2.0, tried=("V", "duration"))
    current = part(f"{analog}.Sources.ConstantCurrent", "current", I=0.6, tried=("I",))
    ammeter, power = part(f"{analog}.Sensors.CurrentSensor", "ammeter"), part(f"{analog}.Sensors.PowerSensor", "power")
    volts = part(f"{analog}.Sensors.VoltageSensor", "volts")

    def wave(t, p):
        return 0.5 + p["sine.V"] * jnp.sin(2 * jnp.pi * p["sine.f"] * t + p["sine.phase"])

    d.connect(sine.p, power.pc, power.pv, volts.p)
    d.connect(power.nc, ammeter.p)
    loaded("r1", ammeter.n, sine.n, 2.0)
    d.connect(sine.n, power.nv, volts.n, ramp.n, current.p, g.p)
    expect("ammeter.i", lambda t, p: wave(t, p) / p["r1.R"])
    expect("power.power", lambda t, p: wave(t, p) ** 2 / p["r1.R"])
    expect("volts.v", wave)
    for name, path, given, form in (
        ("vcv", "VCV", {"gain": 3.0}, lambda t, p: p["vcv.gain"] * p["ramp.V"] * t / p["ramp.duration"]),
        ("vcc", "VCC", {"transConductance": 0.2},
         lambda t, p: -p["vcc.transConductance"] * p["ramp.V"] * t / p["ramp.duration"] * p["vcc_r.R"]),
        ("gyrator", "Gyrator", {"G1": 0.2, "G2": 0.3},
         lambda t, p: p["gyrator.G1"] * p["ramp.V"] * t / p["ramp.duration"] * p["gyrator_r.R"]),
    ):  # fmt: skip
        x = part(f"{analog}.Basic.{path}", name, tried=given, **given)
        d.connect(ramp.p, x.p1)
        d.connect(g.p, x.n1, x.n2)
        loaded(f"{name}_r", x.p2, x.n2, 4.0)
        expect(f"{name}_r.v", form)
    ccv = part(f"{analog}.Basic.CCV", "ccv", transResistance=7.0, tried=("transResistance",))
    ccc = part(f"{analog}.Basic.CCC", "ccc", gain=-2.0, tried=("gain",))
    d.connect(current.n, ccv.p1)
    d.connect(ccv.n1, ccc.p1)
    d.connect(g.p, ccc.n1, ccv.n2, ccc.n2)
    loaded("ccv_r", ccv.p2, ccv.n2, 4.0)
    loaded("ccc_r", ccc.p2, ccc.n2, 5.0)
    expect("ccv_r.v", lambda t, p: p["ccv.transResistance"] * p["current.I"])
    expect("ccc_r.v", lambda t, p: -p["ccc.gain"] * p["current.I"] * p["ccc_r.R"])
    divider = part(f"{analog}.Basic.Potentiometer", "divider", R=30.0, rConstant=0.3, tried=("rConstant",))
    d.connect(sine.p, divider.pin_p)
    d.connect(g.p, divider.pin_n)
    expect("divider.contact.v", lambda t, p: p["divider.rConstant"] * wave(t, p))

    cell = part(
        "Electrical.Batteries.BatteryStacks.SuperCap", "cell", Vnom=10.0, V0=8.0, C=0.5, Rs=0.1,
        structure={"Idis": 0.2}, tried=("V0", "C", "Rs"),
    )  # fmt: skip
    d.connect(cell.n, g.p)
    loaded("cell_r", cell.p, cell.n, 2.0)
    expect(
        "cell_r.v",
        lambda t, p: p["cell.V0"] * jnp.exp(-t / p["cell.C"] * (0.02 + 1 / (p["cell.Rs"] + p["cell_r.R"])))
        * p["cell_r.R"] / (p["cell.Rs"] + p["cell_r.R"]),
    )  # fmt: skip

    # k w = V - R i, d w = k i, for a motor that turns and one that pulls.
    for name, path, wall, damper in (
        ("turns", "RotationalEMF", rotational.FixedAngle(ev, "post"), rotational.Damper(ev, "oil", d=0.5)),
        ("pulls", "TranslationalEMF", translational.FixedPosition(ev, "wall"), translational.Damper(ev, "air", d=0.8)),
    ):
        emf = part(f"{analog}.Basic.{path}", name, k=1.5, tried=("k",), start={"phi" if name == "turns" else "s": 0.0})
        source, r = electrical.VoltageSource(ev, f"{name}_v", V=6.0), electrical.Resistor(ev, f"{name}_r", R=2.0)
        for x in (source, r, wall, damper):
            ours(x)
        d.connect(source.p, r.p)
        d.connect(r.n, emf.p)
        d.connect(source.n, emf.n, g.p)
        d.connect(emf.flange, damper.flange_b)
        d.connect(damper.flange_a, wall.flange)
        plants.values[f"{damper.name}.d"] = 0.5 if name == "turns" else 0.8
    expect("turns.phi", lambda t, p: 6.0 * t * p["turns.k"] / (2.0 * p["oil.d"] + p["turns.k"] ** 2))
    expect("pulls.s", lambda t, p: 6.0 * t * p["pulls.k"] / (2.0 * p["air.d"] + p["pulls.k"] ** 2))

    turning, shifting = "Mechanics.Rotational", "Mechanics.Translational"
    square = part(
        f"{turning}.Sources.QuadraticSpeedDependentTorque", "square", tau_nominal=-2.0, w_nominal=5.0,
        tried=("tau_nominal", "w_nominal"),
    )  # fmt: skip
    linear = part(
        f"{turning}.Sources.LinearSpeedDependentTorque", "linear", tau_nominal=-2.0, w_nominal=5.0,
        tried=("tau_nominal",),
    )  # fmt: skip
    speed = part(f"{turning}.Sensors.SpeedSensor", "speed")
    wheels = [rotational.Inertia(ev, n, J=0.5, initial_angle=0.0, initial_speed=10.0) for n in ("fan", "belt")]
    for wheel, load in zip(wheels, (square, linear), strict=True):
        ours(wheel)
        plants.values[f"{wheel.name}.J"] = 0.5
        d.connect(wheel.flange_a, load.flange)
    d.connect(wheels[0].flange_b, speed.flange)
    expect(
        "speed.w", lambda t, p: 1 / (1 / 10.0 - p["square.tau_nominal"] / p["square.w_nominal"] ** 2 * t / p["fan.J"])
    )
    expect("belt.w", lambda t, p: 10.0 * jnp.exp(p["linear.tau_nominal"] / 5.0 * t / p["belt.J"]))
    # A torque of ours on a rack of the library moves our mass; a disc turns by a fixed angle.
    rack = part(f"{turning}.Components.IdealGearR2T", "rack", ratio=4.0, tried=("ratio",))
    disc = part(f"{turning}.Components.Disc", "disc", deltaPhi=0.3, tried=("deltaPhi",))
    angle, place = part(f"{turning}.Sensors.AngleSensor", "angle"), part(f"{shifting}.Sensors.PositionSensor", "place")
    torque, cart = ours(rotational.Torque(ev, "torque")), ours(translational.Mass(
        ev, "cart", m=2.0, initial_position=0.1, initial_velocity=0.0
    ))  # fmt: skip
    d.connect(plants.level("twist", 0.4, True), torque.tau)
    d.connect(torque.flange, disc.flange_a)
    d.connect(disc.flange_b, rack.flangeR, angle.flange)
    d.connect(rack.flangeT, cart.flange, place.flange)
    expect("place.s", lambda t, p: 0.1 + p["twist.k"] * p["rack.ratio"] / 2.0 * t**2 / 2)
    expect("angle.phi", lambda t, p: p["rack.ratio"] * (0.1 + p["twist.k"] * p["rack.ratio"] / 2.0 * t**2 / 2))
    expect(
        "disc.flange_a.phi",
        lambda t, p: p["rack.ratio"] * (0.1 + p["twist.k"] * p["rack.ratio"] / 4.0 * t**2) - p["disc.deltaPhi"],
    )

    heat = "Thermal.HeatTransfer"
    film, crust = part(f"{heat}.Components.Convection", "film"), part(f"{heat}.Components.ConvectiveResistor", "crust")
    cold = part(f"{heat}.Celsius.FixedTemperature", "cold", T=20.0, tried=("T",))
    hot = part(f"{heat}.Sources.FixedTemperature", "hot", T=350.0, tried=("T",))
    collector = part(f"{heat}.Components.ThermalCollector", "collector", structure={"m": 2})
    flow, store = part(f"{heat}.Sensors.HeatFlowSensor", "flow"), ours(thermal.HeatCapacitor(ev, "store", 50.0, 300.0))
    given = part(f"{heat}.Sources.FixedHeatFlow", "given", Q_flow=25.0, tried=("Q_flow",))
    d.connect(plants.level("Gc", 3.0, True), film.Gc)
    d.connect(plants.level("Rc", 0.5, True), crust.Rc)
    d.connect(hot.port, film.solid, crust.solid)
    d.connect(film.fluid, collector.port_a[0])
    d.connect(crust.fluid, collector.port_a[1])
    d.connect(collector.port_b, flow.port_a)
    d.connect(flow.port_b, cold.port)
    d.connect(given.port, store.heat)
    expect("flow.Q_flow", lambda t, p: (p["Gc.k"] + 1 / p["Rc.k"]) * (p["hot.T"] - p["cold.T"] - 273.15))
    expect("store.T", lambda t, p: 300.0 + p["given.Q_flow"] * t / 50.0)
    plants.agree_with_slopes()
