"""Left null vectors of matrices that are known at sample points.

A square block of the system Jacobian is singular wherever the model is if some w ≠ 0 has wᵀJ(x) = 0 for all states x:
w is found from the matrices of several states side by side. What counts as zero is decided by size relative to the
terms that cancel, so no unit and no rounding of coefficients matters.
"""

import dataclasses
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import scipy.sparse as sp

from ...base.tolerances import CANCELLED, KNOWN, NO_WEIGHT
from ...graph.expressions.node import Number
from ...graph.judgement.rank import DECOMPOSED_UPTO, above_errors, rank_of
from ...graph.judgement.sparse_rank import sparse_rank_of
from . import elimination
from .elimination import Row
from .rounded import Rounded

REFINEMENTS = 2  # set by hand
LARGEST_DENOMINATOR = 1000  # of a fraction that a computed weight is taken for
SIMPLE = 1_000_000  # numerator times denominator: beyond, fractions come as near to any number by chance


@dataclasses.dataclass(frozen=True)
class BlockMatrix:
    """A block's entries at one point or at several side by side, and bounds of their errors."""

    shape: tuple[int, int]
    row: np.ndarray
    column: np.ndarray
    value: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, shape: tuple[int, int], entries: Sequence[tuple[np.ndarray, ...]]) -> "BlockMatrix":
        """From parts (row, column, value, error); what stands at one place is added. Entries that are given numbers are
        known to `KNOWN`, as those that are computed from such."""
        row, column, value, error = (np.concatenate(part) for part in zip(*entries, strict=True))
        return cls(shape, row, column, value, np.maximum(error, KNOWN * np.abs(value)))

    @property
    def is_finite(self) -> bool:
        return bool(np.isfinite(self.value).all())

    def beside(self, other: "BlockMatrix") -> "BlockMatrix":
        """This matrix with another one, of as many rows, to its right."""
        pairs = ((self.row, other.row), (self.column, other.column + self.shape[1]))
        entries = [np.concatenate(pair) for pair in (*pairs, (self.value, other.value), (self.error, other.error))]
        return BlockMatrix((self.shape[0], self.shape[1] + other.shape[1]), *entries)

    def sparse(self) -> tuple[Any, Any]:
        """The matrix, and the bounds of its errors."""
        place = (self.row, self.column)
        values, errors = (sp.coo_array((data, place), shape=self.shape).tocsr() for data in (self.value, self.error))
        return values, errors

    def rows(self) -> list[Row]:
        """Its rows, without entries that may be zero."""
        rows: list[Row] = [{} for _ in range(self.shape[0])]
        entries = (self.row.tolist(), self.column.tolist(), self.value.tolist(), self.error.tolist())
        for i, j, value, error in zip(*entries, strict=True):
            found = Rounded(value, error)
            rows[i][j] = rows[i][j] + found if j in rows[i] else found
        return [{j: value for j, value in row.items() if value} for row in rows]


def null_vectors(matrix: BlockMatrix) -> list[Row]:
    """Vectors w with wᵀA = 0 for the matrix A, by number of the row; fewest entries first."""
    if matrix.shape[0] <= DECOMPOSED_UPTO:
        return [
            dict(zip(np.flatnonzero(w).tolist(), w[w != 0].tolist(), strict=True))
            for w in left_null_vectors(*(part.toarray() for part in matrix.sparse()))
        ]
    # Most large blocks are regular, and one factorization shows it. Elimination with bounds of errors takes Python's
    # time for each operation.
    if matrix.shape[0] == matrix.shape[1] and sparse_rank_of(*matrix.sparse()).is_regular:
        return []
    rows = matrix.rows()
    found = elimination.null_vectors(rows, Rounded(1.0, 0.0))
    return [{i: weight.value for i, weight in w.items()} for w in found if _cancels_in(w, rows)]


def _cancels_in(weights: Row, rows: Sequence[Row]) -> bool:
    """True if every column of Σ weight·row is a rounding error. An elimination that lost all digits shows no
    combination."""
    terms: dict[int, list[float]] = {}
    for i, weight in weights.items():
        for c, entry in rows[i].items():
            terms.setdefault(c, []).append(weight.value * entry.value)
    return all(abs(math.fsum(found)) <= CANCELLED * sum(map(abs, found)) for found in terms.values())


def cancels(weights: np.ndarray, matrix: np.ndarray) -> bool:
    """True if wᵀA = 0, to rounding of the terms of every column."""
    terms = weights[:, None] * matrix
    return bool((np.abs(terms.sum(axis=0)) <= CANCELLED * np.abs(terms).sum(axis=0)).all())


def left_null_vectors(matrix: np.ndarray, errors: np.ndarray) -> list[np.ndarray]:
    """Vectors w with wᵀA = 0, each with an entry 1 where the others have none; fewest entries first.

    `errors` are bounds of the errors of A's entries.
    """
    rank = rank_of(matrix, errors)
    null = rank.u[:, rank.number :].T
    found = _verified(null, rank.r, above_errors(matrix, rank.errors))
    return sorted(found, key=lambda w: (np.count_nonzero(w), *np.flatnonzero(w).tolist()))


def _verified(null: np.ndarray, rows: np.ndarray, matrix: np.ndarray) -> list[np.ndarray]:
    """Sparse combinations of the null vectors of diag(rows)·A, as those of A; without those with which columns of A
    do not cancel."""
    null = null.copy()
    chosen: list[int] = []
    for k in range(len(null)):  # Gauss–Jordan elimination with complete pivoting
        # An orthogonal basis of several null vectors mixes them. Elimination takes them apart, one for each redundant
        # equation, so that an error or a combination names few equations.
        r, c = np.unravel_index(np.argmax(np.abs(null[k:])), null[k:].shape)
        null[[k, k + int(r)]] = null[[k + int(r), k]]
        null[k] /= null[k, c]
        others = np.arange(len(null)) != k
        null[others] -= np.outer(null[others, c], null[k])
        chosen.append(int(c))
    found = []
    for w, c in zip(null, chosen, strict=True):
        # An entry of rounding would draw an equation into the combination that has nothing to do with it. But where
        # columns cancel only with a small weight, it belongs.
        candidates = (np.where(np.abs(w) < least, 0.0, w) * rows / rows[c] for least in NO_WEIGHT)
        found.append(next((w for w in candidates if cancels(w, matrix)), None))
    return [_refined(w, matrix) for w in found if w is not None]


def _refined(w: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Refines w to working precision. Combined equations are combined again, and each time the error left in w is
    amplified."""
    used = np.flatnonzero(w)
    better = w.copy()
    for _ in range(REFINEMENTS):
        terms = better[used, None] * matrix[used]
        size = np.abs(terms).max(axis=0, initial=0.0)
        terms = terms[:, size > 0] / size[size > 0]
        # The sum cancels to the last digits, and those are what is corrected by.
        left = terms.astype(np.longdouble).sum(axis=0).astype(float)
        others = better[used] != 1.0
        better[used[others]] *= 1 + np.linalg.lstsq(terms[others].T, -left, rcond=None)[0]
    return better if cancels(better, matrix) else w


def rational(value: float) -> Number:
    """The simple fraction that a number rounds, if there is one."""
    found = Fraction(value).limit_denominator(LARGEST_DENOMINATOR)
    # A weight that is a fraction stays exact in the combination, so that terms that should cancel do.
    is_simple = abs(found.numerator) * found.denominator <= SIMPLE
    return found if is_simple and abs(float(found) - value) <= CANCELLED * abs(value) else value
