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
from jaxtyping import Bool, Float, Int

from ..host.threads import one_thread
from .evaluation import Evaluation, Weights
from .factors import Factors

# A prior of smoothness weighs so many times as much as the data at most, by the squares of their columns.
HEAVIEST = 1e4
# A prior that is a smaller part of the heaviest one is lost in rounding.
LIGHTEST = 1e-16
# A prior of derivatives does not become stronger where the data determine fewer degrees of freedom than this of what it
# is about.
FAINT = 0.1
NEAR = 2.0  # χ² for each sample, beyond which it is the misfit that speaks, and precisions of priors stay as they are


@dataclasses.dataclass(frozen=True)
class Evidence:
    """The quantities that the evidence determines: noise levels of groups of residuals, precisions of groups of
    coordinates."""

    noise: Int[np.ndarray, " m"]  # the group of each residual; −1: its noise level is known
    labels: tuple[str, ...]  # of these groups
    floor: np.ndarray  # (groups,): the rounding of the data, below which no noise can be seen
    groups: tuple[Bool[np.ndarray, " p"], ...]  # whose precision is to be found
    unit: Float[np.ndarray, " m"] | float = 1.0  # by which each residual's level is multiplied
    laws: tuple[Bool[np.ndarray, " p"], ...] = ()  # the weights of each law that has a prior of smoothness

    @property
    def is_idle(self) -> bool:
        """True if there is nothing to determine."""
        return not self.labels and not self.groups

    def sigma(self, weights: Weights) -> dict[str, float]:
        """The noise level of each group."""
        return {
            label: float(1 / (weights.scale * self.unit)[self.noise == k][0])
            for k, label in enumerate(self.labels)
            if (weights.row[self.noise == k] > 0).any()
        }

    def first(self, weights: Weights, found: Evaluation) -> Weights:
        """Noise levels as large as the residuals are at the start."""
        row = np.array(weights.row)
        for k, floor in enumerate(self.floor):
            chosen = self.noise == k
            share = weights.share[chosen]
            unit = (np.ones(len(row)) * self.unit)[chosen]
            row[chosen] = share / unit / max(_rms(found.residual[chosen] / unit, share), floor)
        return dataclasses.replace(weights, row=row)

    def reweigh(
        self, z: np.ndarray, found: Evaluation, weights: Weights, factors: Factors, free: np.ndarray, is_minimum: bool
    ) -> tuple[Weights, float]:
        """Better weights, and the greatest relative change.

        On the way through residuals that are larger than their known noise levels, precisions stay: the formula holds
        at a minimum, and elsewhere would let go of a prior that nothing else replaces. At a minimum they change in any
        case: a prior that is too strong keeps residuals large."""
        root = factors.root(factors.rank(np.finfo(float).eps * len(found.residual)))
        row = np.array(weights.row)
        changes = [0.0]
        for k, floor in enumerate(self.floor):
            chosen = self.noise == k
            share = weights.share[chosen]
            count = float(np.sum(share**2))
            spread = (weights.row[chosen, None] * found.jacobian[np.ix_(chosen, free)]) @ root
            left = max(count - float(np.sum(spread**2)), 1.0)
            unit = (np.ones(len(row)) * self.unit)[chosen]
            counted = np.sqrt(weights.pull(found.residual)[chosen]) * found.residual[chosen] / unit
            sigma = max(_rms(counted, share) * np.sqrt(count / left), floor)
            changes.append(abs(np.log(sigma * (row * self.unit)[chosen][0] / share[0])))
            row[chosen] = share / (unit * sigma)
        known = self.noise < 0
        misfit = float(np.sum(weights.bent(found.residual)[0][known] ** 2))
        near = misfit <= NEAR * float(np.sum(weights.share[known] ** 2))
        better = dataclasses.replace(weights, row=row)
        if (self.groups or self.laws) and (near or is_minimum):
            wide = np.zeros((len(z), root.shape[1]))
            wide[free] = root
            for group in self.groups:
                better, moved = self._priors(z, found, better, group, wide)
                changes.append(moved)
        return better, float(max(changes))

    def _priors(
        self, z: np.ndarray, found: Evaluation, weights: Weights, group: np.ndarray, root: np.ndarray
    ) -> tuple[Weights, float]:
        """(better precisions of one group of coordinates, and of the derivatives of a law whose weights they are; how
        much they change)."""
        precision, stiffness = np.array(weights.precision), np.array(weights.stiffness)
        old, size = precision[group][0], int(group.sum())
        own = [k for k, law in enumerate(self.laws) if np.array_equal(law, group)]
        inside: list[int] = []
        slopes, values, of_row, data = np.zeros((0, size)), np.zeros(0), np.zeros(0, int), 0.0
        if weights.bends is not None and own:
            inside = np.flatnonzero(weights.bends.owner == own[0]).tolist()
            rows = np.isin(weights.bends.group, inside)
            values, slopes = (a[rows] for a in weights.bends.at(z))
            of_row, slopes = weights.bends.group[rows], slopes[:, group]
            # Beside rows so much heavier than the data's, the data's would be lost to rounding.
            data = np.sum((weights.row[:, None] * found.jacobian[:, group]) ** 2)
        # The prior's own covariance, from the singular values of the derivatives' rows relative to those of weights.
        scaled = np.sqrt(stiffness[of_row] / old)[:, None] * slopes if len(slopes) else slopes
        with one_thread(len(scaled) * size**2):
            left, s, _ = np.linalg.svd(scaled, full_matrices=False)
        shares = s**2 / (1 + s**2)
        determined = size - float(np.sum(shares)) - old * float(np.sum(root[group] ** 2))
        square = float(np.sum((z - weights.mean)[group] ** 2))
        precision[group] = _updated(determined, square)
        changes = [abs(np.log(precision[group][0] / old))]
        for k in inside:
            mine = of_row == k
            weight = float(np.sum(slopes[mine] ** 2))
            # An output that no weight bends, as a piecewise linear or a constant one.
            if weight < np.sqrt(np.finfo(float).tiny) * max(data, 1.0):
                continue
            spread = stiffness[k] * float(np.sum((slopes[mine] @ root[group]) ** 2))
            determined = float(np.sum(left[mine] ** 2 @ shares)) - spread
            most = HEAVIEST * data / weight
            heaviest = most if determined > FAINT else stiffness[k]
            new = np.clip(_updated(determined, float(np.sum(values[mine] ** 2))), LIGHTEST * most, heaviest)
            # A prior that decides next to nothing may go on changing.
            changes.append(abs(np.log(new / stiffness[k])) * min(max(determined, 0.0), 1.0))
            stiffness[k] = new
        return dataclasses.replace(weights, precision=precision, stiffness=stiffness), max(changes)


def log_evidence(z: Float[np.ndarray, " p"], found: Evaluation, weights: Weights) -> float:
    """ln of the probability of the data whatever the coordinates, less a constant, by Laplace's approximation at a
    minimum: by it, priors of different forms compare."""
    has_prior = weights.precision > 0
    prior = weights.prior(z).jacobian[:, has_prior]
    whole = weights.applied(z, found).jacobian
    size = np.linalg.norm(whole, axis=0)
    size[size == 0] = 1.0
    with one_thread(len(whole) * len(size) ** 2):
        logs = [np.log(np.linalg.svd(rows, compute_uv=False)) for rows in (prior / size[has_prior], whole / size)]
    # Sizes of coordinates without a prior stand for units, which are the same for all that is compared.
    return (
        weights.log_rows
        - weights.cost(z, found.residual)
        + float(logs[0].sum() - logs[1].sum() - np.log(size[~has_prior]).sum())
    )


def _updated(determined: float, square: float) -> float:
    """A precision that explains a sum of squares by as many numbers as the data determine."""
    return max(determined, 1e-3) / max(square, np.finfo(float).tiny)


def _rms(values: np.ndarray, share: np.ndarray) -> float:
    return float(np.sqrt(np.average(values**2, weights=share**2)))
