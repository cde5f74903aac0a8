"""Inverses of small matrices, given and returned by entries."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..programs.platform import platform
from . import written_out
from .once import stacked

FORMULA = 3  # rows up to which the elimination is written out and fused with what reads it
# The same in batches, where it is written out as operations on arrays: XLA takes 4 s for 6 × 6, and LAPACK no longer.
IN_BATCHES = 4


def inverse(matrix: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """A⁻¹, rows scaled before pivots are compared; entries are scalars or arrays of one shape (a batch). Not
    differentiable."""
    m, shape = len(matrix), matrix[0][0].shape
    if m == 1:
        return [[1 / matrix[0][0]]]
    if m <= FORMULA or platform() != "cpu":
        return written_out.inverse(matrix)
    dense = jnp.reshape(stacked([a for row in matrix for a in row]), (m, m, *shape))
    found = _of_batch(dense) if shape else _of_one(dense)
    return [[found[r, c] for c in range(m)] for r in range(m)]


@jax.custom_batching.custom_vmap
def _of_one(dense: Float[Array, "m m"]) -> Float[Array, "m m"]:
    return _by_lapack(dense)


@_of_one.def_vmap
def _(size, batched, dense):
    return jnp.moveaxis(_of_batch(jnp.moveaxis(dense, 0, -1)), -1, 0), True


def _of_batch(dense: Float[Array, "m m *batch"]) -> Float[Array, "m m *batch"]:
    m = dense.shape[0]
    if m > IN_BATCHES:
        return jnp.moveaxis(_by_lapack(jnp.moveaxis(dense, (0, 1), (-2, -1))), (-2, -1), (0, 1))
    rows = written_out.inverse([[dense[r, c] for c in range(m)] for r in range(m)])
    return jnp.reshape(stacked([a for row in rows for a in row]), dense.shape)


def _by_lapack(dense: Float[Array, "*batch m m"]) -> Float[Array, "*batch m m"]:
    unit = 1 / jnp.max(jnp.abs(dense), axis=-1)
    lu, _, order = lax.linalg.lu(dense * unit[..., None])
    permutation = jnp.eye(dense.shape[-1], dtype=dense.dtype)[order]
    lower = lax.linalg.triangular_solve(lu, permutation, left_side=True, lower=True, unit_diagonal=True)
    return lax.linalg.triangular_solve(lu, lower, left_side=True, lower=False) * unit[..., None, :]
