"""Where searches begin."""

import numpy as np
from jaxtyping import Float

from .objective import Objective


def starting_points(objective: Objective, count: int, seed: int) -> list[Float[np.ndarray, " f"]]:
    """The start itself, and others drawn around it by `seed`: parameters within a factor of e or their bounds, starts
    by their spread, weights of the same sizes."""
    c, (low, high) = objective.coordinates, objective.bounds
    first, free = c.z_start[objective.free], objective.free
    rng, points = np.random.default_rng(seed), [first]
    # The bounds of what comes with a method are as far away as can be.
    bounded = np.isfinite(low) & np.isfinite(high) & ~np.isin(np.array(c.names)[free], objective.layout.extra)
    least, most = np.where(bounded, low, 0.0), np.where(bounded, high, 0.0)
    for _ in range(count - 1):
        width = np.where(c.log[free], 1.0, np.where(c.is_weight[free], 0.0, 1.0))
        width = np.where(np.isfinite(c.spread[free]), c.spread[free], width)
        for name in dict.fromkeys(c.group):
            chosen = np.array([g == name for g in c.group])[free] & c.is_weight[free]
            width[chosen] = np.sqrt(np.mean(first[chosen] ** 2)) if chosen.any() else 0.0
        centre = np.where(c.is_weight[free], 0.0, first)
        drawn = centre + width * rng.standard_normal(len(first))
        inside = least + (most - least) * rng.uniform(size=len(first)) if bounded.any() else drawn
        points.append(np.clip(np.where(bounded, inside, drawn), low, high))
    return points
