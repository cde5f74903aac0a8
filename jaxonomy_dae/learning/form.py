"""Statistics of the form of series of residuals, and the approximate probabilities of white noise to exceed them.

Several series of n numbers, each of mean square one, are judged at once.
"""

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc

SHORTEST = 8  # frequencies of a record below which its lowest ones are those that a fit takes away
FINE = 2  # frequencies for each that is independent: a peak between two of these loses up to three fifths of its power


def periodogram(values: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "s f"]:
    """The power at frequencies half as far apart as independent ones, above zero; of mean one for white noise."""
    n = values.shape[1]
    return np.abs(np.fft.rfft(values, FINE * n)[:, 1 : FINE * n // 2]) ** 2 / n


def of_several(each: list[Float[np.ndarray, " s"]]) -> Float[np.ndarray, " s"]:
    """The probability of the least of several (Bonferroni)."""
    return np.minimum(np.min(each, axis=0) * len(each), 1.0)


def neighbours(own: Float[np.ndarray, "s n"]) -> tuple[Float[np.ndarray, " s"], int]:
    """(Ljung and Box's statistic of numbers of mean square one, its lags: ln n, as Tsay 2010 advises)."""
    n = own.shape[1]
    lags = max(int(np.log(n)), 1)
    terms = [(np.sum(own[:, k:] * own[:, :-k], axis=1) / n) ** 2 / (n - k) for k in range(1, lags + 1)]
    return n * (n + 2) * np.sum(terms, axis=0), lags


def peak(spectra: list[Float[np.ndarray, "s _"]]) -> Float[np.ndarray, " s"]:
    """The probability of the highest peak of some spectra together: χ² at each frequency, times how many there are, of
    which neighbours depend on each other."""
    highest = np.max(sum(spectra), axis=1)
    return np.minimum(0.75 * spectra[0].shape[1] * chdtrc(2 * len(spectra), 2 * highest), 1.0)


def slow(spectra: list[Float[np.ndarray, "s _"]], left: list[Float[np.ndarray, " _"]]) -> Float[np.ndarray, " s"]:
    """The probability of the power at the lowest frequencies of all spectra together, up to a quarter of them."""
    chosen = [k for k, one in enumerate(spectra) if one.shape[1] >= SHORTEST * FINE]
    if not chosen:
        return np.ones(len(spectra[0]))
    lines = [np.concatenate([left[k][None], spectra[k]])[:, FINE - 1 :: FINE] for k in chosen]
    each = []
    for count in 2 ** np.arange(int(np.log2(max(one.shape[1] for one in lines) / 4)) + 1):
        power = np.sum([2 * np.sum(one[:, : min(count, one.shape[1] // 4)], axis=1) for one in lines], axis=0)
        each.append(chdtrc(max(power[0], 1.0), power[1:]))
    return of_several(each)
