"""Least squares with bounds.

Given residuals r(z) and their Jacobian, finds the least of ½ |W r|² + ½ Σ precision·(z − mean)² inside bounds.

It stops where the remaining step is a thousandth of the confidence region's radius, which the residuals themselves set
(the relative offset of Bates & Watts 1981); or where, along a curved valley of which the data tell next to nothing,
steps in a row each lower the cost by less than a thousandth of the residuals' variance for each coordinate.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from .descent import OFFSET, AbstractMerit, Minimum, Reached, Reweigh, descend
from .evaluation import Evaluation, Weights
from .factors import Factors

GAIN = 1e-9  # relative decrease of the sum of squares below which it is the integration's noise: rtol² is less


@dataclasses.dataclass(frozen=True)
class SumOfSquares(AbstractMerit):
    """A sum of squares with weights that a step does not change; fields as the arguments of `minimise`."""

    evaluation: Callable[[np.ndarray], Evaluation | None]
    residual: Callable[[np.ndarray], np.ndarray | None] | None
    first: Callable[[np.ndarray, Evaluation], Weights]

    def evaluate(self, z: Float[np.ndarray, " p"]) -> Evaluation | None:
        """Calls the function that was given."""
        return self.evaluation(z)

    def weights(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Weights:
        """Calls the function that was given."""
        return self.first(z, found)

    def reach(self, z: Float[np.ndarray, " p"], weights: Weights, below: float) -> Reached | None:
        """The residuals alone tell whether a point costs less, if they can be had alone."""
        if self.residual is not None:
            tried = self.residual(z)
            if tried is None or not weights.cost(z, tried) < below:
                return None
        found = self.evaluation(z)
        if found is None:
            return None
        cost = weights.cost(z, found.residual)
        return Reached(z, found, weights, cost) if cost < below else None

    def left(self, factors: Factors, cost: float, rows: int, noise: float) -> float:
        """The relative offset."""
        return offset(factors, cost, rows, noise)

    def unnoticed(self, cost: float, rows: int, columns: int) -> float:
        """A thousandth of the residuals' variance for each coordinate."""
        freedom = rows - columns
        return max(OFFSET * columns * cost / freedom if freedom > 0 else 0.0, GAIN * cost)

    def next_weights(self, here: Weights, better: Weights) -> Weights:
        """Better ones."""
        return better


def minimise(
    evaluate: Callable[[Float[np.ndarray, " p"]], Evaluation | None],
    residual: Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " m"] | None] | None,
    start: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    weights: Callable[[Float[np.ndarray, " p"], Evaluation], Weights],
    reweigh: Reweigh | None = None,
    steps: int = 200,
    noise: float = float(np.sqrt(np.finfo(float).eps)),
) -> Minimum | None:
    """Descends from a start; as `descend`.

    **Arguments:**

    - `evaluate`, `residual`: residuals and Jacobian, and residuals alone, at a point; None where they cannot be found,
        so that a trial is rejected. Trials that fail are dear: without the Jacobian of a hundred columns, a hundred
        times less. No `residual`: trials are evaluated at once, which is less where columns are few.
    - `weights`: the first weights, from the start.
    """
    return descend(SumOfSquares(evaluate, residual, weights), start, bounds, reweigh, steps, noise)


def offset(factors: Factors, cost: float, rows: int, noise: float) -> float:
    """The remaining step in radii of the confidence region; infinite where there are no degrees of freedom."""
    determined = factors.rank(noise)
    explained = float(np.sum(factors.projected[:determined] ** 2))
    if explained == 0:
        return 0.0
    freedom, rest = rows - determined, 2 * cost - explained
    if freedom <= 0 or rest <= 0:
        return np.inf
    return float(np.sqrt((explained / determined) / (rest / freedom)))
