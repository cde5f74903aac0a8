"""Whether the rows of a matrix are independent, given how well its entries are known.

A is given with bounds N of the errors of its entries. Its rows are independent in every matrix within these bounds if
ρ(N·|R|) < 1 for a right inverse R of A: (A + E)·R = I + E·R, and ρ(E·R) ≤ ρ(N·|R|) for |E| ≤ N. Neither side of this
changes with the scales of rows and columns (for N = u·|A| it is the condition number u·ρ(|A|·|A⁻¹|), the least that any
scaling attains: Bauer 1963; Rump 1999), so no choice of scales decides; they only keep digits of R. Where it does not
hold, the matrix is singular as far as anybody can tell. Entries below their errors are zeros that scales do not see.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from ...base.tolerances import EPS, ILL_CONDITIONED, TINY
from .scaling import balanced, equilibrated

# Rows up to which a dense decomposition answers a question. Singular values and eigenvalues cost n³: 0.03 to 0.1 s of
# one core at 300. Beyond, sparse factorizations answer, and what helps the wording of an error alone is left out.
DECOMPOSED_UPTO = 300
EASY = 1e8  # a condition number below which scales that cost an iterative solve are not looked for
ITERATIONS = 20  # of the power method for ρ, whose bound holds whenever it stops


def rounding(matrix: np.ndarray) -> np.ndarray:
    """Bounds of the errors of entries that are given numbers: one rounding."""
    return EPS * np.abs(matrix)


def above_errors(matrix: Any, errors: Any) -> Any:
    """The matrix, dense or sparse, with zeros in place of the entries that are below their errors."""
    if not sp.issparse(matrix):
        return np.where(np.abs(matrix) > errors, matrix, 0.0)
    kept = matrix.multiply(abs(matrix) > errors)
    kept.eliminate_zeros()
    return kept


@dataclasses.dataclass(frozen=True)
class Rank:
    """A matrix A (m, n), bounds of the errors of its entries, and the singular value decomposition u·diag(s)·vt of
    diag(r)·A·diag(c), A's entries below their errors left out."""

    errors: Float[np.ndarray, "m n"]
    r: Float[np.ndarray, " m"]
    c: Float[np.ndarray, " n"]
    u: Float[np.ndarray, "m m"]
    s: Float[np.ndarray, " m"]  # zeros beyond the smaller side
    vt: Float[np.ndarray, "n n"]

    @property
    def condition(self) -> float:
        """The ratio of the largest and the least singular value."""
        if not len(self.s):
            return 1.0
        return float(self.s[0] / self.s[-1]) if self.s[-1] > 0 else np.inf

    @functools.cached_property
    def uncertainty(self) -> float:
        """A bound of ρ(N·|R|): below 1, the rows are independent in every matrix within the errors."""
        m = len(self.s)
        if not self.condition * m * EPS < 1:
            return np.inf  # R has no digits
        right = self.vt[:m].T @ (self.u.T / self.s[:, None])
        product = (self.r[:, None] * self.errors * self.c) @ np.abs(right)
        x, bound = np.ones(m), np.inf
        for _ in range(ITERATIONS):
            # For every positive x the largest quotient bounds ρ from above, so that the iteration may stop at any time
            # and err on the safe side only.
            y = product @ x
            bound = min(bound, float((y / x).max(initial=0.0)))  # Collatz and Wielandt, for any x > 0
            # A vector with zeros would lose the bound: it is kept positive.
            x = np.maximum(y / max(y.max(initial=0.0), TINY), EPS)
        return bound

    @property
    def is_regular(self) -> bool:
        """True if the rows are independent."""
        return self.uncertainty < 1

    def null_vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """Left and right singular vectors of the scaled matrix, as columns, of singular values that count as zero; at
        least one each if the rows are dependent."""
        least = max(self.s.max(initial=0.0), TINY) / ILL_CONDITIONED
        small = np.flatnonzero(self.s <= (least if self.is_regular else max(least, self.s[-1])))
        return self.u[:, small], self.vt[small].T

    def solve(self, b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """A⁻¹ b of a square matrix that is regular."""
        return self.c * (self.vt.T @ (self.u.T @ (self.r * b) / self.s))

    @functools.cached_property
    def number(self) -> int:
        """The rank that every matrix within the errors has: no singular value moves by more than ‖N‖ (Weyl 1912)."""
        m = len(self.s)
        if self.is_regular:
            return m
        noise = self.r[:, None] * self.errors * self.c
        moved = np.sqrt(noise.sum(axis=0).max(initial=0.0) * noise.sum(axis=1).max(initial=0.0))
        return int((self.s[: m - 1] > moved + m * EPS * self.s.max(initial=0.0)).sum())


def is_undecided(matrix: Float[np.ndarray, "m n"]) -> bool:
    """True if a matrix that is singular within its errors would be regular if its entries were exact to one
    rounding."""
    return rank_of(matrix, rounding(matrix)).is_regular


def are_evident(matrices: Float[np.ndarray, "b m n"], errors: Float[np.ndarray, "b m n"]) -> np.ndarray:
    """True for matrices that are finite and well-conditioned at a glance, with independent rows, as most are, shape
    (b,): with rows and then columns scaled to a largest entry of 1."""
    if matrices.shape[1] > matrices.shape[2]:
        return np.zeros(len(matrices), bool)
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    size, errors = np.where(finite[:, None, None], np.abs(matrices), 0.0), np.where(finite[:, None, None], errors, 0.0)
    if matrices.shape[1:] == (1, 1):  # a single coefficient has no scale but zero
        return finite & (size > errors)[:, 0, 0]
    seen = np.where(size > errors, matrices, 0.0)
    # This glance is for the many blocks of ordinary runs: one batch of decompositions in place of a verdict for each.
    # What it does not clear is judged by `rank_of`.
    rows = np.abs(seen).max(axis=2, keepdims=True, initial=0.0) + TINY
    columns = np.abs(seen / rows).max(axis=1, keepdims=True, initial=0.0)
    columns = np.where(columns > TINY, columns, 1.0)  # beside others, an unknown on which nothing depends is no fault
    s = np.linalg.svd(seen / rows / columns, compute_uv=False)
    with np.errstate(all="ignore"):
        # No singular value moves by more than the norm of the errors.
        moved = np.linalg.norm(errors / rows / columns, axis=(1, 2))
        return finite & (moved < s[:, -1]) & (s[:, 0] < EASY * s[:, -1])


def rank_of(matrix: Float[np.ndarray, "m n"], errors: Float[np.ndarray, "m n"]) -> Rank:
    """Judges a finite matrix; a bound that is not finite says that nothing is known of its entry."""
    # A bound that is not finite would make every product infinite. As large as the entry, it says the same: the entry
    # may be zero.
    size = np.abs(matrix)
    errors = np.maximum(np.where(np.isfinite(errors), errors, size), EPS * size)
    seen = above_errors(matrix, errors)
    # Equilibration takes a few passes, least squares of logarithms an iterative solve. Nearly all matrices are judged
    # by the first.
    first = _decomposed(seen, errors, equilibrated)
    if first.condition < EASY and first.is_regular:
        return first
    second = _decomposed(seen, errors, balanced)
    return first if first.is_regular and not second.condition < first.condition else second


def _decomposed(matrix: np.ndarray, errors: np.ndarray, scales: Callable) -> Rank:
    scaled, r, c = scales(matrix)
    u, s, vt = np.linalg.svd(scaled.toarray())
    return Rank(errors, r, c, u, np.append(s, np.zeros(len(u)))[: len(u)], vt)
