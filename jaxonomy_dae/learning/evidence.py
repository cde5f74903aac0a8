"""Noise levels and prior precisions from the data.

With a normal prior of precision α on a group of k weights w, and noise of standard deviation σ on a group of n
residuals, the evidence of the data is greatest where (MacKay 1992, Neural Computation 4:415 and 4:448)

    α = γ / Σ w²,   γ = k − α·trace C,      σ² = Σ r² / (n − γ_r),   γ_r = Σ leverages of the residuals,

with C the covariance of the weights. γ is how many of them the data determine. Both are brought up to date with every
step of the descent, as Foresee and Hagan do (1997, Proc. ICNN), which costs nothing: C comes from the factors that
the step takes anyway.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from .evaluation import Evaluation, Weights
from .factors import Factors

SETTLED = 0.01  # relative change of a precision or noise level, which changes no interval by as much


@dataclasses.dataclass(frozen=True)
class Evidence:
    """The quantities that the evidence determines: noise levels of groups of residuals, precisions of groups of
    coordinates."""

    noise: Int[np.ndarray, " m"]  # the group of each residual; −1: its noise level is known
    labels: tuple[str, ...]  # of these groups
    floor: np.ndarray  # (groups,): the rounding of the data, below which no noise can be seen
    share: np.ndarray  # (m,): the square root of the experiment's weight
    groups: tuple[Bool[np.ndarray, " p"], ...]  # whose precision is to be found

    @property
    def is_idle(self) -> bool:
        """True if there is nothing to determine."""
        return not self.labels and not self.groups

    def sigma(self, weights: Weights) -> dict[str, float]:
        """The noise level of each group."""
        return {
            label: float((self.share / weights.row)[self.noise == k][0])
            for k, label in enumerate(self.labels)
            if (weights.row[self.noise == k] > 0).any()
        }

    def first(self, weights: Weights, found: Evaluation) -> Weights:
        """Noise levels as large as the residuals are at the start."""
        row = np.array(weights.row)
        for k, floor in enumerate(self.floor):
            chosen = self.noise == k
            row[chosen] = self.share[chosen] / max(_rms(found.residual[chosen]), floor)
        return dataclasses.replace(weights, row=row)

    def reweigh(
        self, z: np.ndarray, found: Evaluation, weights: Weights, factors: Factors, free: np.ndarray
    ) -> tuple[Weights, bool]:
        """Better weights, and whether they are as good as the same."""
        root = factors.root(factors.rank(np.finfo(float).eps * len(found.residual)))
        row, precision = np.array(weights.row), np.array(weights.precision)
        changes = [0.0]
        for k, floor in enumerate(self.floor):
            chosen = self.noise == k
            spread = (weights.row[chosen, None] * found.jacobian[np.ix_(chosen, free)]) @ root
            left = max(chosen.sum() - float(np.sum(spread**2)), 1.0)
            sigma = max(_rms(found.residual[chosen]) * np.sqrt(chosen.sum() / left), floor)
            changes.append(abs(np.log(sigma * row[chosen][0] / self.share[chosen][0])))
            row[chosen] = self.share[chosen] / sigma
        variance = np.zeros(len(z))
        variance[free] = np.sum(root**2, axis=1)
        for group in self.groups:
            old = weights.precision[group][0]
            known = max(group.sum() - old * float(np.sum(variance[group])), 1e-3)
            new = known / max(float(np.sum((z - weights.mean)[group] ** 2)), np.finfo(float).tiny)
            changes.append(abs(np.log(new / old)))
            precision[group] = new
        return dataclasses.replace(weights, row=row, precision=precision), bool(max(changes) <= SETTLED)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
