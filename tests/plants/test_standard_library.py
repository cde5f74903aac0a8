"""Classes of the Modelica Standard Library 4.1.0 in plants with our own parts, beside closed forms and SciPy.

Each plant stands for itself; those of one test share a diagram, a run and a gradient. `MODELICA_LIBRARY` names the
folder of the library; without it the tests are skipped.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from device_library import standard_library
from open_classes import opened, run_with_slopes

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    Eq,
    EqnEnv,
    actual_stream,
    der,
)
from jaxonomy_dae.library import electrical, rotational, thermal, translational
from jaxonomy_dae.library.signal import Constant, Step
from jaxonomy_dae.modelica import Library
from jaxonomy_dae.solvers import Rodas5P

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def test_an_amplifier_with_a_transistor(library):
    """Currents of Ebers and Moll by hand, two equations for the voltages at B and C; their slopes by differences."""
    ev, d = EqnEnv(), AcausalDiagram()
    q = opened(library, "Electrical.Analog.Semiconductors.NPN")(ev, "q")
    rc, rb = electrical.Resistor(ev, "rc", R=1000.0), electrical.Resistor(ev, "rb", R=1e5)
    v, g = electrical.VoltageSource(ev, "v", V=10.0), electrical.Ground(ev, "g")
    d.add(q, rc, rb, v, g)
    d.connect(v.n, g.p, q.E)
    d.connect(v.p, rc.p, rb.p)
    d.connect(rc.n, q.C)
    d.connect(rb.n, q.B)
    system = AcausalCompiler(ev, d)()
    values = {"q.Bf": 50.0, "q.Vak": 0.02, "rb.R": 1e5}
    found, slopes = run_with_slopes(system, values, [1e-4, 1e-3], ["q.C.v", "q.B.v"], ["q.C.v"], Rodas5P())

    def by_hand(Bf, Vak, Rb):
        def rest(x):
            vb, vc = x
            forward = 1e-16 * np.expm1(vb / 0.02585) + vb * 1e-15
            back = 1e-16 * (np.exp(-100.0) * ((vb - vc) / 0.02585 + 101.0) - 1.0) + (vb - vc) * 1e-15
            collector = (forward - back) * (1.0 - (vb - vc) * Vak) - back / 0.1
            return [(10.0 - vc) / 1000.0 - collector, (10.0 - vb) / Rb - forward / Bf - back / 0.1]

        return scipy.optimize.fsolve(rest, [0.8, 5.0], xtol=1e-14)

    base = np.array([50.0, 0.02, 1e5])
    np.testing.assert_allclose([found["q.B.v"][-1], found["q.C.v"][-1]], by_hand(*base), rtol=1e-8)
    for k, name in enumerate(values):
        up, down = (base * np.where(np.arange(3) == k, 1 + s * 1e-4, 1.0) for s in (1, -1))
        expected = (by_hand(*up)[1] - by_hand(*down)[1]) / (up[k] - down[k])
        assert slopes[name] == pytest.approx(expected, rel=1e-5), name


def test_friction_gears_and_a_gap(library):
    """A body on a bearing stops: it turns J w0^2/(2 tau). Two bodies on a clutch slip until their speeds are one. A
    planetary gear divides a torque. A mass returns from an elastic stop after half a period."""
    ev, d = EqnEnv(), AcausalDiagram()
    bearing = opened(library, "Mechanics.Rotational.Components.BearingFriction")(ev, "bearing", tau_pos=[[0.0, 1.5]])
    clutch = opened(library, "Mechanics.Rotational.Components.Clutch")(ev, "clutch", fn_max=4.0)
    gear = opened(library, "Mechanics.Rotational.Components.IdealPlanetary")(ev, "gear", ratio=2.0)
    gap = opened(library, "Mechanics.Translational.Components.ElastoGap")(ev, "gap", c=200.0, d=0.0)
    body = rotational.Inertia(ev, "body", J=2.0, initial_angle=0.0, initial_speed=3.0)
    one = rotational.Inertia(ev, "one", J=1.0, initial_angle=0.0, initial_speed=10.0)
    two = rotational.Inertia(ev, "two", J=3.0, initial_angle=0.0, initial_speed=0.0)
    sun = rotational.Inertia(ev, "sun", J=0.5, initial_angle=0.0, initial_speed=0.0)
    carrier = rotational.Inertia(ev, "carrier", J=4.0, initial_angle=0.0, initial_speed=0.0)
    torque, force = rotational.Torque(ev, "torque"), Constant(ev, "force", 0.5)
    level = Constant(ev, "level", 1.2)
    ring = rotational.FixedAngle(ev, "ring")
    mass = translational.Mass(ev, "mass", m=0.5, initial_position=0.1, initial_velocity=-1.0)
    wall = translational.FixedPosition(ev, "wall")
    d.add(bearing, clutch, gear, gap, body, one, two, sun, carrier, torque, force, level, ring, mass, wall)
    d.connect(body.flange_a, bearing.flange_a)
    d.connect(one.flange_a, clutch.flange_a)
    d.connect(two.flange_a, clutch.flange_b)
    d.connect(force.y, clutch.f_normalized)
    d.connect(level.y, torque.tau)
    d.connect(torque.flange, sun.flange_a, gear.sun)
    d.connect(carrier.flange_a, gear.carrier)
    d.connect(ring.flange, gear.ring)
    d.connect(wall.flange, gap.flange_a)
    d.connect(mass.flange, gap.flange_b)
    system = AcausalCompiler(ev, d)()
    values = {"body.J": 2.0, "bearing.tau_pos[1,2]": 1.5, "clutch.fn_max": 4.0, "gear.ratio": 2.0, "gap.c": 200.0}
    ts = np.array([1.0, 3.0, 8.0])
    names = ["body.phi", "one.w", "two.w", "sun.w", "carrier.w", "mass.s"]
    found, slopes = run_with_slopes(system, values, ts, names, ["body.phi", "sun.w", "mass.s"])
    stop = 2.0 * 3.0 / 1.5
    t = np.minimum(ts, stop)
    np.testing.assert_allclose(found["body.phi"], 3.0 * t - 0.75 * t**2 / 2, atol=1e-7)
    friction = 0.5 * 4.0 * 0.5  # mu fn
    lock = 10.0 / (friction / 1.0 + friction / 3.0)
    np.testing.assert_allclose(found["one.w"], np.where(ts < lock, 10.0 - friction * ts, 2.5), atol=1e-7)
    np.testing.assert_allclose(found["two.w"], np.where(ts < lock, friction * ts / 3.0, 2.5), atol=1e-7)
    inertia = 0.5 + 4.0 / 9.0  # w_sun = (1 + ratio) w_carrier
    np.testing.assert_allclose(found["sun.w"], 1.2 * ts / inertia, rtol=1e-7)
    np.testing.assert_allclose(found["carrier.w"], 0.4 * ts / inertia, rtol=1e-7)
    away = 0.1 + np.pi * np.sqrt(0.5 / 200.0)
    np.testing.assert_allclose(found["mass.s"], ts - away, rtol=1e-7)
    assert slopes["body.J"] == pytest.approx(9.0 / 3.0, rel=1e-6)
    assert slopes["bearing.tau_pos[1,2]"] == pytest.approx(-2.0 * 9.0 / (2 * 1.5**2), rel=1e-6)
    by_ratio = 1.2 * 8.0 / inertia**2 * 2 * 4.0 / 27.0
    assert slopes["gear.ratio"] == pytest.approx(by_ratio, rel=1e-6)
    assert slopes["gap.c"] == pytest.approx(np.pi * np.sqrt(0.5) / 2 * 200.0**-1.5, rel=1e-5)


def test_inductors_transformers_and_radiation(library):
    """A voltage on a saturating inductor gives its flux; a coil on a reluctance is an inductor N^2/Rm; two bodies
    exchange heat by radiation."""
    ev, d = EqnEnv(), AcausalDiagram()
    Saturating = opened(library, "Electrical.Analog.Basic.SaturatingInductor")
    coil = Saturating(ev, "coil", start={"i": 0.0}, Inom=1.0, Lnom=1.0, Lzer=2.0, Linf=0.5)
    winding = opened(library, "Magnetic.FluxTubes.Basic.ElectroMagneticConverter")(ev, "winding", N=20.0)
    core = opened(library, "Magnetic.FluxTubes.Basic.ConstantReluctance")(ev, "core", R_m=800.0)
    ground = opened(library, "Magnetic.FluxTubes.Basic.Ground")(ev, "ground")
    transformer = opened(library, "Electrical.Analog.Ideal.IdealTransformer")(ev, "transformer", n=4.0, Lm1=1.0)
    radiation = opened(library, "Thermal.HeatTransfer.Components.BodyRadiation")(ev, "radiation", Gr=0.01)
    v, g = electrical.VoltageSource(ev, "v", V=0.7), electrical.Ground(ev, "g")
    r, load = electrical.Resistor(ev, "r", R=3.0), electrical.Resistor(ev, "load", R=0.5)
    hot, cold = thermal.HeatCapacitor(ev, "hot", 2e4, 900.0), thermal.HeatCapacitor(ev, "cold", 1e4, 300.0)
    d.add(coil, winding, core, ground, transformer, radiation, v, g, r, load, hot, cold)
    d.connect(v.p, coil.p, r.p, transformer.p1)
    d.connect(v.n, g.p, coil.n, winding.n, transformer.n1, transformer.n2, load.n)
    d.connect(r.n, winding.p)
    d.connect(transformer.p2, load.p)
    d.connect(winding.port_p, core.port_p)
    d.connect(core.port_n, winding.port_n, ground.port)
    d.connect(hot.heat, radiation.port_a)
    d.connect(radiation.port_b, cold.heat)
    system = AcausalCompiler(ev, d)()
    values = {"coil.Linf": 0.5, "winding.N": 20.0, "core.R_m": 800.0, "transformer.n": 4.0, "radiation.Gr": 0.01}
    ts = np.array([0.1, 0.5, 2.0])
    names = ["coil.i", "winding.i", "load.i", "cold.T"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def current(t, Linf=0.5):
        Ipar = scipy.optimize.brentq(lambda k: 1.0 - Linf - (2.0 - Linf) * k * np.arctan(1.0 / k), 1e-6, 1e3)
        return scipy.optimize.brentq(
            lambda i: Linf * i + (2.0 - Linf) * Ipar * np.arctan(i / Ipar) - 0.7 * t, 1e-9, 50.0, xtol=1e-14
        )

    np.testing.assert_allclose(found["coil.i"], [current(t) for t in ts], rtol=1e-7)
    by_Linf = (current(2.0, 0.5 + 1e-5) - current(2.0, 0.5 - 1e-5)) / 2e-5
    assert slopes["coil.Linf"] == pytest.approx(by_Linf, rel=1e-4)

    def charged(N, Rm):
        return 0.7 / 3.0 * (1.0 - jnp.exp(-3.0 * jnp.asarray(ts) * Rm / N**2))

    np.testing.assert_allclose(found["winding.i"], charged(20.0, 800.0), rtol=1e-6)
    by_N, by_Rm = jax.grad(lambda p: charged(*p)[-1])((20.0, 800.0))
    assert slopes["winding.N"] == pytest.approx(float(by_N), rel=1e-5)
    assert slopes["core.R_m"] == pytest.approx(float(by_Rm), rel=1e-5)
    np.testing.assert_allclose(found["load.i"], 0.7 / 4.0 / 0.5, rtol=1e-9)
    assert slopes["transformer.n"] == pytest.approx(-0.7 / 16.0 / 0.5, rel=1e-7)

    def cold_at(Gr):
        sigma = 5.670374419e-8
        flow = lambda T: Gr * sigma * (T[0] ** 4 - T[1] ** 4)  # noqa: E731
        found = scipy.integrate.solve_ivp(
            lambda t, T: [-flow(T) / 2e4, flow(T) / 1e4], (0.0, 2.0), [900.0, 300.0], rtol=1e-12, atol=1e-12
        )
        return found.y[1, -1]

    assert found["cold.T"][-1] == pytest.approx(cold_at(0.01), rel=1e-9)
    by_Gr = (cold_at(0.02) - cold_at(0.0)) / 0.02
    assert slopes["radiation.Gr"] == pytest.approx(by_Gr, rel=1e-5)


def test_an_inverter_a_thyristor_and_a_transformer(library):
    """An inverter of two transistors charges our capacitor; a gate turn-off thyristor conducts after our step; both
    windings of a transformer are loaded. Each by its equations in SciPy; slopes by differences."""
    ev, d, analog = EqnEnv(), AcausalDiagram(), "Electrical.Analog"
    n = opened(library, f"{analog}.Semiconductors.NMOS")(ev, "n")
    p = opened(library, f"{analog}.Semiconductors.PMOS")(ev, "p")
    gto = opened(library, f"{analog}.Ideal.IdealGTOThyristor")(ev, "gto", Ron=0.5, Goff=1e-3, Vknee=1.0)
    Windings = opened(library, f"{analog}.Basic.Transformer")
    windings = Windings(ev, "windings", start={"i1": 0.0, "i2": 0.0}, L1=0.02, L2=0.03, M=0.016)
    supply, gate = electrical.VoltageSource(ev, "supply", V=5.0), electrical.VoltageSource(ev, "gate", V=2.0)
    g, out = electrical.Ground(ev, "g"), electrical.Capacitor(ev, "out", C=1e-7, initial_voltage=0.0)
    v, load = electrical.VoltageSource(ev, "v", V=10.0), electrical.Resistor(ev, "load", R=5.0)
    r1, r2 = electrical.Resistor(ev, "r1", R=1.0), electrical.Resistor(ev, "r2", R=2.0)
    fire = Step(ev, "fire", start_time=0.02)
    d.add(n, p, gto, windings, supply, gate, g, out, v, load, r1, r2, fire)
    d.connect(supply.p, p.S, p.B)
    d.connect(gate.p, n.G, p.G)
    d.connect(n.D, p.D, out.p)
    d.connect(v.p, gto.p, r1.p)
    d.connect(gto.n, load.p)
    d.connect(fire.y, gto.fire)
    d.connect(r1.n, windings.p1)
    d.connect(windings.p2, r2.p)
    d.connect(g.p, supply.n, gate.n, out.n, n.S, n.B, v.n, load.n, windings.n1, windings.n2, r2.n)
    system = AcausalCompiler(ev, d)()
    values = {"n.Beta": 0.041e-3, "p.Vt": -1.0, "gto.Ron": 0.5, "gto.Vknee": 1.0, "windings.M": 0.016}
    ts = np.array([0.01, 0.03, 0.05])
    names = ["out.v", "load.i", "r2.i"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def runs(beta, threshold, Ron, knee, M):
        def solved(slope, start):
            return scipy.integrate.solve_ivp(slope, (0.0, 0.05), start, t_eval=ts, rtol=1e-10, atol=1e-12).y

        def channel(gain, over, across):  # a transistor's current, for positive values
            return gain * (across * (over - across / 2) if over > across else over**2 / 2) + 1e-7 * across

        def charging(t, x):
            down = channel(beta * 17.5 / 4.5, (2.0 - 0.8) * 0.7311, x[0])
            up = channel(0.0105e-3 * 17.5 / 3.9, (3.0 + threshold) * 0.839, 5.0 - x[0])
            return [(up - down) / 1e-7]

        conducting = (10.0 - knee + Ron * 1e-3 * knee) / (5.0 + Ron)
        thyristor = np.where(ts < 0.02, 10.0 * 1e-3 / (1.0 + 5.0 * 1e-3), conducting)
        coupled = np.array([[0.02, M], [M, 0.03]])
        winding = solved(lambda t, i: np.linalg.solve(coupled, [10.0 - i[0], -2.0 * i[1]]), [0.0, 0.0])
        return np.array([solved(charging, [0.0])[0], thyristor, -winding[1]])

    np.testing.assert_allclose([found[name] for name in names], runs(*values.values()), rtol=2e-6)
    for name, value in values.items():
        up, down = (runs(*(values | {name: value * (1 + s * 1e-4)}).values())[:, -1].sum() for s in (1, -1))
        assert slopes[name] == pytest.approx((up - down) / (2e-4 * value), rel=1e-3), name


def test_a_quasi_static_circuit(library):
    """A phasor source on a resistor and a capacitor, whose capacity is our signal: I = V/(R + 1/(j omega C))."""
    ev, d, phasors = EqnEnv(), AcausalDiagram(), "Electrical.QuasiStatic.SinglePhase"
    source = opened(library, f"{phasors}.Sources.VoltageSource")(ev, "source", f=50.0, V=100.0, phi=0.3)
    r = opened(library, f"{phasors}.Basic.Resistor")(ev, "r", R_ref=30.0)
    c = opened(library, f"{phasors}.Basic.VariableCapacitor")(ev, "c")
    ground, capacity = opened(library, f"{phasors}.Basic.Ground")(ev, "ground"), Constant(ev, "capacity", 1e-4)
    d.add(source, r, c, ground, capacity)
    d.connect(source.pin_p, r.pin_p)
    d.connect(r.pin_n, c.pin_p)
    d.connect(c.pin_n, source.pin_n, ground.pin)
    d.connect(capacity.y, c.C)
    system = AcausalCompiler(ev, d)()
    values = {"source.f": 50.0, "source.V": 100.0, "source.phi": 0.3, "r.R_ref": 30.0, "capacity.k": 1e-4}
    order, names = list(values), ["r.i.re", "r.i.im", "r.P"]
    found, slopes = run_with_slopes(system, values, [0.01, 0.02], names, names)

    def phasor(values):
        f, V, phi, R, C = (values[name] for name in order)
        current = V * jnp.exp(1j * phi) / (R + 1.0 / (2j * jnp.pi * f * C))
        return jnp.stack([current.real, current.imag, R * jnp.abs(current) ** 2])

    np.testing.assert_allclose(
        [found[n] for n in names], np.tile(phasor(values)[:, None], 2), rtol=1e-9
    )  # fmt: skip
    by_hand = jax.grad(lambda p: jnp.sum(phasor(p)))(values)
    for name, expected in by_hand.items():
        assert slopes[name] == pytest.approx(float(expected), rel=1e-7), name


def test_sums_and_sines_of_complex_signals(library):
    """y = k1 u1 + k2 u2, and sin(u), of our signals, beside Python's complex numbers."""
    ev, d, blocks = EqnEnv(), AcausalDiagram(), "ComplexBlocks.ComplexMath"
    gains = {"k1.re": 0.5, "k1.im": 0.25, "k2.re": -1.5, "k2.im": 2.0}
    add, sine = opened(library, f"{blocks}.Add")(ev, "add", **gains), opened(library, f"{blocks}.Sin")(ev, "sine")
    inputs = {"u1.re": 0.7, "u1.im": -0.2, "u2.re": 1.1, "u2.im": 0.4}
    signals = [Constant(ev, f"c{k}", value) for k, value in enumerate(inputs.values())]
    d.add(add, sine, *signals)
    for signal, name in zip(signals, inputs, strict=True):
        d.connect(signal, "y", add, name)
    d.connect(signals[2], "y", sine, "u.re")
    d.connect(signals[3], "y", sine, "u.im")
    system = AcausalCompiler(ev, d)()
    values = {f"add.{name}": value for name, value in gains.items()} | {
        f"c{k}.k": v for k, v in enumerate([1.1, 0.4], 2)
    }
    order, names = list(values), ["add.y.re", "add.y.im", "sine.y.re", "sine.y.im"]
    found, slopes = run_with_slopes(system, values, [0.1, 0.2], names, names)

    def outputs(values):
        a, b, c, e, x, y = (values[name] for name in order)
        total, turned = (a + 1j * b) * (0.7 - 0.2j) + (c + 1j * e) * (x + 1j * y), jnp.sin(x + 1j * y)
        return jnp.stack([total.real, total.imag, turned.real, turned.imag])

    np.testing.assert_allclose([found[n] for n in names], np.tile(outputs(values)[:, None], 2), rtol=1e-12)
    for name, expected in jax.grad(lambda p: jnp.sum(outputs(p)))(values).items():
        assert slopes[name] == pytest.approx(float(expected), rel=1e-10), name


ARM = """
model Arm "a body on a revolute joint; its shaft is open"
  inner Modelica.Mechanics.MultiBody.World world(enableAnimation = false, n = {0, -1, 0});
  Modelica.Mechanics.MultiBody.Joints.Revolute joint(useAxisFlange = true, animation = false, n = {0, 0, 1});
  Modelica.Mechanics.MultiBody.Parts.Body body(m = 1.5, r_CM = {0.4, 0, 0}, I_33 = 0.1, animation = false);
  Modelica.Mechanics.Rotational.Interfaces.Flange_a axis;
equation
  connect(world.frame_b, joint.frame_a);
  connect(joint.frame_b, body.frame_a);
  connect(axis, joint.axis);
end Arm;
"""


def test_an_arm_of_three_dimensional_parts_on_our_damper(library):
    """(I + m l^2) phi'' = -m g l cos(phi) - d phi' with the library's gravity, by SciPy; its slopes by differences."""
    Arm = library.component("Arm", source=ARM)
    assert [(p.name, p.potentials) for p in Arm.opened.ports] == [("axis", (("phi", "rad"),))]
    ev, d = EqnEnv(), AcausalDiagram()
    arm, damper = Arm(ev, "arm"), rotational.Damper(ev, "damper", d=0.3)
    wall, motor = (
        rotational.FixedAngle(ev, "wall"),
        rotational.Inertia(ev, "motor", J=0.05, initial_angle=0.2, initial_speed=0.0),
    )
    d.add(arm, damper, wall, motor)
    d.connect(arm.axis, damper.flange_a, motor.flange_a)
    d.connect(damper.flange_b, wall.flange)
    system = AcausalCompiler(ev, d)()
    values = {"arm.body.m": 1.5, "damper.d": 0.3}
    ts = np.array([0.5, 1.0, 2.0])
    found, slopes = run_with_slopes(system, values, ts, ["motor.phi"], ["motor.phi"])

    def phi(m, damping):
        inertia = 0.05 + 0.1 + m * 0.4**2
        swing = scipy.integrate.solve_ivp(
            lambda t, x: [x[1], (-m * 9.80665 * 0.4 * np.cos(x[0]) - damping * x[1]) / inertia], (0.0, 2.0), [0.2, 0.0],
            t_eval=ts, rtol=1e-12, atol=1e-12,
        )  # fmt: skip
        return swing.y[0]

    np.testing.assert_allclose(found["motor.phi"], phi(1.5, 0.3), atol=1e-6)
    h = 1e-5
    by_m = (phi(1.5 + h, 0.3) - phi(1.5 - h, 0.3))[-1] / (2 * h)
    by_d = (phi(1.5, 0.3 + h) - phi(1.5, 0.3 - h))[-1] / (2 * h)
    assert slopes["arm.body.m"] == pytest.approx(by_m, rel=1e-4)
    assert slopes["damper.d"] == pytest.approx(by_d, rel=1e-4)


BODIES = "Mechanics.MultiBody"


def test_a_double_pendulum_of_bodies_and_our_damper(library):
    """World, joints and bodies are components of their own; our damper acts between the links. The equations of
    Lagrange in the angles of both links, by SciPy; slopes by differences."""
    ev, d = EqnEnv(), AcausalDiagram()
    world = library.component(f"Modelica.{BODIES}.World", enableAnimation=False)(ev, "world")
    first = opened(library, f"{BODIES}.Joints.Revolute")(ev, "first", start={"phi": 0.3, "w": 0.0})
    Driven = library.component(f"Modelica.{BODIES}.Joints.Revolute", useAxisFlange=True)
    second = Driven(ev, "second", start={"phi": 0.5, "w": 0.0})
    link = opened(library, f"{BODIES}.Parts.FixedTranslation")(ev, "link", r=[0.7, 0.0, 0.0])
    Body = opened(library, f"{BODIES}.Parts.Body")
    upper = Body(ev, "upper", m=1.2, r_CM=[0.3, 0.0, 0.0], I_33=0.05)
    lower = Body(ev, "lower", m=0.8, r_CM=[0.4, 0.0, 0.0], I_33=0.02)
    damper, wall = rotational.Damper(ev, "damper", d=0.3), rotational.FixedAngle(ev, "wall")
    d.add(world, first, second, link, upper, lower, damper, wall)
    d.connect(world.frame_b, first.frame_a)
    d.connect(first.frame_b, link.frame_a, upper.frame_a)
    d.connect(link.frame_b, second.frame_a)
    d.connect(second.frame_b, lower.frame_a)
    d.connect(second.axis, damper.flange_a)
    d.connect(damper.flange_b, wall.flange)
    wanted = ["first.phi", "first.w", "second.phi", "second.w"]
    system = AcausalCompiler(ev, d, state_selection="dummy_derivatives", prefer_states=wanted)()
    assert system.states == wanted
    values = {"upper.m": 1.2, "lower.m": 0.8, "link.r[1]": 0.7, "lower.I_33": 0.02, "damper.d": 0.3}
    ts = np.array([0.4, 0.8, 1.2])
    found, slopes = run_with_slopes(system, values, ts, ["first.phi", "second.phi"], ["first.phi", "second.phi"])

    def swing(m1, m2, length, inertia, damping):
        g, turned = 9.80665, 0.3 + np.array([0.0, 0.5])
        a, b, c = 0.05 + m1 * 0.09 + m2 * length**2, m2 * length * 0.4, inertia + m2 * 0.16

        def slope(t, x):
            (one, two), (v, w) = x[:2], x[2:]
            sin, cos, torque = np.sin(two - one), np.cos(two - one), damping * (w - v)
            right = [
                torque + b * sin * w**2 - (m1 * 0.3 + m2 * length) * g * np.cos(one),
                -torque - b * sin * v**2 - m2 * 0.4 * g * np.cos(two),
            ]
            return [v, w, *np.linalg.solve([[a, b * cos], [b * cos, c]], right)]

        run = scipy.integrate.solve_ivp(slope, (0.0, 1.2), [*turned, 0.0, 0.0], t_eval=ts, rtol=1e-11, atol=1e-12)
        return np.array([run.y[0], run.y[1] - run.y[0]])

    np.testing.assert_allclose([found["first.phi"], found["second.phi"]], swing(*values.values()), atol=1e-6)
    for name, value in values.items():
        up, down = (swing(*(values | {name: value + s * 1e-5}).values())[:, -1].sum() for s in (1, -1))
        assert slopes[name] == pytest.approx((up - down) / 2e-5, rel=1e-4), name


WATER = "redeclare package Medium = Modelica.Media.Water.ConstantPropertyLiquidWater"


class Tank(Component):
    """A mass M of water of the specific enthalpy h under the pressure p + k M, with a port of the library's domain."""

    def __init__(self, ev, name, port, M, h, k):
        super().__init__(ev, name)
        a = self.port("a", port.domain)
        k, start, begin = self.parameter("k", k), self.parameter("h0", h), self.parameter("M0", M)
        mass, h = self.variable("M", start=begin, fixed=True), self.variable("h", start=start, fixed=True)
        self.add_equations(Eq(a.p, 1e5 + k * mass), Eq(a.h_outflow, h), Eq(der(mass), a.m_flow))
        self.add_equations(Eq(mass * der(h), a.m_flow * (actual_stream(a, "h_outflow") - h)))


def test_tanks_of_ours_behind_valves_of_the_library(library):
    """Three tanks of water meet at a junction behind linear valves, m = dp m_nominal/dp_nominal. The flow out of one of
    them turns. Masses and enthalpies by SciPy, with the mixture of what flows into the junction."""
    Valve = library.component("Modelica.Fluid.Valves.ValveLinear", WATER)
    ev, d = EqnEnv(), AcausalDiagram()
    opening = Constant(ev, "opening", 0.5)
    valves = [Valve(ev, f"v{k}", dp_nominal=1e4, m_flow_nominal=n) for k, n in enumerate([2.0, 1.0, 3.0])]
    given = [(30.0, 1e5, 700.0), (10.0, 3e5, 1500.0), (12.0, 2e5, 400.0)]
    tanks = [Tank(ev, f"t{k}", valves[0].port_a, *each) for k, each in enumerate(given)]
    d.add(opening, *valves, *tanks)
    for valve, tank in zip(valves, tanks, strict=True):
        d.connect(tank.a, valve.port_a)
        d.connect(opening.y, valve.opening)
    d.connect(*(valve.port_b for valve in valves))
    system = AcausalCompiler(ev, d)()
    values = {"t0.M0": 30.0, "t1.h0": 3e5, "t2.k": 400.0, "v1.m_flow_nominal": 1.0}
    ts = np.array([2.0, 10.0, 30.0])
    names = [f"t{k}.{n}" for n in "Mh" for k in range(3)]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(M0, h1, k2, nominal):
        M, h, k = np.array([M0, 10.0, 12.0]), np.array([1e5, h1, 2e5]), np.array([700.0, 1500.0, k2])
        G = 0.5 * np.array([2.0, nominal, 3.0]) / 1e4

        def slope(t, x):
            m = G * (k * x[:3] @ G / G.sum() - k * x[:3])  # into the tanks
            leaving = np.maximum(-m, 0.0)
            mixed = leaving @ x[3:] / max(leaving.sum(), 1e-300)
            return [*m, *(np.maximum(m, 0.0) * (mixed - x[3:]) / x[:3])]

        run = scipy.integrate.solve_ivp(slope, (0.0, 30.0), [*M, *h], t_eval=ts, rtol=1e-11, atol=1e-9, max_step=0.05)
        return run.y

    expected = reference(*values.values())
    np.testing.assert_allclose([found[n] for n in names], expected, rtol=1e-6)
    for name, value in values.items():
        up, down = (reference(*(values | {name: value * (1 + s * 1e-4)}).values())[:, -1].sum() for s in (1, -1))
        assert slopes[name] == pytest.approx((up - down) / (2e-4 * value), rel=1e-4), name


# Classes by their closed forms: parameters, inputs of blocks, and the value of a variable at the time t. Blocks
# have constant inputs u, u1, …; parts with two pins have 0.7 V across; heat flows from 350 K to 300 K; flanges are
# held, b at 0.3 beyond a.
V, HOT, COLD, APART = 0.7, 350.0, 300.0, 0.3
BLOCKS = {
    "Math.Gain": ({"k": 3.0}, [0.7], lambda t, u, k: k * u),
    "Math.Add": ({"k1": 2.0, "k2": -3.0}, [0.7, 0.4], lambda t, u, w, k1, k2: k1 * u + k2 * w),
    "Math.Add3": (
        {"k1": 2.0, "k2": 0.5, "k3": 1.5}, [0.7, 0.4, 0.2],
        lambda t, u, v, w, k1, k2, k3: k1 * u + k2 * v + k3 * w,
    ),
    "Math.Feedback": ({}, [0.7, 0.4], lambda t, u, w: u - w),
    "Math.Product": ({}, [0.7, 0.4], lambda t, u, w: u * w),
    "Math.Division": ({}, [0.7, 0.4], lambda t, u, w: u / w),
    "Math.Max": ({}, [0.7, 0.4], lambda t, u, w: u),
    "Math.Min": ({}, [0.7, 0.4], lambda t, u, w: w),
    "Math.Abs": ({}, [-0.7], lambda t, u: -u),
    "Math.Sqrt": ({}, [0.7], lambda t, u: jnp.sqrt(u)),
    "Math.Sin": ({}, [0.7], lambda t, u: jnp.sin(u)),
    "Math.Cos": ({}, [0.7], lambda t, u: jnp.cos(u)),
    "Math.Tan": ({}, [0.7], lambda t, u: jnp.tan(u)),
    "Math.Asin": ({}, [0.7], lambda t, u: jnp.arcsin(u)),
    "Math.Acos": ({}, [0.7], lambda t, u: jnp.arccos(u)),
    "Math.Atan": ({}, [0.7], lambda t, u: jnp.arctan(u)),
    "Math.Atan2": ({}, [0.7, 0.4], lambda t, u, w: jnp.arctan2(u, w)),
    "Math.Sinh": ({}, [0.7], lambda t, u: jnp.sinh(u)),
    "Math.Cosh": ({}, [0.7], lambda t, u: jnp.cosh(u)),
    "Math.Tanh": ({}, [0.7], lambda t, u: jnp.tanh(u)),
    "Math.Exp": ({}, [0.7], lambda t, u: jnp.exp(u)),
    "Math.Log": ({}, [0.7], lambda t, u: jnp.log(u)),
    "Math.Log10": ({}, [0.7], lambda t, u: jnp.log10(u)),
    "Math.UnitConversions.To_degC": ({}, [300.0], lambda t, u: u - 273.15),
    "Math.UnitConversions.From_degC": ({}, [20.0], lambda t, u: u + 273.15),
    "Math.UnitConversions.To_rpm": ({}, [0.7], lambda t, u: u * 30.0 / jnp.pi),
    "Math.UnitConversions.From_rpm": ({}, [0.7], lambda t, u: u * jnp.pi / 30.0),
    "Nonlinear.Limiter": ({"uMax": 0.5}, [0.7], lambda t, u, uMax: uMax),
    "Nonlinear.DeadZone": ({"uMax": 0.5}, [0.7], lambda t, u, uMax: u - uMax),
    "Continuous.Integrator": ({"k": 3.0}, [0.7], lambda t, u, k: k * u * t),
    "Continuous.FirstOrder": ({"k": 3.0, "T": 0.5}, [0.7], lambda t, u, k, T: k * u * (1.0 - jnp.exp(-t / T))),
    "Continuous.PI": ({"k": 3.0, "T": 0.5}, [0.7], lambda t, u, k, T: k * u * (1.0 + t / T)),
}  # fmt: skip
STARTS = {"Continuous.Integrator": "y", "Continuous.FirstOrder": "y", "Continuous.PI": "x"}
PINS = {
    "Basic.Resistor": ({"R": 2.0}, lambda t, R: V / R),
    "Basic.Conductor": ({"G": 0.3}, lambda t, G: G * V),
    "Basic.Inductor": ({"L": 0.4}, lambda t, L: V * t / L),
    "Ideal.IdealDiode": (
        {"Ron": 0.1, "Goff": 1e-3, "Vknee": 0.3},
        lambda t, Ron, Goff, Vknee: (V - Vknee) / Ron + Goff * Vknee,
    ),
    "Semiconductors.Diode": (
        {"Ids": 1e-6, "Vt": 0.05, "R": 50.0}, lambda t, Ids, Vt, R: Ids * (jnp.exp(V / Vt) - 1.0) + V / R
    ),
}  # fmt: skip
HEATS = {
    "ThermalConductor": ({"G": 0.3}, lambda t, G: G * (HOT - COLD)),
    "ThermalResistor": ({"R": 2.0}, lambda t, R: (HOT - COLD) / R),
}
TURNED = {
    "Spring": ({"c": 40.0, "phi_rel0": 0.1}, lambda t, c, phi_rel0: c * (APART - phi_rel0)),
    "SpringDamper": ({"c": 40.0, "phi_rel0": 0.1, "d": 2.0}, lambda t, c, phi_rel0, d: c * (APART - phi_rel0)),
}
SHIFTED = {
    "Spring": ({"c": 40.0, "s_rel0": 0.1}, lambda t, c, s_rel0: c * (APART - s_rel0)),
    "SpringDamper": ({"c": 40.0, "s_rel0": 0.1, "d": 2.0}, lambda t, c, s_rel0, d: c * (APART - s_rel0)),
}


def test_classes_by_their_closed_forms(library):
    """Forty-three classes, each with its derivatives by all of its parameters, and by time where it has a state."""
    ev, d = EqnEnv(), AcausalDiagram()
    at: dict = {}  # of a component: the variable, the parameters, the closed form

    def part(path, parameters, variable, form, **more):
        name = f"c{len(at)}"
        x = opened(library, path)(ev, name, **parameters, **more)
        d.add(x)
        at[name] = f"{name}.{variable}", parameters, form
        return x

    for path, (parameters, inputs, form) in BLOCKS.items():
        start = {"start": {STARTS[path]: 0.0}} if path in STARTS else {}
        given = functools.partial(lambda form, inputs, t, **p: form(t, *inputs, **p), form, inputs)
        x = part(f"Blocks.{path}", parameters, "y", given, **start)
        for k, value in enumerate(inputs):
            u = Constant(ev, f"{x.name}u{k}", value)
            d.add(u)
            d.connect(u.y, x[f"u{k + 1}" if len(inputs) > 1 else "u"])
    v, g = electrical.VoltageSource(ev, "v", V=V), electrical.Ground(ev, "g")
    d.add(v, g)
    pins = [
        part(f"Electrical.Analog.{path}", parameters, "i", form, **({"start": {"i": 0.0}} if "Ind" in path else {}))
        for path, (parameters, form) in PINS.items()
    ]
    d.connect(v.p, *(x.p for x in pins))
    d.connect(v.n, g.p, *(x.n for x in pins))
    hot, cold = thermal.FixedTemperature(ev, "hot", HOT), thermal.FixedTemperature(ev, "cold", COLD)
    heats = [part(f"Thermal.HeatTransfer.Components.{path}", p, "Q_flow", form) for path, (p, form) in HEATS.items()]
    d.connect(hot.heat, *(x.port_a for x in heats))
    d.connect(cold.heat, *(x.port_b for x in heats))
    a, b = rotational.FixedAngle(ev, "a", 0.0), rotational.FixedAngle(ev, "b", APART)
    turned = [part(f"Mechanics.Rotational.Components.{path}", p, "tau", form) for path, (p, form) in TURNED.items()]
    d.connect(a.flange, *(x.flange_a for x in turned))
    d.connect(b.flange, *(x.flange_b for x in turned))
    e, f = translational.FixedPosition(ev, "e", 0.0), translational.FixedPosition(ev, "f", APART)
    shifted = [part(f"Mechanics.Translational.Components.{path}", p, "f", form) for path, (p, form) in SHIFTED.items()]
    d.connect(e.flange, *(x.flange_a for x in shifted))
    d.connect(f.flange, *(x.flange_b for x in shifted))
    system = AcausalCompiler(ev, d)()
    values = {f"{name}.{p}": value for name, (_, parameters, _) in at.items() for p, value in parameters.items()}
    names, ts = [variable for variable, _, _ in at.values()], np.array([0.3, 0.8])
    found, slopes = run_with_slopes(system, values, ts, names, names)
    for name, (variable, parameters, form) in at.items():
        np.testing.assert_allclose(found[variable], [form(t, **parameters) for t in ts], rtol=1e-7, err_msg=variable)
        by_hand = jax.grad(lambda p, form=form: jnp.asarray(form(0.8, **p), float))(parameters)
        for p, expected in by_hand.items():
            assert slopes[f"{name}.{p}"] == pytest.approx(float(expected), rel=1e-5, abs=1e-9), (variable, p)
