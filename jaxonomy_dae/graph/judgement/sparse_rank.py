"""Whether a large sparse square matrix is regular, given how well its entries are known, by one factorization."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from ...base.tolerances import EPS
from .rank import EASY, above_errors
from .scaling import balanced, equilibrated


@dataclasses.dataclass(frozen=True)
class SparseRank:
    """A matrix A (n, n) as diag(r)·A·diag(c), A's entries below their errors left out, and its factors."""

    scaled: Any
    r: np.ndarray
    c: np.ndarray
    factors: Any  # None if it is exactly singular
    condition: float  # in the 1-norm, estimated from below (Hager 1984)
    uncertainty: float  # ‖A⁻¹‖·‖N‖ for bounds N of the errors, both scaled; below 1 it is regular

    @property
    def is_regular(self) -> bool:
        return self.uncertainty < 1 and self.condition * len(self.r) * EPS < 1

    def solve(self, b: np.ndarray) -> np.ndarray:
        """A⁻¹ b of a matrix that is regular."""
        return self.c * self.factors.solve(self.r * b)

    def null_vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """A left and a right null vector of the scaled matrix, singular or nearly so, as columns, by inverse
        iteration."""
        n = len(self.r)
        linalg: Any = scipy.sparse.linalg
        # The factors of a singular matrix do not exist. The shift differs by row: one and the same shift leaves the
        # matrix singular if it has that eigenvalue.
        shift = 1e-10 * sp.diags_array(1 + np.arange(n) / n)  # regular, whatever the kernel
        factors = linalg.splu(sp.csc_array(self.scaled + shift))
        left = right = np.ones(n) + np.arange(n) / n
        for _ in range(4):
            right = factors.solve(right)
            left = factors.solve(left, trans="T")
            right, left = right / np.abs(right).max(), left / np.abs(left).max()
        return left[:, None], right[:, None]


def sparse_rank_of(matrix: Any, errors: Any) -> SparseRank:
    """Judges a finite sparse matrix; `errors` has bounds of the errors of its entries."""
    size = abs(sp.csr_array(matrix))
    errors = sp.csr_array(errors)
    known = np.isfinite(errors.data)
    errors = sp.csr_array((np.where(known, errors.data, 0.0), errors.indices, errors.indptr), shape=errors.shape)
    errors = errors.maximum(EPS * size)
    seen = above_errors(sp.csr_array(matrix), errors)
    # As for dense matrices, the dear scales are found only where the cheap ones leave the matter open.
    first = _factored(seen, errors, equilibrated)
    if first.condition < EASY and first.is_regular:
        return first
    second = _factored(seen, errors, balanced)
    return first if first.is_regular and not second.condition < first.condition else second


def _factored(matrix: object, errors: object, scales: Callable) -> SparseRank:
    linalg: Any = scipy.sparse.linalg
    scaled, r, c = scales(matrix)
    scaled = sp.csc_array(scaled)
    try:
        factors = linalg.splu(scaled)
    except RuntimeError:
        return SparseRank(scaled, r, c, None, np.inf, np.inf)
    inverse = linalg.LinearOperator(scaled.shape, matvec=factors.solve, rmatvec=lambda v: factors.solve(v, trans="T"))
    # With one column the estimate draws no random numbers: those of `numpy.random` are the user's.
    size = float(linalg.onenormest(inverse, t=1))
    noise = sp.csr_array(sp.diags_array(r) @ errors @ sp.diags_array(c))
    norm, of_noise = (float(abs(matrix).sum(axis=0).max()) for matrix in (scaled, noise))
    return SparseRank(scaled, r, c, factors, norm * size, of_noise * size)
