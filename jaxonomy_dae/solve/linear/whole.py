"""Blocks that stay whole: one linear system of a known pattern, equilibrated, solved with pivoting and checked.

Given the pattern and the values of A, returns x with A·x = b. Rows and columns are scaled to largest entries of one
(Ruiz 2001). Few unknowns are solved for by LAPACK and refined once; many by KLU, and refined where their residual asks
for it. What is returned fulfils every equation to rounding,

    |A x − b| ≤ c eps (|A| |x| + |b|)    or    |A x − b| ≤ c' eps max|x|  in the scaled system,

and is determined by the equations, so that rounding in them does not change its first digit; or is not-a-number
(Skeel 1980, Math. Comp. 35:817; Higham 2002, chapters 7 and 12).
"""

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ...base.errors import ModelError
from ...base.tolerances import TOLERATED, TOLERATED_NORM, UNDETERMINED
from . import dense
from .dense import over
from .once import once
from .operator import SparseLinearOperator
from .sparse import DENSE_UPTO, ULPS, SparsePattern, available, check_solvable, is_double, solve_sparse

LAPACK = 48  # unknowns up to which dense elimination is faster than KLU, which takes 40 µs to begin
GOOD = 2.0**10  # residual in units of eps times the terms of an equation, above which a solution of KLU is refined
REFINEMENTS = 2  # of a solution by KLU, at most
MORE_REFINEMENTS = 10  # the same, of a solution by an iterative method


def solve_whole(
    pattern: SparsePattern,
    values: Float[Array, " nnz"],
    right: Float[Array, " n"],
    *,
    checked: bool = True,
    solver: lx.AbstractLinearSolver | None = None,
) -> Float[Array, " n"]:
    """x with A·x = b; not-a-number where an equation does not hold to rounding, unless it is not to be `checked`. A
    `solver` of Lineax' takes the place of LAPACK and KLU.

    Differentiable with respect to `values` and `right` by the implicit function theorem.

    **Raises:** `ModelError` if there are too many unknowns for dense elimination and KLU is not available.
    """
    # Entries at one place may cancel, and scales are those of their sum.
    pattern, values = pattern.merged(values)
    n = pattern.n
    by_lapack = solver is None and (n <= LAPACK or not (is_double() and available()))
    if by_lapack:
        check_solvable(n)
        if n > DENSE_UPTO:
            raise ModelError(
                f"the model has {n} simultaneous equations; sparse solves compute in float64: call "
                "jax.config.update('jax_enable_x64', True) at the start"
            )
    rows, columns = _scales(pattern, jax.lax.stop_gradient(values))
    scaled = values * rows[pattern.rows] * columns[pattern.cols]
    frozen = jax.lax.stop_gradient(scaled)
    if solver is not None:
        solve, most = _by_lineax(pattern, frozen, solver), MORE_REFINEMENTS
    else:
        solve, most = _lapack(pattern, frozen) if by_lapack else _klu(pattern, frozen), REFINEMENTS

    rounding = np.random.default_rng(0).uniform(-1, 1, n)  # signs alone may cancel in sums

    def solution(b: Any, transpose: bool) -> Any:
        (b,) = once([b])  # solved and checked with the same digits, be they nothing but rounding
        eps, tiny = float(jnp.finfo(b.dtype).eps), float(jnp.finfo(b.dtype).tiny)

        def residual(x):
            """b − A·x, and the terms it is the difference of."""
            missing = b - pattern.multiply(frozen, x, transpose)
            return missing, pattern.multiply(jnp.abs(frozen), jnp.abs(x), transpose) + jnp.abs(b)

        def refined(carry):
            x, missing, _, count = carry
            x = x + solve(missing, transpose)
            missing, size = residual(x)
            return x, missing, jnp.any(jnp.abs(missing) > GOOD * eps * size), count + 1

        x = solve(b, transpose)
        missing, size = residual(x)
        if by_lapack:
            x = x + solve(missing, transpose)
        else:  # a loop, not a branch: what it closes over must stay out of batches
            begin = x, missing, jnp.any(jnp.abs(missing) > GOOD * eps * size), 0
            x, *_ = jax.lax.while_loop(lambda carry: carry[2] & (carry[3] < most), refined, begin)
        if not checked:
            return x
        missing, size = residual(x)
        allowed = jnp.maximum(TOLERATED * size, TOLERATED_NORM * np.sqrt(n) * jnp.max(jnp.abs(x)))
        # Below the second term, products have lost digits to underflow.
        holds = jnp.all(jnp.abs(missing) <= eps * allowed + TOLERATED / eps * tiny)
        if solver is None:
            # Of singular equations that agree, any of many solutions: this one changes with the equations' last digits.
            change = solve((1 if by_lapack else ULPS) * eps * jnp.asarray(rounding, b.dtype) * size, transpose)
            holds = holds & (jnp.max(jnp.abs(change)) <= UNDETERMINED * jnp.max(jnp.abs(x)))
        return jnp.where(holds, x, jnp.nan)

    found = jax.lax.custom_linear_solve(
        lambda x: pattern.multiply(scaled, x),
        right * rows,
        lambda _, b: solution(b, transpose=False),
        lambda _, b: solution(b, transpose=True),
    )
    return found * columns


def _scales(pattern: SparsePattern, values: Any) -> tuple[Any, Any]:
    """Factors of rows and of columns, powers of two, that bring their largest entries near one."""
    size = jnp.abs(values)
    rows = over(jnp.zeros(pattern.n, values.dtype).at[pattern.rows].max(size))
    columns = over(jnp.zeros(pattern.n, values.dtype).at[pattern.cols].max(size * rows[pattern.rows]))
    # Scaling columns has changed the largest entries of the rows.
    again = over(
        jnp.zeros(pattern.n, values.dtype).at[pattern.rows].max(size * rows[pattern.rows] * columns[pattern.cols])
    )
    return rows * again, columns


def _lapack(pattern: SparsePattern, values: Any) -> Any:
    factors = dense.factor(pattern.dense(values))

    def solve(b: Any, transpose: bool) -> Any:
        return (dense.transpose_solve if transpose else dense.solve)(factors, b[:, None])[:, 0]

    return solve


def _klu(pattern: SparsePattern, values: Any) -> Any:
    return lambda b, transpose: solve_sparse(pattern, values, b, transpose, nudged=True)


def _by_lineax(pattern: SparsePattern, values: Any, solver: lx.AbstractLinearSolver) -> Any:
    operator = SparseLinearOperator(values, pattern)

    def solve(b: Any, transpose: bool) -> Any:
        # In units of its size, for tolerances are absolute, too. Whether it succeeded, the residual tells.
        size = jnp.max(jnp.abs(b))
        unit = jnp.where(size > 0, size, 1)
        found = lx.linear_solve(operator.T if transpose else operator, b / unit, solver, throw=False).value
        # A solve that failed counts as zero: as a correction it leaves the solution as it is.
        return jnp.where(jnp.all(jnp.isfinite(found)), unit * found, 0)

    return solve
