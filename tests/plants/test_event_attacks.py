"""Events as nobody had in mind when they were made, each against an independent computation.

Runs are made at rtol = atol = 1e-10; what is integrated is polynomial unless a test says otherwise, so that values are
right to rounding and to the search for events, a few 1e-12.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import sympy
from hybrid_models import Ball
from problems import compiled, component

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    ModelError,
    SimulationError,
    assign,
    der,
    pre,
    reinit,
    simulate,
    terminate,
)
from jaxonomy_dae.library import signal as sig
from jaxonomy_dae.modeling import Eq
from jaxonomy_dae.solvers import BDF

TIGHT = dict(rtol=1e-10, atol=1e-10)


def events(solution):
    return np.asarray(solution.events.ts)[: len(solution.events)]


def clock_hand(self):
    """A state that is the time since the last reset."""
    x = self.variable("x", start=0.0, fixed=True)
    self.add_equations(Eq(der(x), 1))
    return x


def model(write):
    return compiled(component(write))


# --- right, by independent computations ------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_discrete_variable_whose_start_is_an_expression():
    """It begins at 2·a, is doubled at t = 1 and t = 2, and y is its integral: 2·a·(1 + 2 + 4/2) at t = 2.5. The start
    must not be computed again after events."""

    def write(self, ev):
        a, x = self.parameter("a", 1.5), clock_hand(self)
        y, d = self.variable("y", start=0.0, fixed=True), self.discrete("d", start=2 * a)
        self.add_equations(Eq(der(y), d))
        self.when(x >= 1, reinit(x, 0), assign(d, 2 * pre(d)))

    system = model(write)

    def run(a):
        return simulate(system.with_parameters({"c.a": a}), 2.5, ts=jnp.array([0.5, 1.5, 2.5]), **TIGHT)

    np.testing.assert_allclose(run(1.5)["c.d"], [3, 6, 12])
    value, slope = jax.jit(jax.value_and_grad(lambda a: run(a)["c.y"][-1]))(1.5)
    np.testing.assert_allclose([value, slope], [15, 10], rtol=1e-10)


G, HEAVY, LIGHT = 9.81, 1.0, 0.3


def falling_balls(T, e):
    """Heights and speeds of two balls, the light one above the heavy one, from bounce to bounce."""
    t, times = 0.0, []
    h, v = np.array([1.0, 1.5]), np.zeros(2)
    while True:
        floor = (v[0] + np.sqrt(v[0] ** 2 + 2 * G * h[0])) / G
        meet = (h[1] - h[0]) / (v[0] - v[1]) if v[0] > v[1] else np.inf
        s = min(floor, meet, T - t)
        h, v, t = h + v * s - G * s * s / 2, v - G * s, t + s
        if t >= T:
            return h, times
        times.append(t)
        if floor < meet:
            h[0], v[0] = 0.0, -e * v[0]
        else:
            total, apart = HEAVY * v[0] + LIGHT * v[1], e * (v[0] - v[1])
            h[1], v = h[0], np.array([total - LIGHT * apart, total + HEAVY * apart]) / (HEAVY + LIGHT)


@pytest.mark.slow
def test_balls_on_balls():
    def write(self, ev):
        e = self.parameter("e", 0.9)
        h = [self.variable(f"h{k}", start=s, fixed=True) for k, s in enumerate((1.0, 1.5))]
        v = [self.variable(f"v{k}", start=0.0, fixed=True) for k in range(2)]
        for k in range(2):
            self.add_equations(Eq(der(h[k]), v[k]), Eq(der(v[k]), -G))
        self.when(h[0] <= 0, reinit(v[0], -e * v[0]), reinit(h[0], 0))
        total, apart = HEAVY * v[0] + LIGHT * v[1], e * (v[0] - v[1])
        self.when(
            h[1] <= h[0],
            reinit(v[0], (total - LIGHT * apart) / (HEAVY + LIGHT)),
            reinit(v[1], (total + HEAVY * apart) / (HEAVY + LIGHT)),
        )

    system = model(write)

    def run(e):
        return simulate(system.with_parameters({"c.e": e}), 2.0, ts=jnp.array([2.0]), **TIGHT)

    solution, (heights, times) = run(0.9), falling_balls(2.0, 0.9)
    np.testing.assert_allclose(events(solution), times, atol=1e-11)
    np.testing.assert_allclose([solution["c.h0"][-1], solution["c.h1"][-1]], heights, atol=1e-11)
    slope = jax.jit(jax.grad(lambda e: run(e)["c.h1"][-1]))(0.9)
    # Central differences at 1e-6: 1e-10 of curvature, 1e-16/1e-6 of rounding.
    differences = (falling_balls(2.0, 0.9 + 1e-6)[0][1] - falling_balls(2.0, 0.9 - 1e-6)[0][1]) / 2e-6
    assert float(slope) == pytest.approx(differences, rel=1e-7)


def test_clocks_of_commensurate_periods():
    """0.1, 0.2 and 0.3 s, which read each other: what ticks at one instant reads new values, or with pre the ones
    before the instant. The reference counts in integers."""

    def write(self, ev):
        clock_hand(self)
        a, b, c = (self.discrete(n) for n in ("a", "b", "slow"))
        self.when(self.sampled(0.2), assign(b, 100 * a + pre(b)))
        self.when(self.sampled(0.1), assign(a, pre(a) + 1))
        self.when(self.sampled(0.3), assign(c, pre(c) + pre(a) * 1000 + b))

    expected, a, b, c = [], 0, 0, 0
    for k in range(60):
        before, a = a, a + 1
        b += 100 * a if k % 2 == 0 else 0
        c += 1000 * before + b if k % 3 == 0 else 0
        expected.append((a, b, c))
    solution = simulate(model(write), 6.0, ts=jnp.asarray((np.arange(60) + 0.5) * 0.1), **TIGHT)
    found = np.stack([solution[f"c.{n}"] for n in ("a", "b", "slow")], axis=1)
    np.testing.assert_array_equal(found, expected)


class Counting(Component):
    def __init__(self, ev, name, rate=1.0):
        super().__init__(ev, name)
        r, n = self.parameter("rate", rate), self.discrete("n")
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), r))
        self.when(x >= 1, reinit(x, 0), assign(n, pre(n) + r))


class Gear(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        gain = self.discrete("gain", start=1.0)
        self.add(Counting(ev, "child", rate=2 * gain))
        self.add(Counting(ev, "other"))
        self.when(ev.t >= 1.25, assign(gain, 3.0))


def test_a_discrete_variable_as_the_parameter_of_a_child():
    """The child counts at the rate 2, from 1.25 on at 6; a second instance at its own."""
    solution = simulate(compiled(Gear(EqnEnv(), "g")), 1.95, ts=jnp.array([1.2, 1.3, 1.95]), **TIGHT)
    sixth = 1.25 + 0.5 / 6 + np.arange(4) / 6
    np.testing.assert_allclose(events(solution), np.sort([0.5, 1.0, 1.0, 1.25, *sixth]), atol=1e-12)
    np.testing.assert_array_equal(solution["g.child.n"], [4, 4, 28])
    np.testing.assert_array_equal(solution["g.other.n"], [1, 1, 1])


@pytest.mark.slow
def test_a_pendulum_at_a_wall():
    """Cartesian, so that both speeds are reset on a hidden constraint; in the angle by SciPy."""

    def write(self, ev):
        x, y = self.variable("x", start=1.0, fixed=True), self.variable("y", start=0.0)
        u, v = self.variable("u", start=0.0, fixed=True), self.variable("v", start=0.0)
        pull = self.variable("pull")
        self.add_equations(
            Eq(der(x), u), Eq(der(y), v), Eq(der(u), -pull * x), Eq(der(v), -pull * y - G), Eq(x**2 + y**2, 1)
        )
        self.when(x <= -0.3, reinit(u, -0.9 * u), reinit(v, -0.9 * v))

    def hit(t, q):
        return np.sin(q[0]) + 0.3

    hit.terminal, hit.direction = True, -1.0
    t, q, times = 0.0, [np.pi / 2, 0.0], []
    while True:
        run = scipy.integrate.solve_ivp(
            lambda t, q: [q[1], -G * np.sin(q[0])], (t, 2.0), q, "DOP853", events=hit, rtol=1e-12, atol=1e-13
        )
        t, q = run.t[-1], [run.y[0, -1], -0.9 * run.y[1, -1]]
        if run.status == 0:
            break
        times.append(t)
    system = model(write)
    for solver, exact in ((None, 1e-8), (BDF(), 1e-6)):  # errors of BDF add up over its many steps
        solution = simulate(system, 2.0, ts=jnp.array([2.0]), solver=solver, **TIGHT)
        np.testing.assert_allclose(events(solution), times, atol=exact)
        assert float(solution["c.x"][-1]) == pytest.approx(np.sin(run.y[0, -1]), abs=exact)


@pytest.mark.parametrize("depth", [1e-2, 1e-3, 1e-6])
def test_a_guard_that_dips_below_zero_between_two_steps(depth):
    """x = (t − 1)² − depth is below zero for 2·√depth s only, and steps are as long as the run."""

    def write(self, ev):
        x, v = self.variable("x", start=1 - depth, fixed=True), self.variable("v", start=-2.0, fixed=True)
        n = self.discrete("n")
        self.add_equations(Eq(der(x), v), Eq(der(v), 2))
        self.when(x <= 0, assign(n, pre(n) + 1))

    solution = simulate(model(write), 2.0, ts=jnp.array([2.0]), **TIGHT)
    np.testing.assert_allclose(events(solution), [1 - np.sqrt(depth)], atol=1e-9)


def test_guards_faster_than_the_states():
    """sin(ωt + 0.1) rises through zero ⌊(5ω + 0.1)/2π⌋ times, and steps are chosen for a state that needs none."""

    def write(self, ev):
        w, n = self.parameter("w", 50.0), self.discrete("n")
        clock_hand(self)
        self.when(sympy.sin(w * ev.t + 0.1) > 0, assign(n, pre(n) + 1))

    system = model(write)
    count = jax.jit(
        lambda w: simulate(system.with_parameters({"c.w": w}), 5.0, ts=jnp.array([5.0]), max_events=99)["c.n"][-1]
    )
    for w in np.linspace(30.0, 60.0, 21):
        assert int(count(w)) == int((5 * w + 0.1) / (2 * np.pi))


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


def test_a_clock_that_ends_the_run():
    def write(self, ev):
        clock_hand(self)
        self.when(self.sampled(1.0, 0.7), terminate("enough"))

    solution = simulate(model(write), 2.0, ts=jnp.array([0.5, 1.5]), **TIGHT)
    assert solution.events.terminated == "enough" and np.isnan(solution["c.x"][-1])


# --- refused ---------------------------------------------------------------------------------------------------------


def hessian_forward(f):
    return jax.jacfwd(jax.jacfwd(lambda p: f(p, diffrax.ForwardMode())))


@pytest.mark.parametrize("twice", [jax.hessian, hessian_forward])
def test_second_derivatives_are_refused(twice):
    """The map at an event has the flow's first derivative only."""
    system = compiled(Ball(EqnEnv(), "ball"))

    def height(h0, adjoint=None):
        changed = system.with_parameters({"ball.h0": h0})
        return simulate(changed, 0.8, ts=jnp.array([0.8]), adjoint=adjoint)["ball.h"][-1]

    with pytest.raises(ModelError, match="second derivatives through events"):
        twice(height)(1.0)


def test_one_state_by_two_names():
    def write(self, ev):
        x, z = clock_hand(self), self.variable("z")
        self.add_equations(Eq(z, -2 * x))
        self.when(x >= 1, reinit(z, 0.0), reinit(x, 0.5))

    with pytest.raises(ModelError, match=r"'c.z' and 'c.x' are one state"):
        model(write)


def test_steps_that_the_user_prescribes():
    system = compiled(Ball(EqnEnv(), "ball"))
    with pytest.raises(ModelError, match="StepTo"):
        simulate(system, 1.0, stepsize_controller=diffrax.StepTo(ts=jnp.linspace(0.0, 1.0, 11)))


@pytest.mark.parametrize("period", [0.0, -0.5])
def test_a_period_that_is_not_positive(period):
    def write(self, ev):
        clock_hand(self)
        T, d = self.parameter("T", 1.0), self.discrete("d")
        self.when(self.sampled(T), assign(d, pre(d) + 1))

    system = model(write).with_parameters({"c.T": period})
    with pytest.raises(ModelError, match=r"sampled\(T\).*period must be positive"):
        simulate(system, 1.0)


OUTSIDE = {
    "an equation": lambda self, d: self.add_equations(Eq(self.variable("y"), pre(d))),
    "an output": lambda self, d: self.output("y", pre(d)),
    "the start of a variable": lambda self, d: self.variable("y", start=pre(d)),
    "the start of a discrete variable": lambda self, d: self.discrete("y", start=pre(d)),
    "a period": lambda self, d: self.sampled(pre(d)),
    "a mode": lambda self, d: self.either(Eq(pre(d), 1), self.variable("y"), 0),
    "a condition": lambda self, d: self.when(self.symbol("x") > pre(d), assign(d, 1)),
}


@pytest.mark.parametrize("where", OUTSIDE)
def test_pre_is_for_actions(where):
    def write(self, ev):
        clock_hand(self)
        OUTSIDE[where](self, self.discrete("d"))

    with pytest.raises(ModelError, match=r"pre\(d\)"):
        model(write)


@pytest.mark.parametrize(
    "write",
    [lambda self, y, d: self.either(Eq(d, 1), y > 1, y), lambda self, y, d: self.complementary(y, Eq(y, 2))],
    ids=["either", "complementary"],
)
def test_branches_that_are_not_expressions(write):
    with pytest.raises(ModelError, match=r"component 'c': (either|complementary): .*y.* is not an expression"):
        model(lambda self, ev: write(self, self.variable("y"), self.discrete("d")))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 2 * sympy.I])
def test_values_that_are_not_finite_numbers(value):
    def write(self, ev):
        self.when(clock_hand(self) >= 1, assign(self.discrete("d"), value))

    with pytest.raises(ModelError, match="finite and real"):
        component(write)


ACTIONS = {
    "d": lambda self, x, d: self.when(x >= 1, assign(d, sympy.sqrt(0.5 - x))),
    "x": lambda self, x, d: self.when(x >= 1, reinit(x, sympy.log(0.5 - x))),
}


@pytest.mark.parametrize("name", ACTIONS)
def test_values_that_become_not_finite(name):
    def write(self, ev):
        ACTIONS[name](self, clock_hand(self), self.discrete("d"))

    with pytest.raises(SimulationError, match=f"t=1: an event gave 'c.{name}' a value that is not finite"):
        simulate(model(write), 2.0, ts=jnp.array([2.0]))


def test_sampled_blocks_do_not_depend_on_the_order_of_adding():
    """Two holds in a row are transparent to each other at an instant: the second one saw the first one's value of the
    sample before, if it had been added first."""
    found = []
    for turned in (False, True):
        ev, diagram = EqnEnv(), AcausalDiagram()
        ramp = sig.Ramp(ev, "ramp", 10.0, 10.0)
        first, second, total = sig.SampleHold(ev, "h1", 0.1), sig.SampleHold(ev, "h2", 0.1), sig.Integrator(ev, "i")
        diagram.add(ramp, *((second, first) if turned else (first, second)), total)
        diagram.connect(ramp.y, first.u, total.u)
        diagram.connect(first.y, second.u)
        solution = simulate(AcausalCompiler(ev, diagram)(), 0.4, ts=jnp.array([0.05, 0.15, 0.25, 0.35]))
        found.append(np.asarray(solution["h2.y"]))
    np.testing.assert_allclose(found, [[0.0, 0.1, 0.2, 0.3]] * 2, atol=1e-12)


class Loop(Component):
    """A sampled block without delay: what it samples at once shows in its output."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        u, a = self.input("u"), self.discrete("a")
        y = self.variable("y")
        self.add_equations(Eq(y, a))
        self.when(self.sampled(0.1), assign(a, u + 1))


def test_a_sampled_loop_through_equations_is_refused():
    ev, diagram = EqnEnv(), AcausalDiagram()
    one, two, total = Loop(ev, "one"), Loop(ev, "two"), sig.Integrator(ev, "total")
    diagram.add(one, two, total)
    diagram.connect(one.y, two.u, total.u)
    diagram.connect(two.y, one.u)
    with pytest.raises(ModelError, match="need each other's results"):
        AcausalCompiler(ev, diagram)()


class Twice(Component):
    """Two events with one condition."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        k = self.discrete("k")
        self.add_equations(Eq(der(x), 1))
        self.when(x >= 1, reinit(x, 0))
        self.when(x >= 1, assign(k, pre(k) + 1))


def test_two_events_with_one_condition_both_happen():
    """The reset of the first one kept the second one from happening."""
    solution = simulate(compiled(Twice(EqnEnv(), "c")), 2.5, ts=jnp.array([0.5, 1.5, 2.5]))
    np.testing.assert_array_equal(solution["c.k"], [0, 1, 2])
    np.testing.assert_allclose(solution["c.x"], 0.5, rtol=1e-9)


class Steps(Component):
    """x' = u, and u grows by one every half second."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, u = self.variable("x", start=0.0, fixed=True), self.discrete("u")
        self.add_equations(Eq(der(x), u))
        self.when(self.sampled(0.5, 0.5), assign(u, pre(u) + 1))


def test_derivatives_by_saved_times():
    """At the time of an event, a saved value goes along the solution after it; its derivative was zero."""
    system = compiled(Steps(EqnEnv(), "c"))
    slope = jax.grad(lambda t: simulate(system, 2.0, ts=t[None])["c.x"][-1])
    np.testing.assert_allclose([slope(t) for t in (0.75, 1.0, 1.25)], [1.0, 2.0, 2.0], rtol=1e-9)


def test_a_reset_that_hidden_constraints_do_not_admit():
    """Only one of two speeds that the constraint couples: the projection moved both, away from what was asked for."""

    def write(self, ev):
        x, y = self.variable("x", start=1.0, fixed=True), self.variable("y", start=0.0)
        u, v = self.variable("u", start=0.0, fixed=True), self.variable("v", start=0.0)
        pull = self.variable("pull")
        self.add_equations(
            Eq(der(x), u), Eq(der(y), v), Eq(der(u), -pull * x), Eq(der(v), -pull * y - G), Eq(x**2 + y**2, 1)
        )
        self.when(x <= -0.3, reinit(u, -0.9 * u))

    with pytest.raises(SimulationError, match=r"hidden constraints do not admit.*reinit"):
        simulate(model(write), 2.0, ts=jnp.array([2.0]), **TIGHT)
