"""What is done to the samples of one signal before it is fitted: interpolation, decimation, the removal of a trend."""

import numpy as np
import scipy.signal
from jaxtyping import Float

LOBES = 10  # of the low-pass filter on each side, in samples that are kept: as in scipy.signal.decimate


def interpolated(
    times: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"], new: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m k"]:
    """Linear interpolation; NaN outside of the record, and where a neighbour is missing. A sample that stands on a time
    needs no neighbour."""
    right = np.clip(np.searchsorted(times, new), 1, len(times) - 1)
    left = right - 1
    share = ((new - times[left]) / (times[right] - times[left]))[:, None]
    between = (1 - share) * values[left] + share * values[right]
    between = np.where(share == 0, values[left], np.where(share == 1, values[right], between))
    return np.where((share >= 0) & (share <= 1), between, np.nan)


def low_pass(factor: int) -> Float[np.ndarray, " r"]:
    """The response of a filter that lets frequencies below 1/(2·factor) samples pass, without delay."""
    return np.asarray(scipy.signal.firwin(2 * LOBES * factor + 1, 1 / factor), float)


def smoothed(values: Float[np.ndarray, "n k"], response: Float[np.ndarray, " r"]) -> Float[np.ndarray, "n k"]:
    """Filtered signals. Beyond its ends, a signal goes on point-symmetrically, so that straight lines stay."""
    reach, last = len(response) // 2, len(values) - 1
    place = np.arange(-reach, len(values) + reach)
    slope = (values[last] - values[0]) / last
    around = values - values[0] - np.arange(len(values))[:, None] * slope  # of the line through both ends
    turned = place % (2 * last)
    sign = np.where(turned <= last, 1.0, -1.0)[:, None]
    extended = values[0] + place[:, None] * slope + sign * around[np.minimum(turned, 2 * last - turned)]
    return np.stack([np.convolve(column, response, "valid") for column in extended.T], axis=1)


def untrended(
    times: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"], degree: int
) -> Float[np.ndarray, "n k"]:
    """Signals less their polynomials of least squares, NaN where they are missing."""
    middle, half = 0.5 * (times[0] + times[-1]), 0.5 * float(np.ptp(times)) or 1.0
    basis, out = np.vander((times - middle) / half, degree + 1), np.array(values)
    for column in out.T:
        seen = np.isfinite(column)
        column -= basis @ np.linalg.lstsq(basis[seen], column[seen], rcond=None)[0]
    return out
