"""How samples err: levels that are known or estimated, in proportion to a scale, shared by sensors, with outliers.

A distribution with tails enters least squares by a residual that is bent: with −ln p(u) = ρ(u) for u in units of the
level, v = sign(u) √(2ρ(u)) takes the place of u, so that ½ v² = ρ and dv/du · v = ρ', exactly. A level σ that is
estimated is that of greatest likelihood, Σ u ρ'(u) = n, with degrees of freedom in the place of n.
"""

import dataclasses
import math
from typing import Any

import numpy as np
import scipy.special
import scipy.stats
from jaxtyping import Bool, Float

from ..base.errors import ModelError, explained
from .priors import is_finite

ESTIMATE = "estimate"


@explained
@dataclasses.dataclass(frozen=True, eq=False)
class Noise:
    """The noise of one signal, for `Experiment(sigma={"tank.h": Noise(...)})`.

    - `level`: its standard deviation, a number > 0; or `"estimate"`, found from the residuals.
    - `scale`: an array of the data's shape, by which the level is multiplied: with `scale=abs(y) + 0.1`, errors grow
        with what is measured.
    - `shared`: a name. Signals that give the same one have one level, which is estimated from all of them.
    - `student`: degrees of freedom ν > 1 of Student's distribution, whose heavy tails take outliers lightly; 4 is
        common. The level is its scale, less than its standard deviation.
    - `huber`: from how many levels on residuals count linearly, not squared (Huber 1964); 1.5 is common.
    - `rho`: the correlation of errors one sampling step apart, between −1 and 1, of noise of first order; or
        `"estimate"`. Errors that are g steps apart correlate by ρᵍ. The level stays the standard deviation of one
        sample. For fits of runs.
    """

    level: float | str = ESTIMATE
    scale: Any = None
    shared: str = ""
    student: float | None = None
    huber: float | None = None
    rho: float | str | None = None

    def __post_init__(self):
        if not (self.rho is None or _is_open(self.rho) or (is_finite(self.rho) and abs(float(self.rho)) < 1)):
            raise ModelError(f"Noise: rho is a correlation between −1 and 1, or 'estimate'; got {self.rho!r}")
        if self.rho is not None and (self.student is not None or self.huber is not None):
            raise ModelError("Noise: errors that are correlated, rho, are normal: leave student and huber out")
        if not (_is_open(self.level) or (is_finite(self.level) and float(self.level) > 0)):
            raise ModelError(
                "Noise: level is a standard deviation > 0, or 'estimate'; an array goes into scale=; got "
                f"{self.level!r}"
            )
        if self.shared and not _is_open(self.level):
            raise ModelError(
                f"Noise: a level that is shared, '{self.shared}', is estimated; it is given as {self.level}"
            )
        if self.student is not None and not (is_finite(self.student) and self.student > 1):
            raise ModelError(f"Noise: student is a number of degrees of freedom > 1; got {self.student!r}")
        if self.huber is not None and not (is_finite(self.huber) and self.huber > 0):
            raise ModelError(f"Noise: huber is a number of levels > 0; got {self.huber!r}")
        if self.student is not None and self.huber is not None:
            raise ModelError("Noise: student and huber are two distributions: leave one of them out")

    @property
    def number(self) -> float:
        """The level; NaN if it is to be estimated."""
        return math.nan if isinstance(self.level, str) else float(self.level)

    @property
    def tails(self) -> tuple[float, float]:
        """(degrees of freedom, knee); infinite where there is none."""
        return self.student or math.inf, self.huber or math.inf

    @property
    def correlation(self) -> float:
        """The correlation of neighbours: zero for white noise, NaN if it is to be estimated."""
        return math.nan if isinstance(self.rho, str) else float(self.rho or 0.0)

    @property
    def is_plain(self) -> bool:
        """True for white normal noise with a level of its own, which is the same for all samples."""
        return self.scale is None and not self.shared and self.tails == (math.inf, math.inf) and self.rho is None


def _is_open(value: object) -> bool:
    """True for what is to be estimated."""
    return isinstance(value, str) and value == ESTIMATE


@dataclasses.dataclass(frozen=True, eq=False)
class Tails:
    """Distributions of samples, in units of their levels: degrees of freedom ν of Student's, and the knee k of Huber's;
    infinite for all others."""

    freedom: Float[np.ndarray, " m"]
    knee: Float[np.ndarray, " m"]

    def __getitem__(self, rows: Bool[np.ndarray, " m"]) -> "Tails":
        return Tails(self.freedom[rows], self.knee[rows])

    @property
    def _student(self) -> Bool[np.ndarray, " m"]:
        return np.isfinite(self.freedom)

    def bent(self, u: Float[np.ndarray, " m"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """(v = sign(u) √(2ρ), dv/du)."""
        v, slope = np.array(u), np.ones_like(u)
        far = np.abs(u) > self.knee
        k, size = self.knee[far], np.abs(u[far])
        v[far] = np.sign(u[far]) * np.sqrt(2 * k * size - k**2)
        slope[far] = k / np.abs(v[far])
        heavy = self._student
        nu, x = self.freedom[heavy], u[heavy]
        root = np.sqrt((nu + 1) * np.log1p(x**2 / nu))
        v[heavy] = np.sign(x) * root
        near = root < 1e-6  # where v = √((ν + 1)/ν) u to rounding
        slope[heavy] = np.where(
            near, np.sqrt((nu + 1) / nu), (nu + 1) * np.abs(x) / ((nu + x**2) * np.where(near, 1, root))
        )
        return v, slope

    def pull(self, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """ρ'(u)/u: how much a residual counts, beside one of normal noise."""
        counts = np.where(np.abs(u) > self.knee, self.knee / np.maximum(np.abs(u), np.finfo(float).tiny), 1.0)
        heavy = self._student
        counts[heavy] = (self.freedom[heavy] + 1) / (self.freedom[heavy] + u[heavy] ** 2)
        return counts

    def scores(self, u: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Normal numbers of the same probabilities: where the distribution is right, they are standard normal."""
        found, heavy, bent = np.array(u), self._student, np.isfinite(self.knee)
        beyond = np.array(np.abs(u))
        beyond[heavy] = scipy.stats.t.sf(np.abs(u[heavy]), self.freedom[heavy])
        k, size = self.knee[bent], np.abs(u[bent])
        area = np.sqrt(2 * np.pi) * (scipy.special.ndtr(np.minimum(size, k)) - 0.5)
        outside = np.exp(-0.5 * k**2 - k * np.maximum(size - k, 0.0)) / k
        whole = self._whole(k)
        beyond[bent] = np.where(size > k, outside / whole, 0.5 - area / whole)
        own = heavy | bent
        found[own] = np.sign(u[own]) * scipy.stats.norm.isf(np.maximum(beyond[own], np.finfo(float).tiny))
        return found

    def log_peak(self) -> Float[np.ndarray, " m"]:
        """ln of the density at zero, times √(2π)."""
        logs, heavy, bent = np.zeros(len(self.knee)), self._student, np.isfinite(self.knee)
        nu = self.freedom[heavy]
        logs[heavy] = scipy.special.gammaln((nu + 1) / 2) - scipy.special.gammaln(nu / 2) - 0.5 * np.log(nu / 2)
        logs[bent] = 0.5 * np.log(2 * np.pi) - np.log(self._whole(self.knee[bent]))
        return logs

    def information(self) -> Float[np.ndarray, " m"]:
        """Fisher's information of a shift, one for normal noise."""
        found, heavy, bent = np.ones(len(self.knee)), self._student, np.isfinite(self.knee)
        found[heavy] = (self.freedom[heavy] + 1) / (self.freedom[heavy] + 3)
        k = self.knee[bent]
        found[bent] = np.sqrt(2 * np.pi) * (2 * scipy.special.ndtr(k) - 1) / self._whole(k)
        return found

    @staticmethod
    def _whole(k: np.ndarray) -> np.ndarray:
        """∫ exp(−ρ) of Huber's distribution."""
        return np.sqrt(2 * np.pi) * (2 * scipy.special.ndtr(k) - 1) + 2 * np.exp(-0.5 * k**2) / k
