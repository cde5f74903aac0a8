"""Noise levels and prior precisions from the data.

With a normal prior of precision α on a group of k weights w, and noise of standard deviation σ on a group of n
residuals, the evidence of the data is greatest where (MacKay 1992, Neural Computation 4:415 and 4:448)

    α = γ / Σ w²,   γ = k − α·trace C,      σ² = Σ r² / (n − γ_r),   γ_r = Σ leverages of the residuals,

with C the covariance of the weights. γ is how many of them the data determine. A residual of weight w counts w times,
in n as in the sums. Both are brought up to date with every
step of the descent, as Foresee and Hagan do (1997, Proc. ICNN), which costs nothing: C comes from the factors that
the step takes anyway.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from .evaluation import Evaluation, Weights
from .factors import Factors

NEAR = 2.0  # χ² for each sample, beyond which it is the misfit that speaks, and precisions of priors stay as they are


@dataclasses.dataclass(frozen=True)
class Evidence:
    """The quantities that the evidence determines: noise levels of groups of residuals, precisions of groups of
    coordinates."""

    noise: Int[np.ndarray, " m"]  # the group of each residual; −1: its noise level is known
    labels: tuple[str, ...]  # of these groups
    floor: np.ndarray  # (groups,): the rounding of the data, below which no noise can be seen
    groups: tuple[Bool[np.ndarray, " p"], ...]  # whose precision is to be found

    @property
    def is_idle(self) -> bool:
        """True if there is nothing to determine."""
        return not self.labels and not self.groups

    def sigma(self, weights: Weights) -> dict[str, float]:
        """The noise level of each group."""
        return {
            label: float(1 / weights.scale[self.noise == k][0])
            for k, label in enumerate(self.labels)
            if (weights.row[self.noise == k] > 0).any()
        }

    def first(self, weights: Weights, found: Evaluation) -> Weights:
        """Noise levels as large as the residuals are at the start."""
        row = np.array(weights.row)
        for k, floor in enumerate(self.floor):
            chosen = self.noise == k
            share = weights.share[chosen]
            row[chosen] = share / max(_rms(found.residual[chosen], share), floor)
        return dataclasses.replace(weights, row=row)

    def reweigh(
        self, z: np.ndarray, found: Evaluation, weights: Weights, factors: Factors, free: np.ndarray, is_minimum: bool
    ) -> tuple[Weights, float]:
        """Better weights, and the greatest relative change.

        On the way through residuals that are larger than their known noise levels, precisions stay: the formula holds
        at a minimum, and elsewhere would let go of a prior that nothing else replaces. At a minimum they change in any
        case: a prior that is too strong keeps residuals large."""
        root = factors.root(factors.rank(np.finfo(float).eps * len(found.residual)))
        row, precision = np.array(weights.row), np.array(weights.precision)
        changes = [0.0]
        for k, floor in enumerate(self.floor):
            chosen = self.noise == k
            share = weights.share[chosen]
            count = float(np.sum(share**2))
            spread = (weights.row[chosen, None] * found.jacobian[np.ix_(chosen, free)]) @ root
            left = max(count - float(np.sum(spread**2)), 1.0)
            sigma = max(_rms(found.residual[chosen], share) * np.sqrt(count / left), floor)
            changes.append(abs(np.log(sigma * row[chosen][0] / share[0])))
            row[chosen] = share / sigma
        variance = np.zeros(len(z))
        variance[free] = np.sum(root**2, axis=1)
        known = self.noise < 0
        misfit = float(np.sum((weights.row * found.residual)[known] ** 2))
        near = misfit <= NEAR * float(np.sum(weights.share[known] ** 2))
        for group in self.groups if near or is_minimum else ():
            old = weights.precision[group][0]
            determined = max(group.sum() - old * float(np.sum(variance[group])), 1e-3)
            new = determined / max(float(np.sum((z - weights.mean)[group] ** 2)), np.finfo(float).tiny)
            changes.append(abs(np.log(new / old)))
            precision[group] = new
        return dataclasses.replace(weights, row=row, precision=precision), float(max(changes))


def _rms(values: np.ndarray, share: np.ndarray) -> float:
    return float(np.sqrt(np.average(values**2, weights=share**2)))
