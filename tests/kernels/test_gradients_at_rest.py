"""Derivatives of runs whose state rests at an equilibrium: its error is zero, so it says nothing about steps.

Unresolved, ∂x(1)/∂x(0) of an undamped oscillator of 20 rad/s came out as 14,000 in place of cos 20.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, assign, der, pre, reinit, simulate
from jaxonomy_dae.solvers import BDF, Rodas5P

# At rest, a step errs by rtol/0.03, 3e-8 of the motion; 20 rad s take some 60 of them.
RESOLVED = 2e-6
OMEGA = 20.0


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


class Oscillator(Component):
    """x'' = −ω²·(x − offset) − d·x' + θ + u."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        w, d, theta = self.parameter("w", OMEGA), self.parameter("d", 0.0), self.parameter("theta", 0.0)
        x0, offset = self.parameter("x0", 0.0), self.parameter("offset", 0.0)
        x, v = self.variable("x", start=x0 + offset, fixed=True), self.variable("v", start=0.0, fixed=True)
        u = self.input("u", default=0.0)
        self.add_equations(Eq(der(x), v), Eq(der(v), -(w**2) * (x - offset) - d * v + theta + u))


@functools.cache
def system():
    ev, diagram = EqnEnv(), AcausalDiagram("at rest")
    diagram.add(Oscillator(ev, "m"))
    return AcausalCompiler(ev, diagram)()


def end(value, name="m.x0", t1=1.0, others=(), **options):
    changed = system().with_parameters({name: value, **dict(others)})
    return simulate(changed, t1=t1, ts=jnp.array([t1]), rtol=1e-9, atol=1e-11, **options)["m.x"][0]


@pytest.mark.parametrize("solver", [None, diffrax.Tsit5(), slow(diffrax.Dopri5())], ids=["ours", "Tsit5", "Dopri5"])
def test_by_the_start(solver):
    assert abs(float(jax.grad(end)(0.0, solver=solver)) - np.cos(OMEGA)) < RESOLVED


def test_by_a_force_that_is_zero():
    """As a policy that begins with zero output: x = θ·(1 − cos ωt)/ω²."""
    expected = (1 - np.cos(OMEGA)) / OMEGA**2
    assert abs(float(jax.grad(end)(0.0, "m.theta")) - expected) < RESOLVED / OMEGA**2


@pytest.mark.parametrize("offset", [slow(0.3), -7e4])
def test_at_an_equilibrium_that_is_not_zero(offset):
    """There, rounding moves the state a little all the time."""
    found = jax.grad(end)(0.0, others={"m.offset": offset}.items())
    assert abs(float(found) - np.cos(OMEGA)) < RESOLVED


def test_pushed_later():
    """Rest for 0.5 s, then a force of 1: the derivative by the start is that of the motion all the way."""
    force = (jnp.array([0.0, 0.5, 1.0]), jnp.array([0.0, 1.0, 1.0]), "held")
    value, slope = jax.value_and_grad(end)(0.0, inputs={"m.u": force})
    assert abs(float(value) - (1 - np.cos(OMEGA / 2)) / OMEGA**2) < 1e-7 / OMEGA
    assert abs(float(slope) - np.cos(OMEGA)) < RESOLVED


def test_in_batches_and_under_jit():
    """Members at rest beside members that move."""
    starts = jnp.array([0.0, 1e-3, 0.0, 1.0])
    found = jax.jit(jax.vmap(jax.grad(end)))(starts)
    np.testing.assert_allclose(found, np.cos(OMEGA), atol=RESOLVED)


def test_by_the_time_too():
    """x(T) = x0·cos ωT: derivatives by both at rest, and beside it."""
    for x0 in (0.0, 1e-3):
        found = jax.grad(lambda x, t: end(x, t1=t), argnums=(0, 1))(x0, 1.0)
        np.testing.assert_allclose(found, [np.cos(OMEGA), -x0 * OMEGA * np.sin(OMEGA)], atol=RESOLVED)


@pytest.mark.parametrize(
    "adjoint", [diffrax.ForwardMode(), slow(diffrax.RecursiveCheckpointAdjoint())], ids=["forward", "checkpoints"]
)
def test_by_other_adjoints(adjoint):
    by = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.grad
    assert abs(float(by(lambda x0: end(x0, adjoint=adjoint))(0.0)) - np.cos(OMEGA)) < RESOLVED


def test_without_differentiation_steps_grow():
    """Nothing is held back where no derivative is asked for."""
    assert simulate(system(), t1=1.0, ts=jnp.array([1.0])).stats["num_steps"] < 20


@pytest.mark.slow
def test_damped_motion():
    """The derivative by the damping of a motion from afar, against differences of the closed form."""

    def exact(x0, d):
        w = np.sqrt(OMEGA**2 - d**2 / 4)
        return x0 * np.exp(-d / 2) * (np.cos(w) + d / (2 * w) * np.sin(w))

    slope = jax.grad(lambda d: end(1.0, others={"m.d": d}.items()))(2.0)
    expected = (exact(1.0, 2.0 + 1e-5) - exact(1.0, 2.0 - 1e-5)) / 2e-5
    assert abs(float(slope) - expected) < 1e-7


class Counted(Oscillator):
    """Beside the oscillator, a clock that counts, and a guard that falls through zero late."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        count, x = self.discrete("count", start=0.0), self.x
        self.when(self.sampled(0.7), assign(count, pre(count) + 1))
        self.when(ev.t > 0.31, reinit(x, pre(x) + self.x0))


@functools.cache
def counted():
    ev, diagram = EqnEnv(), AcausalDiagram("counted")
    diagram.add(Counted(ev, "m"))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.parametrize("adjoint", [None, slow(diffrax.ForwardMode())], ids=["stored", "forward"])
def test_between_events(adjoint):
    """The start counts twice: once at 0, and once more at 0.31."""

    def last(x0):
        changed = counted().with_parameters({"m.x0": x0})
        return simulate(changed, t1=1.0, ts=jnp.array([1.0]), rtol=1e-9, atol=1e-11, adjoint=adjoint)["m.x"][0]

    slope = jax.jacfwd(last) if adjoint else jax.grad(last)
    assert abs(float(slope(0.0)) - np.cos(OMEGA) - np.cos(0.69 * OMEGA)) < 2 * RESOLVED


class Beside(Oscillator):
    """A large state that rests, 1e7 Pa, beside motion in parts of a micrometre."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p = self.variable("p", start=1e7, fixed=True)
        self.add_equations(Eq(der(p), 1e3 * (1e7 - p)))


def test_the_units_of_what_rests_do_not_count():
    """Motion beside it is seen as such, in some 80 steps: the long one after one that a jump cuts is allowed."""
    ev, diagram = EqnEnv(), AcausalDiagram("beside")
    diagram.add(Beside(ev, "m"))
    system = AcausalCompiler(ev, diagram)()

    def last(x0):
        changed, jumps = system.with_parameters({"m.x0": x0}), [0.3, 0.5, 0.77]
        solution = simulate(changed, t1=1.0, ts=jnp.array([1.0]), rtol=1e-6, atol=1e-12, max_steps=150, jump_ts=jumps)
        return solution["m.x"][0]

    value, slope = jax.value_and_grad(last)(1e-7)
    assert abs(float(slope) - np.cos(OMEGA)) < 1e-3


class Implicit(Component):
    """The force is the root of an equation that stays: steps are implicit by default."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x0, w = self.parameter("x0", 0.0), self.parameter("w", OMEGA)
        x, v = self.variable("x", start=x0, fixed=True), self.variable("v", start=0.0, fixed=True)
        f = self.variable("f")
        self.add_equations(Eq(der(x), v), Eq(der(v), f), Eq(f + 1e-3 * f**3, -(w**2) * x))


@functools.cache
def implicit():
    ev, diagram = EqnEnv(), AcausalDiagram("implicit")
    diagram.add(Implicit(ev, "m"))
    return AcausalCompiler(ev, diagram)()


def last_implicit(x0, **options):
    changed = implicit().with_parameters({"m.x0": x0})
    return simulate(changed, t1=1.0, ts=jnp.array([1.0]), rtol=1e-9, atol=1e-11, **options)["m.x"][0]


@pytest.mark.parametrize("x0", [0.0, slow(1e-13), slow(1e-10)])
@pytest.mark.parametrize(
    "solver",
    [None, BDF(), slow(diffrax.Tsit5()), slow(diffrax.Kvaerno5())],
    ids=["default", "BDF", "Tsit5", "Kvaerno5"],
)
def test_other_methods_and_motion_that_tolerances_do_not_see(solver, x0):
    """The run would take a few long steps."""
    found = jax.grad(lambda x0: last_implicit(x0, solver=solver))(x0)
    assert abs(float(found) - np.cos(OMEGA)) < RESOLVED


def test_implicit_methods_by_forward_mode():
    found = jax.jacfwd(lambda x0: last_implicit(x0, adjoint=diffrax.ForwardMode()))(0.0)
    assert abs(float(found) - np.cos(OMEGA)) < RESOLVED


@pytest.mark.parametrize("count", [slow(1), 3])
def test_stiff_motion_that_has_died_away_costs_few_steps(count):
    """At rest, with rates of 1e5 and 1e3 beside 1: the push dies away, and steps may grow again."""

    class Decays(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            for k in range(count):
                x = self.variable(f"x{k}", start=self.parameter(f"start{k}", 0.0), fixed=True)
                self.add_equations(Eq(der(x), -(10.0 ** [0, 3, 5][k]) * x))

    ev, diagram = EqnEnv(), AcausalDiagram("decays")
    diagram.add(Decays(ev, "m"))
    system = AcausalCompiler(ev, diagram)()

    def last(start):
        changed = system.with_parameters({"m.start0": start})
        solution = simulate(changed, t1=3.0, ts=jnp.array([3.0]), solver=Rodas5P(), max_steps=400)
        return solution["m.x0"][0]

    assert abs(float(jax.grad(last)(0.0)) - np.exp(-3)) < 1e-4  # rtol 1e-6/0.03 a step
