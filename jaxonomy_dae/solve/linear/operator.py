"""A sparse matrix as a `lineax.AbstractLinearOperator`: where its entries lie is static, their values are traced."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ...base.errors import ModelError
from .sparse import SparsePattern


class SparseLinearOperator(lx.AbstractLinearOperator):
    """The matrix with the entries `values` at the places of `pattern`.

    Any Lineax solver accepts it. `KLU` solves with its sparse entries, and `lineax.GMRES` only multiplies by it.

    **Arguments:**

    - `values`: shape (nnz,); values at the same place add up.
    - `pattern`: a `SparsePattern`, (n_rows, n).
    - `tags`: Lineax' tags of properties that are not checked, `lineax.symmetric_tag` and so on.
    """

    values: Float[Array, " nnz"]
    pattern: SparsePattern = eqx.field(static=True)
    tags: frozenset[object] = eqx.field(static=True)

    def __init__(self, values: Float[Array, " nnz"], pattern: SparsePattern, tags: object | frozenset[object] = ()):
        if jnp.shape(values) != (len(pattern),):
            raise ModelError(f"values must have shape ({len(pattern)},), one for each place; got {jnp.shape(values)}")
        self.values, self.pattern = values, pattern
        many = isinstance(tags, frozenset | set | tuple | list)
        self.tags = frozenset(tags if many else (tags,))  # pyright: ignore[reportArgumentType]

    def mv(self, vector: Float[Array, " n"]) -> Float[Array, " n_rows"]:
        return self.pattern.multiply(self.values, vector)

    def as_matrix(self) -> Float[Array, "n_rows n"]:
        return self.pattern.dense(self.values)

    def transpose(self) -> "SparseLinearOperator":
        if lx.is_symmetric(self):
            return self
        p = self.pattern
        turned = SparsePattern(p.cols, p.rows, p.n_rows, p.n)
        return SparseLinearOperator(self.values, turned, lx.transpose_tags(self.tags))

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((self.pattern.n,), self.values.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((self.pattern.n_rows,), self.values.dtype)


def _band(operator: SparseLinearOperator, offset: int) -> Float[Array, " size"]:
    p = operator.pattern
    start = max(-offset, 0)
    size = min(p.n_rows - start, p.n - max(offset, 0))
    here = np.flatnonzero(p.cols - p.rows == offset)
    return jnp.zeros(max(size, 0), operator.values.dtype).at[p.rows[here] - start].add(operator.values[here])


def _lies(operator: SparseLinearOperator, lowest: int, highest: int) -> bool:
    """True if all places have a column − row between two numbers."""
    offsets = operator.pattern.cols - operator.pattern.rows
    return bool(((lowest <= offsets) & (offsets <= highest)).all())


@lx.linearise.register(SparseLinearOperator)
@lx.materialise.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> SparseLinearOperator:
    return operator


@lx.diagonal.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> Array:
    return _band(operator, 0)


@lx.tridiagonal.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> tuple[Array, Array, Array]:
    return _band(operator, 0), _band(operator, -1), _band(operator, 1)


@lx.is_symmetric.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> bool:
    known = (lx.symmetric_tag, lx.positive_semidefinite_tag, lx.negative_semidefinite_tag, lx.diagonal_tag)
    return any(tag in operator.tags for tag in known)


# The pattern does not show these properties, so that the tags alone tell them.
for _asked, _tag in (
    (lx.has_unit_diagonal, lx.unit_diagonal_tag),
    (lx.is_positive_semidefinite, lx.positive_semidefinite_tag),
    (lx.is_negative_semidefinite, lx.negative_semidefinite_tag),
):
    _asked.register(SparseLinearOperator)(lambda operator, tag=_tag: tag in operator.tags)


@lx.is_diagonal.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> bool:
    return lx.diagonal_tag in operator.tags or _lies(operator, 0, 0)


@lx.is_tridiagonal.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> bool:
    return lx.tridiagonal_tag in operator.tags or _lies(operator, -1, 1)


@lx.is_lower_triangular.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> bool:
    return lx.lower_triangular_tag in operator.tags or _lies(operator, -operator.pattern.n_rows, 0)


@lx.is_upper_triangular.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> bool:
    return lx.upper_triangular_tag in operator.tags or _lies(operator, 0, operator.pattern.n)


@lx.conj.register(SparseLinearOperator)
def _(operator: SparseLinearOperator) -> Any:
    return SparseLinearOperator(operator.values.conj(), operator.pattern, operator.tags)
