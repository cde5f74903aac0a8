"""How well an estimate agrees with its data: errors by name, the likelihood, and whether residuals look like noise."""

import dataclasses

import numpy as np
import scipy.stats
from jaxtyping import Float, Int

from .descent import Minimum
from .form import FINE, neighbours, peak, periodogram
from .objective import Objective

STRONGEST = 0.97  # correlation of neighbours: beyond, a record has too few independent parts for its covariance


@dataclasses.dataclass(frozen=True)
class Whiteness:
    """The tests of one output of one experiment.

    - `correlation`: the correlation of neighbouring residuals.
    - `lag`, `strongest`: the number of samples over which residuals correlate most strongly, and this correlation.
    - `statistic`: the statistic of Ljung and Box (1978) over `lags` lags. For white noise it has a χ² distribution with
        `lags` degrees of freedom.
    - `peak`: the probability that the spectrum of white noise has a peak as high as this one. A missing mode of the
        model makes such a peak.
    - `period`: that of its highest peak, in samples.
    """

    correlation: float
    statistic: float
    lags: int
    peak: float
    lag: int = 1
    strongest: float = np.nan
    period: float = np.nan

    @property
    def finding(self) -> str:
        """What speaks most strongly against white noise."""
        if self.peak < self.probability:
            return f"a period of {self.period:.3g} samples stands out"
        if self.lag == 1:
            return f"neighbours correlate by {self.strongest:.2f}"
        return f"residuals {self.lag} samples apart correlate by {self.strongest:.2f}"

    @property
    def probability(self) -> float:
        """The probability that white noise would show as much correlation."""
        return float(scipy.stats.chi2.sf(self.statistic, self.lags))


def whiteness(residual: Float[np.ndarray, " n"]) -> Whiteness:
    """The test over as many lags as ln n, the number of which Ljung and Box's statistic is advised for (Tsay 2010).
    Missing samples, NaN, are left out."""
    residual = residual[np.isfinite(residual)]
    n = len(residual)
    lags = max(int(np.log(n)), 1)
    centred = residual - residual.mean()
    power = float(centred @ centred)
    if n <= lags + 1 or power == 0:
        return Whiteness(np.nan, np.nan, lags, np.nan)
    own = (centred / np.sqrt(power / n))[None]
    spectrum, (statistic, lags) = periodogram(own), neighbours(own)
    rho = np.array([float(centred[k:] @ centred[:-k]) for k in range(1, lags + 1)]) / power
    most = int(np.argmax(np.abs(rho)))
    return Whiteness(
        correlation=float(rho[0]), statistic=float(statistic[0]), lags=lags, peak=float(peak([spectrum])[0]),
        lag=most + 1, strongest=float(rho[most]), period=FINE * n / (int(np.argmax(spectrum[0])) + 1),
    )  # fmt: skip


def log_likelihood(objective: Objective, m: Minimum) -> float:
    """As `Estimate.log_likelihood`."""
    cost = m.weights.cost(m.z, m.found.residual) - m.weights.prior_cost(m.z)
    scale = objective.colour.log_scale(m.weights.share)
    return m.weights.log_rows - cost - scale - 0.5 * m.weights.samples * float(np.log(2 * np.pi))


def rms_by_name(objective: Objective, m: Minimum, point: Float[np.ndarray, " p"]) -> dict[str, dict[str, float]]:
    """As `Estimate.rms`."""
    s, rows = objective.stacked, objective.rows
    errors = np.full(s.values.shape, np.nan)
    errors[rows] = objective.colour.coloured(m.found.residual)
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


def correlated(
    scores: Float[np.ndarray, "m f"], experiment: Int[np.ndarray, " m"], row: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "f f"]:
    """The covariance of Σ scores where residuals are correlated in time and between outputs: the middle of the sandwich
    H⁻¹ Ω H⁻¹. Each component is first whitened as noise of first order (Andrews & Monahan 1992, Econometrica 60:953);
    of what is left, lags up to L count less the further they are (Newey & West 1987, Econometrica 55:703), with L by
    the correlation of neighbours that is left (Andrews 1991, Econometrica 59:817)."""
    out = np.zeros((scores.shape[1], scores.shape[1]))
    for k in np.unique(experiment):
        own = experiment == k
        place = row[own] - row[own].min()
        by_row = np.zeros((int(place.max()) + 1, scores.shape[1]))
        np.add.at(by_row, place, scores[own])
        rho = _of_neighbours(by_row)
        white = np.concatenate([by_row[:1] * np.sqrt(1 - rho**2), by_row[1:] - rho * by_row[:-1]])
        left = float(np.max(np.abs(_of_neighbours(white)), initial=0.0))
        alpha = 4 * left**2 / (1 - left**2) ** 2
        lags = min(int(np.ceil(1.1447 * (alpha * len(white)) ** (1 / 3))), len(white) - 1)
        part = white.T @ white
        for lag in range(1, lags + 1):
            both = white[lag:].T @ white[:-lag]
            part += (1 - lag / (lags + 1)) * (both + both.T)
        out += part / np.outer(1 - rho, 1 - rho)
    return out


def _of_neighbours(rows: Float[np.ndarray, "n f"]) -> Float[np.ndarray, " f"]:
    """The correlation of each column's neighbours."""
    power = np.sum(rows**2, axis=0)
    found = np.sum(rows[1:] * rows[:-1], axis=0) / np.where(power > 0, power, 1.0)
    return np.clip(found, -STRONGEST, STRONGEST)
