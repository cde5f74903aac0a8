"""Condition numbers and null vectors of blocks, and what is found out about those that are singular, or nearly so."""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from ..judgement.rank import EASY, Rank, rank_of
from ..judgement.sparse_rank import sparse_rank_of
from ..tolerances import ILL_CONDITIONED, TINY

NullVectors = Callable[[int], np.ndarray]

DENSE_LIMIT = 200  # unknowns up to which a block gets a singular value decomposition


def conditions(matrices: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, NullVectors, NullVectors]:
    """The condition number of each matrix, rows and columns scaled, infinite for one that cannot be told from a
    singular one; and functions that give the null vectors of one, left and right.

    **Arguments:**

    - `matrices`: shape (n, k, k).
    - `errors`: bounds of the errors of their entries.
    """
    n, k, _ = matrices.shape
    if k == 1:
        # A single coefficient has no scale but zero.
        vanishes = np.abs(matrices[:, 0, 0]) <= errors[:, 0, 0]
        return np.where(vanishes, np.inf, 1.0), lambda b: np.ones((1, 1)), lambda b: np.ones((1, 1))
    finite = np.atleast_1d(np.isfinite(matrices).all(axis=(1, 2)))
    # What is not finite has another cause than rank, and is reported as such.
    matrices = np.where(finite[:, None, None], matrices, np.eye(k))
    errors = np.where(finite[:, None, None], errors, 0.0)
    if k > DENSE_LIMIT:
        ranks = [sparse_rank_of(sp.csr_array(a), sp.csr_array(e)) for a, e in zip(matrices, errors, strict=True)]
        condition = np.array([rank.condition if rank.is_regular else np.inf for rank in ranks])
        return condition, lambda b: np.zeros((k, 0)), lambda b: np.zeros((k, 0))
    condition, is_regular = _at_a_glance(matrices, errors)
    judged: dict[int, Rank] = {}

    def rank(b: int) -> Rank:
        if b not in judged:
            judged[b] = rank_of(matrices[b], errors[b])
        return judged[b]

    for b in np.flatnonzero(~(is_regular & (condition < EASY))).tolist():
        condition[b] = rank(b).condition if rank(b).is_regular else np.inf
    return condition, lambda b: left_null(rank(b)), lambda b: rank(b).vt[_small(rank(b))].T


def left_null(rank: Rank) -> np.ndarray:
    """The left singular vectors of singular values that are none, as columns."""
    return rank.u[:, _small(rank)]


def _small(rank: Rank) -> np.ndarray:
    least = max(rank.s[0], TINY) / ILL_CONDITIONED
    return rank.s <= (least if rank.is_regular else max(least, rank.s[-1]))


def _at_a_glance(matrices: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Condition numbers with rows and then columns scaled to a largest entry of 1, and whether these prove that the
    matrices are regular: most are well-conditioned."""
    seen = np.where(np.abs(matrices) > errors, matrices, 0.0)
    rows = np.abs(seen).max(axis=2, keepdims=True, initial=0.0) + TINY
    columns = np.abs(seen / rows).max(axis=1, keepdims=True, initial=0.0) + TINY
    s = np.linalg.svd(seen / rows / columns, compute_uv=False)
    with np.errstate(all="ignore"):
        condition = np.where(s[:, -1] > 0, s[:, 0] / s[:, -1], np.inf)
        # No singular value moves by more than the norm of the errors.
        return condition, np.linalg.norm(errors / rows / columns, axis=(1, 2)) < s[:, -1]


@dataclasses.dataclass(frozen=True)
class BlockFinding:
    """A block that is singular, or nearly so: the variables it leaves open, the equations that depend on each other,
    and the parameters and variables that make it so, with their values.

    `undecided`: it is regular as its numbers stand, and singular within their errors, so that nobody can tell.
    """

    condition: float
    singular: bool
    size: int
    variables: tuple[str, ...]
    equations: tuple[str, ...]
    causes: tuple[tuple[str, float], ...]
    causes_are_parameters: bool
    undecided: bool = False
