"""Sizes of unknowns on which nothing depends at the start.

An unknown of which nothing is known, and on which nothing depends at the start to first order, as on q in q·|q| at
zero, gets its size from the powers that slopes at two distances show. Then the search begins at the start.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from .arrays import Numbers, namespace
from .machine import Machine, Scalars
from .sizes import Sizes, column_sizes

# Distances from the start at which slopes are compared: a slope that grows as the p-th power differs by 16^p between
# them.
PROBES = (1.0, 1.0 / 16)
SIZED = -1.0 - len(PROBES)  # what `Scalars.begun` is when sizes have been found


def probed(
    state: Machine, value: Float[Numbers, " m"], jacobian: Float[Numbers, "m n"], sizes: Sizes, soft: Any
) -> tuple[Any, Machine, Float[Numbers, " n"]]:
    """Finds the sizes of unknowns by trial steps. Returns (whether sizes are still being found, the next state if so,
    the sizes).

    The residual of a `soft` row, a guess, is the distance of the trial point from it: it tells no size.
    """
    xp, dtype, n = namespace(value), value.dtype, jacobian.shape[1]
    where, one = xp.where, xp.ones((), dtype)
    begun, (trial, base, *others, stored) = state.scalars[3], state.points
    first, last = begun == 0, begun == -float(len(PROBES))
    flat = where(first, (sizes.known == 0) & ~xp.any(jacobian != 0, axis=0), stored[:n] < 0)
    probing = first & xp.all(xp.isfinite(value)) & xp.any(flat) | (begun < 0) & (begun > SIZED)
    base, value = where(first, trial, base), where(first, value, state.rows[1])
    slopes, before = xp.abs(jacobian), xp.abs(state.jacobian)
    comparable = flat[None, :] & last & (slopes > 0) & (before > 0) & xp.isfinite(before)
    growth = xp.log(where(comparable, before / slopes, one)) / float(np.log(PROBES[0] / PROBES[1]))
    power = 1 + xp.clip(growth, 0, 8)
    known_slopes = where(first, jacobian, where(flat[None, :] & ~last, jacobian, state.jacobian))
    implied = column_sizes(where(soft, 0 * one, value), known_slopes / power, sizes, power)
    unit = where(first | last, implied, stored[:n])
    distance = where(first, PROBES[0], where(last, 0.0, PROBES[1]))
    trial = base + distance * xp.append(where(flat, one, 0 * one), 0 * one)
    kept = where(last, unit, where(flat, -one, one))
    points = xp.stack([trial, base, *others, xp.append(kept, one)])
    counted = xp.asarray(np.eye(len(Scalars._fields))[[3, 5]], dtype)
    scalars = state.scalars - counted[0] + counted[1]
    rows = xp.stack([value, value, *state.rows[2:]])
    return probing, Machine(scalars, points, rows, known_slopes), unit
