"""Which states are coordinates on the hidden constraints.

Given the Jacobian of c constraints with respect to n states that are redundant by r ≤ c, returns r constraints and r
states that they determine from the others: the n − r others are coordinates of the tangent space.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..base.tolerances import RANK

ALIKE = 0.5  # of the largest pivot: what counts as equally good, so that rounding decides nothing


class Coordinates(NamedTuple):
    """A choice of coordinates on the constraints: the states kept, the states that follow from them, and the
    constraints that determine these."""

    kept: np.ndarray
    dependent: np.ndarray
    rows: np.ndarray


def choose_coordinates(jacobian: Float[np.ndarray, "c n"], give_way: np.ndarray | None = None) -> Coordinates:
    """Gaussian elimination with complete pivoting, each constraint in units of its gradient. Of pivots that are alike
    the last state gives way, so that positions and velocities are chosen alike. With `give_way`, only these states
    may."""
    c, n = jacobian.shape
    norm = np.linalg.norm(jacobian, axis=1, keepdims=True)
    # A constraint multiplied by 1e9 is the same constraint, and must not be the first pivot for that.
    left = jacobian / np.where(norm > 0, norm, 1)
    if give_way is not None:
        left[:, np.setdiff1d(np.arange(n), give_way)] = 0.0
    rows, columns = [], []
    for _ in range(min(c, n)):
        size = np.abs(left)
        largest = size.max(initial=0.0)
        if largest <= RANK:  # in units of a gradient: the constraint repeats others
            break
        alike = np.argwhere(size >= ALIKE * largest)
        # The last column, and in it the first row: a choice that rounding does not change.
        row, column = alike[np.lexsort((alike[:, 0], -alike[:, 1]))[0]]
        rows.append(int(row))
        columns.append(int(column))
        pivot_row = left[row] / left[row, column]
        left = left - np.outer(left[:, column], pivot_row)
        left[row], left[:, column] = 0.0, 0.0
    dependent = np.array(sorted(columns), np.int64)
    return Coordinates(np.setdiff1d(np.arange(n), dependent), dependent, np.array(sorted(rows), np.int64))
