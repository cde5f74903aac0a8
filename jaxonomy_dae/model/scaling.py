"""Equilibration: the scaling of a sparse matrix that makes questions of rank independent of units."""

from typing import Any

import numpy as np
import scipy.sparse as sp

PASSES = 10


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
            r = r / largest(row_of, n)
            c = c / largest(column_of, m)
            continue
        rows, columns = largest(row_of, n), largest(column_of, m)
        r, c = r / np.sqrt(rows), c / np.sqrt(columns)
    scaled = sp.csr_array((a.data * r[row_of] * c[column_of], a.indices, a.indptr), shape=a.shape)
    return scaled, r, c
