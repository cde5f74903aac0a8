"""Samples that noise of a normal distribution does not make: a test for them, and which they are."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import betaincc, ndtr

FEWEST = 20  # samples, from which the distribution of the kurtosis is known well enough (Anscombe & Glynn 1983)
BEYOND = 4.5  # robust standard deviations: of 10⁵ normal numbers, one
NORMAL = 1.4826  # standard deviations of normal numbers for each of their median magnitude


def heavy_tails(u: Float[np.ndarray, "s n"]) -> Float[np.ndarray, " s"]:
    """The probability that normal numbers have tails as heavy, of any size: by the greatest one's share of the sum of
    squares (Grubbs 1950, Ann. Math. Stat. 21:27), and by the kurtosis (Anscombe & Glynn 1983, Biometrika 70:227),
    which several of them do not mask."""
    n = u.shape[1]
    squares = u**2
    total = np.maximum(np.sum(squares, axis=1), np.sqrt(np.finfo(float).tiny))
    greatest = n * betaincc(0.5, 0.5 * (n - 1), np.max(squares, axis=1) / total)
    if n < FEWEST:
        return np.minimum(greatest, 1.0)
    return np.minimum(2 * np.minimum(greatest, _flat(n * np.sum(squares**2, axis=1) / total**2, n)), 1.0)


def _flat(kurtosis: Float[np.ndarray, " s"], n: int) -> Float[np.ndarray, " s"]:
    """The probability of so great a kurtosis of n normal numbers."""
    mean = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    skew = 6 * (n**2 - 5 * n + 2) / ((n + 7) * (n + 9)) * np.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    a = 6 + 8 / skew * (2 / skew + np.sqrt(1 + 4 / skew**2))
    x = np.maximum(1 + (kurtosis - mean) / np.sqrt(variance) * np.sqrt(2 / (a - 4)), np.finfo(float).tiny)
    return ndtr((np.cbrt((1 - 2 / a) / x) - (1 - 2 / (9 * a))) / np.sqrt(2 / (9 * a)))


def outliers(u: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """True for single samples that lie far out. Where most of them have a neighbour that does, it is no sample's error,
    and none is."""
    far = np.abs(u) > BEYOND * NORMAL * np.median(np.abs(u))
    beside = np.zeros_like(far)
    beside[1:] |= far[:-1]
    beside[:-1] |= far[1:]
    return far & (2 * np.sum(far & beside) <= np.sum(far))
