"""Descent on a likelihood whose noise levels depend on what is estimated.

Residuals r, of variances s, cost ½ Σ (r²/s + ln s). With u = r/√s, its gradient is Jᵀρ, exactly, for the rows

    ρ = [u; (1 − u²)/√2],    J = [(∂r/∂z)/√s; (∂ ln s/∂z)/√2],

and JᵀJ is the Fisher information, expected over the innovations (Gupta & Mehra 1974, IEEE Trans. Autom. Control
19:774). So steps are those of Levenberg and Marquardt, from one factorization, and intervals follow as for least
squares; only whether a step is better is for the likelihood to say.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from .descent import AbstractMerit, Reached
from .evaluation import Evaluation, Rows, Weights

GAIN = 1e-5  # decrease of −ln L for each coordinate that is not noticed: that of a step of 0.004 standard deviations
# Change of a coordinate by one step, a factor of 7 on a logarithmic scale: far away, the expected information is not
# the curvature.
LONGEST = 2.0


@dataclasses.dataclass(frozen=True)
class Likelihood(Weights):
    """The weights of innovations: `row` is √(w/s)."""

    @property
    def log_rows(self) -> float:
        """Zero, since the cost contains the logarithms of noise levels."""
        return 0.0

    def applied(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Rows:
        """The rows above and below, with one for each prior."""
        assert found.log_slope is not None
        plain = super().applied(z, found)
        u = self.row * found.residual / self.share
        return Rows(
            np.concatenate([plain.residual, self.share * (1 - u**2) / np.sqrt(2)]),
            np.concatenate([plain.jacobian, self.share[:, None] * found.log_slope / np.sqrt(2)]),
        )

    def expected(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Rows:
        """The same."""
        return self.applied(z, found)

    def cost(self, z: Float[np.ndarray, " p"], residual: Float[np.ndarray, " m"]) -> float:
        """½ Σ w (r²/s + ln s) + ½ Σ precision·(z − mean)²."""
        return super().cost(z, residual) - super().log_rows


@dataclasses.dataclass(frozen=True)
class Scoring(AbstractMerit):
    """A likelihood, of which every point has weights of its own. Its descent stops where the remaining step is a
    thousandth of the confidence region's radius: gᵀF⁻¹g ≤ 10⁻⁶ for each coordinate, with the gradient g and the Fisher
    information F; or where steps in a row gain nothing.

    - `limited`: the coordinates that are logarithms, whose steps are limited.
    """

    limited: Bool[np.ndarray, " p"]

    def cost(self, z: Float[np.ndarray, " p"], weights: Weights) -> float:
        """The cost by the likelihood at a point, with the priors at hand."""
        found = self.evaluate(z)
        return np.inf if found is None else self.at(z, found, weights).cost(z, found.residual)

    def at(self, z: Float[np.ndarray, " p"], found: Evaluation, weights: Weights) -> Weights:
        """The weights that the model says at a point, with the priors at hand."""
        return self.weights(z, found).with_priors_of(weights)

    def reach(self, z: Float[np.ndarray, " p"], weights: Weights, below: float) -> Reached | None:
        """What is reached at a point, by the likelihood there, with the priors at hand."""
        found = self.evaluate(z)
        if found is None:
            return None
        here = self.at(z, found, weights)
        cost = here.cost(z, found.residual)
        return Reached(z, found, here, cost) if cost < below else None

    def unnoticed(self, cost: float, rows: float, columns: int) -> float:
        """A small part of a likelihood ratio that would mean something."""
        return GAIN * columns

    def next_weights(self, here: Weights, better: Weights) -> Weights:
        """The weights at the current point, with better precisions."""
        return here.with_priors_of(better)

    def shortened(self, step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Logarithms change by no more than `LONGEST`."""
        return np.where(self.limited, np.clip(step, -LONGEST, LONGEST), step)
