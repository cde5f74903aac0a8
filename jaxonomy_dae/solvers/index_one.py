"""What index 1 means for a solver: a slope at a consistent point, and a way back to one."""

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Float

from ..linear.choice import LinearAlgebra, choose
from .dae_term import FlatProblem


def index_matrix(
    problem: FlatProblem, linear: lx.AbstractLinearSolver | None, t: Float[ArrayLike, ""], y: Float[Array, " n"]
) -> tuple[LinearAlgebra, Float[Array, " n"], Any, Any]:
    """(linear algebra, F, ∂F/∂y, M − P ∂F/∂y): with P the projector onto the algebraic equations, the last is regular
    if and only if the index is 1."""
    chosen = choose(linear, y.shape[0], problem.pattern, problem.mass)
    right, jacobian = chosen.jacobian(lambda v: problem.right(t, v), y)
    return chosen, right, jacobian, chosen.index_matrix(problem.mass, jacobian)


def consistent_slope(
    problem: FlatProblem, linear: lx.AbstractLinearSolver | None, t: Float[ArrayLike, ""], y: Float[Array, " n"]
) -> Float[Array, " n"]:
    """dy/dt at a consistent point: M y' = F in the differential equations, P (∂F/∂t + ∂F/∂y y') = 0 in the others."""
    if not problem.mass.is_singular:
        chosen, right, _, matrix = index_matrix(problem, linear, t, y)
        return chosen.solve(chosen.factor(matrix), matrix, right) if not _is_identity(problem) else right
    chosen, right, _, matrix = index_matrix(problem, linear, t, y)
    drift = jax.jvp(lambda s: problem.right(s, y), (t,), (jnp.ones_like(t),))[1]
    b = right + algebraic_part(problem, drift - right)
    return chosen.solve(chosen.factor(matrix), matrix, b)


def consistent_shift(
    problem: FlatProblem,
    linear: lx.AbstractLinearSolver | None,
    t: Float[ArrayLike, ""],
    y: Float[Array, " n"],
    start: Float[Array, " n"],
) -> Float[Array, " n"]:
    """A Newton step onto the algebraic equations that leaves M y as it was at the start: zero at a consistent point.

    Large steps there and back would leave rounding errors in M y, so every step mends it.
    """
    chosen, right, _, matrix = index_matrix(problem, linear, t, y)
    b = algebraic_part(problem, right) + problem.mass.times(start - y)
    return chosen.solve(chosen.factor(matrix), matrix, b)


def consistent_point(
    problem: FlatProblem,
    linear: lx.AbstractLinearSolver | None,
    t: Float[ArrayLike, ""],
    y: Float[Array, " n"],
    max_steps: int = 50,
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Newton's method onto the algebraic equations from y, M y left alone: the point, and the size of the last step.

    Differentiable by one exact step at the end.
    """
    if not problem.mass.is_singular:
        return y, jnp.zeros((), y.dtype)
    frozen = jax.lax.stop_gradient
    still, t_still, y_still = problem.frozen(), frozen(t), frozen(y)
    eps = jnp.finfo(y.dtype).eps

    def going(carry):
        _, size, count = carry
        return (size > 10 * eps) & (count < max_steps)

    def body(carry):
        v, _, count = carry
        d = consistent_shift(still, linear, t_still, v, y_still)
        return v + d, jnp.max(jnp.abs(d) / (1 + jnp.abs(v)), initial=0.0), count + 1

    found, size, _ = jax.lax.while_loop(going, body, (y_still, jnp.asarray(jnp.inf, y.dtype), 0))
    found = y + frozen(found - y_still)
    return found + consistent_shift(problem, linear, t, found, y), size


def algebraic_part(problem: FlatProblem, v: Float[Array, " n"]) -> Float[Array, " n"]:
    """P v: the part in the algebraic equations."""
    p = jnp.asarray(problem.mass.algebraic, v.dtype)
    return p * v if problem.mass.is_diagonal else p @ v


def _is_identity(problem: FlatProblem) -> bool:
    return problem.mass.is_diagonal and bool((problem.mass.array == 1).all())
