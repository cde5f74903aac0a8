"""Symmetric positive definite matrices of large sparse graphs, solved in a time near their size.

Unknowns with few neighbours, no two of them adjacent, are eliminated at once, and again among those that are left: the
order of minimum degree, in rounds that are a few products of sparse matrices each. Chains, trees, ladders and all that
hangs on one node shrink by a third in each round. What is left when few are eliminated (a mesh) goes to SuperLU.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Float, Int

# An unknown may be eliminated at once if it has so many neighbours at most. A mesh of 300 × 300 takes 0.33 s with 6, 10
# and 16. With 6, a ladder all of whose nodes hang on two others, too, stops at 7 neighbours, and SuperLU takes 0.5 s
# for 20,000 cells.
NEIGHBOURS = 12
FEW = 300  # unknowns that SuperLU takes as they are, in a millisecond
SHARE = 0.03  # of the unknowns that a round must eliminate to be worth its products


@dataclasses.dataclass(frozen=True)
class _Round:
    """One round: unknowns eliminated and kept, the pivots, and the rows of the matrix between both."""

    eliminated: Int[np.ndarray, " e"]
    kept: Int[np.ndarray, " k"]
    pivot: Float[np.ndarray, " e"]
    between: Any  # (e, k), sparse

    def forwards(self, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The right-hand sides of the unknowns eliminated, over their pivots, and of those kept."""
        own = right[self.eliminated] / self.pivot
        return own, right[self.kept] - self.between.T @ own

    def backwards(self, own: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """All unknowns, given those that were kept."""
        out = np.empty(len(own) + len(kept))
        out[self.kept] = kept
        out[self.eliminated] = own - (self.between @ kept) / self.pivot
        return out


class GraphElimination:
    """The factors of a symmetric positive definite matrix, sparse, shape (n, n)."""

    def __init__(self, matrix: Any):
        self._rounds: Sequence[_Round]
        self._rounds, core = _rounds(with_small_indices(sp.csr_array(matrix)))
        self._core = None
        if core.shape[0]:
            # The matrix is symmetric positive definite: pivots on the diagonal are stable, and keep the pattern that
            # the order of minimum degree was chosen for.
            options = {"SymmetricMode": True}
            self._core = scipy.sparse.linalg.splu(
                core.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
            )

    def solve(self, right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The solution for one right-hand side."""
        eliminated = []
        for one in self._rounds:
            own, right = one.forwards(right)
            eliminated.append(own)
        found = right if self._core is None else self._core.solve(right)
        for one, own in zip(reversed(self._rounds), reversed(eliminated), strict=True):
            found = one.backwards(own, found)
        return found


def with_small_indices(matrix: Any) -> Any:
    """The matrix, compressed by rows, with 32-bit indices, where these are enough: products take two thirds of the
    time and of the memory."""
    if max(*matrix.shape, matrix.nnz) > np.iinfo(np.int32).max:
        return matrix
    places = matrix.indices.astype(np.int32, copy=False), matrix.indptr.astype(np.int32, copy=False)
    return sp.csr_array((matrix.data, *places), shape=matrix.shape)


def _rounds(matrix: Any) -> tuple[list[_Round], Any]:
    """All rounds, and the matrix of the unknowns that are left."""
    rng = np.random.default_rng(0)  # by place in order, a chain would lose one unknown in each round
    rounds: list[_Round] = []
    while (n := matrix.shape[0]) > FEW:
        degree = np.diff(matrix.indptr) - 1
        rank = np.where(degree <= NEIGHBOURS, degree.astype(np.int64) * n + rng.permutation(n), np.iinfo(np.int64).max)
        # Those that come before all of their neighbours; each row has an entry, on the diagonal.
        is_first = (rank <= np.minimum.reduceat(rank[matrix.indices], matrix.indptr[:-1])) & (degree <= NEIGHBOURS)
        eliminated, kept = (np.flatnonzero(which).astype(matrix.indices.dtype) for which in (is_first, ~is_first))
        if len(eliminated) < SHARE * n:
            break
        pivot, between = matrix.diagonal()[eliminated], matrix[eliminated][:, kept]
        rounds.append(_Round(eliminated, kept, pivot, between))
        matrix = (matrix[kept][:, kept] - between.T @ sp.diags_array(1 / pivot) @ between).tocsr()
    return rounds, matrix
