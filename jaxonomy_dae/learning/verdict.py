"""Whether a fit can be relied on: what is against it, each with what to try next.

A reason is given only where chance would give it to a right model once in a hundred fits.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from ..diagnosis.wording import listed
from .agreement import slow
from .objective import AWAY

if TYPE_CHECKING:
    from .estimate import Estimate

# Probability below which noise is no excuse: with two such checks, right models are doubted in less than one of fifty
# fits, as each bounds what chance does from above.
IMPROBABLE = 1e-2
FAINT = 10.0  # times the integration's tolerance: residuals below are its error, which is never white
BELOW = 0.1  # of the noise that was stated: residuals below, of exact data, need not look like it


class FitWarning(UserWarning):
    """The warning of a fit that is not reliable. Its text gives the reasons."""


def reasons(fit: "Estimate") -> tuple[str, ...]:
    """What is against an estimate; nothing, if it is as it should be."""
    found = []
    if not fit.minimum.converged:
        found.append(f"{fit.message}: start elsewhere, with starts=5 or horizons=(0.1, 0.3, 1), or allow more steps=")
    for check in (_chi2, _colour, _table):
        found.extend(check(fit))
    return tuple(found)


def _chi2(fit: "Estimate") -> list[str]:
    """χ² of the samples whose noise level is known."""
    m, known = fit.minimum, fit.objective.evidence.noise < 0
    if not known.any() or fit.objective.has_variances:
        return []
    count = float(np.sum(m.weights.share[known] ** 2))
    chi2 = float(np.sum((m.weights.share * m.weights.scores(m.found.residual))[known] ** 2))
    freedom = max(count * fit.freedom / m.weights.samples, 1.0)
    if scipy.stats.chi2.sf(chi2, freedom) > IMPROBABLE:
        return []
    return [
        f"χ² is {chi2:.4g} where noise of the given sigma makes it {freedom:.4g} ± {np.sqrt(2 * freedom):.2g}: the "
        "model lacks something, the search ended in a local minimum (starts=5), or sigma is too small"
    ]


def _colour(fit: "Estimate") -> list[str]:
    """Outputs whose residuals are correlated from sample to sample, over all experiments together (Ljung and Box's
    statistics add up), or have a frequency that stands out; and what all outputs have in common: power at low
    frequencies. Half of the probability of a false alarm goes to what they have in common."""
    s, tests = fit.objective.stacked, {}
    for label, by in fit.whiteness.items():
        for name, test in by.items():
            if test.statistic >= 0 and not _is_faint(fit, label, name):
                tests.setdefault(name, []).append((label, test))
    found = []
    for name, each in tests.items():
        together = scipy.stats.chi2.sf(sum(t.statistic for _, t in each), sum(t.lags for _, t in each))
        alone = min(min(t.probability, t.peak) for _, t in each) * 2 * len(each)
        if 4 * min(float(together), alone) * len(tests) < IMPROBABLE:
            label, worst = min(each, key=lambda pair: min(pair[1].probability, pair[1].peak))
            where = f" of {label}" if len(s.labels) > 1 else ""
            found.append(f"'{name}'{where} ({worst.finding})")
    every = [test for each in tests.values() for _, test in each]
    if not found and 2 * slow(every) >= IMPROBABLE:
        return []
    if not found:
        strongest = max(tests, key=lambda name: sum(sum(test.spectrum[:4]) for _, test in tests[name]))
        found.append(
            f"those of '{strongest}' and others drift slowly" if len(tests) > 1 else f"'{strongest}' drifts slowly"
        )
    return [
        f"residuals are not white noise: {', '.join(found[:4])}. The model lacks something there, or noise is "
        "correlated: intervals are too narrow, and those of fit.table(white=False) wider. Look at fit.plot_residuals()"
    ]


def _is_faint(fit: "Estimate", label: str, name: str) -> bool:
    """True for residuals that are the integration's error, or as small as those of exact data."""
    s = fit.objective.stacked
    size = float(np.nanmax(np.abs(s.values[s.labels.index(label), :, s.outputs.index(name)]), initial=0.0))
    rms = float(np.sqrt(np.nanmean(fit.residuals[label][name] ** 2)))
    return fit.rms[label][name] < FAINT * fit.minimum.tolerance * size or rms < BELOW


def _table(fit: "Estimate") -> list[str]:
    """Numbers that reached a bound, or that the data do not determine."""
    rows, found = fit.table(), []
    ends = [row.name for row in rows if row.note.startswith("bound reached")]
    lost = [row.name for row in rows if row.note == "not determined"]
    away = [row.name for row in rows if row.note == "ran away"]
    if away:
        found.append(
            f"nothing in the data keeps {listed(away, 6)} from running away, to {AWAY:.0e} times its start: begin "
            "closer, freeze it, or give it a prior, priors=, or bounds="
        )
    if ends:
        found.append(f"a bound was reached by {listed(ends, 6)}: widen bounds=, or look whether it should be there")
    if lost:
        found.append(
            f"the data do not determine {listed(lost, 6)}: freeze it, give it a prior, or see fit.identifiability()"
        )
    return found
