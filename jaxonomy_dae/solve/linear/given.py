"""The linear algebra of implicit steps by a Lineax solver that the user chose."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax import Array
from jax.typing import DTypeLike

from ...base.aliases import PyTree
from .algebra import Dense, Factor, Sparse
from .mass import Mass


class ByLineax(eqx.Module):
    """Matrices as `storage` keeps them, dense or sparse; solves by a Lineax solver.

    A solver that does not succeed gives not-a-number, so that the step is rejected. Derivatives are taken of the linear
    equation and not through the solver.
    """

    storage: Dense | Sparse
    solver: lx.AbstractLinearSolver

    def jacobian(self, function: Callable[[Array], Array], y: Array) -> tuple[Array, Array]:
        """(F(y), ∂F/∂y)."""
        return self.storage.jacobian(function, y)

    def combine(self, mass: Mass, a: Array, jacobian: Array) -> Array:
        """a·M − ∂F/∂y."""
        return self.storage.combine(mass, a, jacobian)

    def index_matrix(self, mass: Mass, jacobian: Array) -> Array:
        """M − P·∂F/∂y with P the projector onto the algebraic equations."""
        return self.storage.index_matrix(mass, jacobian)

    def row_sizes(self, jacobian: Array, y: Array) -> Array:
        """|∂F/∂y| |y|: the sizes of the terms in each row of F."""
        return self.storage.row_sizes(jacobian, y)

    def materialise(self, matrix: Array) -> Array:
        """The matrix as an array, shape (n, n)."""
        return self.storage.materialise(matrix)

    def operator(self, matrix: Array) -> lx.AbstractLinearOperator:
        """The matrix as a Lineax operator."""
        return self.storage.operator(matrix)

    def factor(self, matrix: Array) -> tuple[Array, PyTree]:
        """The matrix, and the arrays of the solver's state."""
        state = self.solver.init(self.operator(matrix), {})
        return matrix, eqx.filter(state, eqx.is_array)

    def empty(self, n: int, dtype: DTypeLike) -> Factor:
        """Something that looks like what `factor` returns."""
        shapes = eqx.filter_eval_shape(self.factor, self.storage.blank(n, dtype))
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def apply(self, factor: Factor, matrix: Array | None, b: Array) -> Array:
        """W⁻¹ b, without derivatives."""
        return self._applied(jax.lax.stop_gradient(factor), b, transposed=False)

    def _applied(self, factor: Factor, b: Array, transposed: bool) -> Array:
        matrix, arrays = factor
        # The state of a Lineax solver has static parts, which a loop cannot carry. They are made again from shapes.
        shapes = eqx.filter_eval_shape(lambda m: self.solver.init(self.operator(m), {}), matrix)
        static = eqx.filter(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct), inverse=True)
        state, options = eqx.combine(arrays, static), {}
        if transposed:
            state, options = self.solver.transpose(state, options)
        x, result, _ = self.solver.compute(state, b, options)
        return jnp.where(result == lx.RESULTS.successful, x, jnp.nan)

    def solve(self, factor: Factor, matrix: Array | None, b: Array) -> Array:
        """W⁻¹ b, differentiable."""
        factor = jax.lax.stop_gradient(factor)
        assert matrix is not None
        return jax.lax.custom_linear_solve(
            self.operator(matrix).mv,
            b,
            lambda _, c: self._applied(factor, c, transposed=False),
            lambda _, c: self._applied(factor, c, transposed=True),
        )
