"""Amplifiers, three-dimensional mechanisms, fluids, an actuator and a machine of the Modelica Standard Library 4.1.0.

Each stands in a plant with our own parts, beside its equations in SciPy; slopes are those of central differences.
`MODELICA_LIBRARY` names the folder of the library; without it the tests are skipped.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from device_library import standard_library
from open_classes import by_differences, opened, run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, Rotational, der, simulate
from jaxonomy_dae.library import electrical, rotational, thermal, translational
from jaxonomy_dae.library.signal import Constant, Step
from jaxonomy_dae.modelica import Library
from jaxonomy_dae.solvers import Rodas5P

pytestmark = pytest.mark.slow
BODIES = "Mechanics.MultiBody"
G = 9.80665


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def solved(slope, start, ts, method="DOP853", rtol=1e-11, atol=1e-12):
    run = scipy.integrate.solve_ivp(slope, (0.0, ts[-1]), start, method, t_eval=ts, rtol=rtol, atol=atol)
    assert run.success
    return run.y


def test_amplifiers(library):
    """An operational amplifier with its poles and its slew rate inverts 0.5 V with a gain of 10. A pnp transistor
    drives a resistor from 2 V; two equations give its voltages."""
    ev, d, analog = EqnEnv(), AcausalDiagram(), "Electrical.Analog"
    Amplifier = opened(library, f"{analog}.Basic.OpAmpDetailed")
    start = {"q_fr1": 0.0, "q_fr2": 0.0, "q_fr3": 0.0, "q_fp1": 0.0, "v_in": 0.0}
    amplifier = Amplifier(ev, "amplifier", start=start)
    q = opened(library, f"{analog}.Semiconductors.PNP")(ev, "q")
    given, plus, minus = (
        electrical.VoltageSource(ev, n, V=v) for n, v in (("u", 0.5), ("plus", 15.0), ("minus", -15.0))
    )
    r1, r2, load = (electrical.Resistor(ev, n, R=R) for n, R in (("r1", 1e3), ("r2", 1e4), ("load", 2e3)))
    rail, g = electrical.VoltageSource(ev, "rail", V=2.0), electrical.Ground(ev, "g")
    rc, rb = electrical.Resistor(ev, "rc", R=50.0), electrical.Resistor(ev, "rb", R=5e3)
    d.add(amplifier, q, given, plus, minus, r1, r2, load, rail, g, rc, rb)
    d.connect(given.p, r1.p)
    d.connect(r1.n, r2.p, amplifier.m)
    d.connect(r2.n, load.p, amplifier.outp)
    d.connect(plus.p, amplifier.p_supply)
    d.connect(minus.p, amplifier.m_supply)
    d.connect(rail.p, q.E)
    d.connect(q.C, rc.p)
    d.connect(q.B, rb.p)
    d.connect(g.p, given.n, plus.n, minus.n, amplifier.p, load.n, rail.n, rc.n, rb.n)
    system = AcausalCompiler(ev, d)()
    values = {"r2.R": 1e4, "amplifier.sr_m": 0.5e6, "amplifier.Vos": 1e-3, "q.Bf": 50.0, "rb.R": 5e3}
    ts = np.array([2e-6, 6e-6, 1.2e-5])
    names = ["load.v", "rc.v"]
    found, slopes = run_with_slopes(system, values, ts, names, names, Rodas5P())

    def amplified(R2, slew, offset):
        gain, common = 10.0 ** (106.0 / 20.0), 10.0 ** (16.0 / 20.0) / 2.0
        I2, Rcm, turn = 70e-9, 2e9, 2.0 * np.pi

        def output(v_in, v_source):  # of the resistors and the output resistance, below its limits
            vm = -offset - v_in
            return vm, (v_source / 75.0 + vm / R2) / (1.0 / 75.0 + 1.0 / R2 + 1.0 / 2e3)

        def slope(t, x):  # the gain's limits count only once its output has reached them
            v_in, one, two, three, pole, v_source = x
            vm, out = output(v_in, v_source)
            charging = I2 + vm / Rcm - v_in / 2e6 + (vm - 0.5) / 1e3 + (vm - out) / R2
            first = turn * 2e6 * (v_in - one)
            summed = gain * three + common * (vm - offset)
            return [
                charging / 1.4e-12, first, turn * 20e6 * (one + first / (turn * 5e6) - two),
                turn * 100e6 * (two - three), turn * 5.0 * (summed - pole),
                np.clip((pole - v_source) / 1.2e-6, -slew, 0.5e6),
            ]  # fmt: skip

        x = solved(slope, np.zeros(6), ts, "Radau", 1e-9, 1e-12)
        return np.array([output(v, s)[1] for v, s in zip(x[0], x[5], strict=True)])

    def driven(Bf, Rb):
        def rest(x):
            vb, vc = x
            ieb = 1e-16 * np.expm1((2.0 - vb) / 0.02585) + (2.0 - vb) * 1e-15
            icb = 1e-16 * np.expm1((vc - vb) / 0.02585) + (vc - vb) * 1e-15
            collector = icb / 0.1 + (icb - ieb) * (1.0 - (vc - vb) * 0.02)
            return [collector + vc / 50.0, vb / Rb - ieb / Bf - icb / 0.1]

        return np.full(3, scipy.optimize.fsolve(rest, [1.2, 0.6], xtol=1e-14)[1])

    def reference(R2, slew, offset, Bf, Rb):
        return np.array([amplified(R2, slew, offset), driven(Bf, Rb)])

    np.testing.assert_allclose([found[n] for n in names], reference(*values.values()), rtol=1e-6)
    for name, expected in by_differences(reference, values, 1e-3).items():
        assert slopes[name] == pytest.approx(expected, rel=1e-4), name


def turned(phi):
    """The matrix from the world into a frame that is turned about x, y and z, one after the other."""
    (a, b, c), (u, v, w) = np.cos(phi), np.sin(phi)
    return (
        np.array([[c, w, 0], [-w, c, 0], [0, 0, 1]])
        @ np.array([[b, 0, -v], [0, 1, 0], [v, 0, b]])
        @ np.array([[1, 0, 0], [0, a, u], [0, -u, a]])
    )


def speed(phi, rates):
    """The angular velocity of that frame in its own coordinates."""
    h = 1e-6
    change = (turned(phi + h * rates) - turned(phi - h * rates)) / (2 * h)
    W = -change @ turned(phi).T
    return np.array([W[2, 1], W[0, 2], W[1, 0]])


def test_a_spherical_pendulum_and_a_body_in_flight(library):
    """A body hangs from a spherical joint and is pulled by our constant force; another one flies freely, turning about
    all of its axes, and our constant force bends its path. Both by the equations of Euler."""
    ev, d = EqnEnv(), AcausalDiagram()
    world = library.component(f"Modelica.{BODIES}.World", enableAnimation=False)(ev, "world")
    Spherical = library.component(f"Modelica.{BODIES}.Joints.Spherical", enforceStates=True, useQuaternions=False)
    Free = library.component(f"Modelica.{BODIES}.Joints.FreeMotion", useQuaternions=False)
    Body, Force = opened(library, f"{BODIES}.Parts.Body"), opened(library, f"{BODIES}.Forces.WorldForce")
    angles, rates = np.array([[0.3, 0.2, -0.4], [0.5, -0.2, 0.1]]), np.array([[0.5, -0.3, 1.0], [2.0, 3.0, 1.0]])
    given = [
        {f"{n}[{i + 1}]": x[k, i] for n, x in (("phi", angles), ("phi_d", rates)) for i in range(3)} for k in (0, 1)
    ]
    flying = {f"r_rel_a[{i + 1}]": x for i, x in enumerate([0.1, 0.2, 0.3])}
    flying |= {f"v_rel_a[{i + 1}]": x for i, x in enumerate([1.0, 4.0, 0.5])}
    joint, free = Spherical(ev, "joint", start=given[0]), Free(ev, "free", start=given[1] | flying)
    bob = Body(ev, "bob", m=1.5, r_CM=[0.4, 0.0, 0.1], I_11=0.02, I_22=0.05, I_33=0.06)
    stone = Body(ev, "stone", m=0.7, r_CM=[0.0, 0.0, 0.0], I_11=0.02, I_22=0.03, I_33=0.05)
    pull, push = Force(ev, "pull"), Force(ev, "push")
    forces = np.array([[2.0, 0.0, -1.0], [0.3, 0.0, 0.2]])
    signals = [[Constant(ev, f"f{k}{i}", forces[k, i]) for i in range(3)] for k in (0, 1)]
    d.add(world, joint, free, bob, stone, pull, push, *signals[0], *signals[1])
    d.connect(world.frame_b, joint.frame_a, free.frame_a)
    d.connect(joint.frame_b, bob.frame_a, pull.frame_b)
    d.connect(free.frame_b, stone.frame_a, push.frame_b)
    for k, force in enumerate((pull, push)):
        for i in range(3):
            d.connect(signals[k][i], "y", force, f"force[{i + 1}]")
    wanted = [f"{j}.{n}[{i}]" for j in ("joint", "free") for n in ("phi", "phi_d") for i in (1, 2, 3)]
    wanted += [f"free.{n}[{i}]" for n in ("r_rel_a", "v_rel_a") for i in (1, 2, 3)]
    system = AcausalCompiler(ev, d, state_selection="dummy_derivatives", prefer_states=wanted)()
    assert sorted(system.states) == sorted(wanted)
    values = {"bob.m": 1.5, "bob.I_33": 0.06, "stone.m": 0.7, "stone.I_11": 0.02, "f10.k": 0.3}
    ts = np.array([0.2, 0.5, 0.8])
    names = [f"{b}.frame_a.R.T[{i},{j}]" for b in ("bob", "stone") for i in (1, 2) for j in (1, 2, 3)]
    names += [f"stone.frame_a.r_0[{i}]" for i in (1, 2, 3)]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(m, I33, m2, I11, push):
        def turning(inertia, arm, mass, start, rates):
            whole = inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))

            def slope(t, x):
                T, w = x[:9].reshape(3, 3), x[9:]
                torque = np.cross(arm, T @ np.array([0.0, -mass * G, 0.0]))
                W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
                return [*(-W @ T).ravel(), *np.linalg.solve(whole, torque - np.cross(w, whole @ w))]

            return solved(slope, [*turned(start).ravel(), *speed(start, rates)], ts)[:6]

        hanging = turning(np.diag([0.02, 0.05, I33]), np.array([0.4, 0.0, 0.1]), m, angles[0], rates[0])
        loose = turning(np.diag([I11, 0.03, 0.05]), np.zeros(3), m2, angles[1], rates[1])
        pushed = np.array([push, 0.0, 0.2]) / m2 - np.array([0.0, G, 0.0])
        path = np.array([[0.1, 0.2, 0.3]]).T + np.outer([1.0, 4.0, 0.5], ts) + np.outer(pushed, ts**2 / 2)
        return np.array([*hanging, *loose, *path])

    np.testing.assert_allclose([found[n] for n in names], reference(*values.values()), atol=1e-7)
    for name, expected in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(expected, rel=1e-5), name


class Motor(Component):
    """A network of the angle and the speed is the torque on a flange."""

    def __init__(self, ev: EqnEnv, name: str, network):
        super().__init__(ev, name)
        a = self.port("flange", Rotational)
        speed = self.variable("w")
        (torque,) = self.learned("law", network, [a.phi, speed])
        self.add_equations(Eq(speed, der(a.phi)), Eq(a.tau, -torque))


def test_a_double_pendulum_with_a_network_in_its_joint(library):
    """A network turns the first joint of two links. The equations of Lagrange with its weights, by SciPy; the
    derivative along a direction of its weights by differences."""
    ev, d = EqnEnv(), AcausalDiagram()
    world = library.component(f"Modelica.{BODIES}.World", enableAnimation=False)(ev, "world")
    Driven = library.component(f"Modelica.{BODIES}.Joints.Revolute", useAxisFlange=True)
    first = Driven(ev, "first", start={"phi": 0.3, "w": 0.2})
    second = opened(library, f"{BODIES}.Joints.Revolute")(ev, "second", start={"phi": 0.5, "w": 0.0})
    link = opened(library, f"{BODIES}.Parts.FixedTranslation")(ev, "link", r=[0.7, 0.0, 0.0])
    Body = opened(library, f"{BODIES}.Parts.Body")
    upper = Body(ev, "upper", m=1.2, r_CM=[0.3, 0.0, 0.0], I_33=0.05)
    lower = Body(ev, "lower", m=0.8, r_CM=[0.4, 0.0, 0.0], I_33=0.02)
    network = eqx.nn.MLP(2, 1, 6, 1, activation=jnp.tanh, key=jax.random.key(0))
    motor = Motor(ev, "motor", network)
    d.add(world, first, second, link, upper, lower, motor)
    d.connect(world.frame_b, first.frame_a)
    d.connect(first.frame_b, link.frame_a, upper.frame_a)
    d.connect(link.frame_b, second.frame_a)
    d.connect(second.frame_b, lower.frame_a)
    d.connect(first.axis, motor.flange)
    wanted = ["first.phi", "first.w", "second.phi", "second.w"]
    system = AcausalCompiler(ev, d, state_selection="dummy_derivatives", prefer_states=wanted)()
    assert system.states == wanted
    weights, rest = eqx.partition(network, eqx.is_array)
    ts = np.array([0.4, 0.8, 1.2])
    towards = jax.tree.map(lambda w: jnp.cos(jnp.arange(w.size, dtype=float)).reshape(w.shape), weights)

    def moved(step):
        return jax.tree.map(lambda w, v: w + step * v, weights, towards)

    def run(step):
        moving = eqx.tree_at(lambda s: s.neural["motor.law"], system, eqx.combine(moved(step), rest))
        solution = simulate(moving, 1.2, ts=jnp.asarray(ts), rtol=1e-9, atol=1e-11)
        found = jnp.stack([solution["first.phi"], solution["second.phi"]])
        return found[:, -1].sum(), found

    (_, found), by_weights = jax.jit(jax.value_and_grad(run, has_aux=True))(0.0)

    def swing(step):
        matrices = [(np.asarray(layer.weight), np.asarray(layer.bias)) for layer in moved(step).layers]
        a, b, c = 0.05 + 1.2 * 0.09 + 0.8 * 0.49, 0.8 * 0.7 * 0.4, 0.02 + 0.8 * 0.16

        def slope(t, x):
            (one, two), (v, w) = x[:2], x[2:]
            (A, p), (B, q) = matrices
            torque = (B @ np.tanh(A @ np.array([one, v]) + p) + q)[0]
            sin, cos = np.sin(two - one), np.cos(two - one)
            right = [
                torque + b * sin * w**2 - (1.2 * 0.3 + 0.8 * 0.7) * G * np.cos(one),
                -b * sin * v**2 - 0.8 * 0.4 * G * np.cos(two),
            ]
            return [v, w, *np.linalg.solve([[a, b * cos], [b * cos, c]], right)]

        run = solved(slope, [0.3, 0.8, 0.2, 0.2], ts)
        return np.array([run[0], run[1] - run[0]])

    np.testing.assert_allclose(found, swing(0.0), atol=1e-7)
    expected = (swing(1e-4) - swing(-1e-4))[:, -1].sum() / 2e-4
    assert float(by_weights) == pytest.approx(expected, rel=1e-5)


WATER = "redeclare package Medium = Modelica.Media.Water.ConstantPropertyLiquidWater"
DENSITY, HEAT = 995.586, 4184.0  # of this medium, in kg/m3 and J/(kg.K)
LAMINAR = "Modelica.Fluid.Pipes.BaseClasses.FlowModels.NominalLaminarFlow(dp_nominal = 2e4, m_flow_nominal = 1)"


# The front end takes no arrays of connectors with streams at the border of a class.
BASIN = """
model Basin "a tank with two ports"
  package Medium = Modelica.Media.Water.ConstantPropertyLiquidWater;
  inner Modelica.Fluid.System system;
  Modelica.Fluid.Interfaces.FluidPort_a a(redeclare package Medium = Medium), b(redeclare package Medium = Medium);
  Modelica.Fluid.Vessels.OpenTank tank(redeclare package Medium = Medium, nPorts = 2, use_portsData = false,
    height = 20, crossArea = 0.1);
equation
  connect(a, tank.ports[1]);
  connect(b, tank.ports[2]);
end Basin;
"""


PUMP = """model Lift
  package Medium = Modelica.Media.Water.ConstantPropertyLiquidWater;
  inner Modelica.Fluid.System system;
  function straight
    extends Modelica.Fluid.Machines.BaseClasses.PumpCharacteristics.baseFlow;
  algorithm
    head := 8 - 4000*V_flow;
  end straight;
  Modelica.Fluid.Interfaces.FluidPort_a a(redeclare package Medium = Medium), b(redeclare package Medium = Medium);
  Modelica.Fluid.Machines.PrescribedPump pump(redeclare package Medium = Medium, redeclare function flowCharacteristic = straight, N_nominal = 1200, rho_nominal = 995.586);
equation
  connect(a, pump.port_a);
  connect(b, pump.port_b);
end Lift;
"""  # noqa: E501


def test_tanks_with_a_pump_between_which_the_flow_turns(library):
    """A pump fills a tank that a pipe and our valve's opening join to a higher one: the flow in the pipe turns. Levels
    and temperatures by the balances of mass and energy; the pump heats what it lifts."""
    ev, d = EqnEnv(), AcausalDiagram()
    Basin = library.component("Basin", source=BASIN)
    Pipe = library.component("Modelica.Fluid.Pipes.StaticPipe", WATER, f"redeclare model FlowModel = {LAMINAR}")
    Valve = library.component("Modelica.Fluid.Valves.ValveLinear", WATER)
    Source = library.component("Modelica.Fluid.Sources.Boundary_pT", WATER, nPorts=1)
    low = Basin(ev, "low", start={"tank.level": 1.0, "tank.medium.T": 300.0})
    high = Basin(ev, "high", start={"tank.level": 5.0, "tank.medium.T": 340.0})
    nominal = {"flowModel.dp_nominal": 2e4, "flowModel.m_flow_nominal": 1.0}
    pipe = Pipe(ev, "pipe", length=1.0, diameter=0.1, **nominal)
    valve, pump = (
        Valve(ev, "valve", dp_nominal=2e4, m_flow_nominal=1.0),
        library.component("Lift", source=PUMP)(ev, "pump"),
    )
    source, opening = Source(ev, "source", p=101325.0, T=290.0), Constant(ev, "opening", 0.5)
    d.add(low, high, pump, pipe, valve, source, opening)
    d.connect(source.ports["ports[1]"], pump.a)
    d.connect(pump.b, low.a)
    d.connect(low.b, pipe.port_a)
    d.connect(pipe.port_b, valve.port_a)
    d.connect(valve.port_b, high.a)
    d.connect(opening.y, valve.opening)
    system = AcausalCompiler(ev, d)()
    values = {"opening.k": 0.5, "low.tank.crossArea": 0.1, "source.T": 290.0, "valve.m_flow_nominal": 1.0}
    ts = np.array([40.0, 150.0, 500.0])
    names = ["low.tank.level", "high.tank.level", "low.tank.medium.T", "high.tank.medium.T", "pipe.port_a.m_flow"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(opening, area, T, nominal):
        def flow(x):
            return DENSITY * G * (x[0] - x[1]) / (2e4 + 2e4 / (opening * nominal))

        def slope(t, x):
            lifted = DENSITY * (8.0 - x[0]) / 4000.0
            warm, m = T + x[0] * G / 0.8 / HEAT, flow(x)
            low = lifted * (warm - x[2]) + min(m, 0.0) * (x[2] - x[3])
            high = max(m, 0.0) * (x[2] - x[3])
            masses = DENSITY * np.array([area, 0.1]) * x[:2]
            return [(lifted - m) / DENSITY / area, m / DENSITY / 0.1, low / masses[0], high / masses[1]]

        x = solved(slope, [1.0, 5.0, 300.0, 340.0], ts, rtol=1e-13)
        return np.array([*x, flow(x)])

    expected = reference(*values.values())
    assert expected[-1, 0] < 0.0 < expected[-1, -1]
    np.testing.assert_allclose([found[n] for n in names], expected, rtol=1e-6)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-5), name


def test_a_pipe_with_heated_walls(library):
    """Water flows through a pipe of two volumes; our walls, one of which is heated, give heat to each."""
    ev, d = EqnEnv(), AcausalDiagram()
    Pipe = library.component(
        "Modelica.Fluid.Pipes.DynamicPipe", WATER, f"redeclare model FlowModel = {LAMINAR}", nNodes=2,
        use_HeatTransfer=True,
    )  # fmt: skip
    Feed = library.component("Modelica.Fluid.Sources.MassFlowSource_T", WATER, nPorts=1)
    Sink = library.component("Modelica.Fluid.Sources.Boundary_pT", WATER, nPorts=1)
    start = {"mediums[1].T": 290.0, "mediums[2].T": 295.0}
    nominal = {"flowModel.dp_nominal": 2e4, "flowModel.m_flow_nominal": 1.0}
    pipe = Pipe(ev, "pipe", length=4.0, diameter=0.05, start=start, **nominal)
    feed, sink = Feed(ev, "feed", m_flow=0.3, T=285.0), Sink(ev, "sink", p=1e5, T=300.0)
    walls = [thermal.HeatCapacitor(ev, f"wall{k}", 3e3, 300.0 + 10 * k) for k in (0, 1)]
    films = [thermal.ThermalConductor(ev, f"film{k}", G=200.0) for k in (0, 1)]
    heater = thermal.HeatFlowSource(ev, "heater")
    power = Constant(ev, "power", 5e3)
    d.add(pipe, feed, sink, *walls, *films, heater, power)
    d.connect(feed.ports["ports[1]"], pipe.port_a)
    d.connect(pipe.port_b, sink.ports["ports[1]"])
    for k in (0, 1):
        d.connect(walls[k].heat, films[k].port_a)
        d.connect(films[k].port_b, pipe.heatPorts[k])
    d.connect(heater.heat, walls[0].heat)
    d.connect(power.y, heater.Q_flow)
    system = AcausalCompiler(ev, d)()
    values = {"feed.m_flow": 0.3, "film0.G": 200.0, "power.k": 5e3, "pipe.length": 4.0}
    ts = np.array([5.0, 20.0, 60.0])
    names = ["pipe.mediums[1].T", "pipe.mediums[2].T", "wall0.T", "wall1.T"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(m, conduct, power, length):
        M = DENSITY * np.pi / 4 * 0.05**2 * length / 2

        def slope(t, x):
            into = [conduct * (x[2] - x[0]), 200.0 * (x[3] - x[1])]
            first = (m * HEAT * (285.0 - x[0]) + into[0]) / (M * HEAT)
            second = (m * HEAT * (x[0] - x[1]) + into[1]) / (M * HEAT)
            return [first, second, (power - into[0]) / 3e3, -into[1] / 3e3]

        return solved(slope, [290.0, 295.0, 300.0, 310.0], ts)

    np.testing.assert_allclose([found[n] for n in names], reference(*values.values()), rtol=1e-6)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-4), name


def test_a_magnetic_actuator(library):
    """A coil on a core with an air gap pulls our mass against our spring."""
    ev, d, tubes = EqnEnv(), AcausalDiagram(), "Magnetic.FluxTubes"
    coil = opened(library, f"{tubes}.Basic.ElectroMagneticConverter")(ev, "coil", N=200.0)
    core = opened(library, f"{tubes}.Basic.ConstantReluctance")(ev, "core", R_m=2e5)
    gap = opened(library, f"{tubes}.Shapes.Force.HollowCylinderAxialFlux")(ev, "gap", r_o=0.02, mu_r=1.0)
    zero = opened(library, f"{tubes}.Basic.Ground")(ev, "zero")
    v, r, g = electrical.VoltageSource(ev, "v", V=10.0), electrical.Resistor(ev, "r", R=4.0), electrical.Ground(ev, "g")
    mass = translational.Mass(ev, "mass", m=0.1, initial_position=0.002, initial_velocity=0.0)
    spring, wall = translational.Spring(ev, "spring", c=2e5), translational.FixedPosition(ev, "wall", 0.002)
    d.add(coil, core, gap, zero, v, r, g, mass, spring, wall)
    d.connect(v.p, r.p)
    d.connect(r.n, coil.p)
    d.connect(v.n, coil.n, g.p)
    d.connect(coil.port_p, core.port_p)
    d.connect(core.port_n, gap.port_p)
    d.connect(gap.port_n, coil.port_n, zero.port)
    d.connect(gap.flange, mass.flange, spring.flange_b)
    d.connect(spring.flange_a, wall.flange)
    starts = {"coil.Phi": 0.0}
    system = AcausalCompiler(ev, d)()
    values = {"coil.N": 200.0, "core.R_m": 2e5, "gap.r_o": 0.02, "spring.c": 2e5, "r.R": 4.0}
    ts = np.array([0.004, 0.012, 0.03])
    found, slopes = run_with_slopes(system, values, ts, ["mass.s", "r.i"], ["mass.s", "r.i"], initial=starts)

    def reference(N, Rm, radius, c, R):
        def tension(flux, s):
            across = flux * s / (1.25663706212e-6 * np.pi * radius**2)
            return across, across + flux * Rm

        def slope(t, x):
            flux, s, speed = x
            across, whole = tension(flux, s)
            force = 0.5 * across**2 * 1.25663706212e-6 * np.pi * radius**2 / s**2
            return [(10.0 - R * whole / N) / N, speed, (-force - c * (s - 0.002)) / 0.1]

        x = solved(slope, [0.0, 0.002, 0.0], ts)
        return np.array([x[1], tension(x[0], x[1])[1] / N])

    np.testing.assert_allclose([found[n] for n in ("mass.s", "r.i")], reference(*values.values()), rtol=1e-6)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-4), name


def test_an_induction_machine_on_an_inverter(library):
    """Three legs that switch six times a period feed a machine with a squirrel cage, which turns our load. Space
    phasors of stator and rotor in the stator's frame, by SciPy from switch to switch."""
    ev, d = EqnEnv(), AcausalDiagram()
    Machine = library.component("Modelica.Electrical.Machines.BasicMachines.InductionMachines.IM_SquirrelCage", p=2)
    given = {"Rs": 0.5, "Rr": 0.4, "Lm": 0.06, "Lssigma": 2e-3, "Lrsigma": 2e-3, "Jr": 0.02, "fsNominal": 50.0}
    given |= dict.fromkeys(("TsRef", "TrRef", "TsOperational", "TrOperational"), 293.15)
    given |= dict.fromkeys(("alpha20s", "alpha20r"), 0.0)
    given |= {"statorCoreParameters.VRef": 100.0, "strayLoadParameters.IRef": 100.0}
    start = dict.fromkeys([f"{n}[{k}]" for n in ("lssigma.i_", "airGap.i_rr") for k in (1, 2)], 0.0)
    machine = Machine(ev, "machine", start=start, **given)
    legs = [
        electrical.PulseVoltage(ev, f"leg{k}", height=200.0, period=0.02, start_time=0.02 * (k / 3 - 1), offset=-100.0)
        for k in range(3)
    ]
    g, load = electrical.Ground(ev, "g"), rotational.Inertia(ev, "load", J=0.1, initial_angle=0.0, initial_speed=0.0)
    damper, wall = rotational.Damper(ev, "damper", d=0.02), rotational.FixedAngle(ev, "wall")
    d.add(machine, *legs, g, load, damper, wall)
    for k in range(3):
        d.connect(legs[k].p, machine.plug_sp[k])
    d.connect(g.p, *(leg.n for leg in legs))
    d.connect(*machine.plug_sn)
    d.connect(machine.flange, load.flange_a, damper.flange_a)
    d.connect(damper.flange_b, wall.flange)
    system = AcausalCompiler(ev, d)()
    values = {"machine.Lm": 0.06, "machine.Rr": 0.4, "load.J": 0.1, "leg0.height": 200.0}
    ts = np.array([0.015, 0.04])
    names = ["load.w", "machine.plug_sp.pin[1].i"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(Lm, Rr, J, height):
        inductance = np.array([[2e-3 + Lm, Lm], [Lm, 2e-3 + Lm]])
        phasor = 2 / 3 * np.exp(2j * np.pi * np.arange(3) / 3)

        def slope(t, x, volts):
            i_s, i_r = x[0] + 1j * x[1], x[2] + 1j * x[3]
            w = x[4]
            flux = Lm * (i_s + i_r)
            turning = 2j * w * (flux + 2e-3 * i_r)
            change = np.linalg.solve(inductance, [volts - 0.5 * i_s, turning - Rr * i_r])
            torque = 3 / 2 * 2 * (i_s.imag * flux.real - i_s.real * flux.imag)
            return [change[0].real, change[0].imag, change[1].real, change[1].imag, (torque - 0.02 * w) / (0.02 + J)]

        x, t, found = np.zeros(5), 0.0, []
        stops = sorted({*ts, *(0.02 / 6 * np.arange(1, 13))})
        for stop in stops:
            middle = (t + stop) / 2
            on = [(middle / 0.02 - k / 3) % 1.0 < 0.5 for k in range(3)]
            volts = phasor @ (np.array([height, 200.0, 200.0]) * on - 100.0)
            options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11, "args": (volts,)}
            x, t = scipy.integrate.solve_ivp(slope, (t, stop), x, **options).y[:, -1], stop
            if stop in ts:
                found.append([x[4], x[0]])
        return np.array(found).T

    np.testing.assert_allclose([found[n] for n in names], reference(*values.values()), rtol=1e-6, atol=1e-6)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-4), name


def test_a_gear_with_losses(library):
    """A gear that loses a tenth of what drives it, and a fifth where the load drives: our torque turns its sign."""
    ev, d = EqnEnv(), AcausalDiagram()
    Gear = library.component("Modelica.Mechanics.Rotational.Components.LossyGear", "lossTable = [0, 0.9, 0.8, 0, 0]")
    gear = Gear(ev, "gear", ratio=2.0)
    motor = rotational.Inertia(ev, "motor", J=0.5, initial_angle=0.0, initial_speed=4.0)
    load, torque = rotational.Inertia(ev, "load", J=3.0), rotational.Torque(ev, "torque")
    wanted = Step(ev, "wanted", height=-1.8, start_time=1.0, offset=1.2)
    d.add(gear, motor, load, torque, wanted)
    d.connect(wanted.y, torque.tau)
    d.connect(torque.flange, motor.flange_a, gear.flange_a)
    d.connect(gear.flange_b, load.flange_a)
    system = AcausalCompiler(ev, d)()
    values = {"gear.ratio": 2.0, "motor.J": 0.5, "load.J": 3.0, "wanted.height": -1.8, "wanted.start_time": 1.0}
    ts = np.array([0.5, 1.5, 3.0])
    found, slopes = run_with_slopes(system, values, ts, ["motor.w"], ["motor.w"])

    def reference(ratio, J, load, height, turns):
        driven = 1.2 / (J + load / (0.9 * ratio**2))
        driving = (1.2 + height) / (J + 0.8 * load / ratio**2)
        return 4.0 + driven * np.minimum(ts, turns) + driving * np.maximum(ts - turns, 0.0)

    np.testing.assert_allclose(found["motor.w"], reference(*values.values()), rtol=1e-7)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-5), name
