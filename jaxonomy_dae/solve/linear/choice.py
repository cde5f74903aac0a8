"""Which linear algebra an implicit step takes: by size, or by the Lineax solver it was given."""

from typing import Any

import lineax as lx

from ...base.errors import ModelError
from . import direct
from .algebra import Dense, Sparse
from .given import ByLineax
from .mass import Mass
from .sparse import DENSE_UPTO, available

LinearAlgebra = Dense | Sparse | ByLineax
SPARSE_FROM = 128  # unknowns from which a sparse factorisation is taken, where the pattern is sparse enough
SPARSE_DENSITY = 0.15


def choose(given: Any, n: int, pattern: Any, mass: Mass) -> LinearAlgebra:
    """The linear algebra for n unknowns, by a `lineax.AbstractLinearSolver` or, for None, by size.

    Without a solver given it is dense for few, and where no pattern is known or it is nearly full. Our own solvers have
    their fast forms here; others are given a sparse operator where the pattern is known and the mass matrix diagonal,
    and a dense one otherwise.

    **Raises:** `ModelError` for a solver that needs a pattern where there is none.
    """
    if given is None:
        if pattern is None or n < SPARSE_FROM or pattern.density > SPARSE_DENSITY:
            return Dense()
        return Dense() if n <= DENSE_UPTO and not available() else Sparse(pattern)
    check_linear_solver(given)
    if isinstance(given, direct.KLU):
        if pattern is None:
            raise ModelError("KLU needs to know where entries lie: DAETerm(..., pattern=SparsePattern(rows, cols, n))")
        return Sparse(pattern)
    if isinstance(given, direct.Dense):
        return Dense()
    return ByLineax(Sparse(pattern) if pattern is not None and mass.is_diagonal else Dense(), given)


def check_linear_solver(given: Any):
    """**Raises:** `ModelError` for what is not a Lineax solver."""
    if not isinstance(given, lx.AbstractLinearSolver):
        what = f"the class {given.__name__}: write {given.__name__}(...)" if isinstance(given, type) else repr(given)
        raise ModelError(f"linear_solver must be a Lineax solver such as lineax.GMRES(rtol, atol); got {what}")
