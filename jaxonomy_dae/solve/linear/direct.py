"""Direct solvers for `lineax.linear_solve`: what implicit steps use inside, for anybody.

All take square, regular operators from vectors or other structures to the same, in `jit`, `vmap`, forward and reverse
mode. A singular operator gives what is not finite, which Lineax reports as `lineax.RESULTS.singular`.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ...base.errors import ModelError
from .algebra import Dense as DenseAlgebra
from .operator import SparseLinearOperator
from .sparse import SparsePattern, factorised_solve
from .written_out import UNROLLED_POSITIVE as MOST
from .written_out import solve as solve_written_out


class _State(eqx.Module):
    """The arrays that solves need, and the structures between which they go."""

    arrays: Any
    domain: Any  # something that looks like the solution
    range: Any  # something that looks like the right-hand side
    transposed: bool = eqx.field(static=True)
    pattern: SparsePattern | None = eqx.field(static=True, default=None)


class _AbstractDirect(lx.AbstractLinearSolver[_State]):
    """A Lineax solver between vectors. A subclass says what is kept of a matrix, and how it is used."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _State:
        del options
        if operator.in_size() != operator.out_size():
            raise ModelError(
                f"{type(self).__name__} solves square systems; this operator is {operator.out_size()} × "
                f"{operator.in_size()}"
            )
        domain, range_ = (
            jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structure)
            for structure in (operator.in_structure(), operator.out_structure())
        )
        arrays, pattern = self._kept(operator)
        return _State(arrays, domain, range_, False, pattern)

    @abc.abstractmethod
    def _kept(self, operator: lx.AbstractLinearOperator) -> tuple[Any, SparsePattern | None]:
        """The arrays of a matrix that solves need, and the pattern if it is sparse."""

    @abc.abstractmethod
    def _solved(self, state: _State, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """The solution as one vector."""

    def compute(self, state: _State, vector: Any, options: dict[str, Any]) -> tuple[Any, Any, dict[str, Any]]:
        del options
        x = self._solved(state, ravel_pytree(vector)[0])
        like = state.range if state.transposed else state.domain
        # Lineax itself calls the operator singular if the solution is not finite (lineax/_solve.py).
        return ravel_pytree(like)[1](x), lx.RESULTS.successful, {}

    def transpose(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        del options
        turned = _State(state.arrays, state.domain, state.range, not state.transposed, state.pattern)
        return turned, {}

    def conj(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        del options
        return jax.tree.map(jnp.conj, state), {}

    def assume_full_rank(self) -> bool:
        return True


class WrittenOut(_AbstractDirect):
    """Unrolled elimination, with row-scaled partial pivoting by selection. It has no call of LAPACK and no branch, so a
    `vmap` over many small systems is vectorized. For up to 6 unknowns."""

    def _kept(self, operator):
        n = operator.in_size()
        if n > MOST:
            raise ModelError(f"WrittenOut is for up to {MOST} unknowns; this operator has {n}: use Dense()")
        return operator.as_matrix(), None

    def _solved(self, state, b):
        matrix = state.arrays.T if state.transposed else state.arrays
        scale = jnp.max(jnp.abs(matrix), axis=1)
        # Pivots are compared across rows, which may have different units.
        matrix, b = matrix / scale[:, None], b / scale
        n = b.shape[0]
        return jnp.stack(solve_written_out([[matrix[i, j] for j in range(n)] for i in range(n)], list(b)))


class Dense(_AbstractDirect):
    """LU with partial pivoting; up to 32 unknowns the inverse is formed once, and a solve is a product."""

    def _kept(self, operator):
        return DenseAlgebra().factor(operator.as_matrix()), None

    def _solved(self, state, b):
        algebra = DenseAlgebra()
        return algebra.apply_transposed(state.arrays, b) if state.transposed else algebra.apply(state.arrays, None, b)


class KLU(_AbstractDirect):
    """KLU (Davis & Palamadai Natarajan 2010, ACM TOMS 37:36), a sparse LU made for circuits, for a
    `SparseLinearOperator`. Needs the extra `sparse` and 64-bit mode.

    It factorizes at each solve, which costs about as much as loading a stored factorization.
    """

    def _kept(self, operator):
        if not isinstance(operator, SparseLinearOperator):
            raise ModelError(
                f"KLU solves with a SparseLinearOperator; got {type(operator).__name__}. Give the entries and their "
                "places: SparseLinearOperator(values, SparsePattern(rows, cols, n))"
            )
        return operator.values, operator.pattern

    def _solved(self, state, b):
        assert state.pattern is not None
        return factorised_solve(state.pattern, state.arrays, b, state.transposed)
