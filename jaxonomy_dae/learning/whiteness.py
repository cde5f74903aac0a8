"""Whether residuals look like noise."""

import dataclasses

import numpy as np
import scipy.stats
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Whiteness:
    """The test of one output of one experiment: the correlation of neighbouring residuals, and the probability that
    white noise would show as much over all lags looked at (Ljung & Box 1978)."""

    correlation: float
    probability: float


def whiteness(residual: Float[np.ndarray, " n"]) -> Whiteness:
    """The test over as many lags as ln n, the number of which Ljung and Box's statistic is advised for (Tsay 2010)."""
    n = len(residual)
    centred = residual - residual.mean()
    power = float(centred @ centred)
    lags = max(int(np.log(n)), 1)
    if n <= lags + 1 or power == 0:
        return Whiteness(np.nan, np.nan)
    rho = np.array([float(centred[k:] @ centred[:-k]) for k in range(1, lags + 1)]) / power
    statistic = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    return Whiteness(float(rho[0]), float(scipy.stats.chi2.sf(statistic, lags)))
