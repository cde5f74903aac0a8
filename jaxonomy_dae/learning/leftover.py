"""Whether what a fit leaves over is noise: one test of one level, made of several that each look for another error.

- χ² of the samples whose noise level is known: a model that misses more than the noise; of an output, that it misses
  less.
- The greatest residual, and the kurtosis (`outliers`): samples that are wrong.
- Correlations of neighbours, by the statistic of Ljung and Box (1978): noise that is correlated.
- The highest peak of the periodogram (Fisher 1929), of one output and of all: a mode that the model lacks.
- Power at the lowest 1, 2, 4, … frequencies (a smooth test; Neyman 1937): errors as slow as what the model describes.
- Correlations with inputs, and with predictions, their rates, squares and drifts: wrong inputs, gains and delays.

A fit takes from the noise what looks like a change of its numbers. With J the derivatives of predictions in units of
the noise and C the covariance of the numbers, residuals of a right model have the covariance I − J C Jᵀ, where C
contains the priors. Residuals drawn with this covariance say how often chance gives a least probability as small as the
one that was found: a Monte Carlo test (Barnard 1963, J. R. Stat. Soc. B 25:294; Dufour 2006, J. Econometrics 133:443).
So degrees of freedom that the fit has used up count, and tests that depend on each other are not counted twice.
"""

import dataclasses
import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtr, chdtrc

from ..host.threads import one_thread
from .form import neighbours, of_several, peak, periodogram, slow
from .outliers import heavy_tails, outliers

if TYPE_CHECKING:
    from .estimate import Estimate

# The share of right models that is doubted: fewer than one in twenty, whatever other reasons add.
LEVEL = 0.02
# So many sets of residuals are drawn that the level is a whole number of them. All fits of a model have the same draws:
# with 499 of them, the level of one oscillator was 3.1 %.
DRAWS = 1999
SURE = 499  # draws after which a third of the level counts as below it: the level itself looks so once in 300 times
BATCH = 50  # draws at once: most right models are known by the first
ROOM = 2e7  # numbers at once: 160 MB
# Residuals below this part of the noise that was stated, as those of exact data, need not look like noise.
BELOW = 0.1
LEAST = 0.5  # of a degree of freedom: what is less is rounding, or a trace of priors
FEWEST = 4  # samples of a series, below which there is nothing to correlate
ALIKE = 1e-3  # of the greatest singular value: signals that differ by less are one


class Series(NamedTuple):
    """The samples of one output in one experiment, as positions among all."""

    experiment: int
    output: int
    at: Int[np.ndarray, " n"]


class Signals(NamedTuple):
    """What residuals of one output may correlate with, over all experiments: `each` by name, of length one, and with
    them some by which residuals are only described; the `basis` of what is tested; and how many of these a fit does not
    take up."""

    at: Int[np.ndarray, " n"]
    basis: Float[np.ndarray, "n k"]
    count: float
    names: tuple[str, ...]
    each: Float[np.ndarray, "n s"]


@dataclasses.dataclass(frozen=True)
class Leftover:
    """Residuals in units of the noise, and what is needed to judge them.

    - `share`: the root of each residual's weight.
    - `leverage`: L, of which L Lᵀ is what the fit takes from the noise, weights included.
    - `known`: True for samples whose noise level is known; `freedom`: of their χ².
    - `loose`: of each output whose residuals may be too small, samples whose level is known, and degrees of freedom.
    """

    scores: Float[np.ndarray, " m"]
    share: Float[np.ndarray, " m"]
    leverage: Float[np.ndarray, "m r"]
    series: tuple[Series, ...]
    signals: tuple[Signals, ...]
    known: np.ndarray
    freedom: float
    loose: tuple[tuple[Int[np.ndarray, " _"], float], ...] = ()

    @classmethod
    def of(cls, fit: "Estimate", counts: Iterable[tuple[int, int]]) -> "Leftover":
        """What a fit leaves over. `counts`: (experiment, output) of the series whose form is judged."""
        m, o = fit.minimum, fit.objective
        experiment, _, output = o.rows
        share = m.weights.share
        leverage = m.weights.informing[:, None] * m.found.jacobian @ fit.root[o.free]
        # Samples that are all used up by numbers of the model leave rounding, of which nothing is to be said.
        has_left = fit.freedom > LEAST
        known = (o.evidence.noise < 0) & (has_left and not o.has_variances)
        count = float(np.sum(share[known] ** 2))
        chosen = [Series(k, j, np.flatnonzero((experiment == k) & (output == j))) for k, j in counts if has_left]
        series = tuple(one for one in chosen if len(one.at) >= FEWEST)
        found = []
        for j in dict.fromkeys(one.output for one in series):
            own = [one for one in series if one.output == j]
            at = np.concatenate([one.at for one in own])
            found.append(signals(at, _parts(fit, own), leverage / share[:, None], o.has_variances))
        scores, loose = m.weights.scores(m.found.residual), []
        for j in np.unique(o.rows[2][known]):
            at = np.flatnonzero(known & (o.rows[2] == j))
            if np.mean(scores[at] ** 2) > BELOW**2:
                loose.append((at, max(float(np.sum(share[at] ** 2) - np.sum(leverage[at] ** 2)), 1.0)))
        return cls(
            scores, share, leverage, series, tuple(found), known, loose=tuple(loose),
            freedom=max(count * fit.freedom / m.weights.samples, 1.0),
        )  # fmt: skip

    def drawn(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "s m"]:
        """Residuals as a right model would leave them."""
        left, sizes = self._factors
        noise, own = rng.standard_normal((count, len(self.share))), rng.standard_normal((count, len(sizes)))
        # `own` is the noise of the priors. With it, the covariance of what is left is exactly I − L Lᵀ. Without priors
        # the sizes are one, and nothing is added.
        taken = sizes * ((self.share * noise) @ left) + np.sqrt(1 - sizes**2) * own
        return noise - (taken * sizes) @ left.T / self.share

    @functools.cached_property
    def _factors(self) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, " k"]]:
        with one_thread(len(self.leverage) * self.leverage.shape[1] ** 2):
            left, sizes, _ = np.linalg.svd(self.leverage, full_matrices=False)
        return left, np.minimum(sizes, 1.0)

    @functools.cached_property
    def found(self) -> dict[str, float]:
        """The probability of each test by itself, approximately."""
        return {name: float(p[0]) for name, p in self.tested(self.scores[None]).items()}

    @functools.cached_property
    def probability(self) -> float:
        """The probability that a right model leaves something as improbable. Draws end where it exceeds the level."""
        if not self.found:
            return 1.0
        least, rng, below, drawn = min(self.found.values()), np.random.default_rng(0), 0, 0
        batch = int(np.clip(ROOM / len(self.share), 1, BATCH))
        while drawn < DRAWS and below + 1 <= LEVEL * (DRAWS + 1):
            count = min(batch, DRAWS - drawn)
            each = self.tested(self.drawn(count, rng)).values()
            below, drawn = below + int(np.sum(np.min(list(each), axis=0) <= least)), drawn + count
            if drawn >= SURE and below + 1 < LEVEL / 3 * (drawn + 1):
                break
        return (below + 1) / (drawn + 1)

    def tested(self, residuals: Float[np.ndarray, "s m"]) -> dict[str, Float[np.ndarray, " s"]]:
        """The approximate probability of each test, for several sets of residuals."""
        found: dict[str, np.ndarray] = {}
        if self.known.any():
            chi2 = np.sum((self.share * residuals)[:, self.known] ** 2, axis=1)
            found["χ²"] = chdtrc(self.freedom, chi2)
        if self.loose:
            sums = [np.sum((self.share * residuals)[:, at] ** 2, axis=1) for at, _ in self.loose]
            found["small χ²"] = of_several(
                [chdtr(free, chi2) for (_, free), chi2 in zip(self.loose, sums, strict=True)]
            )
        if not self.series:
            return found
        scaled, spectra, correlations = np.array(residuals), [], []
        for one in self.series:
            own = residuals[:, one.at]
            size = np.sqrt(np.mean(own**2, axis=1, keepdims=True))
            own = scaled[:, one.at] = own / np.where(size > 0, size, 1.0)
            spectra.append(periodogram(own))
            correlations.append(neighbours(own))
        found["outliers"] = of_several([heavy_tails(scaled[:, at]) for at in self.by_output.values()])
        found["neighbours"] = of_several([chdtrc(lags, statistic) for statistic, lags in correlations])
        if len(correlations) > 1:
            statistics, lags = zip(*correlations, strict=True)
            found["all neighbours"] = chdtrc(sum(lags), sum(statistics))
        found["peak"] = of_several([peak([one]) for one in spectra])
        together = self._together
        if len(together) < len(spectra):
            found["common peak"] = of_several([peak([spectra[k] for k in group]) for group in together])
        found["slow"] = slow(spectra, self._left)
        squares = [np.sum((scaled[:, one.at] @ one.basis) ** 2, axis=1) for one in self.signals]
        found["signals"] = chdtrc(sum(one.count for one in self.signals), np.sum(squares, axis=0))
        return found

    @functools.cached_property
    def by_output(self) -> dict[int, Int[np.ndarray, " _"]]:
        """The samples of each output whose form is judged."""
        outputs = dict.fromkeys(one.output for one in self.series)
        return {j: np.concatenate([one.at for one in self.series if one.output == j]) for j in outputs}

    @functools.cached_property
    def outliers(self) -> Bool[np.ndarray, " m"]:
        """True for single samples that lie far out, of the series whose form is judged."""
        found = np.zeros(len(self.scores), bool)
        for one in self.series:
            found[one.at] = outliers(self.scores[one.at])
        return found

    @functools.cached_property
    def cleaned(self) -> Float[np.ndarray, " m"]:
        """What a fit to all samples but outliers would leave over, to first order; zero at outliers."""
        far = self.outliers
        if not far.any():
            return self.scores
        # With numbers in units of A, of which A Aᵀ is the covariance, samples and priors together tell one of each.
        pulling = self.leverage[far]
        rest = np.eye(pulling.shape[1]) - pulling.T @ pulling
        moves = np.linalg.lstsq(rest, pulling.T @ (self.share * self.scores)[far], rcond=None)[0]
        return np.where(far, 0.0, self.scores + self.leverage @ moves / self.share)

    @functools.cached_property
    def without_outliers(self) -> dict[str, float]:
        """The probability of each test if single samples that lie far out had not been fitted."""
        return {name: float(p[0]) for name, p in self.tested(self.cleaned[None]).items()}

    @functools.cached_property
    def _left(self) -> list[Float[np.ndarray, " _"]]:
        """The part of the power of noise that a fit leaves, at each frequency."""
        own = self.leverage / self.share[:, None]
        return [np.maximum(1 - periodogram(own[one.at].T).sum(axis=0), 0.0) for one in self.series]

    @functools.cached_property
    def _together(self) -> list[list[int]]:
        """The series that have their frequencies in common: of as many samples. A mode shows in all of them."""
        sizes = [len(one.at) for one in self.series]
        return [[k for k, n in enumerate(sizes) if n == size] for size in dict.fromkeys(sizes)]


def signals(
    at: Int[np.ndarray, " n"],
    parts: list[tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]],
    leverage: Float[np.ndarray, "m r"],
    is_filter: bool = False,
) -> Signals:
    """The signals of one output: constants and drifts; its predictions, their rates, squares and cubes, and what these
    become if they drift; and inputs. A gain that is wrong shows as the prediction, a delay as its rate.

    - `parts`: (predictions, times, inputs by name) of each experiment.
    - `is_filter`: whether each prediction is made from the samples before it. The next one then contains the present
        error, so rates are those of the past.
    """
    rows = []
    for y, t, inputs in parts:
        tau = 2 * (t - t.mean()) / (np.ptp(t) or 1.0)
        rate = np.diff(y, prepend=y[:1]) / np.diff(t, prepend=2 * t[0] - t[1]) if is_filter else np.gradient(y, t)
        rows.append(np.stack([y, rate, tau, *inputs.values()]))
    (y, rate, tau, *others) = (row - row.mean() for row in np.concatenate(rows, axis=1))
    found = {
        "a constant": np.ones_like(y), "the prediction": y, "the rate of change of the prediction": rate,
        **{f"the input '{name}'": u for name, u in zip(parts[0][2], others, strict=True)},
        "time": tau, "a drift of its gain": y * tau, "a drift in time": rate * tau,
        "the square of the prediction": y * y, "the cube of the prediction": y**3,
        "the square of its rate": rate * rate, "the prediction times its rate": y * rate,
        "the square of time": tau * tau,
    }  # fmt: skip
    tested = len(found)
    found |= {
        "the direction of its rate": np.sign(rate), "the sign of the prediction": np.sign(y),
        "the rate times its size": rate * np.abs(rate),
    }  # fmt: skip
    columns = np.stack(list(found.values()), axis=1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    basis, values, _ = np.linalg.svd(columns[:, :tested], full_matrices=False)
    basis = basis[:, values > ALIKE * values[0]]
    count = max(basis.shape[1] - float(np.sum((leverage[at].T @ basis) ** 2)), 1.0)
    return Signals(at, basis, count, tuple(found), columns)


def _parts(fit: "Estimate", series: list[Series]) -> list[tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]]:
    """(predictions, times, inputs) of some series."""
    s, rows, parts = fit.objective.stacked, fit.objective.rows[1], []
    errors = fit.objective.colour.coloured(fit.minimum.found.residual)
    for one in series:
        k, i = one.experiment, rows[one.at]
        t = s.times[k, i]
        inputs = {name: s.input_at(name, k, t - fit.values.get(f"delay of {name}", 0.0)) for name in s.inputs}
        parts.append((errors[one.at] + s.values[k, i, one.output], t, inputs))
    return parts
