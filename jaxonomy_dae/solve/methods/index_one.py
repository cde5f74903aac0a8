"""What index 1 means for a solver: a slope at a consistent point, and a way back to one."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Float

from ..linear.choice import LinearAlgebra, choose
from ..linear.newton import Tried, newton
from .dae_term import FlatProblem

SHORTEST = 1e-6  # of a Newton step: if not even this part brings the next one down, there is no way on from here
SURE = 1e-6  # steps so small are taken whole: rounding, not curvature, decides how long the next one is


def index_matrix(
    problem: FlatProblem, linear: lx.AbstractLinearSolver | None, t: Float[ArrayLike, ""], y: Float[Array, " n"]
) -> tuple[LinearAlgebra, Float[Array, " n"], Array, Array]:
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
    """A Newton step onto the algebraic equations that leaves M y as it was at the start: zero at a consistent point."""
    return _newton_step(problem, linear, t, y, start)(y)


def _newton_step(
    problem: FlatProblem,
    linear: lx.AbstractLinearSolver | None,
    t: Float[ArrayLike, ""],
    y: Float[Array, " n"],
    start: Float[Array, " n"],
) -> Callable[[Float[Array, " n"]], Float[Array, " n"]]:
    """The Newton step at a point, with the matrix factored at y."""
    chosen, at_y, _, matrix = index_matrix(problem, linear, t, y)
    factors = chosen.factor(matrix)

    def step(v: Float[Array, " n"]) -> Float[Array, " n"]:
        right = at_y if v is y else problem.right(t, v)
        return chosen.solve(factors, matrix, _off(problem, right, v, start))

    return step


def consistent_point(
    problem: FlatProblem,
    linear: lx.AbstractLinearSolver | None,
    t: Float[ArrayLike, ""],
    y: Float[Array, " n"],
    max_steps: int = 50,
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Newton's method onto the algebraic equations from y, M y left alone: the point, and the size of the last step.

    Steps are shortened until the next one, with the same matrix, is shorter (the natural monotonicity test, Deuflhard
    2004, section 3.3): far from a solution of exponentials, whole steps wander.
    """
    if not problem.mass.is_singular:
        return y, jnp.zeros((), y.dtype)
    frozen = jax.lax.stop_gradient
    still, t_still, y_still = problem.frozen(), frozen(t), frozen(y)
    chosen = choose(linear, y.shape[0], problem.pattern, problem.mass)
    eps = float(jnp.finfo(y.dtype).eps)

    def look(v, part, last):
        factors, size, weight = last

        def length(of, weight):
            return jnp.max(jnp.abs(of) / weight, initial=0.0)

        _, right, _, matrix = index_matrix(still, linear, t_still, v)
        b = _off(still, right, v, y_still)
        # The restricted monotonicity test (Deuflhard 2004, section 3.3): the step from here, by the last matrix, must
        # be shorter by a quarter of the part of the last step that was taken. Both are measured where the last one
        # began: beside the values of a trial point that is far off, any step is short.
        falls = (size <= SURE) | (length(chosen.apply(factors, None, b), weight) <= (1 - part / 4) * size)
        new, weight = chosen.factor(matrix), 1 + jnp.abs(v)
        step = chosen.apply(new, None, b)
        return Tried(falls, length(step, weight) <= 10 * eps, step, (new, length(step, weight), weight))

    none = chosen.empty(y.shape[0], y.dtype), jnp.asarray(jnp.inf, y.dtype), jnp.ones_like(y)
    found = newton(look, y_still, none, max_steps + 1, SHORTEST)
    # The search is constant under differentiation, and y itself is not: M y is kept, with its derivative.
    at = y + frozen(found.x - y_still)
    step = _newton_step(problem, linear, t, at, y)
    for _ in range(2):  # with derivatives, written out
        at = at + step(at)
    return at, found.memory[1]


def _off(problem: FlatProblem, right: Array, v: Array, start: Array) -> Float[Array, " n"]:
    """The right side of a Newton step. Large steps there and back would leave rounding errors in M y, so every step
    mends it."""
    return algebraic_part(problem, right) + problem.mass.times(start - v)


def algebraic_part(problem: FlatProblem, v: Float[Array, " n"]) -> Float[Array, " n"]:
    """P v: the part in the algebraic equations."""
    p = jnp.asarray(problem.mass.algebraic, v.dtype)
    return p * v if problem.mass.is_diagonal else p @ v


def _is_identity(problem: FlatProblem) -> bool:
    return problem.mass.is_diagonal and bool((problem.mass.array == 1).all())
