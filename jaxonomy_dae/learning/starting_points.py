"""Where searches begin; gradient steps before least squares, by the same program: the gradient is Jᵀr."""

import numpy as np
from jaxtyping import Float

from .objective import Objective

DECAY = (0.9, 0.999)  # of the means of gradients and of their squares (Kingma & Ba 2015)


def starting_points(
    objective: Objective, own: Float[np.ndarray, " f"], first: Float[np.ndarray, " f"], count: int, seed: int
) -> list[Float[np.ndarray, " f"]]:
    """The start itself, `own`, and others drawn around it by `seed`: parameters within a factor of e or their bounds,
    starts by their spread, weights of the same sizes as those of `first`."""
    c, free, (low, high) = objective.coordinates, objective.free, objective.bounds
    rng, points = np.random.default_rng(seed), [own]
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


def adam_steps(
    objective: Objective, start: Float[np.ndarray, " f"], steps: int, rate: float
) -> Float[np.ndarray, " f"]:
    """The point of least cost among so many steps of Adam on the scale of the coordinates, kept inside the bounds.
    Weights of noise and priors are those of the start."""
    z = np.clip(start, *objective.limits)
    found = objective.evaluate(z)
    if found is None:
        return z
    weights = objective.weights(z, found)
    best, mean, square = (np.inf, z), np.zeros_like(z), np.zeros_like(z)
    for k in range(1, steps + 2):
        r, jacobian = weights.applied(z, found)
        cost = 0.5 * float(r @ r)
        if cost < best[0]:
            best = cost, z
        gradient = jacobian.T @ r / len(r)
        mean = DECAY[0] * mean + (1 - DECAY[0]) * gradient
        square = DECAY[1] * square + (1 - DECAY[1]) * gradient**2
        step = (mean / (1 - DECAY[0] ** k)) / (np.sqrt(square / (1 - DECAY[1] ** k)) + 1e-8)
        z = np.clip(z - rate * step, *objective.limits)
        found = objective.evaluate(z) if k <= steps else None
        if found is None:
            break
    return best[1]
