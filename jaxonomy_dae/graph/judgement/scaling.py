"""Scales of the rows and columns of a sparse matrix that make its entries alike, whatever their units."""

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import ArrayLike

PASSES = 10  # each halves, in logarithms, how far the largest entries are from one (Ruiz 2001): a thousandth is left
LARGEST_EXPONENT = 300.0  # of ten, for a scale


def geometric_scales(matrix: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """r and c for which the logarithms of the entries of diag(r)·A·diag(c) are nearest to zero (Curtis & Reid 1972).

    Matrices that differ by scalings of rows and columns alone come out equal, however far apart the scales are. Small
    entries count as much as large ones, so entries that are rounding errors must have been left out.
    """
    a: Any = sp.coo_array(matrix)
    a.eliminate_zeros()
    n, m = a.shape
    if not a.nnz:
        return np.ones(n), np.ones(m)
    row, column = a.coords
    k = np.arange(len(row))
    pattern = sp.csr_array((np.ones(2 * len(k)), (np.tile(k, 2), np.append(row, n + column))), shape=(len(k), n + m))
    # Four digits of a logarithm are more than scales need: a factor of two would do.
    linalg: Any = scipy.sparse.linalg
    found = linalg.lsmr(pattern, -np.log10(np.abs(a.data)), atol=1e-4, btol=1e-4, maxiter=20 * (n + m))[0]
    exponent = np.clip(found, -LARGEST_EXPONENT, LARGEST_EXPONENT)
    return 10.0 ** exponent[:n], 10.0 ** exponent[n:]


def equilibrated(matrix: Any, passes: int = PASSES) -> tuple[Any, np.ndarray, np.ndarray]:
    """diag(r)·A·diag(c) with the largest entry of every row and column near 1 (Ruiz 2001), r and c.

    The first pass scales rows, then columns: matrices that differ by such scalings alone come out nearly equal.
    """
    a: Any = sp.csr_array(matrix, dtype=float)
    n, m = a.shape
    row_of = np.repeat(np.arange(n), np.diff(a.indptr))
    column_of, data = a.indices, np.abs(a.data)
    r, c = np.ones(n), np.ones(m)

    def largest(places: np.ndarray, size: int) -> np.ndarray:
        out = np.zeros(size)
        np.maximum.at(out, places, data * r[row_of] * c[column_of])
        return np.where((out > 0) & np.isfinite(out), out, 1.0)

    for k in range(passes):
        if k == 0:
            # Columns are scaled after rows, with the rows' scales in them: scaling both at once by what stood there
            # before would depend on units.
            r = r / largest(row_of, n)
            c = c / largest(column_of, m)
            continue
        rows, columns = largest(row_of, n), largest(column_of, m)
        r, c = r / np.sqrt(rows), c / np.sqrt(columns)
    scaled = sp.csr_array((a.data * r[row_of] * c[column_of], a.indices, a.indptr), shape=a.shape)
    return scaled, r, c


def balanced(matrix: Any) -> tuple[Any, np.ndarray, np.ndarray]:
    """diag(r)·A·diag(c) with the sizes of its entries near 1, the largest of every row and column nearest; r and c."""
    r, c = geometric_scales(matrix)
    scaled, more_r, more_c = equilibrated(sp.csr_array(sp.diags_array(r) @ sp.csr_array(matrix) @ sp.diags_array(c)))
    return scaled, r * more_r, c * more_c
