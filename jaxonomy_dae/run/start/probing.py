"""Sizes of unknowns on which nothing depends at the start.

An unknown of which nothing is known, and on which nothing depends at the start to first order, as on q in q·|q| at
zero, gets its size from the powers that slopes at two distances show. Then the search begins at the start.
"""

from typing import NamedTuple

import numpy as np

from ...solve.linear.arrays import Numbers, Verdict, where
from .search import Equations, Look, Probe, Search
from .sizes import column_sizes, terms_of

# Distances from the start at which slopes are compared: a slope that grows as the p-th power differs by 16^p between
# them.
PROBES = (1.0, 1.0 / 16)


class Probed(NamedTuple):
    """Whether sizes are still being found; the sizes; unknowns that are flat at the start; the next trial point; the
    slopes known so far."""

    goes_on: Verdict
    unit: Numbers
    flat: Numbers
    start: Numbers
    trial: Numbers
    slopes: Numbers


def probed(equations: Equations, search: Search, at: Look) -> Probed:
    """Finds the sizes of unknowns by trial steps.

    The residual of a guess is the distance of the trial point from it: it tells no size.
    """
    xp, sizes, value, jacobian = equations.xp, equations.sizes, at.value, at.jacobian
    first, last = search.probe == Probe.START, search.probe == Probe.NEAR
    flat = where(first, (sizes.known == 0) & ~xp.any(jacobian != 0, axis=0), search.flat)
    goes_on = first & xp.all(xp.isfinite(value)) & xp.any(flat) | (search.probe == Probe.FAR) | last
    start = where(first, search.trial, search.base.at)
    value = where(first, terms_of(value, at.terms), search.first)
    slopes, before = xp.abs(jacobian), xp.abs(search.base.jacobian)
    comparable = flat[None, :] & last & (slopes > 0) & (before > 0) & xp.isfinite(before)
    growth = xp.log(where(comparable, before / slopes, 1.0)) / float(np.log(PROBES[0] / PROBES[1]))
    # A slope that grows as the p-th power belongs to a term of one power more.
    power = 1 + xp.clip(growth, 0, 8)
    known = where(first, jacobian, where(flat[None, :] & ~last, jacobian, search.base.jacobian))
    implied = column_sizes(where(equations.soft, 0.0, value), known / power, sizes, power)
    unit = where(first | (last & flat), implied, search.unit)
    distance = where(first, PROBES[0], where(last, 0.0, PROBES[1]))
    trial = start + distance * xp.append(equations.array(flat), equations.array(0.0))
    return Probed(goes_on, unit, flat, start, trial, known)
