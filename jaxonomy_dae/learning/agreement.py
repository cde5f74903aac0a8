"""How well an estimate agrees with its data: errors by name, the likelihood, and whether residuals look like noise."""

import dataclasses

import numpy as np
import scipy.stats
from jaxtyping import Float

from .descent import Minimum
from .objective import Objective


@dataclasses.dataclass(frozen=True)
class Whiteness:
    """The tests of one output of one experiment.

    - `correlation`: the correlation of neighbouring residuals.
    - `statistic`: the statistic of Ljung and Box (1978) over `lags` lags. For white noise it has a χ² distribution with
        `lags` degrees of freedom.
    - `peak`: the probability that the spectrum of white noise has a peak as high as this one. A missing mode of the
        model makes such a peak.
    """

    correlation: float
    statistic: float
    lags: int
    peak: float

    @property
    def probability(self) -> float:
        """The probability that white noise would show as much correlation."""
        return float(scipy.stats.chi2.sf(self.statistic, self.lags))


def whiteness(residual: Float[np.ndarray, " n"]) -> Whiteness:
    """The test over as many lags as ln n, the number of which Ljung and Box's statistic is advised for (Tsay 2010).
    Missing samples, NaN, are left out."""
    residual = residual[np.isfinite(residual)]
    n = len(residual)
    centred = residual - residual.mean()
    power = float(centred @ centred)
    lags = max(int(np.log(n)), 1)
    if n <= lags + 1 or power == 0:
        return Whiteness(np.nan, np.nan, lags, np.nan)
    rho = np.array([float(centred[k:] @ centred[:-k]) for k in range(1, lags + 1)]) / power
    statistic = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    return Whiteness(float(rho[0]), statistic, lags, peak(centred))


def peak(centred: Float[np.ndarray, " n"]) -> float:
    """The probability that the periodogram of white noise has a peak as high as this, relative to its sum: of m
    frequencies, at most m·(1 − g)^(m − 1) (Fisher 1929, Proc. R. Soc. A 125:54)."""
    squares = np.abs(np.fft.rfft(centred)[1 : (len(centred) + 1) // 2]) ** 2
    if len(squares) < 2:
        return 1.0
    share = float(squares.max() / squares.sum())
    return min(len(squares) * (1 - share) ** (len(squares) - 1), 1.0)


def log_likelihood(m: Minimum) -> float:
    """As `Estimate.log_likelihood`."""
    cost = m.weights.cost(m.z, m.found.residual) - m.weights.prior_cost(m.z)
    return m.weights.log_rows - cost - 0.5 * m.weights.samples * float(np.log(2 * np.pi))


def rms_by_name(objective: Objective, m: Minimum, point: Float[np.ndarray, " p"]) -> dict[str, dict[str, float]]:
    """As `Estimate.rms`."""
    s, rows = objective.stacked, objective.rows
    errors = np.full(s.values.shape, np.nan)
    errors[rows] = m.found.residual
    if not np.isin(np.arange(len(s.labels)), rows[0]).all():
        free_runs = objective.outputs(point) - s.values
        errors = np.where(np.isnan(errors), free_runs, errors)
    found: dict[str, dict[str, float]] = {}
    for k, label in enumerate(s.labels):
        for j, name in enumerate(s.outputs):
            seen = s.observed[k, :, j]
            if seen.any():
                found.setdefault(label, {})[name] = float(np.sqrt(np.mean(errors[k, :, j][seen] ** 2)))
    return found
