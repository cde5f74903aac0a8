"""What a user can write, checked on models with closed forms: circuits, oscillators, hierarchy, inputs, outputs."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from problems import compiled, damped_oscillation, drag_on, mlp, pendulum, rc_circuit, rc_voltage
from shared_models import Moved, Squares
from sympy import Eq, sin, sqrt

from jaxonomy_dae import Component, Electrical, EqnEnv, Translational, der, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Rod, Spring

TS = jnp.linspace(0.0, 2.0, 9)
T = np.asarray(TS)
SOLVE = dict(rtol=1e-9, atol=1e-11)
CLOSE = dict(rtol=0, atol=1e-7)  # a hundred times the tolerance of the solves


def single(component):
    return compiled(component)


# --- circuits ----------------------------------------------------------------------------------------------------

Model = tuple[list[Component], list[tuple]]  # components and connections


def rc(ev) -> Model:
    source, r = VoltageSource(ev, "source", 3.0), Resistor(ev, "r", 2.0)
    c, ground = Capacitor(ev, "c", 0.5, initial_voltage=-1.0), Ground(ev, "ground")
    return [source, r, c, ground], [(source.p, r.p), (r.n, c.p), (c.n, source.n, ground.p)]


@pytest.mark.slow
def test_rc(solution):
    v = rc_voltage(T, v0=-1.0)
    np.testing.assert_allclose(solution["rc.c.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["rc.r.v"], 3.0 - v, **CLOSE)
    np.testing.assert_allclose(solution["rc.c.i"], (3.0 - v) / 2.0, **CLOSE)
    # Positive into a pin: the source delivers what the resistor takes.
    np.testing.assert_allclose(solution["rc.source.i"], -solution["rc.r.i"], **CLOSE)
    np.testing.assert_allclose(solution["rc.r.p.i"], -solution["rc.r.n.i"], **CLOSE)
    np.testing.assert_allclose(solution["rc.ground.p.v"], 0.0, **CLOSE)
    np.testing.assert_allclose(solution["rc.r.n.v"], v, **CLOSE)


def rlc(ev) -> Model:
    source, r, c, ground = VoltageSource(ev, "s", 2.0), Resistor(ev, "r", 0.6), Capacitor(ev, "c", 0.25, 0.0), Ground(
        ev, "g"
    )  # fmt: skip
    coil = Inductor(ev, "l", 0.5, initial_current=0.0)
    return [source, r, coil, c, ground], [(source.p, r.p), (r.n, coil.p), (coil.n, c.p), (c.n, source.n, ground.p)]


def test_rlc(solution):
    R, L, C, V = 0.6, 0.5, 0.25, 2.0
    assert sorted(alone(rlc).states) == ["c.v", "l.i"]
    a = R / (2 * L)
    w = np.sqrt(1 / (L * C) - a * a)
    np.testing.assert_allclose(solution["rlc.l.i"], V / (w * L) * np.exp(-a * T) * np.sin(w * T), **CLOSE)
    np.testing.assert_allclose(
        solution["rlc.c.v"], V * (1 - np.exp(-a * T) * (np.cos(w * T) + a / w * np.sin(w * T))), **CLOSE
    )


@pytest.mark.slow
def test_voltage_divider_is_purely_algebraic():
    ev = EqnEnv()
    source, top, bottom, ground = VoltageSource(ev, "s", 6.0), Resistor(ev, "a", 1.0), Resistor(ev, "b", 2.0), Ground(
        ev, "g"
    )  # fmt: skip
    system = compiled(
        source, top, bottom, ground, connect=[(source.p, top.p), (top.n, bottom.p), (bottom.n, source.n, ground.p)]
    )
    assert system.states == [] and system.initialize().shape == (0,)
    assert float(system.observe("b.v", 0.0, system.initialize())) == pytest.approx(4.0)
    solution = simulate(system, 2.0, ts=TS)
    np.testing.assert_allclose(solution["b.v"], np.full(9, 4.0), rtol=1e-12)  # a few roundings
    np.testing.assert_allclose(solution["s.i"], np.full(9, -2.0), rtol=1e-12)


def parallel_capacitors(ev) -> Model:
    source, r, ground = VoltageSource(ev, "s", 3.0), Resistor(ev, "r", 2.0), Ground(ev, "g")
    c1, c2 = Capacitor(ev, "c1", 0.1, initial_voltage=0.0), Capacitor(ev, "c2", 0.4)
    return [source, r, c1, c2, ground], [(source.p, r.p), (r.n, c1.p, c2.p), (c1.n, c2.n, source.n, ground.p)]


def test_parallel_capacitors_share_one_state(solution):
    assert alone(parallel_capacitors).states == ["c1.v"]  # the one with a fixed start
    v = rc_voltage(T)  # R = 2, C = 0.5 in all
    np.testing.assert_allclose(solution["parallel_capacitors.c2.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["parallel_capacitors.c1.i"], 0.2 * (3.0 - v) / 2.0, **CLOSE)
    np.testing.assert_allclose(solution["parallel_capacitors.c2.i"], 0.8 * (3.0 - v) / 2.0, **CLOSE)


def capacitor_loop(ev) -> Model:
    source, ground = VoltageSource(ev, "s", 3.0), Ground(ev, "g")
    c1, c2, r = Capacitor(ev, "c1", 1.0, initial_voltage=1.0), Capacitor(ev, "c2", 2.0), Resistor(ev, "r", 1.0)
    return [source, c1, c2, r, ground], [(source.p, c1.p), (c1.n, c2.p, r.p), (c2.n, r.n, source.n, ground.p)]


def test_capacitor_loop_through_a_source_has_index_two(solution):
    """Two capacitors in series across a source: constant charge ratio, the source's current is an impulse at 0 only."""
    assert alone(capacitor_loop).report.index == 2
    # The node between has v' = −v/(R(C1 + C2)), v(0) = 2.
    np.testing.assert_allclose(solution["capacitor_loop.c2.v"], 2.0 * np.exp(-T / 3.0), **CLOSE)
    np.testing.assert_allclose(solution["capacitor_loop.c1.v"], 3.0 - 2.0 * np.exp(-T / 3.0), **CLOSE)
    np.testing.assert_allclose(solution["capacitor_loop.c1.i"], 2.0 / 3.0 * np.exp(-T / 3.0), **CLOSE)


def inductor_cut_set(ev) -> Model:
    l1, l2 = Inductor(ev, "l1", L=1.0, initial_current=1.0), Inductor(ev, "l2", L=2.0)
    r, ground = Resistor(ev, "r", R=3.0), Ground(ev, "g")
    return [r, l1, l2, ground], [(r.p, l1.p), (l1.n, l2.p), (r.n, l2.n, ground.p)]


def test_inductor_cut_set(solution):
    np.testing.assert_allclose(solution["inductor_cut_set.l2.i"], np.exp(-T), **CLOSE)  # exp(−R t/(L1 + L2))


def ladder(ev, n=50) -> Model:
    source, ground = VoltageSource(ev, "source"), Ground(ev, "ground")
    parts, connect, before = [source, ground], [(source.n, ground.p)], source.p
    for k in range(n):
        r, c = Resistor(ev, f"r{k}"), Capacitor(ev, f"c{k}", initial_voltage=0.0)
        parts += [r, c]
        connect += [(before, r.p), (r.n, c.p), (c.n, ground.p)]
        before = r.n
    return parts, connect


def test_ladder_against_scipy(solution):
    n = 50
    main = np.full(n, -2.0)
    main[-1] = -1.0
    a = np.diag(main) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    b = np.eye(n)[0]
    reference = scipy.integrate.solve_ivp(
        lambda t, v: a @ v + b, (0, 2), np.zeros(n), method="DOP853", rtol=1e-12, atol=1e-14
    ).y[:, -1]
    found = solution[[f"ladder.c{k}.v" for k in range(n)]][-1]
    np.testing.assert_allclose(found, reference, **CLOSE)


# --- mechanics ---------------------------------------------------------------------------------------------------


def oscillator(ev) -> Model:
    mass = Mass(ev, "mass", 2.0, initial_position=0.7, initial_velocity=-0.4)
    spring, damper, wall = Spring(ev, "spring", 5.0), Damper(ev, "damper", 0.6), FixedPosition(ev, "wall")
    connect = [(wall.flange, spring.flange_a, damper.flange_a), (mass.flange, spring.flange_b, damper.flange_b)]
    return [wall, spring, damper, mass], connect


def test_mass_spring_damper(solution):
    x, v = damped_oscillation(T)
    np.testing.assert_allclose(solution["oscillator.mass.s"], x, **CLOSE)
    np.testing.assert_allclose(solution["oscillator.mass.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["oscillator.spring.f"], 5.0 * x, **CLOSE)
    np.testing.assert_allclose(solution["oscillator.damper.f"], 0.6 * v, **CLOSE)
    # Forces are positive into a component: the wall feels the pull of both.
    np.testing.assert_allclose(solution["oscillator.wall.flange.f"], 5.0 * x + 0.6 * v, **CLOSE)


def joined_masses(ev) -> Model:
    a, b = Mass(ev, "a", 1.0, initial_position=0.5, initial_velocity=0.0), Mass(ev, "b", 3.0)
    spring, wall, rod = Spring(ev, "spring", 4.0, length=0.2), FixedPosition(ev, "w", position=-0.2), Rod(ev, "r", 0.3)
    return [wall, spring, a, rod, b], [
        (wall.flange, spring.flange_a), (spring.flange_b, a.flange, rod.flange_a), (rod.flange_b, b.flange)
    ]  # fmt: skip


def test_two_masses_rigidly_connected(solution):
    system = alone(joined_masses)
    assert sorted(system.states) == ["a.s", "a.v"] and system.report.index == 3
    x = 0.5 * np.cos(T)  # K/(M1 + M2) = 1, at rest at x = 0
    np.testing.assert_allclose(solution["joined_masses.a.s"], x, **CLOSE)
    np.testing.assert_allclose(solution["joined_masses.b.s"], x + 0.3, **CLOSE)
    np.testing.assert_allclose(solution["joined_masses.b.v"], -0.5 * np.sin(T), **CLOSE)
    np.testing.assert_allclose(solution["joined_masses.r.f"], 3.0 * x, **CLOSE)  # what accelerates b
    np.testing.assert_allclose(solution["joined_masses.spring.f"], 4.0 * x, **CLOSE)


class Gear(Component):
    """Inertias of 2 and 3 on a rigid gear phi1 = 10·phi2; a torque of 1 drives the first."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        phi1, w1 = self.variable("phi1", start=0.0, fixed=True), self.variable("w1", start=0.0, fixed=True)
        phi2, w2, tau = self.variable("phi2"), self.variable("w2"), self.variable("tau")
        self.add_equations(Eq(der(phi1), w1), Eq(der(phi2), w2), Eq(2 * der(w1), 1 - tau), Eq(3 * der(w2), 10 * tau))
        self.add_equations(Eq(phi1, 10 * phi2))


def test_two_inertias_on_a_gear(solution):
    """The reflected inertia 2 + 3/100, driven by 1."""
    np.testing.assert_allclose(solution["gear.phi1"], T**2 / (2 * 2.03), **CLOSE)


# --- hierarchy ---------------------------------------------------------------------------------------------------


class Parallel(Component):
    """Two resistors side by side between its own pins, connected inside."""

    def __init__(self, ev, name, R1=2.0, R2=3.0):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        r1, r2 = self.add(Resistor(ev, "r1", R1)), self.add(Resistor(ev, "r2", R2))
        self.connect(p, r1.p, r2.p)
        self.connect(r1, "n", r2, "n")
        self.connect(n, r2.n)
        power = self.output("power", r1.v * r1.i + r2.v * r2.i, unit="W")
        self.output("relative", power / (p.v * p.i))  # 1: what flows in at p is what the children take


class Ladder(Component):
    """A resistor in series with two `Parallel`s in series: three levels."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        r = self.add(Resistor(ev, "r", 0.6))
        first, second = self.add(Parallel(ev, "first")), self.add(Parallel(ev, "second", R1=1.0, R2=1.0))
        self.connect(p, r.p)
        self.connect(r.n, first.p)
        self.connect(first.n, second.p)
        self.connect(second.n, n)


def hierarchy(ev) -> Model:
    source, ladder, ground = VoltageSource(ev, "s", 4.6), Ladder(ev, "x"), Ground(ev, "g")
    return [source, ladder, ground], [(source.p, ladder.p), (ladder.n, source.n, ground.p)]


@pytest.mark.slow
def test_hierarchy_and_signs(solution):
    names = [
        "x.p.i", "x.n.i", "s.i", "x.r.v", "x.first.p.i", "x.first.n.i", "x.first.r1.i", "x.first.r2.i", "x.second.r2.i",
        "x.second.p.v", "x.first.power", "x.first.relative",
    ]  # fmt: skip
    found = solution[[f"hierarchy.{name}" for name in names]][0]
    # 0.6 + 2∥3 + 1∥1 = 2.3 Ω: 2 A.
    expected = [2, -2, -2, 1.2, 2, -2, 1.2, 0.8, 1.0, 1.0, 2.4 * 2, 2.4 * 2 / (3.4 * 2)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)  # rounding


class Unit(Component):
    """A component that uses its own port both in equations and in an inner connection."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        flange = self.port("flange", Translational)
        mass = self.add(Mass(ev, "mass", 2.0, initial_position=0.3, initial_velocity=0.0))
        self.connect(flange, mass.flange)
        self.output("double", 2 * flange.s)
        self.output("pull", flange.f)


def own_ports(ev) -> Model:
    unit, spring, wall = Unit(ev, "u"), Spring(ev, "s", 8.0), FixedPosition(ev, "w")
    return [unit, spring, wall], [(wall.flange, spring.flange_a), (spring.flange_b, unit.flange)]


@pytest.mark.slow
def test_own_ports_in_equations(solution):
    # Force into the unit: −K·x = −2.4; acceleration −1.2.
    names = ["u.double", "u.pull", "u.mass.flange.f", "s.f", "w.flange.f"]
    found = solution[[f"own_ports.{name}" for name in names]][0]
    np.testing.assert_allclose(found, [0.6, -2.4, -2.4, 2.4, 2.4], rtol=1e-12)
    assert float(solution["der(own_ports.u.mass.v)"][0]) == pytest.approx(-1.2)


def loose(ev) -> Model:
    return [Mass(ev, "m", 1.0, initial_position=0.0, initial_velocity=2.0)], []


def test_loose_ports_carry_nothing(solution):
    assert (solution["loose.m.flange.f"] == 0.0).all()


# --- inputs ------------------------------------------------------------------------------------------------------


class Follower(Component):
    """dx/dt = u − x; y = u·gain."""

    def __init__(self, ev, name, default=None):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        u = self.input("u", default=default, unit="V")
        gain = self.parameter("gain", 2.0)
        self.add_equations(Eq(der(x), u - x))
        self.output("y", gain * u)


SAMPLES = jnp.array([0.0, 1.0, 2.0])
INPUTS = {
    "number.u": 2.0,
    "function.u": lambda t: jnp.sin(t),
    "ramp.u": diffrax.LinearInterpolation(SAMPLES, 3.0 * SAMPLES).evaluate,
    "moved.u": lambda t: jnp.sin(3 * t) + t**2,
    "passed.u": lambda t: 3 * t,
}


@pytest.mark.parametrize(
    "name, u, x",
    [
        ("number", 2.0 * np.ones(9), 2.0 * (1 - np.exp(-T))),
        ("function", np.sin(T), (np.sin(T) - np.cos(T) + np.exp(-T)) / 2),
        ("ramp", 3.0 * T, 3.0 * (T - 1 + np.exp(-T))),
        ("default", 0.5 * np.ones(9), 0.5 * (1 - np.exp(-T))),
    ],
)
def test_inputs(system, solution, name, u, x):
    assert f"{name}.u" in system.inputs
    np.testing.assert_allclose(solution[f"{name}.x"], x, **CLOSE)
    np.testing.assert_allclose(solution[f"{name}.u"], u, **CLOSE)
    np.testing.assert_allclose(solution[f"{name}.y"], 2.0 * u, **CLOSE)


def test_inputs_are_differentiated(solution):
    assert single(Moved(EqnEnv(), "m")).states == []
    found = solution[["moved.x", "moved.v", "moved.f"]]
    expected = [np.sin(3 * T) + T**2, 3 * np.cos(3 * T) + 2 * T, 2 * (2 - 9 * np.sin(3 * T))]
    np.testing.assert_allclose(found, np.stack(expected, 1), rtol=1e-12, atol=1e-12)  # rounding


class Passed(Component):
    """An input that stands in an alias only, and one that stands nowhere."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, _ = self.input("u"), self.input("idle", default=4.0)
        self.add_equations(Eq(self.variable("y"), -u))


def test_inputs_that_nothing_needs_can_be_read(solution):
    found = solution[["passed.y", "passed.u", "passed.idle"]]
    np.testing.assert_allclose(found, np.stack([-3 * T, 3 * T, np.full(9, 4.0)], 1))


class Sensor(Component):
    """z = dy/dt for y = x², a derivative that nothing else needs; q = 7 + x³ stands beside it."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0.5, fixed=True)
        y, z, a, q = (self.variable(n) for n in ("y", "z", "a", "q"))
        self.add_equations(Eq(der(x), -x), Eq(y, x**2), Eq(z, der(y)), Eq(a, der(der(x))), Eq(q, 7 + x**3))


def test_derivatives_that_only_an_output_reads(solution):
    found = solution[[f"sensor.{n}" for n in ("z", "a", "q", "y")]][0]
    np.testing.assert_allclose(found, [-0.5, 0.5, 7.125, 0.25], rtol=1e-12)  # rounding


# --- equations ---------------------------------------------------------------------------------------------------


class Source(Component):
    """x' = sin(t)·environment constant."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0, fixed=True)
        self.add_equations(Eq(der(x), ev.constants["gain"] * sin(ev.t)))


class Harmonic(Component):
    """der(der(x)) = −ω²·x, the velocity nowhere named."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        w = self.parameter("w", 3.0)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(der(der(x)) + w**2 * x)  # an expression that is zero


class Draining(Component):
    """A·dh/dt = −k·√h (Torricelli): √h falls linearly."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        A, k = self.parameter("A", 2.0), self.parameter("k", 0.8)
        h = self.variable("h", start=4.0, fixed=True)
        q = self.output("q", k * sqrt(h))
        self.add_equations(Eq(A * der(h), -q))


# --- the plant: all of them beside each other --------------------------------------------------------------------

MODELS = (
    rc, rlc, parallel_capacitors, capacitor_loop, inductor_cut_set, ladder, oscillator, joined_masses, hierarchy,
    own_ports, loose,
)  # fmt: skip


class Beside(Component):
    """A model as one component."""

    def __init__(self, ev, name, parts, connect):
        super().__init__(ev, name)
        for part in parts:
            self.add(part)
        for ends in connect:
            self.connect(*ends)


def alone(model):
    """A model compiled by itself."""
    parts, connect = model(EqnEnv())
    return compiled(*parts, connect=connect)


@pytest.fixture(scope="module")
def system():
    """Independent models in one, so that one program runs them all."""
    ev = EqnEnv(gain=1.5)
    models = [Beside(ev, model.__name__, *model(ev)) for model in MODELS]
    driven = [Follower(ev, name) for name in ("number", "function", "ramp")]
    others = [Gear(ev, "gear"), Moved(ev, "moved"), Passed(ev, "passed"), Sensor(ev, "sensor")]
    equations = [Source(ev, "source"), Squares(ev, "squares"), Harmonic(ev, "osc"), Draining(ev, "tank")]
    return compiled(*models, *driven, Follower(ev, "default", 0.5), *others, *equations)


@pytest.fixture(scope="module")
def solution(system):
    return simulate(system, 2.0, ts=TS, inputs=INPUTS, initial={"der(osc.x)": -2.0}, **SOLVE)


@pytest.mark.parametrize(
    "name, expected",
    [
        pytest.param("source.x", 1.5 * (1 - np.cos(T)), id="time and environment constant"),
        pytest.param("squares.x", 2 * np.exp(-T), id="der of a square"),
        pytest.param("squares.y", 3 * np.exp(T), id="der of a product"),
        pytest.param("squares.z", 1 - T / 4, id="der of parameter and time"),
        pytest.param("osc.x", np.cos(3 * T) - 2 / 3 * np.sin(3 * T), id="second order"),
        pytest.param("der(osc.x)", -3 * np.sin(3 * T) - 2 * np.cos(3 * T), id="its velocity"),
        pytest.param("der(der(osc.x))", -9 * np.cos(3 * T) + 6 * np.sin(3 * T), id="its acceleration"),
        pytest.param("tank.h", (2 - 0.2 * T) ** 2, id="root"),
        pytest.param("tank.q", 0.8 * (2 - 0.2 * T), id="output"),
    ],
)
def test_equations(solution, name, expected):
    np.testing.assert_allclose(solution[name], expected, **CLOSE)


def test_names(system, solution):
    assert {"osc.x", "tank.h", "tank.q", "source.x"} <= set(system.variables)
    assert {"osc.x", "der(osc.x)", "tank.h", "source.x", "squares.x"} <= set(system.states)
    assert "tank.q" in system.algebraics and "tank.h" not in system.algebraics
    assert list(solution) == system.variables


# --- parameters --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_partition_and_combine_give_the_system_back():
    system = pendulum(drag_on("vx", "vy", network=mlp(2, 2)))
    trainable, frozen = system.partition("pend.m", "drag")
    assert trainable.parameters.free.shape == (1,) and trainable.parameters.values is None
    weights = jax.tree.leaves(trainable.neural)
    assert len(weights) == 4  # two layers, the first parameter apart
    assert not jax.tree.leaves(eqx.filter(frozen.neural, eqx.is_array))
    joined = eqx.combine(trainable, frozen)
    assert eqx.tree_equal(joined.merged(), system)
    assert float(joined.parameters["pend.m"]) == 1.0
    x = jnp.array([0.36, 0.9, -0.93, 0.35])
    np.testing.assert_array_equal(joined.vector_field(0.0, x), system.vector_field(0.0, x))
    moved = eqx.tree_at(lambda s: s.parameters.free, joined, jnp.array([2.5]))
    assert float(moved.merged().parameters["pend.m"]) == 2.5
    assert float(moved.parameters["pend.L"]) == 1.0
    heavier = system.with_parameters({"pend.m": 2.5})
    np.testing.assert_array_equal(moved.vector_field(0.0, x), heavier.vector_field(0.0, x))
    only_parameter, rest = system.partition("pend.L")
    assert not jax.tree.leaves(only_parameter.neural) and jax.tree.leaves(rest.neural)


def test_parameters_are_one_array_with_names():
    system = rc_circuit()
    names = ["source.V", "r.R", "c.C", "c.initial_voltage"]
    assert list(system.parameters) == names == system.parameters.names
    np.testing.assert_array_equal(system.parameters.array, [3.0, 2.0, 0.5, 0.0])
    changed = system.with_parameters({"r.R": 5, "c.C": jnp.array(0.1)})
    assert dict(changed.parameters.items())["r.R"] == 5.0
    assert float(system.parameters["r.R"]) == 2.0  # the old one is as it was
