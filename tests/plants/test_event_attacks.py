"""Events as nobody had in mind when they were made, each against an independent computation.

Runs are made at rtol = atol = 1e-10; what is integrated is polynomial unless a test says otherwise, so that values are
right to rounding and to the search for events, a few 1e-12.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import sympy
from problems import compiled, component

from jaxonomy_dae import ModelError, SimulationError, assign, der, pre, reinit, simulate, terminate
from jaxonomy_dae.solvers import BDF
from jaxonomy_dae.write import Eq

TIGHT = dict(rtol=1e-10, atol=1e-10)
G = 9.81


def events(solution):
    return np.asarray(solution.events.ts)[: len(solution.events)]


def clock_hand(self):
    """A state that is the time since the last reset."""
    x = self.variable("x", start=0.0, fixed=True)
    self.add_equations(Eq(der(x), 1))
    return x


def model(write):
    return compiled(component(write))


# --- a pendulum at a wall --------------------------------------------------------------------------------------------


@functools.cache
def at_a_wall():
    """Cartesian, so that both speeds are reset on a hidden constraint."""

    def write(self, ev):
        x, y = self.variable("x", start=1.0, fixed=True), self.variable("y", start=0.0)
        u, v = self.variable("u", start=0.0, fixed=True), self.variable("v", start=0.0)
        pull, back = self.variable("pull"), self.parameter("back", -0.9)
        self.add_equations(
            Eq(der(x), u), Eq(der(y), v), Eq(der(u), -pull * x), Eq(der(v), -pull * y - G), Eq(x**2 + y**2, 1)
        )
        self.when(x <= -0.3, reinit(u, -0.9 * u), reinit(v, back * v))

    return model(write)


def by_the_angle(T):
    """(x at the end, times of impacts) by SciPy."""

    def hit(t, q):
        return np.sin(q[0]) + 0.3

    hit.terminal, hit.direction = True, -1.0
    t, q, times = 0.0, [np.pi / 2, 0.0], []
    while True:
        run = scipy.integrate.solve_ivp(
            lambda t, q: [q[1], -G * np.sin(q[0])], (t, T), q, "DOP853", events=hit, rtol=1e-12, atol=1e-13
        )
        t, q = run.t[-1], [run.y[0, -1], -0.9 * run.y[1, -1]]
        if run.status == 0:
            return np.sin(run.y[0, -1]), times
        times.append(t)


@pytest.mark.slow
@pytest.mark.parametrize("solver, exact", [(None, 1e-8), (BDF(), 1e-6)])  # errors of BDF add up over its many steps
def test_a_pendulum_at_a_wall(solver, exact):
    x, times = by_the_angle(2.0)
    solution = simulate(at_a_wall(), 2.0, ts=jnp.array([2.0]), solver=solver, **TIGHT)
    np.testing.assert_allclose(events(solution), times, atol=exact)
    assert float(solution["c.x"][-1]) == pytest.approx(x, abs=exact)


@pytest.mark.slow
def test_a_reset_that_hidden_constraints_do_not_admit():
    """Only one of two speeds that the constraint couples: the projection moved both, away from what was asked for."""
    with pytest.raises(SimulationError, match=r"hidden constraints do not admit.*reinit"):
        simulate(at_a_wall().with_parameters({"c.back": 1.0}), 2.0, ts=jnp.array([2.0]), **TIGHT)


@pytest.mark.slow
def test_every_step_with_bdf():
    """x' = 2·on − x, switched at 0.5 and 1.5: first at ln 4, then every ln 3."""

    def write(self, ev):
        x, on = self.variable("x", start=0.0, fixed=True), self.discrete("on", start=1)
        self.add_equations(Eq(der(x), 2 * on - x))
        self.when(x > 1.5, assign(on, 0))
        self.when(x < 0.5, assign(on, 1))

    solution = simulate(model(write), 4.0, solver=BDF(), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(events(solution), np.log(4) + np.log(3) * np.arange(3), atol=1e-6)
    assert solution.stats["num_jacobians"] > 0


# --- a clock with values that may be wrong ---------------------------------------------------------------------------


@functools.cache
def clocked():
    """It writes roots and logarithms of what parameters leave, and ends the run after a while."""

    def write(self, ev):
        x, y, d = clock_hand(self), self.variable("y", start=0.0, fixed=True), self.discrete("d")
        T, a, b = (self.parameter(n, v) for n, v in (("T", 1.0), ("a", 5.0), ("b", 5.0)))
        self.add_equations(Eq(der(y), 0))
        self.when(x >= 1, assign(d, sympy.sqrt(a - x)))
        self.when(x >= 1, reinit(y, sympy.log(b - x)))
        self.when(self.sampled(T, 1.7), terminate("enough"))

    return model(write)


def run(**parameters):
    changed = clocked().with_parameters({f"c.{name}": value for name, value in parameters.items()})
    return simulate(changed, 2.0, ts=jnp.array([0.5, 1.5, 2.0]), **TIGHT)


@pytest.mark.slow
def test_a_clock_that_ends_the_run():
    solution = run()
    assert solution.events.terminated == "enough"
    np.testing.assert_array_equal(np.isnan(solution["c.x"]), [False, False, True])
    np.testing.assert_allclose(solution["c.y"][:2], [0.0, np.log(4.0)], atol=1e-12)
    np.testing.assert_allclose(solution["c.d"][:2], [0.0, 2.0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("parameter, name", [("a", "d"), ("b", "y")])
def test_values_that_become_not_finite(parameter, name):
    with pytest.raises(SimulationError, match=f"t=1: an event gave 'c.{name}' a value that is not finite"):
        run(**{parameter: 0.5})


def test_a_mode_in_which_equations_are_singular():
    """Kind: a text that blames what an event does not write. The event gives k the value 1, and y + w is asked for to
    be two things at once: 'c.q' was said to have been given a value by an event."""

    def write(self, ev):
        time, k = clock_hand(self), self.discrete("k", start=2)
        q, y, w = self.variable("q", start=1.0, fixed=True), self.variable("y"), self.variable("w")
        self.add_equations(Eq(k * y + w, q), Eq(y + w, q / 2), Eq(der(q), -y - w / 10))
        self.when(time >= 0.5, assign(k, 1))

    with pytest.raises(SimulationError, match="began a mode in which") as found:
        simulate(model(write), 1.0, ts=jnp.array([1.0]))
    text = str(found.value)
    assert "'c.y', 'c.w' is singular" in text and "'c.k' = 1" in text and "an event gave" not in text


@pytest.mark.parametrize("period", [0.0, -0.5])
def test_a_period_that_is_not_positive(period):
    with pytest.raises(ModelError, match=r"sampled\(T.*period must be positive"):
        run(T=period)


# --- floors, quantities that stay at zero, many events ---------------------------------------------------------------


@functools.cache
def dropped():
    """A ball that is let go at 1, resets to the floor, and keeps a part of its speed."""

    def write(self, ev):
        h, v = self.variable("h", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        self.add_equations(Eq(der(h), v), Eq(der(v), -G))
        self.when(h <= 0, reinit(v, -self.parameter("e", 0.5) * v), reinit(h, 0))

    return model(write)


@pytest.mark.slow
@pytest.mark.parametrize("e, why", [(0.0, "the equations make it true at once"), (0.5, "accumulate at t=1.35457")])
def test_a_ball_does_not_fall_through_the_floor(e, why):
    """Bounces accumulate at √(2h/g)·(1 + e)/(1 − e)."""
    with pytest.raises(SimulationError, match=rf"'c: when\(h <= 0\)' would happen again and again there.*{why}"):
        simulate(dropped().with_parameters({"c.e": e}), 5.0, ts=jnp.array([5.0]))


@pytest.mark.slow
def test_two_tanks_and_one_tap():
    """1.8 flows into the tank that is empty, and 1 out of each: they take turns at 10 − 9·0.8ᵏ, until both are empty
    (the water tanks of Johansson, Egerstedt, Lygeros and Sastry 1999, Systems and Control Letters 38)."""

    def write(self, ev):
        a, b = self.variable("a", start=1.0, fixed=True), self.variable("b", start=1.0, fixed=True)
        first = self.discrete("first", start=1)
        self.add_equations(Eq(der(a), 1.8 * first - 1), Eq(der(b), 1.8 * (1 - first) - 1))
        self.when(a <= 0, assign(first, 1))
        self.when(b <= 0, assign(first, 0))

    tanks = model(write)
    solution = simulate(tanks, 9.99, ts=jnp.array([9.99]), **TIGHT)
    turns = 10 - 9 * 0.8 ** np.arange(31)
    np.testing.assert_allclose(events(solution), turns, atol=1e-9)
    np.testing.assert_allclose(solution["c.a"] + solution["c.b"], 0.002, atol=1e-9)
    both = r"t=10: 'c: when\(a <= 0\)' and 'c: when\(b <= 0\)' would happen again and again there.*accumulate at t=10"
    with pytest.raises(SimulationError, match=both):
        simulate(tanks, 30.0, ts=jnp.array([30.0]))


@pytest.mark.long("a run is compiled")
def test_a_thermostat_with_one_level():
    """Where an event turns back what has just risen to zero, it falls: conditions that make each other true."""

    def write(self, ev):
        x, on = self.variable("x", start=0.0, fixed=True), self.discrete("on", start=1)
        self.add_equations(Eq(der(x), on - 0.5))
        self.when(x > 1, assign(on, 0))
        self.when(x < 1, assign(on, 1))

    message = r"t=2: 'c: when\(x > 1\)' and 'c: when\(x < 1\)' would happen again and again.*hysteresis"
    with pytest.raises(SimulationError, match=message):
        simulate(model(write), 5.0, ts=jnp.array([5.0]))


@pytest.mark.slow
def test_modes_that_contradict_the_other_equations():
    """u ≥ 0, v ≥ 0, u·v = 0 and u + v = 1 − x: no solution once x is above 1."""

    def write(self, ev):
        x, u, v = self.variable("x", start=0.0, fixed=True), self.variable("u"), self.variable("v")
        self.complementary(u, v)
        self.add_equations(Eq(der(x), 1), Eq(u + v, 1 - x))

    with pytest.raises(SimulationError, match=r"t=1: no mode is consistent there, 'c: when\(.* are true in turn"):
        simulate(model(write), 3.0, ts=jnp.array([3.0]))


def conditions_on_an_input():
    def write(self, ev):
        x, y, u = self.variable("x", start=0.0, fixed=True), self.variable("y", start=0.0, fixed=True), self.input("u")
        self.add_equations(Eq(der(x), sympy.Piecewise((1, u > 0), (0, True))))
        self.add_equations(Eq(der(y), sympy.Piecewise((1, u >= 0), (0, True))))
        for k, condition in enumerate((u > 0, u >= 0, u < 0, u <= 0)):
            n = self.discrete(f"n{k}", start=0)
            self.when(condition, assign(n, pre(n) + 1))

    return model(write)


def seen(solution):
    return jnp.stack([solution[f"c.{name}"][0] for name in ("x", "y", "n0", "n1", "n2", "n3")])


def truths(u):
    return np.array([u > 0, u >= 0, u < 0, u <= 0], float)


@pytest.mark.slow
def test_an_input_that_jumps_over_a_level_or_onto_it():
    """A guard that has jumped when the step begins does not fall any more. Clutches pressed by a step from 0 were
    pressed when the next event came, 0.16 s later, and what was on while u > 0 stayed on for u = 0, without a word."""
    system = conditions_on_an_input()

    def reached(case):
        before, after, rate = case
        u = lambda t: jnp.where(t < 0.4, before, after + rate * (t - 0.4))  # noqa: E731
        return seen(simulate(system, 1.0, ts=jnp.array([1.0]), inputs={"c.u": u}, jump_ts=0.4))

    cases = np.array([(a, b, r) for a in (-1, 0, 1) for b in (-1, 0, 1) for r in (-1, 0, 1) if b or not r], float)
    cases = np.vstack([cases, [0, 1e-9, 0]])
    sides = truths(cases[:, 0]), truths(cases[:, 1])
    happened = (1 - sides[0]) * sides[1]
    known = np.vstack([(0.4 * sides[0] + 0.6 * sides[1])[:2], happened]).T
    np.testing.assert_allclose(jax.lax.map(reached, jnp.asarray(cases)), known, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("left", [pytest.param("a corner", marks=pytest.mark.slow), "a ramp"])
def test_a_quantity_that_stays_at_zero_is_there_once(left):
    def write(self, ev):
        n = self.discrete("n", start=0)
        clock_hand(self)
        ramp = sympy.Min(sympy.Max(ev.t / 1.5, 0), 1)
        self.when((sympy.Max(1.5 - ev.t, 0) if left == "a corner" else 1 - ramp) <= 0, assign(n, pre(n) + 1))

    solution = simulate(model(write), 4.0, ts=jnp.array([1.4, 1.6, 4.0]), **TIGHT)
    np.testing.assert_allclose(events(solution), [1.5], atol=1e-9)
    np.testing.assert_array_equal(solution["c.n"], [0, 1, 1])


@pytest.mark.slow
def test_more_than_a_hundred_events_are_listed():
    """x' = 150, back to 0 at 1."""

    def write(self, ev):
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), 150))
        self.when(x >= 1, reinit(x, 0))

    solution = simulate(model(write), 1.002, ts=jnp.array([1.002]))
    assert type(solution.events.count) is int and solution.events.count == len(solution.events) == 150
    np.testing.assert_allclose(events(solution), np.arange(1, 151) / 150, rtol=1e-7)
    assert len(solution.events.names) == 150


@pytest.mark.slow
def test_a_run_that_ends_where_it_begins():
    """x' = 1000 from 1, and the end where x ≥ 1/2, at the start, too: one row. A first step was taken, to 0.001."""

    def write(self, ev):
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), 1e3))
        self.when(x >= self.parameter("most", 0.5), terminate("over"), at_start=True)

    system, ts = model(write), jnp.linspace(0.0, 1.0, 5)
    over = simulate(system, 1.0)
    np.testing.assert_array_equal(over.ts, [0.0])
    np.testing.assert_array_equal(over["c.x"], [1.0])
    assert over.events.terminated == "over" and len(over.events) == 1 and float(over.events.ts[0]) == 0.0
    saved = simulate(system, 1.0, ts=ts)
    np.testing.assert_array_equal(saved["c.x"], [1.0, *[np.nan] * 4])
    assert saved.events.terminated == "over" and saved.result == over.result

    def inside(most, ts=None):
        solution = simulate(system.with_parameters({"c.most": most}), 1.0, ts=ts, max_steps=64)
        return solution.ts, solution["c.x"], solution.result == over.result

    times, x, ended = jax.jit(inside)(0.5)
    assert (times == 0).all() and (x == 1).all() and ended
    _, x, ended = jax.jit(lambda most: jax.vmap(lambda m: inside(m, ts))(most))(jnp.array([0.5, 2.0, 1e4]))
    np.testing.assert_array_equal(np.isfinite(x), [[True] + [False] * 4, [True] + [False] * 4, [True] * 5])
    np.testing.assert_array_equal(ended, [True, True, False])


def test_events_of_a_model_without_any():
    solution = simulate(model(lambda self, ev: clock_hand(self)), 1.0)
    assert len(solution.events) == solution.events.count == 0
    assert solution.events.names == [] and solution.events.ts.shape == (0,)
    assert solution.events.before["c.x"].shape == (0,)
