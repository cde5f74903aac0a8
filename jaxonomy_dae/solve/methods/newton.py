"""The modified Newton iteration of an implicit step, and its derivative."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ...base.aliases import PyTree, Tolerance
from ...base.errors import ModelError
from ...base.private_names import FROM_CONTROLLER
from ..linear.choice import LinearAlgebra
from ..linear.mass import Mass
from .dae_term import FlatProblem

CONVERGED = 0.1  # of the local error's tolerance (Brenan, Campbell & Petzold 1996, section 5.2.2)
# The following, and the numbers in `_found`, are those of IDA (Hindmarsh et al. 2005, ACM TOMS 31:363).
DIVERGED = 0.9  # contraction rate above which an iteration is given up
STALE = 0.25  # relative change of the leading coefficient that a factorisation survives


class Tolerances(eqx.Module):
    """Tolerances of the iteration: those of the step-size controller, unless given."""

    rtol: Tolerance = FROM_CONTROLLER
    atol: Tolerance = FROM_CONTROLLER
    norm: PyTree = FROM_CONTROLLER

    def values(self, dtype: DTypeLike) -> tuple[Array, Array, Callable[[PyTree], Array]]:
        """(rtol, atol flat, norm)."""
        if self.rtol is FROM_CONTROLLER:
            raise ModelError(
                "BDF needs tolerances: call it by diffrax.diffeqsolve, or BDF(root_finder=Tolerances(...))"
            )
        leaves = [jnp.ravel(jnp.asarray(leaf, dtype)) for leaf in jax.tree.leaves(self.atol)]
        atol = leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)
        return jnp.asarray(self.rtol, dtype), atol[0] if atol.shape[0] == 1 else atol, self.norm


class Equation(NamedTuple):
    """M (slope + c_j (y − predicted)) = F(t, y), the equation of a step for y."""

    t: Float[ArrayLike, ""]
    predicted: Float[Array, " n"]
    slope: Float[Array, " n"]
    cj: Float[Array, ""]

    def residual(self, mass: Mass, right: Callable[..., Array], y: Float[Array, " n"]) -> Float[Array, " n"]:
        """The left side minus the right one."""
        return mass.times(self.slope + self.cj.astype(y.dtype) * (y - self.predicted)) - right(self.t, y)


class Known(NamedTuple):
    """What earlier steps have left: a factorisation and its c_j, the c_j and ρ/(1 − ρ) of the last iteration; and the
    weight of each unknown in norms."""

    factor: PyTree  # as the linear algebra keeps it
    factor_cj: Float[Array, ""]
    last_cj: Float[Array, ""]
    contraction: Float[Array, ""]
    weight: Float[Array, " n"]


class Solved(NamedTuple):
    """The outcome of `implicit_step`."""

    y: Float[Array, " n"]
    converged: Bool[Array, ""]
    factor: PyTree
    factor_cj: Float[Array, ""]
    contraction: Float[Array, ""]
    factorisations: Int[Array, ""]
    iterations: Int[Array, ""]


def implicit_step(
    problem: FlatProblem,
    linear: LinearAlgebra,
    equation: Equation,
    known: Known,
    norm: Callable[[PyTree], Array],
    max_iterations: int,
) -> Solved:
    """Solves the equation of a step.

    The factorisation at hand serves if its leading coefficient is near; where the iteration then fails, it is made anew
    at the prediction and tried once more. The derivative of y is that of the equation, whatever factorisation was used.
    """
    # What the equations close over, such as parameters, becomes an argument of the rule below. JAX does not
    # differentiate what a custom rule closes over.
    right = eqx.filter_closure_convert(problem.right, equation.t, equation.predicted)
    mass = problem.mass

    @eqx.filter_custom_jvp
    def root(right, equation, known):
        found = _found(linear, mass, right, equation, known, norm, max_iterations)
        return found.y, found[1:]

    @root.def_jvp
    def _(primals, tangents):
        right, equation, known = primals
        y, rest = root(right, equation, known)

        def at(right, equation):
            return equation.residual(mass, right, y)

        _, change = eqx.filter_jvp(at, (right, equation), tuple(tangents[:2]))
        # At the solution, not that of the iteration: a stale factorization costs iterations, and must not cost digits
        # of derivatives.
        _, jacobian = linear.jacobian(lambda v: right(equation.t, v), y)
        matrix = linear.combine(mass, equation.cj.astype(y.dtype), jacobian)
        tangent = linear.solve(linear.factor(matrix), matrix, -change)
        return (y, rest), (tangent, jax.tree.map(lambda v: None, rest))

    y, rest = root(right, equation, jax.lax.stop_gradient(known))
    return Solved(y, *jax.lax.stop_gradient(rest))


def _found(
    linear: LinearAlgebra,
    mass: Mass,
    right: Callable[..., Array],
    equation: Equation,
    known: Known,
    norm: Callable[[PyTree], Array],
    max_iterations: int,
) -> Solved:
    """The solution, found with the factorisation at hand, or with one made at the prediction. A second failure there is
    one of the step size, which the error test shortens."""
    t, predicted, cj, dtype = equation.t, equation.predicted, equation.cj, equation.predicted.dtype

    def fresh():
        _, jacobian = linear.jacobian(lambda y: right(t, y), predicted)
        return linear.factor(linear.combine(mass, cj.astype(dtype), jacobian)), cj

    def attempt(carry):
        renew, solved, _ = carry
        factor, factor_cj = jax.lax.cond(renew, fresh, lambda: (solved.factor, solved.factor_cj))
        changed = renew | (cj != known.last_cj)
        # ρ/(1−ρ) is not known before the second iteration. A pessimistic guess makes sure of two iterations, unless
        # the first change is far below the tolerance: 20 for a new factorisation, 100 for one of another c_j.
        contraction = jnp.where(renew, 20.0, jnp.where(changed, 100.0, solved.contraction))
        # An old factorisation belongs to another c_j, which this factor makes up for (section 5.2.2).
        scale = (2 / (1 + cj / factor_cj)).astype(dtype)

        def change(y):
            return -scale * linear.apply(factor, None, equation.residual(mass, right, y))

        y, m, contraction, done = _iterated(
            change, predicted, contraction.astype(dtype), lambda v: norm(v * known.weight), max_iterations
        )
        made, iterations = solved.factorisations + renew.astype(jnp.int32), solved.iterations + m
        return (
            jnp.array(True),
            Solved(y, done, factor, factor_cj, contraction.astype(cj.dtype), made, iterations),
            renew,
        )

    def unfinished(carry):
        _, solved, was_fresh = carry
        return ~solved.converged & ~was_fresh

    ratio = cj / jnp.where(known.factor_cj == 0, 1, known.factor_cj)
    near = (1 - STALE) / (1 + STALE)
    stale = (known.factor_cj == 0) | (ratio < near) | (ratio > 1 / near)
    zero, no = jnp.array(0, jnp.int32), jnp.array(False)
    begin = Solved(predicted, no, known.factor, known.factor_cj, known.contraction, zero, zero)
    _, solved, _ = jax.lax.while_loop(unfinished, attempt, (stale, begin, no))
    y = jnp.where(solved.converged & jnp.isfinite(solved.y).all(), solved.y, predicted)
    return solved._replace(y=y)


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
