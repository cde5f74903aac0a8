"""Estimates that ended at a bound, and whether the data push them against it.

A truth that lies on its bound, such as a dead time of zero, ends there in half of all records: noise alone moves the
least of the cost beyond. With c the column of the coordinate's derivatives in units of the noise, less what all other
coordinates take of it, and r the residuals, the least lies −c·r/c² away, and is known to 1/|c|: a score test (Rao 1948,
Math. Proc. Camb. Phil. Soc. 44:50).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.special import ndtri

from .evaluation import Rows
from .factors import Factors
from .leftover import LEVEL

PUSHED = float(ndtri(1 - LEVEL))  # standard deviations, beyond which noise alone pushes as rarely as it looks like form


class AtBound(NamedTuple):
    """How far beyond the bound the least of the linearized cost lies, and the standard deviation by which that is
    known, infinite where the data say nothing."""

    beyond: float
    spread: float

    @property
    def is_pushed(self) -> bool:
        """True if data and priors push against the bound by more than noise would, were the truth there."""
        return abs(self.beyond) > PUSHED * self.spread


def at_bounds(rows: Rows, moves: Bool[np.ndarray, " p"], noise: float) -> dict[int, AtBound]:
    """Judges the coordinates that do not move, by their places.

    **Arguments:**

    - `rows`: weighted residuals and Jacobian at the minimum, with those of priors.
    - `noise`: the relative error of the Jacobian.
    """
    if moves.all():
        return {}
    factors = Factors.of(rows.residual, rows.jacobian[:, moves], noise)
    along = rows.jacobian[:, moves] @ factors.root(factors.rank(noise))  # columns of length one
    found = {}
    for k in np.flatnonzero(~moves).tolist():
        column = rows.jacobian[:, k]
        own = column - along @ (along.T @ column)
        square = float(own @ own)
        if square <= (noise * float(np.linalg.norm(column))) ** 2:
            found[k] = AtBound(0.0, np.inf)
        else:
            found[k] = AtBound(-float(own @ rows.residual) / square, square**-0.5)
    return found
