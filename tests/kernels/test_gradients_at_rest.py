"""Derivatives of runs whose state, or some of it, rests at an equilibrium: its error is zero, so it says nothing about
steps.

Unresolved, ∂x(1)/∂x(0) of an undamped oscillator of 20 rad/s came out as 14,000 in place of cos 20.
"""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxonomy_dae.solve.adjoint import stored_adjoint
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, StoredAdjoint, Tsit5, solve_dae

# At rest, a step errs by rtol/0.03, 3e-8 of the motion; 20 rad s take some 60 of them.
RESOLVED = 2e-6
OMEGA = 20.0
NAMES = ("x0", "offset", "d", "theta", "push", "speed", "t1")
JUMP = 0.5  # s, when the push begins


def solve(p, solver=None, rtol=1e-9, atol=1e-11):
    """x'' = −ω²·(x − offset) − d·x' + θ + push(t), from rest at offset + x0, and s' = speed beside it, from 1; p in the
    order of NAMES."""
    x0, offset, d, theta, push, speed, t1 = p

    def field(t, y, args):
        offset, d, theta, push, speed = args
        x, v, _ = y
        return jnp.stack([v, -(OMEGA**2) * (x - offset) - d * v + theta + jnp.where(t >= JUMP, push, 0.0), speed])

    controller = diffrax.ClipStepSizeController(diffrax.PIDController(rtol, atol), jump_ts=jnp.array([JUMP]))
    start = jnp.stack([x0 + offset, jnp.zeros(()), jnp.ones(())])
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver or Tsit5(), 0.0, t1, 0.01, start, (offset, d, theta, push, speed),
        saveat=diffrax.SaveAt(ts=t1[None]), stepsize_controller=controller, adjoint=StoredAdjoint(), throw=False,
        max_steps=4096,
    )  # fmt: skip


def at(**values):
    return np.array([values.get(name, 1.0 if name == "t1" else 0.0) for name in NAMES])


CASES = {
    "rest": at(), "moves little": at(x0=1e-3), "moves": at(x0=1.0), "elsewhere": at(offset=0.3),
    "far": at(offset=-7e4), "pushed later": at(push=1.0), "damped": at(x0=1.0, d=2.0),
    "beside motion": at(speed=1.0),
}  # fmt: skip


def found(solver=None, batched=False):
    """(value, gradient) of all cases by one program: one after another, or as one batch."""
    return _found(solver, batched)


@functools.cache
def _found(solver, batched):

    def end(p):
        return solve(p, solver).ys[0, 0]

    given, gradient = np.stack(list(CASES.values())), jax.value_and_grad(end)
    if batched:
        values, gradients = jax.tree.map(np.asarray, jax.jit(jax.vmap(gradient))(given))
        rows = zip(values, gradients, strict=True)
    else:
        alone = jax.jit(gradient)
        rows = (jax.tree.map(np.asarray, alone(p)) for p in given)
    return {case: (value, dict(zip(NAMES, by, strict=True))) for case, (value, by) in zip(CASES, rows, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [None, *(pytest.param(s, marks=pytest.mark.slow) for s in (diffrax.Tsit5(), diffrax.Dopri5()))],
    ids=["ours", "Tsit5", "Dopri5"],
)
def test_by_the_start(solver):
    for case in ("rest", "moves little", "moves"):
        assert abs(found(solver)[case][1]["x0"] - np.cos(OMEGA)) < RESOLVED


@pytest.mark.slow
def test_in_batches():
    """Members at rest beside members that move."""
    for case, (value, by) in found(batched=True).items():
        alone, alone_by = found()[case]
        np.testing.assert_allclose(value, alone, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(by["x0"], alone_by["x0"], rtol=0, atol=2 * RESOLVED)
        if case != "damped":
            assert abs(by["x0"] - np.cos(OMEGA)) < RESOLVED


@pytest.mark.slow
def test_beside_what_moves():
    """The steps of what moves evenly grow without limit, too."""
    assert abs(found()["beside motion"][1]["x0"] - np.cos(OMEGA)) < RESOLVED


@pytest.mark.slow
@pytest.mark.parametrize("omega", [20.0, 2e3, 2e5])
def test_the_first_step(omega):
    """Chosen by what moves, it may be longer than the whole motion of what rests."""
    t1 = 20.0 / omega

    @jax.jit
    @jax.grad
    def slope(x0):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, w: jnp.stack([y[1], -(w**2) * y[0], -0.1 * y[2]])), Tsit5(), 0.0, t1, None,
            jnp.stack([x0, 0.0 * x0, 1.0 + 0.0 * x0]), omega, saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(1e-9, 1e-11), adjoint=StoredAdjoint(),
        ).ys[-1, 0]  # fmt: skip

    assert abs(float(slope(0.0)) - np.cos(20.0)) < RESOLVED


def test_by_a_force_that_is_zero():
    """As a policy that begins with zero output: x = θ·(1 − cos ωt)/ω²."""
    expected = (1 - np.cos(OMEGA)) / OMEGA**2
    assert abs(found()["rest"][1]["theta"] - expected) < RESOLVED / OMEGA**2


def test_at_an_equilibrium_that_is_not_zero():
    """There, rounding moves the state a little all the time."""
    for case in ("elsewhere", "far"):
        assert abs(found()[case][1]["x0"] - np.cos(OMEGA)) < RESOLVED


def test_pushed_later():
    """Rest for 0.5 s, then a force of 1: the derivative by the start is that of the motion all the way."""
    value, by = found()["pushed later"]
    assert abs(value - (1 - np.cos(OMEGA / 2)) / OMEGA**2) < 1e-7 / OMEGA
    assert abs(by["x0"] - np.cos(OMEGA)) < RESOLVED


def test_by_the_time_too():
    """x(T) = x0·cos ωT: derivatives by both at rest, and beside it."""
    for case, x0 in (("rest", 0.0), ("moves little", 1e-3)):
        by = found()[case][1]
        np.testing.assert_allclose([by["x0"], by["t1"]], [np.cos(OMEGA), -x0 * OMEGA * np.sin(OMEGA)], atol=RESOLVED)


def test_damped_motion():
    """The derivative by the damping of a motion from afar, against differences of the closed form."""

    def exact(d):
        w = np.sqrt(OMEGA**2 - d**2 / 4)
        return np.exp(-d / 2) * (np.cos(w) + d / (2 * w) * np.sin(w))

    expected = (exact(2.0 + 1e-5) - exact(2.0 - 1e-5)) / 2e-5
    assert abs(found()["damped"][1]["d"] - expected) < 1e-7


@pytest.mark.slow
def test_without_differentiation_steps_grow():
    """Nothing is held back where no derivative is asked for."""
    assert int(jax.jit(lambda p: solve(p, rtol=1e-6, atol=1e-8).stats["num_steps"])(at())) < 20


# --- implicit methods ------------------------------------------------------------------------------------------------


@functools.cache
def implicit(solver):
    """∂x(1)/∂x(0), where the force is the root of an equation that stays."""

    def field(t, y, args):
        x, v, force = y
        return jnp.stack([v, force, force + 1e-3 * force**3 + OMEGA**2 * x])

    term = DAETerm(field, mass=np.array([1.0, 1.0, 0.0]))

    def end(x0):
        start = jnp.stack([x0, 0.0 * x0, -(OMEGA**2) * x0])  # so small that the cubic is below rounding
        return solve_dae(term, 1.0, start, solver=solver, rtol=1e-9, atol=1e-11, throw=False).ys[0, 0]

    return eqx.filter_jit(jax.grad(end))


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(Rodas5P(), id="Rodas5P"),
        # At rest it sees no error, and its history is not that of the pushed run that chooses its steps and orders. Not
        # strict, for with other roundings it is right by chance.
        pytest.param(
            BDF(), id="BDF", marks=pytest.mark.xfail(reason="0.65 to 0.95 for 0.408, or off by 8e-6", strict=False)
        ),
    ],
)
def test_implicit_methods_and_motion_that_tolerances_do_not_see(solver):
    """The run would take a few long steps."""
    for x0 in (0.0, 1e-13, 1e-10):
        assert abs(float(implicit(solver)(jnp.array(x0))) - np.cos(OMEGA)) < RESOLVED


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_stiff_motion_that_has_died_away_costs_few_steps(count):
    """At rest, with rates of 1e5 and 1e3 beside 1: the push dies away, and steps may grow again."""
    rates = jnp.array([1.0, 1e3, 1e5])[:count]

    @jax.jit
    @jax.grad
    def slope(start):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, x, rates: -rates * x), Rodas5P(), 0.0, 3.0, 1e-3,
            jnp.zeros(count).at[0].set(start), rates, saveat=diffrax.SaveAt(ts=jnp.array([3.0])),
            stepsize_controller=diffrax.PIDController(1e-6, 1e-8), adjoint=StoredAdjoint(), throw=False, max_steps=400,
        ).ys[0, 0]  # fmt: skip

    assert abs(float(slope(0.0)) - np.exp(-3)) < 1e-4  # rtol 1e-6/0.03 a step


# --- other ways to ask -----------------------------------------------------------------------------------------------


def beside_a_ramp(way):
    """∂x(1)/∂x(0) at rest, and s' = 1 beside it."""

    def field(t, y, args):
        return jnp.stack([y[1], -(OMEGA**2) * y[0], 1.0 + 0.0 * y[2]])

    def end(x0):
        start = jnp.stack([x0, 0.0 * x0, 0.0 * x0])
        if way == "a controller that grows slowly":
            controller = diffrax.PIDController(1e-9, 1e-11, factormax=1.5)
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field), Tsit5(), 0.0, 1.0, 0.01, start, stepsize_controller=controller,
                adjoint=StoredAdjoint(), max_steps=4096,
            ).ys[-1, 0]  # fmt: skip
        adjoints = {"forward": diffrax.ForwardMode(), "checkpoint": diffrax.RecursiveCheckpointAdjoint()}
        adjoint = adjoints.get(way)
        term = DAETerm(field, mass=np.ones(3))
        return solve_dae(term, 1.0, start, rtol=1e-9, atol=1e-11, adjoint=adjoint, throw=False).ys[-1, 0]

    by = jax.jacfwd if way == "forward" else jax.grad
    return float(jax.jit(by(end))(jnp.zeros(())))


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    ["forward", *(pytest.param(w, marks=pytest.mark.slow) for w in ("checkpoint", "a controller that grows slowly"))],
)
def test_every_adjoint_and_controller(way):
    """`solve_dae` in forward mode gave 153,498 and a controller that grows by 1.5 at most 179.5, in place of 0.408."""
    assert abs(beside_a_ramp(way) - np.cos(OMEGA)) < RESOLVED


@pytest.mark.slow
def test_a_record_that_is_too_large(monkeypatch):
    """Kind: what one adjoint minds and the one that takes its place does not. Where the record of `StoredAdjoint` would
    be too large, steps were not held back, and ∂x(1)/∂x(0) at rest was −0.729 in place of 0.408."""
    monkeypatch.setattr(stored_adjoint, "LARGEST_RECORD", 0)
    assert abs(beside_a_ramp("default") - np.cos(OMEGA)) < RESOLVED


# --- random systems --------------------------------------------------------------------------------------------------


def drawn(seed):
    """(A, y(0), r, t1) of y' = A·y + r: four pairs of states that are oscillators at rest or not, of rates that differ
    by up to 1000, or stay as they are, or move evenly."""
    rng = np.random.default_rng([seed, 7])
    a, start, even, t1 = np.zeros((8, 8)), np.zeros(8), np.zeros(8), 10 ** rng.uniform(-1, 1)
    for i in range(0, 8, 2):
        kind = rng.choice(["rests", "oscillates", "moves evenly", "stays"])
        if kind in ("rests", "oscillates"):
            rate, scale = 10 ** rng.uniform(-1, 2) / t1, 10 ** rng.uniform(-2, 2)
            a[i, i + 1], a[i + 1, i] = scale, -(rate**2) / scale
            a[i + 1, i + 1] = -rate * rng.choice([0.0, 0.1, 1.4])
        start[i] = 0.0 if kind == "rests" else rng.normal()
        even[i] = rng.normal() if kind == "moves evenly" else 0.0
    return a, start, even, t1


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Tsit5(), Rodas5P()], ids=["Tsit5", "Rodas5P"])
def test_beside_each_other(solver):
    """∂y(t1)/∂y(0) = exp(A·t1), in parts of the largest entry of a row, at rtol 1e-6, of which a step errs by 33 times
    that, some hundred steps in a row by 1000 times; where steps were not held back, it was off by up to 1e13."""

    @jax.jit
    def slopes(a, start, even, t1):
        def end(start):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(lambda t, y, args: args[0] @ y + args[1]), solver, 0.0, t1, None, start, (a, even),
                saveat=diffrax.SaveAt(t1=True), stepsize_controller=diffrax.PIDController(1e-6, 1e-8),
                adjoint=StoredAdjoint(), max_steps=4096, throw=False,
            ).ys[-1]  # fmt: skip

        return jax.jacrev(end)(start)

    for seed in range(60):
        a, start, even, t1 = drawn(seed)
        exact = scipy.linalg.expm(a * t1)
        off = np.abs(np.asarray(slopes(a, start, even, t1)) - exact).max(axis=1)
        assert (off <= 1e-3 * np.maximum(np.abs(exact).max(axis=1), 1.0)).all(), seed
