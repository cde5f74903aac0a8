"""The linear algebra of implicit steps: one interface, chosen by size.

A step factorises W = a·M − ∂F/∂y once and solves with it often. `factor` gives what the solves need, as arrays;
`solve` is differentiable with respect to W and the right-hand side by the implicit rule, and never through the
factorisation.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from ...base.aliases import PyTree
from ...base.errors import ModelError
from . import dense
from .mass import Mass
from .operator import SparseLinearOperator
from .sparse import SparsePattern, compressed, solve_sparse
from .written_out import solve as solve_unrolled

# A factorisation: an inverse or the values of a sparse matrix, LU factors, or a matrix with the state of a solver.
Factor = PyTree
UNROLLED_INVERSE = 4  # up to this many unknowns the inverse is written out
EXPLICIT_INVERSE = 32  # up to this many it is kept: a solve is one small product, a tenth of LAPACK's calls


class Dense(eqx.Module):
    """Dense matrices: an explicit inverse for few unknowns, LU with partial pivoting for more.

    The forward error of a solve by the inverse is of the size of that by LU (Higham 2002, Accuracy and Stability of
    Numerical Algorithms, 14.1).
    """

    def jacobian(self, function: Callable[[Array], Array], y: Array) -> tuple[Array, Array]:
        """(F(y), ∂F/∂y, shape (n, n))."""
        # One evaluation of the function serves the value and all columns.
        value, push = jax.linearize(function, y)
        return value, jax.vmap(push, out_axes=-1)(jnp.eye(y.shape[0], dtype=y.dtype))

    def combine(self, mass: Mass, a: Array, jacobian: Array) -> Array:
        """a·M − ∂F/∂y."""
        m = mass.array if not mass.is_diagonal else np.diag(mass.array)
        return a * jnp.asarray(m, jacobian.dtype) - jacobian

    def index_matrix(self, mass: Mass, jacobian: Array) -> Array:
        """M − P·∂F/∂y with P the projector onto the algebraic equations: regular if and only if the index is 1."""
        p = jnp.asarray(mass.algebraic, jacobian.dtype)
        m = jnp.asarray(mass.array, jacobian.dtype)
        if mass.is_diagonal:
            return jnp.diag(m) - p[:, None] * jacobian
        return m - p @ jacobian

    def row_sizes(self, jacobian: Array, y: Array) -> Array:
        """|∂F/∂y| |y|: the sizes of the terms in each row of F."""
        return jnp.abs(jacobian) @ jnp.abs(y)

    def materialise(self, matrix: Array) -> Array:
        """The matrix as an array, shape (n, n)."""
        return matrix

    def factor(self, matrix: Array) -> Factor:
        """The factors that solves need: an explicit inverse of small matrices, LU factors of larger ones."""
        n = matrix.shape[0]
        if not n:  # a model without states
            return matrix
        if n <= UNROLLED_INVERSE:
            rows = [[matrix[i, j] for j in range(n)] for i in range(n)]
            return jnp.stack(solve_unrolled(rows, list(jnp.eye(n, dtype=matrix.dtype))))
        factors = dense.factor(matrix)
        return factors if n > EXPLICIT_INVERSE else dense.inverse(factors)

    def operator(self, matrix: Array) -> lx.AbstractLinearOperator:
        """The matrix as a Lineax operator."""
        return lx.MatrixLinearOperator(matrix)

    def blank(self, n: int, dtype: DTypeLike) -> Array:
        """Zeros of a matrix's shape."""
        return jnp.zeros((n, n), dtype)

    def empty(self, n: int, dtype: DTypeLike) -> Factor:
        """Zeros in the shapes of a factorisation."""
        square = jnp.zeros((n, n), dtype)
        if n <= EXPLICIT_INVERSE:
            return square
        return dense.Factors(square, jnp.zeros((n,), jnp.int32), jnp.zeros((n,), dtype))

    def apply(self, factor: Factor, matrix: Array | None, b: Array) -> Array:
        """W⁻¹ b, without derivatives."""
        return dense.solve(factor, b[:, None])[:, 0] if isinstance(factor, dense.Factors) else factor @ b

    def apply_transposed(self, factor: Factor, c: Array) -> Array:
        """W⁻ᵀ c, without derivatives."""
        if isinstance(factor, dense.Factors):
            return dense.transpose_solve(factor, c[:, None])[:, 0]
        return factor.T @ c

    def solve(self, factor: Factor, matrix: Array | None, b: Array) -> Array:
        """W⁻¹ b, differentiable."""
        factor = jax.lax.stop_gradient(factor)
        # Derivatives are those of the linear equation, whatever factors solve it: stale factors, or an inverse, do not
        # show in them.
        return jax.lax.custom_linear_solve(
            lambda x: matrix @ x,
            b,
            lambda _, c: self.apply(factor, None, c),
            lambda _, c: self.apply_transposed(factor, c),
        )


class Sparse(eqx.Module):
    """Sparse matrices of one pattern, as values in the order of the pattern: needs the extra `sparse`.

    Only values are kept between steps: KLU factorises anew at each solve, which costs about as much as reading a stored
    factorisation would.
    """

    pattern: SparsePattern = eqx.field(static=True)

    def jacobian(self, function: Callable[[Array], Array], y: Array) -> tuple[Array, Array]:
        """(F(y), the values of ∂F/∂y, from one derivative for each colour of its columns)."""
        value, push = jax.linearize(function, y)
        return value, compressed(push, self.pattern, y.dtype)

    def combine(self, mass: Mass, a: Array, jacobian: Array) -> Array:
        """a·M − ∂F/∂y."""
        m = jnp.asarray(_diagonal(mass), jacobian.dtype)
        # The diagonal has entries of its own beside those of the pattern, which may lack it. Both are added up when
        # they are solved with.
        return jnp.concatenate([-jacobian, a * m])

    def index_matrix(self, mass: Mass, jacobian: Array) -> Array:
        """M − P·∂F/∂y with P the projector onto the algebraic equations: regular if and only if the index is 1."""
        p = jnp.asarray(mass.algebraic, jacobian.dtype)
        return jnp.concatenate([-p[self.pattern.rows] * jacobian, jnp.asarray(_diagonal(mass), jacobian.dtype)])

    def row_sizes(self, jacobian: Array, y: Array) -> Array:
        """|∂F/∂y| |y|: the sizes of the terms in each row of F."""
        return self.pattern.multiply(jnp.abs(jacobian), jnp.abs(y))

    def materialise(self, matrix: Array) -> Array:
        """The matrix as an array, shape (n, n)."""
        return _with_diagonal(self.pattern).dense(matrix)

    def factor(self, matrix: Array) -> Factor:
        """The values themselves."""
        return matrix

    def operator(self, matrix: Array) -> lx.AbstractLinearOperator:
        """The matrix as a Lineax operator."""
        return SparseLinearOperator(matrix, _with_diagonal(self.pattern))

    def blank(self, n: int, dtype: DTypeLike) -> Array:
        """Zeros of a matrix's shape."""
        return jnp.zeros((len(self.pattern) + n,), dtype)

    def empty(self, n: int, dtype: DTypeLike) -> Factor:
        """Zeros in the shapes of what `factor` returns."""
        return self.blank(n, dtype)

    def apply(self, factor: Factor, matrix: Array | None, b: Array) -> Array:
        """W⁻¹ b, without derivatives."""
        return self.solve(jax.lax.stop_gradient(factor), None, b) if matrix is None else self.solve(factor, matrix, b)

    def solve(self, factor: Factor, matrix: Array | None, b: Array) -> Array:
        """W⁻¹ b, differentiable."""
        return solve_sparse(_with_diagonal(self.pattern), factor if matrix is None else matrix, b, nudged=True)


@functools.lru_cache(maxsize=64)
def _with_diagonal(pattern: SparsePattern) -> SparsePattern:
    place = np.arange(pattern.n)
    return SparsePattern(np.concatenate([pattern.rows, place]), np.concatenate([pattern.cols, place]), pattern.n)


def _diagonal(mass: Mass) -> np.ndarray:
    if not mass.is_diagonal:
        raise ModelError("sparse steps need a diagonal mass matrix: give its diagonal, shape (n,)")
    return mass.array
