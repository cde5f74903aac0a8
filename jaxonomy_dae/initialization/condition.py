"""Condition numbers and null vectors, of matrices whose rows and columns are scaled so that units do not matter."""

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from ..judgement.scaling import geometric_scales
from .block_finding import DENSE_LIMIT, ILL_CONDITIONED

TINY = 1e-300
PASSES = 5


def equilibrated_all(matrix: np.ndarray, passes: int) -> np.ndarray:
    """Matrices (n, rows, columns) with rows and columns scaled to a largest entry near 1 (Ruiz 2001)."""
    matrix = matrix / (np.abs(matrix).max(axis=2, keepdims=True, initial=0.0) + TINY)
    matrix = matrix / (np.abs(matrix).max(axis=1, keepdims=True, initial=0.0) + TINY)
    for _ in range(passes):
        rows, columns = np.abs(matrix).max(axis=2, initial=0.0), np.abs(matrix).max(axis=1, initial=0.0)
        rows, columns = np.sqrt(np.where(rows > 0, rows, 1.0)), np.sqrt(np.where(columns > 0, columns, 1.0))
        matrix = matrix / rows[:, :, None] / columns[:, None, :]
    return matrix


def conditions(matrices: np.ndarray):
    """The condition number of each matrix, and functions that give the null vectors of one, left and right."""
    n, k, _ = matrices.shape
    if k == 1:
        # A single coefficient has no scale but zero.
        return np.where(matrices[:, 0, 0] == 0, np.inf, 1.0), lambda b: np.ones((1, 1)), lambda b: np.ones((1, 1))
    finite = np.atleast_1d(np.isfinite(matrices).all(axis=(1, 2)))
    # What is not finite has another cause than rank, and is reported as such.
    matrices = np.where(finite[:, None, None], matrices, np.eye(k))
    if k > DENSE_LIMIT:
        condition = np.array([_estimate(a) for a in equilibrated_all(matrices, PASSES)])
        return condition, lambda b: np.zeros((k, 0)), lambda b: np.zeros((k, 0))
    scaled = equilibrated_all(matrices, 0)
    condition = _ratio(np.linalg.svd(scaled, compute_uv=False))
    if not (condition < ILL_CONDITIONED).all():  # perhaps for want of better scaling
        scaled = equilibrated_all(matrices, PASSES)
        condition = _ratio(np.linalg.svd(scaled, compute_uv=False))
    for b in np.flatnonzero(~(condition < ILL_CONDITIONED)):
        r, c = geometric_scales(matrices[b])
        better = equilibrated_all((r[:, None] * matrices[b] * c)[None], PASSES)
        least = _ratio(np.linalg.svd(better, compute_uv=False))[0]
        if least < condition[b]:
            scaled[b], condition[b] = better[0], least

    def null(b: int, transposed: bool) -> np.ndarray:
        u, s, vt = np.linalg.svd(scaled[b])
        small = s <= max(s[0], 1e-300) / ILL_CONDITIONED
        return u[:, small] if transposed else vt[small].T

    return condition, lambda b: null(b, True), lambda b: null(b, False)


def _ratio(singular: np.ndarray) -> np.ndarray:
    """Condition numbers from singular values, shape (n, k)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(singular[:, -1] > 0, singular[:, 0] / singular[:, -1], np.inf)


def _estimate(matrix: np.ndarray) -> float:
    """A lower bound of a large block's condition number, by a sparse factorization (Hager 1984)."""
    return factored(sp.csc_array(matrix))[1]


def spectrum(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Left singular vectors and singular values of the equilibrated matrix, one for each row, and its condition."""
    m = len(matrix)
    u, s, _ = np.linalg.svd(equilibrated_all(matrix[None], PASSES if m > 1 else 0)[0])
    s = np.append(s, np.zeros(max(0, m - len(s))))[:m]
    return u, s, np.inf if s[-1] == 0 else float(s[0] / s[-1])


def factored(matrix: Any) -> tuple[Any, float]:
    """The factors of a sparse matrix, None if it is exactly singular, and an estimate of its condition number."""
    linalg: Any = scipy.sparse.linalg
    try:
        factors = linalg.splu(matrix)
    except RuntimeError:
        return None, np.inf
    inverse = linalg.LinearOperator(matrix.shape, matvec=factors.solve, rmatvec=lambda v: factors.solve(v, trans="T"))
    return factors, float(linalg.onenormest(matrix) * linalg.onenormest(inverse, t=1))


def null_vectors(matrix: Any) -> tuple[np.ndarray, np.ndarray]:
    """Left and right null vectors of a sparse matrix that is singular, or nearly so, by inverse iteration."""
    n = matrix.shape[0]
    linalg: Any = scipy.sparse.linalg
    shift = 1e-10 * sp.diags_array(1 + np.arange(n) / n)  # regular, whatever the kernel
    factors = linalg.splu(sp.csc_array(matrix + shift))
    left = right = np.ones(n) + np.arange(n) / n
    for _ in range(4):
        right = factors.solve(right)
        left = factors.solve(left, trans="T")
        right, left = right / np.abs(right).max(), left / np.abs(left).max()
    return left, right
