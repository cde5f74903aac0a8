"""Sizes of unknowns on which nothing depends at the start.

An unknown of which nothing is known, and on which nothing depends at the start to first order, as on q in q·|q| at
zero, gets its size from the powers that slopes at two distances show. Then the search begins at the start.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .machine import Machine, Scalars
from .sizes import Sizes, column_sizes

# Distances from the start at which slopes are compared: a slope that grows as the p-th power differs by 16^p between
# them.
PROBES = (1.0, 1.0 / 16)
SIZED = -1.0 - len(PROBES)  # what `Scalars.begun` is when sizes have been found


def probed(
    state: Machine, value: Float[Array, " m"], jacobian: Float[Array, "m n"], sizes: Sizes, soft: Any
) -> tuple[Any, Machine, Float[Array, " n"]]:
    """Finds the sizes of unknowns by trial steps. Returns (whether sizes are still being found, the next state if so,
    the sizes).

    The residual of a `soft` row, a guess, is the distance of the trial point from it: it tells no size.
    """
    dtype, n = value.dtype, jacobian.shape[1]
    where, one = jnp.where, jnp.ones((), dtype)
    begun, (trial, base, *others, stored) = state.scalars[3], state.points
    first, last = begun == 0, begun == -float(len(PROBES))
    flat = where(first, (sizes.known == 0) & ~jnp.any(jacobian != 0, axis=0), stored[:n] < 0)
    probing = first & jnp.all(jnp.isfinite(value)) & jnp.any(flat) | (begun < 0) & (begun > SIZED)
    base, value = where(first, trial, base), where(first, value, state.rows[1])
    slopes, before = jnp.abs(jacobian), jnp.abs(state.jacobian)
    comparable = flat[None, :] & last & (slopes > 0) & (before > 0) & jnp.isfinite(before)
    growth = jnp.log(where(comparable, before / slopes, one)) / float(np.log(PROBES[0] / PROBES[1]))
    power = 1 + jnp.clip(growth, 0, 8)
    known_slopes = where(first, jacobian, where(flat[None, :] & ~last, jacobian, state.jacobian))
    implied = column_sizes(where(soft, 0 * one, value), known_slopes / power, sizes, power)
    unit = where(first | last, implied, stored[:n])
    distance = where(first, PROBES[0], where(last, 0.0, PROBES[1]))
    trial = base + distance * jnp.append(where(flat, one, 0 * one), 0 * one)
    kept = where(last, unit, where(flat, -one, one))
    points = jnp.stack([trial, base, *others, jnp.append(kept, one)])
    counted = jnp.asarray(np.eye(len(Scalars._fields))[[3, 5]], dtype)
    scalars = state.scalars - counted[0] + counted[1]
    rows = jnp.stack([value, value, *state.rows[2:]])
    return probing, Machine(scalars, points, rows, known_slopes), unit
