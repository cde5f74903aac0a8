"""LU factors of dense matrices, solves with them, and least squares where a matrix leaves directions open.

Rows are scaled to largest entries near one before pivots are compared: the unit of an equation must not decide which
row is a pivot's. Scales are powers of two, so that scaling rounds nothing. Matrices may come in batches, along leading
axes. Nothing here is differentiated but `solve_dense` and `least_squares`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...base.tolerances import ridge

# The order of rows is a permutation, so XLA need not look for indices that are out of bounds, negative or equal.
PERMUTATION: Any = {"mode": "promise_in_bounds", "wrap_negative_indices": False, "unique_indices": True}


class Factors(NamedTuple):
    """P·D·A = L·U.

    - `lu`: L below the diagonal, where it has ones; U above.
    - `order`: which row of A each row of P·D·A is; `unit`: the diagonal of D.
    """

    lu: Float[Array, "*batch n n"]
    order: Int[Array, "*batch n"]
    unit: Float[Array, "*batch n"]


def factor(matrix: Float[Array, "*batch n n"]) -> Factors:
    """The LU factors, with partial pivoting among scaled rows."""
    matrix = lax.stop_gradient(matrix)
    power = _power_of_two(jnp.max(jnp.abs(matrix), axis=-1))
    unit = 1 / jnp.where(power == 0, 1, power)
    lu, _, order = lax.linalg.lu(matrix * unit[..., None])
    return Factors(lu, order, unit)


def solve(factors: Factors, right: Float[Array, "*batch n k"]) -> Float[Array, "*batch n k"]:
    """A⁻¹ B."""
    lu, order, unit = factors
    rows = _each(lambda rows, order: rows.at[order].get(**PERMUTATION), order)(unit[..., None] * right, order)
    y = lax.linalg.triangular_solve(lu, rows, left_side=True, lower=True, unit_diagonal=True)
    return lax.linalg.triangular_solve(lu, y, left_side=True, lower=False)


def transpose_solve(factors: Factors, right: Float[Array, "*batch n k"]) -> Float[Array, "*batch n k"]:
    """A⁻ᵀ B."""
    lu, order, unit = factors
    y = lax.linalg.triangular_solve(lu, right, left_side=True, lower=False, transpose_a=True)
    y = lax.linalg.triangular_solve(lu, y, left_side=True, lower=True, transpose_a=True, unit_diagonal=True)
    back = _each(lambda rows, order: jnp.zeros_like(rows).at[order].set(rows, **PERMUTATION), order)
    return unit[..., None] * back(y, order)


def inverse(factors: Factors) -> Float[Array, "*batch n n"]:
    """A⁻¹."""
    return solve(factors, jnp.broadcast_to(jnp.eye(factors.lu.shape[-1], dtype=factors.lu.dtype), factors.lu.shape))


def solve_dense(matrix: Float[Array, "*batch n n"], right: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """x with A·x = b, differentiable by the implicit rule."""
    factors = factor(matrix)
    found = lax.custom_linear_solve(
        lambda x: matrix @ x,
        right[..., None],
        lambda _, b: solve(factors, b),
        lambda _, b: transpose_solve(factors, b),
    )
    return found[..., 0]


def over(size: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1 / size to a power of two; 1 where there is nothing to scale."""
    kind, power = jnp.finfo(size.dtype), _power_of_two(size)
    # No power of two is one over what is subnormal, or near the largest number.
    return jnp.where((power >= 2 * kind.tiny) & (power <= 0.25 * kind.max), 1 / power, 1.0)


def _power_of_two(size: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    # Dropping all bits of the fraction takes one instruction; a logarithm would round.
    return lax.reduce_precision(size, exponent_bits=jnp.finfo(size.dtype).nexp, mantissa_bits=0)


def _each(function: Any, order: Any) -> Any:
    """The function of one matrix, for a batch of them."""
    for _ in order.shape[:-1]:
        function = jax.vmap(function)
    return function


def least_squares(matrix: Float[Array, "m n"], right: Float[Array, " m"]) -> Float[Array, " n"]:
    """The least-squares solution of A·x = b, rows equilibrated; near the one of least norm where A leaves directions
    open. Rows of zeros say nothing, whatever stands in b. Differentiable with respect to b alone."""
    m, n = matrix.shape
    largest = jnp.max(jnp.abs(matrix), axis=1, initial=0.0)
    empty = largest < float(jnp.finfo(matrix.dtype).tiny)
    scale = jnp.where(empty, 0, 1 / jnp.where(empty, 1, largest))
    # QR of the matrix above a small diagonal rather than a pseudo-inverse: there is no threshold that a singular value
    # may lie beside.
    held = jnp.asarray(ridge(matrix.dtype) * np.eye(n), matrix.dtype)
    stacked = jnp.concatenate([scale[:, None] * matrix, held])
    q, r = jnp.linalg.qr(jax.lax.stop_gradient(stacked))
    return jax.scipy.linalg.solve_triangular(r, q[:m].T @ (scale * right))
