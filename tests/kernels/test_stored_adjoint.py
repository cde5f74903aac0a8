"""Gradients by `StoredAdjoint`: those of Diffrax's own adjoints, and closed forms.

Both differentiate the same steps, so they agree to rounding: 1e-10 relative to the largest component leaves room for
its growth over some hundred steps.
"""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxonomy_dae.host.cache import compiled
from jaxonomy_dae.solvers import BDF, DAETerm, StoredAdjoint, Tsit5, solve_dae

STORED, RECURSIVE = StoredAdjoint(), diffrax.RecursiveCheckpointAdjoint()
ARGS = (np.array([1.5, 1.0]), np.array([[0.1, -0.2], [0.3, 0.2]]))
Y0 = np.array([1.0, 0.5])
PID = diffrax.PIDController(rtol=1e-6, atol=1e-8)
TS = np.array([0.0, 0.7, 0.71, 0.72, 2.0, 3.9])
# For comparisons to rounding of two programs that XLA compiles separately: where a controller chooses steps, rounding
# of its error estimates moves the steps' times by eps/rtol relatively (1e-10 at rtol 1e-6, 1e-4 in single precision).
SAME_STEPS = diffrax.StepTo(np.linspace(0.0, 4.0, 101))


def field(t, y, args):
    """A driven predator–prey model with a bounded learned term."""
    (a, b), w = args
    growth = jnp.stack([a * y[0] - y[0] * y[1], y[0] * y[1] - b * y[1]])
    return growth + 0.1 * jnp.tanh(w @ y) + 0.1 * jnp.cos(3 * t)


def solve(args, y0, adjoint, t0=0.0, t1=4.0, dt0=0.05, solver=None, saveat=None, controller=PID, term=None, **kwargs):
    kwargs = {"max_steps": 4096, "throw": True} | kwargs
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field) if term is None else term,
        Tsit5() if solver is None else solver,
        t0, t1, dt0, y0, args,
        saveat=diffrax.SaveAt(t1=True) if saveat is None else saveat,
        stepsize_controller=controller, adjoint=adjoint, **kwargs,
    )  # fmt: skip


def total(solution):
    """A weighted sum of everything saved, rows never filled excepted."""
    leaves = jax.tree.leaves((solution.ys, solution.ts))
    finite = [jnp.where(jnp.isfinite(leaf), leaf, 0) for leaf in leaves]
    return sum(jnp.sum(leaf * jnp.cos(jnp.arange(leaf.size, dtype=leaf.dtype)).reshape(leaf.shape)) for leaf in finite)


def agree(a, b, tolerance=1e-10):
    a, b = jax.tree.leaves(a), jax.tree.leaves(b)
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * max(float(np.abs(other).max()), 1e-3))


def both(loss, *at, argnums=0):
    """The loss and its gradient by both adjoints, which must agree."""
    mine = jax.jit(jax.value_and_grad(lambda *v: loss(*v, STORED), argnums))(*at)
    other = jax.jit(jax.value_and_grad(lambda *v: loss(*v, RECURSIVE), argnums))(*at)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(other))
    agree(mine, other)
    return mine


SAVED = {
    "t1": diffrax.SaveAt(t1=True),
    "ts": diffrax.SaveAt(ts=TS),  # the start, several within a step, none in most steps
    "steps": diffrax.SaveAt(t0=True, steps=True),
    "parts": diffrax.SaveAt(
        subs=[
            diffrax.SubSaveAt(ts=TS, steps=2, t1=True, fn=lambda t, y, args: {"a": args[0][0] * y[0] ** 2, "b": t * y}),
            diffrax.SubSaveAt(t0=True, ts=TS[2:]),
        ]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("saved", ["parts"])
def test_what_is_saved(saved):
    def loss(args, y0, adjoint):
        return total(solve(args, y0, adjoint, dt0=None, controller=SAME_STEPS, saveat=SAVED[saved]))

    both(loss, ARGS, Y0, argnums=(0, 1))


@pytest.mark.slow
def test_an_implicit_solver():
    """Another's; ours are compared in test_dae_gradients.py."""
    solver = diffrax.Kvaerno5(root_finder=optx.Newton(rtol=1e-9, atol=1e-9))

    def loss(args, y0, adjoint):
        saveat = diffrax.SaveAt(ts=TS)
        return total(solve(args, y0, adjoint, dt0=None, solver=solver, controller=SAME_STEPS, saveat=saveat))

    both(loss, ARGS, Y0, argnums=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("t1, max_steps", [(20.0, 4096), pytest.param(170.0, None, marks=pytest.mark.slow)])
def test_more_steps_than_rows(t1, max_steps):
    """Pieces are run again, and with the 64 rows and 32 points of large states, points are thinned out beyond 2048."""
    copies = 1 if max_steps else 2000
    term = diffrax.ODETerm(lambda t, y, args: args * jnp.stack([y[1], -y[0]]))
    controller = diffrax.StepTo(np.linspace(0.0, t1, 301 if max_steps else 2501))

    def final(args, adjoint):
        y0 = jnp.tile(Y0[:, None], copies)
        solved = solve(args, y0, adjoint, t1=t1, dt0=None, controller=controller, term=term, max_steps=max_steps)
        return jnp.array([1.0, 2.0]) @ jnp.mean(solved.ys[0], axis=1)

    value, slope = jax.jit(jax.value_and_grad(lambda args: final(args, STORED)))(np.array(1.0))
    exact = np.array([np.cos(t1) + 0.5 * np.sin(t1), 0.5 * np.cos(t1) - np.sin(t1)]) @ [1.0, 2.0]
    turned = t1 * np.array([0.5 * np.cos(t1) - np.sin(t1), -np.cos(t1) - 0.5 * np.sin(t1)]) @ [1.0, 2.0]
    # Steps of 0.07 with an error constant of about 1e-4 at order 5: 1e-4·0.07^5·t1 = 3e-8 of the angle, times t1.
    np.testing.assert_allclose(value, exact, atol=1e-7)
    np.testing.assert_allclose(slope, turned, atol=1e-7 * t1)
    if copies > 1:
        forward = jax.jit(jax.jacfwd(lambda args: final(args, diffrax.ForwardMode())))(np.array(1.0))
        agree(slope, forward)


def swung(scale, y0):
    """A number that depends on a pendulum of this time scale."""
    term = diffrax.ODETerm(lambda t, y, args: args * jnp.stack([y[1], -jnp.sin(y[0])]))
    return total(solve(scale, y0, STORED, term=term, saveat=diffrax.SaveAt(ts=TS)))


@pytest.mark.slow
def test_batches():
    """y'' = −k²·y: members that take different numbers of steps, some more than the record has rows, others few."""
    term = diffrax.ODETerm(lambda t, y, k: k * jnp.stack([y[1], -y[0]]))
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-8)

    def loss(k, y0):
        return solve(k, y0, STORED, term=term, controller=controller).ys[-1] @ np.array([1.0, 2.0])

    def exact(k, y0):
        c, s = jnp.cos(k * 4.0), jnp.sin(k * 4.0)
        return (c - 2 * s) * y0[0] + (s + 2 * c) * y0[1]

    k = np.array([0.05, 1.0, 40.0])
    y0 = np.stack([Y0, 1.1 * Y0, 0.5 * Y0])
    found, expected = (jax.jit(jax.vmap(jax.grad(f, argnums=(0, 1))))(k, y0) for f in (loss, exact))
    # Some 160 radians at 1e-8 a step: 1e-6, and by k that times the end, 4.
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5)


SCALES = np.array([0.05, 1.0, 40.0])
STARTS = np.stack([Y0, 1.1 * Y0, 0.5 * Y0])
by_both = jax.grad(swung, argnums=(0, 1))


@functools.cache
def batch():
    return jax.jit(jax.vmap(by_both))(SCALES, STARTS)


@pytest.mark.slow
def test_batches_are_their_members():
    """Members that take different numbers of steps; to rounding."""
    alone = jax.jit(by_both)
    each = [alone(s, y) for s, y in zip(SCALES, STARTS, strict=True)]
    # Fused differently, the error estimates differ by rounding, and so do step sizes: by 1e-16/rtol relatively, and
    # the result by that part of its own error, over the 170 radians of the fastest member.
    agree(batch(), jax.tree.map(lambda *leaves: np.stack(leaves), *each), 1e-7)


@pytest.mark.slow
def test_nested_and_outer_batches():
    """vmap of vmap, and the gradient of a vmap with what is shared between its members."""
    nested = jax.jit(jax.vmap(jax.vmap(by_both)))(SCALES[None], STARTS[None])
    agree(nested, jax.tree.map(lambda leaf: np.asarray(leaf)[None], batch()), 1e-7)
    scale = np.array([0.05, 1.0, 4.0])
    shared = jax.jit(jax.grad(lambda y0: jax.vmap(lambda s: swung(s, y0))(scale).sum()))(Y0)
    parts = jax.jit(jax.vmap(jax.grad(lambda y0, s: swung(s, y0)), (None, 0)))(Y0, scale)
    agree(shared, np.asarray(parts).sum(axis=0), 1e-7)


@pytest.mark.slow
def test_times():
    """The start, the end, the length of steps and the times saved at."""

    def loss(t0, t1, dt0, ts, adjoint):
        saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(steps=1, t1=True)])
        controller = diffrax.ConstantStepSize()  # compared to rounding, as with SAME_STEPS
        return total(solve(ARGS, Y0, adjoint, t0=t0, t1=t1, dt0=dt0, controller=controller, saveat=saveat))

    at = jnp.array(0.0), jnp.array(4.0), jnp.array(0.3), TS[1:]
    _, slopes = both(loss, *at, argnums=(0, 1, 2, 3))
    assert all(np.abs(leaf).min() > 1e-8 for leaf in slopes)


def test_end_in_closed_form():
    """y(t1) of y' = a·y·t: dy/dt1 = a·t1·y and dy/dt0 = −a·t0·y, to the solver's accuracy; and the time saved."""
    term = diffrax.ODETerm(lambda t, y, a: a * y * t)
    controller = diffrax.PIDController(rtol=1e-10, atol=1e-10)

    def final(t0, t1):
        solution = solve(-0.5, jnp.array([2.0]), STORED, t0=t0, t1=t1, term=term, controller=controller)
        return solution.ys[0, 0] + 3 * solution.ts[0]

    value, (by_start, by_end) = jax.jit(jax.value_and_grad(final, (0, 1)))(np.array(0.5), np.array(2.0))
    y = 2 * np.exp(-0.25 * (2.0**2 - 0.5**2))
    np.testing.assert_allclose([value, by_start, by_end], [y + 6, 0.25 * y, 3 - y], rtol=1e-8)


@pytest.mark.slow
def test_jumps():
    """A discontinuity at a time that is differentiated, which the controller steps to."""

    def loss(jump, args, adjoint):
        controller = diffrax.ClipStepSizeController(PID, jump_ts=jump[None])
        term = diffrax.ODETerm(lambda t, y, a: -a * y + jnp.where(t < jump, 0.0, 1.0))
        saveat = diffrax.SaveAt(ts=TS, steps=True)
        return total(solve(args, Y0, adjoint, controller=controller, term=term, saveat=saveat))

    both(loss, jnp.array(1.3), jnp.array(0.7), argnums=(0, 1))


def slope_with_rejected_steps(adjoint):
    """A first step far too long takes the root of a negative number: y' = −a·√y, y(1) = (1 − a/2)² for y(0) = 1.
    Within [0, 1] y stays positive for a = 1.9, 0.0025 at the end, but stages of long steps do not."""
    term = diffrax.ODETerm(lambda t, y, a: -a * jnp.sqrt(y))
    strict = diffrax.ClipStepSizeController(diffrax.PIDController(rtol=1e-9, atol=1e-9))

    def final(a):
        solved = solve(a, np.array([1.0]), adjoint, t1=1.0, dt0=20.0, term=term, controller=strict)
        return solved.ys[0, 0], solved.stats["num_rejected_steps"]

    return jax.jit(jax.value_and_grad(final, has_aux=True))(np.array(1.9))


@pytest.mark.slow
def test_rejected_steps_do_no_harm():
    (value, rejected), by_a = slope_with_rejected_steps(STORED)
    assert int(rejected) > 0
    np.testing.assert_allclose(value, (1 - 1.9 / 2) ** 2, rtol=1e-6)
    np.testing.assert_allclose(by_a, -(1 - 1.9 / 2), rtol=1e-6)


@pytest.mark.slow
def test_rejected_steps_do_harm_elsewhere():
    """Why they are left out."""
    assert np.isnan(slope_with_rejected_steps(RECURSIVE)[1])


@pytest.mark.slow
def test_failed_solves():
    """Rows that were never reached are infinite and have no part in the gradient."""

    def loss(args, adjoint):
        return total(solve(args, Y0, adjoint, saveat=SAVED["ts"], max_steps=9, throw=False))

    both(loss, ARGS)


@pytest.mark.slow
def test_single_precision():
    args, y0 = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (ARGS, Y0))
    controller = diffrax.StepTo(np.linspace(0, 4, 101, dtype=np.float32))

    def loss(args, adjoint):
        saveat = diffrax.SaveAt(ts=TS.astype(jnp.float32))
        return total(solve(args, y0, adjoint, t0=jnp.float32(0), t1=jnp.float32(4), dt0=None,
                           saveat=saveat, controller=controller))  # fmt: skip

    mine = jax.jit(jax.grad(lambda args: loss(args, STORED)))(args)
    other = jax.jit(jax.grad(lambda args: loss(args, RECURSIVE)))(args)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(mine))
    agree(mine, other, 2e-5)  # some hundred roundings of 1e-7


@pytest.mark.slow
def test_closures():
    """What is differentiated may be hidden in functions, also in one that `SaveAt` calls."""

    def loss(a, adjoint):
        term = diffrax.ODETerm(lambda t, y, args: -a * y + args(t))
        saveat = diffrax.SaveAt(ts=TS, fn=lambda t, y, args: a * y * args(t))
        return total(solve(lambda t: jnp.sin(a * t), Y0, adjoint, term=term, saveat=saveat))

    both(loss, jnp.array(0.8))


@pytest.mark.slow
def test_networks():
    """Modules with functions and static parts in `args`; arrays that are not floats are left alone."""
    network = eqx.nn.MLP(2, 2, 4, 1, jnp.tanh, key=jax.random.key(1))
    table = jnp.array([1, 0])
    term = diffrax.ODETerm(lambda t, y, args: args[0](y)[args[1]] - y)

    def loss(adjoint):
        return eqx.filter_jit(eqx.filter_grad(lambda n: total(solve((n, table), Y0, adjoint, term=term))))(network)

    agree(loss(STORED), loss(RECURSIVE))


@pytest.mark.slow
def test_final_solver_state():
    """A solve in two parts, the second one from where the solver stood, is differentiated through its state."""

    def loss(args, adjoint):
        saveat = diffrax.SaveAt(t1=True, solver_state=True)
        first = solve(args, Y0, adjoint, t1=2.0, saveat=saveat)
        return total(solve(args, first.ys[0], adjoint, t0=2.0, solver_state=first.solver_state))

    both(loss, ARGS)


@pytest.mark.slow
def test_events_are_handed_on():
    """y' = a, until y = 1: the time is 1/a."""
    term = diffrax.ODETerm(lambda t, y, a: a * jnp.ones_like(y))
    event = diffrax.Event(lambda t, y, args, **kwargs: y[0] - 1, optx.Newton(1e-10, 1e-10))

    def end(a):
        return solve(a, jnp.array([0.0]), STORED, term=term, event=event).ts[0]

    np.testing.assert_allclose(jax.jit(jax.value_and_grad(end))(jnp.array(2.0)), (0.5, -0.25), rtol=1e-10)


def test_forward_mode_is_refused():
    with pytest.raises(TypeError, match="custom_vjp"):
        jax.jvp(lambda y0: solve(ARGS, y0, STORED).ys, (Y0,), (Y0,))


@pytest.mark.slow
def test_nothing_recorded_without_differentiation():
    """The result is that of Diffrax's own loop, to the rounding of two programs."""
    options = {"saveat": SAVED["parts"], "controller": SAME_STEPS, "dt0": None}
    mine = jax.jit(lambda: solve(ARGS, Y0, STORED, **options))()
    other = jax.jit(lambda: solve(ARGS, Y0, diffrax.ForwardMode(), **options))()
    assert {k: int(v) for k, v in mine.stats.items()} == {k: int(v) for k, v in other.stats.items()}
    agree((mine.ts[0][:10], mine.ys[0]["a"][:10]), (other.ts[0][:10], other.ys[0]["a"][:10]), 1e-14)


@pytest.mark.slow
def test_without_rank_promotion():
    """`jax_numpy_rank_promotion="raise"`, here with BDF: x' = −a·z, z = x, so ∂x(1)/∂a = −exp(−a)."""
    term = DAETerm(lambda t, x, z, a: -a * z, lambda t, x, z, a: z - x)

    def final(a):
        return solve_dae(term, 1.0, (np.ones(2), np.ones(2)), solver=BDF(), args=a, throw=False).ys[0][0, 0]

    with jax.numpy_rank_promotion("raise"):
        assert jax.jit(jax.grad(final))(0.7) == pytest.approx(-np.exp(-0.7), rel=1e-4)


@pytest.mark.slow
def test_a_record_that_is_whole_says_nothing_of_another_one():
    """Of two solves in one program, the second has more steps than its record has room for. Inside of `jax.checkpoint`
    it hands on nothing: the first one's record counted for it, and the gradient was not a number."""

    def decayed(k, steps):
        term, step = diffrax.ODETerm(lambda t, y, k: -k * y), 1.0 / steps
        return diffrax.diffeqsolve(
            term, Tsit5(), 0.0, 1.0, step, jnp.ones(1), k, adjoint=STORED, max_steps=1000, throw=False
        ).ys[-1, 0]  # fmt: skip

    run = compiled(lambda k: decayed(k, 5) + jax.checkpoint(lambda k: decayed(2 * k, 400))(k))
    expected = -np.exp(-0.7) - 2 * np.exp(-1.4)
    assert float(jax.grad(run)(jnp.asarray(0.7))) == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_parts_of_parameters_are_read_once():
    """A step's cotangents are as long as what it reads. Each read of a long array inside the step was padded to the
    length of the whole, at every stage: the gradient of a ladder of 4,000 cells by its parameters took 11 times its
    run, and half of this went into pads."""
    n = 600
    values = jnp.concatenate([jnp.linspace(0.5, 1.0, n), jnp.linspace(1.0, 3.0, n), jnp.ones(1)])
    mixed = np.random.default_rng(0).permutation(n)

    @jax.jit
    def along(values, y):
        return values[:n] * (jnp.append(values[-1], y[:-1]) - y)

    def diffusion(t, y, values):
        flow = along(values, y)  # functions that are called read, too
        return (flow - jnp.append(flow[1:], 0.0)) / values[n + mixed]

    def loss(values, adjoint):
        return total(
            solve(values, jnp.zeros(n), adjoint, dt0=None, term=diffrax.ODETerm(diffusion), controller=SAME_STEPS)
        )

    traced = jax.jit(jax.grad(functools.partial(loss, adjoint=STORED))).trace(values)
    agree(traced.lower().compile()(values), jax.jit(jax.grad(functools.partial(loss, adjoint=RECURSIVE)))(values))
    inside = list(_loop_bodies(traced.jaxpr.jaxpr))
    assert inside
    whole = [e for body in inside for e in body.eqns if any(v.aval.shape == values.shape for v in e.outvars)]
    assert not [e.primitive.name for e in whole if e.primitive.name in ("pad", "scatter-add", "add_any", "add")]


def _loop_bodies(jaxpr, inside=False):
    """All programs inside loops of a program."""
    if inside:
        yield jaxpr
    for equation in jaxpr.eqns:
        within = inside or equation.primitive.name in ("while", "scan")
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")):
            leaf = getattr(leaf, "jaxpr", leaf)
            if hasattr(leaf, "eqns"):
                yield from _loop_bodies(leaf, within)
