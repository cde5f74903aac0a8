"""Least squares with large sparse matrices in NumPy, by one factorization.

Tikhonov's x = (AᵀA + δ)⁻¹Aᵀb solves the augmented system

    [ I   A ] [ r ]   [ b ]
    [ Aᵀ −δ ] [ x ] = [ 0 ],

whose matrix is regular for every A, and sparse if A is. Repeated with what is left of b, x tends to the least-squares
solution of least norm (iterated Tikhonov regularization; Engl, Hanke & Neubauer 1996, section 5.1).

A square matrix that is far from singular has one solution, which its own factors give in a fifth of the time.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Float

# The δ of matrices with entries near one. What belongs to singular values above its root, 1e-5, is solved. Rounding
# leaves some eps/δ of the residual in directions that A leaves open, and the repetitions take this out of b, not out of
# x.
REGULARIZATION = 1e-10
SMALLEST = REGULARIZATION**0.5
REPETITIONS = 3
STEPS = 4  # after which a random vector of 10⁵ entries shows a single small singular value to a factor of ten


class SparseLeastSquares:
    """The factors for a sparse matrix A, shape (m, n), with entries near one (`judgement.scaling.equilibrated`)."""

    def __init__(self, matrix: Any):
        self.matrix: Any = sp.csr_array(matrix)
        m, n = self.matrix.shape
        self._regular = regular_factors(self.matrix) if m == n else None
        if self._regular is not None:
            return
        one, ridge = sp.eye_array(m), REGULARIZATION * sp.eye_array(n)
        augmented: Any = sp.block_array([[one, self.matrix], [self.matrix.T, -ridge]], format="csc")
        self._factors = scipy.sparse.linalg.splu(augmented)

    def solve(self, right: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
        """The least-squares solution of A·x = b, of least norm."""
        if self._regular is not None:
            return self._regular(right)
        m, n = self.matrix.shape
        x = np.zeros(n)
        for _ in range(REPETITIONS):
            x = x + self._factors.solve(np.concatenate([right - self.matrix @ x, np.zeros(n)]))[m:]
        return x


def regular_factors(matrix: Any, least: float = SMALLEST) -> Callable[[np.ndarray], np.ndarray] | None:
    """The solution for right-hand sides, given a square sparse matrix with entries near one; None if it has a singular
    value below `least`, by default one that least squares would leave out."""
    # SuperLU orders columns, and puts a full one last; a full row, such as that of a node where all of an array meets,
    # would fill the factors: 6.5 GB for 20,000 cells.
    by_rows, by_columns = sp.csr_array(matrix), sp.csc_array(matrix)
    turned = np.diff(by_rows.indptr).max(initial=0) > np.diff(by_columns.indptr).max(initial=0)
    try:
        factors = scipy.sparse.linalg.splu(by_rows.T if turned else by_columns)
    except RuntimeError:  # exactly singular
        return None
    way, back = ("T", "N") if turned else ("N", "T")
    x, size = np.random.default_rng(0).normal(size=matrix.shape[0]), 1.0
    with np.errstate(all="ignore"):
        for _ in range(STEPS):  # of the power method for the inverse of AᵀA
            x = factors.solve(factors.solve(x / np.linalg.norm(x), back), way)
            size = np.linalg.norm(x)
    return functools.partial(factors.solve, trans=way) if size * least**2 < 1 else None
