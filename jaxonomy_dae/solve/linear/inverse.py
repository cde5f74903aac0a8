"""Inverses of small matrices, given and returned by entries."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...host.platform import platform
from . import dense, written_out
from .once import stacked

FORMULA = 3  # rows up to which the elimination is written out and fused with what reads it
# The number of rows in batches, where the elimination is written out as operations on arrays. XLA takes 4 s to compile
# 6 × 6, and LAPACK is no slower.
IN_BATCHES = 4


def inverse(matrix: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """A⁻¹, rows scaled before pivots are compared; entries are scalars or arrays of one shape (a batch). Not
    differentiable."""
    m, shape = len(matrix), matrix[0][0].shape
    if m == 1:
        return [[1 / matrix[0][0]]]
    if m <= FORMULA or platform() != "cpu":
        return written_out.inverse(matrix)
    entries = jnp.reshape(stacked([a for row in matrix for a in row]), (m, m, *shape))
    found = _of_batch(entries) if shape else _of_one(entries)
    return [[found[r, c] for c in range(m)] for r in range(m)]


@jax.custom_batching.custom_vmap
def _of_one(entries: Float[Array, "m m"]) -> Float[Array, "m m"]:
    return dense.inverse(dense.factor(entries))


@_of_one.def_vmap
def _(size, batched, entries):
    if not batched[0]:
        return _of_one(entries), False
    return jnp.moveaxis(_of_batch(jnp.moveaxis(entries, 0, -1)), -1, 0), True


def _of_batch(entries: Float[Array, "m m *batch"]) -> Float[Array, "m m *batch"]:
    m = entries.shape[0]
    if m > IN_BATCHES:
        return jnp.moveaxis(dense.inverse(dense.factor(jnp.moveaxis(entries, (0, 1), (-2, -1)))), (-2, -1), (0, 1))
    rows = written_out.inverse([[entries[r, c] for c in range(m)] for r in range(m)])
    return jnp.reshape(stacked([a for row in rows for a in row]), entries.shape)
