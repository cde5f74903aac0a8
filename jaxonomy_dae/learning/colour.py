"""Noise whose neighbours are correlated: of first order, of each sensor by itself.

Errors e of one sensor in one record, in units of their standard deviation, obey

    e₁ ~ N(0, 1),    e_k = φ_k e_{k−1} + √(1 − φ_k²) w_k,    φ_k = ρ^g,    w_k ~ N(0, 1),

over g sampling steps: a missing sample leaves a gap of two. Innovations w are independent, so residuals and their
Jacobian are whitened, and all else is least squares. The likelihood is exact, the first sample included:
−ln L = ½ Σ w² + ½ Σ ln (1 − φ²) + Σ ln σ + const.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ..base.errors import ModelError
from .data import Stacked

EVEN = 1e-3  # of a step, by which gaps may differ from whole numbers of them


@dataclasses.dataclass(frozen=True)
class Colour:
    """The filter that whitens some rows of samples: each row's predecessor, −1 if it is the first of its record; how
    many steps lie between the two, and φ; and the unit of its errors."""

    before: Int[np.ndarray, " m"]
    gaps: Float[np.ndarray, " m"]
    phi: Float[np.ndarray, " m"]
    unit: Float[np.ndarray, " m"]

    @classmethod
    def of(cls, s: Stacked, rows: tuple[np.ndarray, ...], rho: Float[np.ndarray, " k"]) -> "Colour":
        """The filter of samples, (experiments, times, outputs), with the correlation of each output's neighbours."""
        experiment, index, output = rows
        before, gaps = np.full(len(output), -1), np.ones(len(output))
        for k in np.unique(experiment):
            for j in np.unique(output):
                own = np.flatnonzero((experiment == k) & (output == j))
                before[own[1:]] = own[:-1]
                gaps[own[1:]] = steps_between(s.times[k, : s.counts[k]])(index[own])
        with np.errstate(invalid="ignore"):
            phi = np.where((before >= 0) & (rho[output] != 0), rho[output] ** gaps, 0.0)
        level = s.sigma[rows]
        return cls(before, gaps, phi, np.where(np.isnan(level), s.unit[rows], level))

    def whitened(self, a: np.ndarray) -> np.ndarray:
        """Errors or their derivatives, shape (m,) or (m, p), as innovations of the same standard deviations."""
        later = self.before >= 0
        scaled = (a.T / self.unit).T
        out, phi = scaled.copy(), self.phi[later].reshape(-1, *[1] * (a.ndim - 1))
        out[later] = (scaled[later] - phi * scaled[self.before[later]]) / np.sqrt(1 - phi**2)
        return (out.T * self.unit).T

    def coloured(self, w: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """The errors whose innovations these are."""
        out = w / self.unit
        for k in np.flatnonzero(self.before >= 0):  # predecessors come first
            out[k] = np.sqrt(1 - self.phi[k] ** 2) * out[k] + self.phi[k] * out[self.before[k]]
        return out * self.unit

    def log_scale(self, share: Float[np.ndarray, " m"]) -> float:
        """½ Σ w ln (1 − φ²), by which −ln L is more than that of independent innovations."""
        return 0.5 * float(np.sum(share**2 * np.log1p(-(self.phi**2))))


def check_steps(s: Stacked) -> None:
    """Refuses noise of a known correlation below zero whose samples are not whole steps apart: between them, such noise
    has no meaning.

    **Raises:**

    - `ModelError` that names the record and the output.
    """
    for j in np.flatnonzero(s.rho < 0):
        for k, label in enumerate(s.labels):
            gaps = steps_between(s.times[k, : s.counts[k]])(np.flatnonzero(s.observed[k, : s.counts[k], j]))
            if not np.array_equal(gaps, np.rint(gaps)):
                raise ModelError(
                    f"{label}: the samples of '{s.outputs[j]}' are not whole sampling steps apart, over which alone "
                    f"rho = {s.rho[j]:g} of its noise, below zero, has a meaning: resample(times), or leave rho out"
                )


def steps_between(times: Float[np.ndarray, " n"]):
    """A function of row numbers, increasing: how many sampling steps lie between them. The step is the median one; gaps
    that are nearly whole numbers of it are whole."""
    steps = np.diff(times)[np.diff(times) > 0]  # a part of the record ends with times that repeat its last
    step = np.median(steps) if len(steps) else 1.0

    def between(index: Int[np.ndarray, " r"]) -> Float[np.ndarray, " _"]:
        gaps = np.diff(times[index]) / step
        whole = np.rint(gaps)
        return np.where(np.abs(gaps - whole) <= EVEN * np.maximum(gaps, 1), np.maximum(whole, 1), gaps)

    return between
