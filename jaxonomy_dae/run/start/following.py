"""Unknowns without a guess that follow from other ones, where a search cannot begin at zero.

A conductance that nobody guessed is zero, and the resistance R = 1/G has no value there. But G may follow from a field
that is guessed. So where the rows are not finite at a start, each row that reads one open unknown alone sets it by a
step of Newton's method, then the next ones, until the rows are finite. Where no row does, the unknown that most rows
read stays what it is, as the variable by which a block would be torn.
"""

from typing import NamedTuple

import numpy as np

from ...solve.linear.arrays import Numbers, Verdict, where
from .search import Equations, Look, Search


class Following(NamedTuple):
    """Whether there is more to set; the unknowns still open, shape (n,); the next trial point."""

    some: Verdict
    open: Numbers
    trial: Numbers


def followed(equations: Equations, search: Search, at: Look) -> Following:
    """The trial point with the unknowns that follow from rows that are finite there."""
    xp, value, jacobian = equations.xp, at.value, at.jacobian
    usable = xp.isfinite(value) & xp.all(xp.isfinite(jacobian), axis=1)
    reads = (jacobian != 0) & search.open[None, :]
    alone = reads & (usable & (xp.sum(reads, axis=1) == 1))[:, None]
    row, found = xp.argmax(alone, axis=0), xp.any(alone, axis=0)
    slope = where(found, jacobian[row, np.arange(equations.n)], 1.0)
    step = where(found, -value[row] / slope, 0.0)
    ahead = equations.bounded(search.trial + xp.append(step, equations.array(0.0)), search.trial)
    readers = xp.sum(reads & usable[:, None], axis=0)
    torn = (np.arange(equations.n) == xp.argmax(readers)) & ~xp.any(found)
    return Following(xp.any(readers > 0), search.open & ~found & ~torn, ahead)
