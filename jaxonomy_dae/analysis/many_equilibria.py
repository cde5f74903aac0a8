"""Whether it matters which of many equilibria a search has found.

Where nothing determines the states in some directions, such as the temperature of bodies that exchange heat with each
other alone, equilibria form a line or a surface, and a search ends somewhere on it. A linear model is that of the
system if it is the same all along, as for an angle that two shafts have in common. Else somebody has to say which
equilibrium is meant.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..base.tolerances import solved
from .equilibrium import Equilibrium, is_open, open_directions
from .partials import Partials, alike

BESIDE = 1e-2  # of the way that a search went: far enough to tell linear models apart, and near enough to be linear


def wandered(found: Equilibrium, begin: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"] | None:
    """How far the search went from `begin` in the directions that nothing determines, shape (n,); None if it did not.
    No state drifts."""
    if not found.jacobian.shape[1]:
        return None
    n, unit = len(begin), np.asarray(found.unit)
    way = np.zeros(len(unit))  # discrete values that clocks write are unknowns, too
    way[:n] = (np.asarray(found.x) - begin) / unit[:n]
    if not np.any(np.abs(way) > solved(begin.dtype)):
        return None
    values, directions = open_directions(found)
    loose = np.asarray(directions)[np.asarray(is_open(values))]
    along = (loose.T @ (loose @ way))[:n]
    return along * unit[:n] if np.any(np.abs(along) > solved(begin.dtype)) else None


def same_beside(partials_of: Callable[[jax.Array], Partials], x: jax.Array, way: Float[np.ndarray, " n"]) -> bool:
    """Whether the derivatives at x are those a little back on the way."""
    here, beside = partials_of(x), partials_of(x - BESIDE * way)
    for one, other in zip(_slopes(here), _slopes(beside), strict=True):
        if not bool(alike(jnp.stack([one, other]))):
            return False
    return True


def _slopes(partials: Partials) -> list[jax.Array]:
    return jax.tree.leaves((partials.of_slopes, partials.of_constraints, partials.of_outputs))
