"""Whether a fit can be relied on: what is against it, each with what to try next.

A reason is given only where chance would give it to a right model once in some thousand fits.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from ..diagnosis.wording import listed

if TYPE_CHECKING:
    from .estimate import Estimate

IMPROBABLE = 1e-4  # probability below which noise is no excuse
FAINT = 10.0  # times the integration's tolerance: residuals below are its error, which is never white
BELOW = 0.1  # of the noise that was stated: residuals below, of exact data, need not look like it


class FitWarning(UserWarning):
    """A fit says why it cannot be relied on."""


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
    chi2 = float(np.sum((m.weights.row * m.found.residual)[known] ** 2))
    freedom = max(count * fit.freedom / m.weights.samples, 1.0)
    if scipy.stats.chi2.sf(chi2, freedom) > IMPROBABLE:
        return []
    return [
        f"χ² is {chi2:.4g} where noise of the given sigma makes it {freedom:.4g} ± {np.sqrt(2 * freedom):.2g}: the "
        "model lacks something, the search ended in a local minimum (starts=5), or sigma is too small"
    ]


def _colour(fit: "Estimate") -> list[str]:
    """Residuals that are correlated from sample to sample."""
    s, names = fit.objective.stacked, []
    tests = [(label, n, w) for label, by in fit.whiteness.items() for n, w in by.items() if w.probability >= 0]
    for label, n, w in tests:
        k, j = s.labels.index(label), s.outputs.index(n)
        size = float(np.max(np.abs(s.values[k, :, j]), initial=0.0))
        rms = float(np.sqrt(np.mean(fit.residuals[label][n] ** 2)))
        faint = fit.rms[label][n] < FAINT * fit.minimum.tolerance * size or rms < BELOW
        if w.probability * len(tests) < IMPROBABLE and not faint:
            names.append(f"'{n}' of {label} (neighbours correlate by {w.correlation:.2f})")
    if not names:
        return []
    return [
        f"residuals are not white noise: {', '.join(names[:4])}. The model lacks something there, or noise is "
        "correlated: intervals are too narrow. Look at fit.plot_residuals()"
    ]


def _table(fit: "Estimate") -> list[str]:
    """Numbers that reached a bound, or that the data do not determine."""
    rows, found = fit.table(), []
    ends = [row.name for row in rows if row.note.startswith("bound reached")]
    lost = [row.name for row in rows if row.note == "not determined"]
    if ends:
        found.append(f"a bound was reached by {listed(ends, 6)}: widen bounds=, or look whether it should be there")
    if lost:
        found.append(
            f"the data do not determine {listed(lost, 6)}: freeze it, give it a spread, or see fit.identifiability()"
        )
    return found
