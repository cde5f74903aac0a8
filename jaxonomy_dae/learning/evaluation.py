"""Residuals at a point, and how much each of them counts."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .noise import Tails
from .smoothness import Bends


class Evaluation(NamedTuple):
    """Residuals as they are, not weighted, and their Jacobian; and where the model says how large they should be, their
    variance and the derivatives of its logarithm."""

    residual: Float[np.ndarray, " m"]
    jacobian: Float[np.ndarray, "m p"]
    variance: Float[np.ndarray, " m"] | None = None
    log_slope: Float[np.ndarray, "m p"] | None = None


class Rows(NamedTuple):
    """Weighted residuals and Jacobian, with those of priors."""

    residual: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r p"]


@dataclasses.dataclass(frozen=True)
class Weights:
    """The weights of residuals and priors in the cost. A residual of weight w counts as w residuals of the same value
    would, in every sum and in every number of samples."""

    row: Float[np.ndarray, " m"]  # √w/σ
    precision: Float[np.ndarray, " p"]  # of the normal prior of each coordinate; 0 where there is none
    mean: Float[np.ndarray, " p"]
    share: Float[np.ndarray, " m"]  # √w
    bends: Bends | None = None  # the derivatives of learned laws whose prior is around zero
    stiffness: Float[np.ndarray, " g"] = dataclasses.field(default_factory=lambda: np.zeros(0))  # precisions of these
    tails: Tails | None = None  # distributions of the noise; None: all are normal

    @property
    def samples(self) -> float:
        """The number of samples, Σ w."""
        return float(np.sum(self.share**2))

    @property
    def scale(self) -> Float[np.ndarray, " m"]:
        """1/σ of each sample."""
        return self.row / self.share

    @property
    def log_rows(self) -> float:
        """Σ w ln (1/σ), which the cost does not contain, and what distributions with tails have besides."""
        logs = np.log(self.scale) if self.tails is None else np.log(self.scale) + self.tails.log_peak()
        return float(np.sum(self.share**2 * logs))

    def bent(self, residual: Float[np.ndarray, " m"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """(weighted residuals v, of which ½ v² is the cost; their derivatives by the residuals)."""
        if self.tails is None:
            return self.row * residual, self.row
        v, slope = self.tails.bent(self.scale * residual)
        return self.share * v, self.row * slope

    def pull(self, residual: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """How much each residual counts beside one of normal noise."""
        return np.ones_like(residual) if self.tails is None else self.tails.pull(self.scale * residual)

    def scores(self, residual: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Residuals as standard normal numbers, if model and noise are right."""
        u = self.scale * residual
        return u if self.tails is None else self.tails.scores(u)

    @property
    def informing(self) -> Float[np.ndarray, " m"]:
        """√ of Fisher's information of each sample about its mean."""
        return self.row if self.tails is None else self.row * np.sqrt(self.tails.information())

    def part(self, rows: Bool[np.ndarray, " m"]) -> "Weights":
        """The weights of some residuals."""
        tails = None if self.tails is None else self.tails[rows]
        return dataclasses.replace(self, row=self.row[rows], share=self.share[rows], tails=tails)

    def prior(self, z: Float[np.ndarray, " p"]) -> Rows:
        """A row for each prior of a coordinate, and each derivative of a law."""
        chosen = np.flatnonzero(self.precision)
        root = np.sqrt(self.precision)
        plain = Rows((root * (z - self.mean))[chosen], np.diag(root)[chosen])
        if self.bends is None:
            return plain
        values, slopes = self.bends.at(z)
        root = np.sqrt(self.stiffness)[self.bends.group]
        return Rows(
            np.concatenate([plain.residual, root * values]),
            np.concatenate([plain.jacobian, root[:, None] * slopes]),
        )

    def prior_cost(self, z: Float[np.ndarray, " p"]) -> float:
        """½ Σ precision·(z − mean)² and the same of derivatives."""
        cost = 0.5 * float(np.sum(self.precision * (z - self.mean) ** 2))
        if self.bends is not None:
            cost += 0.5 * float(np.sum(self.stiffness[self.bends.group] * self.bends.at(z)[0] ** 2))
        return cost

    def with_priors_of(self, other: "Weights") -> "Weights":
        """These weights of residuals, and the priors of others."""
        return dataclasses.replace(
            self, precision=other.precision, mean=other.mean, bends=other.bends, stiffness=other.stiffness
        )

    def applied(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Rows:
        """Weighted residuals and Jacobian, with a row for each prior."""
        return self._rows(z, found, *self.bent(found.residual))

    def expected(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Rows:
        """The same, of which the square of the Jacobian is the information that is expected of such samples."""
        return self._rows(z, found, self.bent(found.residual)[0], self.informing)

    def _rows(self, z: np.ndarray, found: Evaluation, residual: np.ndarray, row: np.ndarray) -> Rows:
        prior = self.prior(z)
        return Rows(
            np.concatenate([residual, prior.residual]),
            np.concatenate([row[:, None] * found.jacobian, prior.jacobian]),
        )

    def cost(self, z: Float[np.ndarray, " p"], residual: Float[np.ndarray, " m"]) -> float:
        """½ |W r|² and what the priors add; infinite where a run leads beyond all numbers."""
        with np.errstate(over="ignore"):
            return 0.5 * float(np.sum(self.bent(residual)[0] ** 2)) + self.prior_cost(z)
