"""Scores on experiments that are held out."""

import dataclasses

import numpy as np
from jaxtyping import Float

from .coordinates import Coordinates
from .evaluation import Weights
from .objective import Objective


def with_own_starts(objective: Objective, z: Float[np.ndarray, " f"], weights: Weights) -> Float[np.ndarray, " p"]:
    """All coordinates after a fit. The unknown starts of experiments that were held out are fitted to these with all
    else fixed: that is what they alone can tell, and all that is taken from them."""
    full = objective.full(z)
    held = objective.stacked.holdout
    if not held.any() or not objective.coordinates.n_own:
        return full
    c = _at(objective.coordinates, full)
    fixed = np.array(c.fixed)
    fixed[: c.n_shared] = True
    sigma = objective.sigma(z, weights)
    alone = dataclasses.replace(
        objective.with_noise(sigma), coordinates=dataclasses.replace(c, fixed=fixed), counted=held, penalties={}
    )
    if not alone.free.any() or not len(alone.rows[0]):
        return full
    best = alone.lowest(full[alone.free])
    return full if best is None else alone.full(best.z)


def holdout_score(objective: Objective, z: Float[np.ndarray, " f"], weights: Weights) -> float:
    """The root mean square of the residuals of experiments that are held out, in units of the noise; infinite where a
    run fails."""
    s = objective.stacked
    rows = np.nonzero(s.observed & s.holdout[:, None, None])
    return objective.scored(with_own_starts(objective, z, weights), objective.sigma(z, weights), rows)


def _at(c: Coordinates, full: Float[np.ndarray, " p"]) -> Coordinates:
    """The coordinates with their starts at a point."""
    return dataclasses.replace(c, start=c.natural(full))
