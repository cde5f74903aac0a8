"""Least squares with bounds.

Given residuals r(z) and their Jacobian, finds the least of ½ |W r|² + ½ Σ precision·(z − mean)² inside bounds.

It stops where the remaining step is a thousandth of the confidence region's radius, which the noise levels set (the
relative offset of Bates & Watts 1981); or where, along a curved valley of which the data tell next to nothing, steps in
a row each lower the cost by less than a thousandth of the residuals' variance for each coordinate.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from .descent import OFFSET, AbstractMerit, Reached
from .evaluation import Evaluation, Weights

GAIN = 1e-9  # relative decrease of the sum of squares below which it is the integration's noise: rtol² is less


@dataclasses.dataclass(frozen=True)
class SumOfSquares(AbstractMerit):
    """A sum of squares with weights that a step does not change.

    - `residual`: residuals alone. Trials that fail are dear: without the Jacobian of a hundred columns, a hundred times
        less. None: trials are evaluated at once, which is less where columns are few.
    """

    residual: Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " m"] | None] | None

    def cost(self, z: Float[np.ndarray, " p"], weights: Weights) -> float:
        """The cost at a point, by the residuals alone if they can be had alone."""
        if self.residual is None:
            found = self.evaluate(z)
            tried = None if found is None else found.residual
        else:
            tried = self.residual(z)
        return np.inf if tried is None else weights.cost(z, tried)

    def rows(self, z: Float[np.ndarray, " p"], weights: Weights) -> Float[np.ndarray, " r"] | None:
        """The rows at a point, by the residuals alone if they can be had alone."""
        tried = None if self.residual is None else self.residual(z)
        return None if tried is None else np.concatenate([weights.bent(tried)[0], weights.prior(z).residual])

    def reach(self, z: Float[np.ndarray, " p"], weights: Weights, below: float) -> Reached | None:
        """The residuals alone tell whether a point costs less, if they can be had alone."""
        if self.residual is not None:
            tried = self.residual(z)
            if tried is None or not weights.cost(z, tried) < below:
                return None
        found = self.evaluate(z)
        if found is None:
            return None
        cost = weights.cost(z, found.residual)
        return Reached(z, found, weights, cost) if cost < below else None

    def unnoticed(self, cost: float, rows: float, columns: int) -> float:
        """A thousandth of the residuals' variance for each coordinate."""
        freedom = rows - columns
        variance = min(2 * cost / freedom, 1.0) if freedom > 0 else 0.0
        return max(0.5 * OFFSET * columns * variance, GAIN * cost)

    def at(self, z: Float[np.ndarray, " p"], found: Evaluation, weights: Weights) -> Weights:
        """The weights at a point: the same ones."""
        return weights

    def next_weights(self, here: Weights, better: Weights) -> Weights:
        """The weights to go on with: the better ones."""
        return better
