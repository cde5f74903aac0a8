"""The modified Newton iteration of an implicit step, and its derivative."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..aliases import PyTree, Tolerance
from ..errors import ModelError
from ..linear.choice import LinearAlgebra
from ..private_names import FROM_CONTROLLER
from .dae_term import FlatProblem

CONVERGED = 0.1  # of the local error's tolerance (Brenan, Campbell & Petzold 1996, section 5.2.2)
# The following, and the numbers in `attempt`, are those of IDA (Hindmarsh et al. 2005, ACM TOMS 31:363).
DIVERGED = 0.9  # contraction rate above which an iteration is given up
STALE = 0.25  # relative change of the leading coefficient that a factorisation survives


class Tolerances(eqx.Module):
    """Tolerances of the iteration: those of the step-size controller, unless given."""

    rtol: Tolerance = FROM_CONTROLLER
    atol: Tolerance = FROM_CONTROLLER
    norm: PyTree = FROM_CONTROLLER

    def values(self, dtype: DTypeLike) -> tuple[Any, Any, Callable[[Any], Any]]:
        """(rtol, atol flat, norm)."""
        if self.rtol is FROM_CONTROLLER:
            raise ModelError(
                "BDF needs tolerances: call it by diffrax.diffeqsolve, or BDF(root_finder=Tolerances(...))"
            )
        leaves = [jnp.ravel(jnp.asarray(leaf, dtype)) for leaf in jax.tree.leaves(self.atol)]
        atol = leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)
        return jnp.asarray(self.rtol, dtype), atol[0] if atol.shape[0] == 1 else atol, self.norm


class Solved(NamedTuple):
    """The outcome of `implicit_step`."""

    y: Float[Array, " n"]
    converged: Bool[Array, ""]
    factor: PyTree  # as the linear algebra keeps it
    factor_cj: Float[Array, ""]
    contraction: Float[Array, ""]
    factorisations: Int[Array, ""]
    iterations: Int[Array, ""]


def implicit_step(
    problem: FlatProblem,
    linear: LinearAlgebra,
    t: Float[ArrayLike, ""],
    predicted: Float[Array, " n"],
    slope: Float[Array, " n"],
    cj: Float[Array, ""],
    *,
    weight: Float[Array, " n"],
    norm: Callable[[PyTree], PyTree],
    max_iterations: int,
    factor: PyTree,
    factor_cj: Float[Array, ""],
    last_cj: Float[Array, ""],
    contraction: Float[Array, ""],
) -> Solved:
    """Solves M (slope + c_j (y − predicted)) = F(t, y).

    The factorisation at hand serves if its leading coefficient is near; where the iteration then fails, it is made anew
    at the prediction and tried once more. The derivative of y is that of the equation, whatever factorisation was used.
    """
    right = eqx.filter_closure_convert(problem.right, t, predicted)
    dtype = predicted.dtype

    @eqx.filter_custom_jvp
    def root(right, t, predicted, slope, cj, history):
        factor, factor_cj, last_cj, contraction, weight = history
        mass, y_cj = problem.mass, cj.astype(dtype)

        def residual(y):
            return mass.times(slope + y_cj * (y - predicted)) - right(t, y)

        def fresh():
            _, jacobian = linear.jacobian(lambda y: right(t, y), predicted)
            return linear.factor(linear.combine(mass, y_cj, jacobian)), cj

        ratio = cj / jnp.where(factor_cj == 0, 1, factor_cj)
        near = (1 - STALE) / (1 + STALE)
        stale = (factor_cj == 0) | (ratio < near) | (ratio > 1 / near)

        def attempt(carry):
            renew, _, factor, factor_cj, contraction, made, iterations = carry
            factor, factor_cj = jax.lax.cond(renew, fresh, lambda: (factor, factor_cj))
            changed = renew | (cj != last_cj)
            # ρ/(1−ρ) is not known before the second iteration. A pessimistic guess makes sure of two iterations, unless
            # the first change is far below the tolerance: 20 for a new factorisation, 100 for one of another c_j.
            contraction = jnp.where(renew, 20.0, jnp.where(changed, 100.0, contraction))
            # An old factorisation belongs to another c_j, which this factor makes up for (section 5.2.2).
            scale = (2 / (1 + cj / factor_cj)).astype(dtype)

            def change(y):
                return -scale * linear.apply(factor, None, residual(y))

            y, m, contraction, done = _iterated(
                change, predicted, contraction.astype(dtype), lambda v: norm(v * weight), max_iterations
            )
            contraction = contraction.astype(cj.dtype)
            out = y, factor, factor_cj, contraction, made + renew.astype(jnp.int32), iterations + m
            return done, out

        def body(carry):
            renew, _, (_, factor, factor_cj, contraction, made, iterations), _ = carry
            done, out = attempt((renew, None, factor, factor_cj, contraction, made, iterations))
            return jnp.array(True), done, out, renew

        # Twice at most: with the factorisation at hand, and if that fails, with one made at the prediction. A second
        # failure there is one of the step size, which the error test shortens.
        def unfinished(carry):
            _, done, _, was_fresh = carry
            return ~done & ~was_fresh

        zero = jnp.array(0, jnp.int32)
        start = (stale, jnp.array(False), (predicted, factor, factor_cj, contraction, zero, zero), jnp.array(False))
        _, done, (y, *rest), _ = jax.lax.while_loop(unfinished, body, start)
        y = jnp.where(done & jnp.isfinite(y).all(), y, predicted)
        return y, (done, *rest)

    @root.def_jvp
    def _(primals, tangents):
        right, t, predicted, slope, cj, history = primals
        y, rest = root(right, t, predicted, slope, cj, history)

        def at(right, t, predicted, slope, cj):
            return problem.mass.times(slope + cj.astype(dtype) * (y - predicted)) - right(t, y)

        moved = (*tangents[:5],)
        _, change = eqx.filter_jvp(at, (right, t, predicted, slope, cj), moved)
        _, jacobian = linear.jacobian(lambda v: right(t, v), y)
        matrix = linear.combine(problem.mass, cj.astype(dtype), jacobian)
        tangent = linear.solve(linear.factor(matrix), matrix, -change)
        still = jax.tree.map(lambda v: None, rest)
        return (y, rest), (tangent, still)

    still = jax.lax.stop_gradient
    y, rest = root(right, t, predicted, slope, cj, still((factor, factor_cj, last_cj, contraction, weight)))
    done, factor, factor_cj, contraction, made, iterations = still(rest)
    return Solved(y, done, factor, factor_cj, contraction, made.astype(jnp.int32), iterations.astype(jnp.int32))


def _iterated(
    change: Callable[[Array], Array], start: Array, contraction: Array, size: Callable[[Array], Array], most: int
) -> tuple[Array, Array, Array, Array]:
    """Newton's iteration by the steps `change(y)`. Returns (y, the number of steps, ρ/(1−ρ) of the last ones, whether
    it converged)."""
    dtype = start.dtype

    def iterate(inner):
        y, m, first, contraction, _, _ = inner
        step = change(y)
        length = size(step)
        first = jnp.where(m == 0, length, first)
        mean = (length / jnp.where(first == 0, 1, first)) ** (1 / jnp.maximum(m, 1).astype(dtype))
        rate = jnp.where(m == 0, 0.0, mean)
        failed = ~jnp.isfinite(length) | (rate > DIVERGED)
        contraction = jnp.where(m == 0, contraction, jnp.where(failed, contraction, rate / (1 - rate)))
        small = jnp.where(m == 0, length <= 1e-4 * CONVERGED, False)
        done = (small | (contraction * length <= CONVERGED)) & ~failed
        return y + step, m + 1, first, contraction, done, failed

    def going(inner):
        _, m, _, _, done, failed = inner
        return ~done & ~failed & (m < most)

    no = jnp.array(False)
    begin = start, jnp.array(0, jnp.int32), jnp.zeros((), dtype), contraction, no, no
    y, m, _, contraction, done, _ = jax.lax.while_loop(going, iterate, begin)
    return y, m, contraction, done
