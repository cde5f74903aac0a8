"""What index 1 means for a solver: a slope at a consistent point, and a way back to one."""

from typing import Any

import jax
import jax.numpy as jnp

from .dae_term import FlatProblem
from .linear_algebra import LinearAlgebra, choose


def index_matrix(problem: FlatProblem, linear: LinearAlgebra | None, t: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """(linear algebra, F, ∂F/∂y, M − P ∂F/∂y): with P the projector onto the algebraic equations, the last is regular
    if and only if the index is 1."""
    chosen = choose(linear, y.shape[0], problem.pattern)
    right, jacobian = chosen.jacobian(lambda v: problem.right(t, v), y)
    return chosen, right, jacobian, chosen.index_matrix(problem.mass, jacobian)


def consistent_slope(problem: FlatProblem, linear: LinearAlgebra | None, t: Any, y: Any) -> Any:
    """dy/dt at a consistent point: M y' = F in the differential equations, P (∂F/∂t + ∂F/∂y y') = 0 in the others."""
    if not problem.mass.is_singular:
        chosen, right, _, matrix = index_matrix(problem, linear, t, y)
        return chosen.solve(chosen.factor(matrix), matrix, right) if not _is_identity(problem) else right
    chosen, right, _, matrix = index_matrix(problem, linear, t, y)
    drift = jax.jvp(lambda s: problem.right(s, y), (t,), (jnp.ones_like(t),))[1]
    b = right + algebraic_part(problem, drift - right)
    return chosen.solve(chosen.factor(matrix), matrix, b)


def consistent_shift(problem: FlatProblem, linear: LinearAlgebra | None, t: Any, y: Any) -> Any:
    """A Newton step onto the algebraic equations that leaves M y alone: zero at a consistent point."""
    chosen, right, _, matrix = index_matrix(problem, linear, t, y)
    return chosen.solve(chosen.factor(matrix), matrix, algebraic_part(problem, right))


def algebraic_part(problem: FlatProblem, v: Any) -> Any:
    """P v: the part in the algebraic equations."""
    p = jnp.asarray(problem.mass.algebraic, v.dtype)
    return p * v if problem.mass.is_diagonal else p @ v


def _is_identity(problem: FlatProblem) -> bool:
    return problem.mass.is_diagonal and bool((problem.mass.array == 1).all())
