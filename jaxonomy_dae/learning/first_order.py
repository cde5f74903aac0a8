"""Gradient steps before least squares, by the program of least squares: the gradient is Jᵀr."""

import numpy as np
from jaxtyping import Float

from .objective import Objective

DECAY = (0.9, 0.999)  # of the means of gradients and of their squares (Kingma & Ba 2015)


def adam_steps(
    objective: Objective, start: Float[np.ndarray, " f"], steps: int, rate: float
) -> Float[np.ndarray, " f"]:
    """The point of least cost among so many steps of Adam on the scale of the coordinates, kept inside the bounds.
    Weights of noise and priors are those of the start."""
    z = np.clip(start, *objective.bounds)
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
        z = np.clip(z - rate * step, *objective.bounds)
        found = objective.evaluate(z) if k <= steps else None
        if found is None:
            break
    return best[1]
