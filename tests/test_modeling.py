"""What a user can write, checked on models with closed forms: circuits, oscillators, hierarchy, inputs, outputs."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, damped_oscillation, drag_on, mlp, oscillator, pendulum, rc_circuit, rc_voltage
from shared_models import Moved, Squares
from sympy import Eq, sin, sqrt

from jaxonomy_dae import Component, Electrical, EqnEnv, Translational, der, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.translational import FixedPosition, Mass, Rod, Spring

TS = jnp.linspace(0.0, 2.0, 9)
T = np.asarray(TS)
SOLVE = dict(rtol=1e-9, atol=1e-11)
CLOSE = dict(rtol=0, atol=1e-7)  # a hundred times the tolerance of the solves


@pytest.fixture
def ev():
    return EqnEnv()


def single(component):
    return compiled(component)


# --- circuits ----------------------------------------------------------------------------------------------------


def test_rc():
    solution = simulate(rc_circuit(v0=-1.0), 2.0, ts=TS, **SOLVE)
    v = rc_voltage(T, v0=-1.0)
    np.testing.assert_allclose(solution["c.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["r.v"], 3.0 - v, **CLOSE)
    np.testing.assert_allclose(solution["c.i"], (3.0 - v) / 2.0, **CLOSE)
    # Positive into a pin: the source delivers what the resistor takes.
    np.testing.assert_allclose(solution["source.i"], -solution["r.i"], **CLOSE)
    np.testing.assert_allclose(solution["r.p.i"], -solution["r.n.i"], **CLOSE)
    np.testing.assert_allclose(solution["ground.p.v"], 0.0, **CLOSE)
    np.testing.assert_allclose(solution["r.n.v"], v, **CLOSE)


def test_rlc(ev):
    R, L, C, V = 0.6, 0.5, 0.25, 2.0
    source, r, c, ground = VoltageSource(ev, "s", V), Resistor(ev, "r", R), Capacitor(ev, "c", C, 0.0), Ground(ev, "g")
    coil = Inductor(ev, "l", L, initial_current=0.0)
    system = compiled(
        source, r, coil, c, ground, connect=[(source.p, r.p), (r.n, coil.p), (coil.n, c.p), (c.n, source.n, ground.p)]
    )
    assert sorted(system.states) == ["c.v", "l.i"]
    solution = simulate(system, 2.0, ts=TS, **SOLVE)
    a = R / (2 * L)
    w = np.sqrt(1 / (L * C) - a * a)
    np.testing.assert_allclose(solution["l.i"], V / (w * L) * np.exp(-a * T) * np.sin(w * T), **CLOSE)
    np.testing.assert_allclose(
        solution["c.v"], V * (1 - np.exp(-a * T) * (np.cos(w * T) + a / w * np.sin(w * T))), **CLOSE
    )


def test_voltage_divider_is_purely_algebraic(ev):
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


def test_parallel_capacitors_share_one_state(ev):
    source, r, ground = VoltageSource(ev, "s", 3.0), Resistor(ev, "r", 2.0), Ground(ev, "g")
    c1, c2 = Capacitor(ev, "c1", 0.1, initial_voltage=0.0), Capacitor(ev, "c2", 0.4)
    system = compiled(
        source, r, c1, c2, ground, connect=[(source.p, r.p), (r.n, c1.p, c2.p), (c1.n, c2.n, source.n, ground.p)]
    )
    assert system.states == ["c1.v"]  # the one with a fixed start
    solution = simulate(system, 2.0, ts=TS, **SOLVE)
    v = rc_voltage(T)  # R = 2, C = 0.5 in all
    np.testing.assert_allclose(solution["c2.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["c1.i"], 0.2 * (3.0 - v) / 2.0, **CLOSE)
    np.testing.assert_allclose(solution["c2.i"], 0.8 * (3.0 - v) / 2.0, **CLOSE)


def test_capacitor_loop_through_a_source_has_index_two(ev):
    """Two capacitors in series across a source: constant charge ratio, the source's current is an impulse at 0 only."""
    source, ground = VoltageSource(ev, "s", 3.0), Ground(ev, "g")
    c1, c2, r = Capacitor(ev, "c1", 1.0, initial_voltage=1.0), Capacitor(ev, "c2", 2.0), Resistor(ev, "r", 1.0)
    system = compiled(
        source, c1, c2, r, ground, connect=[(source.p, c1.p), (c1.n, c2.p, r.p), (c2.n, r.n, source.n, ground.p)]
    )
    assert system.report.index == 2
    solution = simulate(system, 2.0, ts=TS, **SOLVE)
    # The node between has v' = −v/(R(C1 + C2)), v(0) = 2.
    np.testing.assert_allclose(solution["c2.v"], 2.0 * np.exp(-T / 3.0), **CLOSE)
    np.testing.assert_allclose(solution["c1.v"], 3.0 - 2.0 * np.exp(-T / 3.0), **CLOSE)
    np.testing.assert_allclose(solution["c1.i"], 2.0 / 3.0 * np.exp(-T / 3.0), **CLOSE)


# --- mechanics ---------------------------------------------------------------------------------------------------


def test_mass_spring_damper():
    solution = simulate(oscillator(), 2.0, ts=TS, **SOLVE)
    x, v = damped_oscillation(T)
    np.testing.assert_allclose(solution["mass.s"], x, **CLOSE)
    np.testing.assert_allclose(solution["mass.v"], v, **CLOSE)
    np.testing.assert_allclose(solution["spring.f"], 5.0 * x, **CLOSE)
    np.testing.assert_allclose(solution["damper.f"], 0.6 * v, **CLOSE)
    # Forces are positive into a component: the wall feels the pull of both.
    np.testing.assert_allclose(solution["wall.flange.f"], 5.0 * x + 0.6 * v, **CLOSE)


def test_two_masses_rigidly_connected(ev):
    a, b = Mass(ev, "a", 1.0, initial_position=0.5, initial_velocity=0.0), Mass(ev, "b", 3.0)
    spring, wall, rod = Spring(ev, "spring", 4.0, length=0.2), FixedPosition(ev, "w", position=-0.2), Rod(ev, "r", 0.3)
    system = compiled(
        wall, spring, a, rod, b,
        connect=[(wall.flange, spring.flange_a), (spring.flange_b, a.flange, rod.flange_a), (rod.flange_b, b.flange)],
    )  # fmt: skip
    assert sorted(system.states) == ["a.s", "a.v"] and system.report.index == 3
    solution = simulate(system, 2.0, ts=TS, **SOLVE)
    x = 0.5 * np.cos(T)  # K/(M1 + M2) = 1, at rest at x = 0
    np.testing.assert_allclose(solution["a.s"], x, **CLOSE)
    np.testing.assert_allclose(solution["b.s"], x + 0.3, **CLOSE)
    np.testing.assert_allclose(solution["b.v"], -0.5 * np.sin(T), **CLOSE)
    np.testing.assert_allclose(solution["r.f"], 3.0 * x, **CLOSE)  # what accelerates b
    np.testing.assert_allclose(solution["spring.f"], 4.0 * x, **CLOSE)


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


def test_hierarchy_and_signs(ev):
    source, ladder, ground = VoltageSource(ev, "s", 4.6), Ladder(ev, "x"), Ground(ev, "g")
    system = compiled(source, ladder, ground, connect=[(source.p, ladder.p), (ladder.n, source.n, ground.p)])
    names = [
        "x.p.i", "x.n.i", "s.i", "x.r.v", "x.first.p.i", "x.first.n.i", "x.first.r1.i", "x.first.r2.i", "x.second.r2.i",
        "x.second.p.v", "x.first.power", "x.first.relative",
    ]  # fmt: skip
    found = system.observe(names, 0.0, system.initialize())
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


def test_own_ports_in_equations(ev):
    unit, spring, wall = Unit(ev, "u"), Spring(ev, "s", 8.0), FixedPosition(ev, "w")
    system = compiled(unit, spring, wall, connect=[(wall.flange, spring.flange_a), (spring.flange_b, unit.flange)])
    x = system.initialize()
    # Force into the unit: −K·x = −2.4; acceleration −1.2.
    names = ["u.double", "u.pull", "u.mass.flange.f", "s.f", "w.flange.f"]
    np.testing.assert_allclose(system.observe(names, 0.0, x), [0.6, -2.4, -2.4, 2.4, 2.4], rtol=1e-12)
    slopes = dict(zip(system.states, system.vector_field(0.0, x), strict=True))
    assert float(slopes["u.mass.v"]) == pytest.approx(-1.2)


def test_loose_ports_carry_nothing(ev):
    mass = Mass(ev, "m", 1.0, initial_position=0.0, initial_velocity=2.0)
    system = single(mass)
    assert float(system.observe("m.flange.f", 0.0, system.initialize())) == 0.0


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


def test_inputs():
    system = single(Follower(EqnEnv(), "f", default=0.5))
    assert system.inputs == ["f.u"]
    samples = jnp.array([0.0, 1.0, 2.0])
    ramp = diffrax.LinearInterpolation(samples, 3.0 * samples)
    decay = np.exp(-T)
    assert float(system.observe("f.u", 0.0, system.initialize())) == 0.5  # the default
    cases = [
        ({"f.u": 2.0}, 2.0 * np.ones(9), 2.0 * (1 - decay)),
        ({"f.u": lambda t: jnp.sin(t)}, np.sin(T), (np.sin(T) - np.cos(T) + decay) / 2),
        ({"f.u": ramp.evaluate}, 3.0 * T, 3.0 * (T - 1 + decay)),
    ]
    for inputs, u, x in cases:
        solution = simulate(system, 2.0, ts=TS, inputs=inputs, **SOLVE)
        np.testing.assert_allclose(solution["f.x"], x, **CLOSE)
        np.testing.assert_allclose(solution["f.u"], u, **CLOSE)
        np.testing.assert_allclose(solution["f.y"], 2.0 * u, **CLOSE)


def test_inputs_are_differentiated():
    system = single(Moved(EqnEnv(), "m"))
    assert system.states == []
    inputs = {"m.u": lambda t: jnp.sin(3 * t) + t**2}
    found = [system.observe(["m.x", "m.v", "m.f"], t, system.initialize(t, inputs), inputs) for t in (0.0, 0.7)]
    expected = [(np.sin(3 * t) + t**2, 3 * np.cos(3 * t) + 2 * t, 2 * (2 - 9 * np.sin(3 * t))) for t in (0.0, 0.7)]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)  # rounding


class Passed(Component):
    """An input that stands in an alias only, and one that stands nowhere."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, _ = self.input("u"), self.input("idle", default=4.0)
        self.add_equations(Eq(self.variable("y"), -u))


def test_inputs_that_nothing_needs_can_be_read():
    system = single(Passed(EqnEnv(), "c"))
    inputs = {"c.u": lambda t: 3 * t}
    x = system.initialize(2.0, inputs)
    np.testing.assert_allclose(system.observe(["c.y", "c.u", "c.idle"], 2.0, x, inputs), [-6.0, 6.0, 4.0])


class Sensor(Component):
    """z = dy/dt for y = x², a derivative that nothing else needs; q = 7 + x³ stands beside it."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0.5, fixed=True)
        y, z, a, q = (self.variable(n) for n in ("y", "z", "a", "q"))
        self.add_equations(Eq(der(x), -x), Eq(y, x**2), Eq(z, der(y)), Eq(a, der(der(x))), Eq(q, 7 + x**3))


def test_derivatives_that_only_an_output_reads():
    system = single(Sensor(EqnEnv(), "c"))
    found = [float(system.observe(f"c.{n}", 0.0, system.initialize())) for n in ("z", "a", "q", "y")]
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


@pytest.fixture(scope="module")
def equations():
    """Independent components in one model, simulated together."""
    ev = EqnEnv(gain=1.5)
    system = compiled(Source(ev, "source"), Squares(ev, "squares"), Harmonic(ev, "osc"), Draining(ev, "tank"))
    return system, simulate(system, 2.0, ts=TS, initial={"der(osc.x)": -2.0}, **SOLVE)


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
def test_equations(equations, name, expected):
    np.testing.assert_allclose(equations[1][name], expected, **CLOSE)


def test_names(equations):
    system, solution = equations
    assert {"osc.x", "tank.h", "tank.q", "source.x"} <= set(system.variables)
    assert {"osc.x", "der(osc.x)", "tank.h", "source.x", "squares.x"} <= set(system.states)
    assert "tank.q" in system.algebraics and "tank.h" not in system.algebraics
    assert list(solution) == system.variables


# --- parameters --------------------------------------------------------------------------------------------------


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
