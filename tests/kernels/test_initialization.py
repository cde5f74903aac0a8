"""Consistent initialization: what is fixed holds, what is a guess yields, what contradicts is named."""

import jax
import numpy as np
import planar_models
import pytest
from problems import RELEASE, compiled
from sympy import Eq, acos, sqrt

from jaxonomy_dae import Component, EqnEnv, InitializationError, der
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Spring


class Cubic(Component):
    """dx/dt = −x with y = x³ + x: a start of y determines x through a nonlinear equation."""

    def __init__(self, ev, name, x_start=None, x_fixed=False, y_start=10.0, y_fixed=True):
        super().__init__(ev, name)
        p = self.parameter("p", y_start)
        x = self.variable("x", start=x_start, fixed=x_fixed)
        y = self.variable("y", start=p, fixed=y_fixed)
        self.add_equations(Eq(der(x), -x), Eq(y, x**3 + x))


class Bare(Component):
    """dx/dt = 1 − x, without any start."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x")
        self.add_equations(Eq(der(x), 1 - x))


class Discharging(Component):
    """A capacitor on a resistor of 4 Ω."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        c, r, g = (self.add(part) for part in (Capacitor(ev, "c", 1.0), Resistor(ev, "r", 4.0), Ground(ev, "g")))
        self.connect(c.p, r.p)
        self.connect(c.n, r.n, g.p)


class Charged(Component):
    """A capacitor without a given voltage, and one that a source determines."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        s, r, g = (self.add(part) for part in (VoltageSource(ev, "s", 3.0), Resistor(ev, "r"), Ground(ev, "g")))
        free, tied = self.add(Capacitor(ev, "free", 1.0)), self.add(Capacitor(ev, "tied", 1.0))
        self.connect(s.p, r.p, tied.p)
        self.connect(r.n, free.p)
        self.connect(free.n, tied.n, s.n, g.p)


class Oscillator(Component):
    """A mass between a spring and a damper."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        mass = self.add(Mass(ev, "mass", 2.0, initial_position=0.7, initial_velocity=-0.4))
        spring, damper = self.add(Spring(ev, "spring", 5.0)), self.add(Damper(ev, "damper", 0.6))
        wall = self.add(FixedPosition(ev, "wall"))
        self.connect(wall.flange, spring.flange_a, damper.flange_a)
        self.connect(mass.flange, spring.flange_b, damper.flange_b)


@pytest.fixture(scope="module")
def declared():
    """Models beside each other, started as they declare: initial values by name."""
    ev = EqnEnv()
    system = compiled(
        Cubic(ev, "fixed"),
        Cubic(ev, "guess", x_start=5.0),
        Cubic(ev, "free", x_start=1.5, y_fixed=False),
        Cubic(ev, "redundant", x_start=2.0, x_fixed=True),
        Bare(ev, "bare"),
        Charged(ev, "charged"),
        PlanarPendulum(ev, "pend", initial_theta=RELEASE),
    )
    return started(system, {})


@pytest.fixture(scope="module")
def given():
    """The same with values that are given."""
    ev = EqnEnv()
    system = compiled(
        Cubic(ev, "x", x_start=2.0, x_fixed=True),
        Cubic(ev, "y", x_start=2.0, x_fixed=True),
        PlanarPendulum(ev, "pend", initial_theta=RELEASE),
        Oscillator(ev, "osc"),
        Discharging(ev, "out"),
        Discharging(ev, "back"),
    )
    values = {"x.x": 1.0, "y.y": 30.0, "pend.x": 0.6, "pend.vx": 1.6, "der(osc.mass.s)": 2.5}
    with pytest.warns(RuntimeWarning, match=r"starts are fixed in the model.*'pend\.y', 'pend\.vy'"):
        return started(system, values | {"out.c.i": -0.5, "back.r.n.i": -0.5})


def started(system, initial):
    @jax.jit
    def values():
        return system.observe(system.variables, 0.0, system.initialize(initial=initial))

    found = dict(zip(system.variables, np.asarray(values()), strict=True))
    return lambda *names: [found[name] for name in names]


@pytest.mark.slow
def test_a_fixed_start_of_an_algebraic_variable_holds(declared):
    # 2³ + 2 = 10; Newton to rounding
    np.testing.assert_allclose(declared("fixed.x", "fixed.y"), [2.0, 10.0], rtol=1e-12)


def test_its_gradient_is_the_implicit_functions():
    system = compiled(Cubic(EqnEnv(), "c"))

    def x(p):
        return system.with_parameters({"c.p": p}).initialize()[0]

    # dx/dp = 1/(3x² + 1) at x = 2 and, by the same program, at x = 1.
    slopes = jax.jit(lambda p: (jax.grad(x)(p), jax.jvp(x, (p,), (1.0,))[1]))
    np.testing.assert_allclose(slopes(10.0), 1 / 13, rtol=1e-10)
    np.testing.assert_allclose(slopes(2.0), 1 / 4, rtol=1e-10)


def test_a_guess_yields_to_what_is_fixed(declared):
    np.testing.assert_allclose(declared("guess.x", "guess.y"), [2.0, 10.0], rtol=1e-12)


def test_a_guess_of_a_state_is_taken_where_nothing_else_determines_it(declared):
    np.testing.assert_allclose(declared("free.x"), [1.5], rtol=1e-12)


def test_without_any_start_the_state_is_zero(declared):
    np.testing.assert_array_equal(declared("bare.x"), [0.0])


def test_redundant_starts_that_agree_are_accepted(declared):
    np.testing.assert_allclose(declared("redundant.x", "redundant.y"), [2.0, 10.0], rtol=1e-12)
    # The pendulum fixes four numbers of two degrees of freedom.
    x, y = np.cos(RELEASE), np.sin(RELEASE)
    pend = declared("pend.x", "pend.y", "pend.vx", "pend.vy", "pend.lam")
    np.testing.assert_allclose(pend, [x, y, 0, 0, -9.81 * y / 2], rtol=1e-12, atol=1e-12)


def test_contradicting_starts_are_named():
    system = compiled(Cubic(EqnEnv(), "c", x_start=3.0, x_fixed=True))
    with pytest.raises(InitializationError, match=r"(?s)c\.[xy].*off by.*fixed=False"):
        system.initialize()


def test_contradicting_starts_across_a_connection():
    """Two capacitors in parallel that are to start at different voltages."""
    ev = EqnEnv()
    a, b, r = Capacitor(ev, "a", 1.0, initial_voltage=1.0), Capacitor(ev, "b", 1.0, initial_voltage=2.0), Resistor(
        ev, "r"
    )  # fmt: skip
    g = Ground(ev, "g")
    system = compiled(a, b, r, g, connect=[(a.p, b.p, r.p), (a.n, b.n, r.n, g.p)])
    with pytest.raises(
        InitializationError,
        match=r"(?s)start of a\.v, 1: off by 1.*b\.v and a\.v are fixed at 2 and 1.*values that agree",
    ):
        system.initialize()
    # New values that agree mend it: nothing is wrong with the model.
    mended = system.with_parameters({"b.initial_voltage": 1.0})
    np.testing.assert_allclose(started(mended, {})("a.v", "b.v"), [1.0, 1.0], rtol=1e-12)


@pytest.mark.slow
def test_contradiction_inside_jit():
    system = compiled(Cubic(EqnEnv(), "c", x_start=3.0, x_fixed=True))
    assert np.isnan(jax.jit(lambda: system.initialize())()).all()
    with pytest.raises(Exception, match="no consistent initial point"):
        jax.block_until_ready(jax.jit(lambda: system.initialize(throw=True))())


@pytest.mark.slow
def test_values_given_outrank_declared_starts(given):
    np.testing.assert_allclose(given("x.x", "x.y"), [1.0, 2.0], rtol=1e-12)
    np.testing.assert_allclose(given("y.x", "y.y"), [3.0, 30.0], rtol=1e-12)


def test_values_given_outrank_starts_that_follow_from_others(given):
    """A pendulum given an x alone: y and the velocities follow, from the declared side of the circle."""
    found = given("pend.x", "pend.y", "pend.vx", "pend.vy")
    np.testing.assert_allclose(found, [0.6, -0.8, 1.6, 1.2], rtol=1e-10)  # x·vx + y·vy = 0


def test_a_fixed_start_that_gives_way_is_named():
    """A cubic with x fixed at 2: what is given for y moves x, unless it says the same."""
    system = compiled(Cubic(EqnEnv(), "c", x_start=2.0, x_fixed=True))
    with pytest.warns(RuntimeWarning, match=r"'c\.y' determines variables whose.*'c\.x' = 3, declared 2\."):
        system.initialize(initial={"c.y": 30.0})
    with pytest.warns(RuntimeWarning, match=r"'c\.y' determines variables whose.*: 'c\.x'\."):
        jax.eval_shape(lambda y: system.initialize(initial={"c.y": y}), 30.0)
    np.testing.assert_allclose(system.initialize(initial={"c.y": 10.0}), [2.0], rtol=1e-12)


def test_a_derivative_may_be_given(given):
    np.testing.assert_allclose(given("osc.mass.s", "osc.mass.v", "osc.spring.f"), [0.7, 2.5, 3.5], rtol=1e-12)


def test_an_alias_may_be_given_with_its_sign(given):
    """The current of a discharging capacitor determines its voltage: v = −R·i, and r.i = −c.i."""
    np.testing.assert_allclose(given("out.c.v", "out.r.i"), [2.0, 0.5], rtol=1e-12)
    np.testing.assert_allclose(given("back.c.v", "back.c.i"), [2.0, -0.5], rtol=1e-12)


def test_underdetermined_starts_keep_the_guesses(declared):
    """A capacitor without a given voltage starts at its guess, 0; one that a source determines starts there."""
    np.testing.assert_allclose(declared("charged.free.v", "charged.tied.v", "charged.r.i"), [0.0, 3.0, 3.0], atol=1e-12)


def test_a_start_whose_slope_is_infinite():
    """√(2gh) at h = 0 and acos(c) at c = 1 are numbers, though rounding of h and c cannot be told by their slopes."""

    class Dropped(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            h, c = self.parameter("h", 0.0), self.parameter("c", 1.0)
            v = self.variable("v", start=sqrt(2 * 9.81 * h), fixed=True)
            a = self.variable("a", start=acos(c), fixed=True)
            self.add_equations(Eq(der(v), -v), Eq(der(a), v))

    system = compiled(Dropped(EqnEnv(), "m"))
    order = [system.states.index(name) for name in ("m.v", "m.a")]
    np.testing.assert_array_equal(np.asarray(system.initialize())[order], [0.0, 0.0])
    moved = system.with_parameters({"m.h": 0.5, "m.c": 0.0})
    np.testing.assert_allclose(np.asarray(moved.initialize())[order], [np.sqrt(9.81), np.pi / 2], rtol=1e-15)


def test_inputs_and_time_enter():
    class Follows(Component):
        """x + y = u(t), dx/dt = y, y fixed at the start."""

        def __init__(self, ev, name):
            super().__init__(ev, name)
            u = self.input("u")
            x, y = self.variable("x"), self.variable("y", start=1.0, fixed=True)
            self.add_equations(Eq(x + y, u), Eq(der(x), y))

    system = compiled(Follows(EqnEnv(), "c"))
    inputs = {"c.u": lambda t: 5 * t}
    found = jax.jit(lambda t: system.observe(["c.x", "c.y"], t, system.initialize(t, inputs), inputs))(2.0)
    np.testing.assert_allclose(found, [9.0, 1.0], rtol=1e-12)


class TwoBranches(Component):
    """a = −2·b with a² = 4 + z, which has two solutions; a guess of each."""

    def __init__(self, ev, name, first, second):
        super().__init__(ev, name)
        a, b = (self.variable(n, start=self.parameter(f"{n}0", g)) for n, g in (("a", first), ("b", second)))
        z = self.variable("z", start=0.0, fixed=True)
        self.add_equations(Eq(a, -2 * b), Eq(a**2, 4 + z), Eq(der(z), 1))


@pytest.mark.slow
def test_guesses_that_differ():
    """The one that says more counts; not a model of the same structure that came before, with other values."""
    for first, second, expected in ((0.0, 1.5, -2.0), (3.0, 0.0, 2.0), (0.0, -1.5, 2.0), (0.0, 1.5, -2.0)):
        system = compiled(TwoBranches(EqnEnv(), "c", first, second))
        found = system.observe(["c.a"], 0.0, system.initialize())
        assert float(found[0]) == pytest.approx(expected)


class NearlyParallel(Component):
    """u = x + y and v = x + (1 + e)·y, both with fixed starts."""

    def __init__(self, ev, name, e):
        super().__init__(ev, name)
        x, y = self.variable("x"), self.variable("y")
        u = self.variable("u", start=self.parameter("us", 1.0), fixed=True)
        v = self.variable("v", start=self.parameter("vs", 1.0), fixed=True)
        self.add_equations(Eq(der(x), -x), Eq(der(y), -y), Eq(u, x + y), Eq(v, x + (1 + e) * y))


@pytest.mark.parametrize("e", [1e-4, 1e-8])
def test_starts_that_are_nearly_parallel_determine_the_states(e):
    """y = (v − u)/e: neither start follows from the other, though e is a number that all points share."""
    system = compiled(NearlyParallel(EqnEnv(), "c", e))

    def y(v):
        return system.with_parameters({"c.vs": v}).initialize()[1]

    value, slope = jax.value_and_grad(y)(1 + e)
    assert float(value) == pytest.approx(1.0, rel=1e-15 / e)
    assert float(slope) == pytest.approx(1 / e, rel=1e-15 / e)


class Drains(Component):
    """der(x) = −y and y + c·y³ = 2·x − 1, of which also der(y) may be asked."""

    def __init__(self, ev, name, starts, c=0.0, asked=False):
        super().__init__(ev, name)
        v = {n: self.variable(n, start=start) for n, start in starts.items()}
        x, y = v["x"], v["y"]
        self.add_equations(Eq(der(x), -y), Eq(y + c * y**3, 2 * x - 1))
        if asked:
            self.output("slope", der(y))


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("c", [0.0, pytest.param(0.3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("starts, x", [({"x": 0.5, "y": 0.7}, 0.5), ({"x": None, "y": 0.7}, None)])
def test_what_is_asked_does_not_move_the_start(starts, x, c, asked):
    """What is asked: with an output der(y), y was a state or could be one, and its guess counted as much as that of x,
    or more. In a linear block, the zero of x that nobody declared outranked the guess of y, but not with that
    output."""
    expected = (0.7 + c * 0.7**3 + 1) / 2 if x is None else x
    for order in ("xy", "yx"):
        system = compiled(Drains(EqnEnv(), "c", {n: starts[n] for n in order}, c, asked))
        found = system.observe(["c.x"], 0.0, system.initialize())
        assert float(found[0]) == pytest.approx(expected, rel=1e-12)


class Coupled(Component):
    """Two states with a relation between them: one of them is eliminated. The guess nearest to (a, b) is sought."""

    def __init__(self, ev, name, starts):
        super().__init__(ev, name)
        v = {n: self.variable(n, start=start) for n, start in starts.items()}
        x, y, f = v["x"], v["y"], self.variable("f")
        self.add_equations(Eq(der(x), f - x), Eq(der(y), -2 * y - f), Eq(x - 2 * y, 1))


@pytest.mark.slow
def test_guesses_of_what_is_no_state_count_as_much():
    """The order of declaration: the first of two variables became the state, and its guess held; the other's did not
    count. Now the point is the nearest to both."""
    for order in ("xy", "yx"):
        system = compiled(Coupled(EqnEnv(), "c", {n: {"x": 0.4, "y": 0.9}[n] for n in order}))
        assert len(system.states) == 1
        # Without a warning: linear equations have no other solution, nearer to the guesses.
        found = system.observe(["c.x", "c.y"], 0.0, system.initialize())
        np.testing.assert_allclose(found, [0.88, -0.06], rtol=1e-9)


class Equal(Component):
    def __init__(self, ev, name, order):
        super().__init__(ev, name)
        v = {n: self.variable(n, start={"x": 1e-6, "y": 0.9}[n]) for n in order}
        self.add_equations(Eq(der(v["x"]), -v["x"]), Eq(v["y"], v["x"]))


def test_the_size_of_variables_that_are_equal():
    """The order of declaration: the size was that of the first start."""
    one, other = (compiled(Equal(EqnEnv(), "c", order)) for order in ("xy", "yx"))
    np.testing.assert_array_equal(one.typical_sizes, other.typical_sizes)
    assert float(np.max(one.typical_sizes)) == 1.0


def test_a_start_that_is_met_to_rounding_moves_as_a_whole():
    """The search began at angles and positions that held to 1e-16, and took that for the size of what it moved: the
    gradient moved one link's middle by half, and turned the other."""
    pendulum = planar_models.double_pendulum("auto")

    def start(x):
        return pendulum.with_parameters({"world.x": x}).initialize()

    moved = jax.jvp(start, (0.0,), (1.0,))[1]
    expected = [float(name in ("j2.frame_a.x", "a.body.x", "b.body.x")) for name in pendulum.states]
    np.testing.assert_allclose(moved, expected, atol=1e-12)
