"""Whether a fit can be relied on: what is against it, each with what to try next.

What a fit leaves over is judged by one test (`leftover.py`), which doubts a right model in two of a hundred fits.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtr

from ..compile.diagnosis.wording import listed
from .causes import described
from .held_out import missed
from .leftover import BELOW, LEAST, LEVEL, Leftover
from .objective import AWAY
from .resolution import EXACT, NOTICED

if TYPE_CHECKING:
    from .estimate import Estimate

SINGLE = 1e-2  # probability of a single test below which it is named, once all tests together doubt the model
FAINT = 10.0  # times the tolerance of an integration that cannot be finer: residuals below are its error


class FitWarning(UserWarning):
    """The warning of a fit that is not reliable. Its text gives the reasons."""


def reasons(fit: "Estimate") -> tuple[str, ...]:
    """What is against an estimate; nothing, if it is as it should be."""
    found = []
    if fit.message.startswith(("interrupted", "stopped by timeout")):
        found.append(f"{fit.message}: go on from its point, fit(start=fit.values)")
    elif not fit.minimum.converged:
        found.append(f"{fit.message}: start elsewhere, with starts=10 or horizons=(0.1, 0.3, 1), or allow more steps=")
    for check in (_resolution, _freedom, _leftover, _held_out, _table):
        found.extend(check(fit))
    return tuple(found)


def asks_for_starts(fit: "Estimate") -> bool:
    """True if the search ended short of a minimum, ran away or against a bound, or left over what is no noise. Outliers
    and noise levels that were stated too large are no reason to search elsewhere."""
    lost = any(row.note == "ran away" for row in fit.table())
    return lost or bool(_pushed(fit)) or not fit.minimum.converged or bool(_judged(fit)[1] & ({"χ²"} | COLOURS))


def _judged(fit: "Estimate") -> tuple[Leftover, set[str]]:
    """(what is left over, the tests that doubt it: where outliers are among them, those that do so without them)."""
    s = fit.objective.stacked
    pairs = [(label, name) for label, by in fit.residuals.items() for name in by if not _is_faint(fit, label, name)]
    left = Leftover.of(fit, [(s.labels.index(label), s.outputs.index(name)) for label, name in pairs])
    if left.probability > LEVEL:
        return left, set()
    named = {name for name, p in left.found.items() if p <= max(min(left.found.values()), SINGLE)}
    if "outliers" in named and left.outliers.any():
        # A fit follows outliers: how large the noise is shows once they are left out.
        named = {name for name in named & COLOURS if left.without_outliers[name] <= SINGLE} | {"outliers"}
    return left, named


def _leftover(fit: "Estimate") -> list[str]:
    """What is left over, if it is not noise: all tests that say so, at least the one that says it most clearly."""
    left, named = _judged(fit)
    said = []
    if "outliers" in named and left.outliers.any():
        said.append(_outliers(fit, left))
    if "small χ²" in named:
        said.extend(_overstated(fit, left))
    if "χ²" in named:
        chi2 = float(np.sum((left.share * left.scores)[left.known] ** 2))
        why = (
            f"the model lacks something{_elsewhere(fit)}"
            if named & COLOURS
            else f"sigma is stated {np.sqrt(chi2 / left.freedom):.2g} times too small, or what the model lacks looks "
            "like noise. Give what the sensor has, or sigma='estimate'"
        )
        said.append(
            f"χ² is {chi2:.4g} where noise of the given sigma makes it {left.freedom:.4g} ± "
            f"{np.sqrt(2 * left.freedom):.2g}: {why}"
        )
    if named & COLOURS:
        said.append(_coloured(fit, left))
    return said


def _elsewhere(fit: "Estimate") -> str:
    """What is to be said of local minima."""
    if fit.tried > 1:
        return f" ({fit.tried - 1} other starts ended no better)"
    return ", or the search ended in a local minimum: try fit(starts=5)"


def _coloured(fit: "Estimate", left: Leftover) -> str:
    """What residuals look like, and what that speaks for."""
    found, also = described(fit, left), _standing_out(fit, left)
    clauses = [found[0].clause, *(clause for clause in also if "correlate" not in found[0].clause)]
    rivals = "".join(f"; or, hardly less likely, {one.clause}: {one.speaks}" for one in found[1:])
    return (
        f"residuals are not white noise: {', '.join(clauses[:4])}. It may be that {found[0].speaks}{rivals}. Until "
        "then intervals are too narrow, those of fit.table(white=False) wider. Look at fit.plot_residuals()"
    )


def _outliers(fit: "Estimate", left: Leftover) -> str:
    """Single samples that lie far out: how many of each output, and the furthest."""
    s, (experiment, row, output) = fit.objective.stacked, fit.objective.rows
    far = np.flatnonzero(left.outliers)
    worst = far[np.argmax(np.abs(left.scores[far]))]
    names = [s.outputs[j] for j in dict.fromkeys(output[far].tolist())]
    k = experiment[worst]
    where = f"t = {s.times[k, row[worst]]:.4g}{f' of {s.labels[k]}' if len(s.labels) > 1 else ''}"
    return (
        f"{len(far)} of {sum(map(len, left.by_output.values()))} samples are outliers, of {listed(names, 4)}, the "
        f"furthest at {where}: estimates and noise levels follow them. Leave them out as NaN, or take them lightly, "
        f"sigma={{'{s.outputs[output[worst]]}': learning.Noise(student=4)}}"
    )


def _overstated(fit: "Estimate", left: Leftover) -> list[str]:
    """Outputs whose noise is less than was stated."""
    said, output = [], fit.objective.rows[2]
    for at, freedom in left.loose:
        chi2 = float(np.sum((left.share * left.scores)[at] ** 2))
        if chdtr(freedom, chi2) * len(left.loose) <= SINGLE:
            name = fit.objective.stacked.outputs[output[at[0]]]
            said.append(
                f"χ² of '{name}' is {chi2:.4g} where noise of the given sigma makes it {freedom:.4g} ± "
                f"{np.sqrt(2 * freedom):.2g}: sigma is stated {np.sqrt(freedom / chi2):.2g} times too large, and "
                f"intervals are as much too wide. Give what the sensor has, or sigma={{'{name}': 'estimate'}}"
            )
    return said


def _standing_out(fit: "Estimate", left: Leftover) -> list[str]:
    """The outputs whose neighbours correlate, or that have a frequency that stands out."""
    s, by_name = fit.objective.stacked, {}
    for one in left.series:
        name = s.outputs[one.output]
        test = fit.whiteness[s.labels[one.experiment]][name]
        by_name.setdefault(name, []).append((min(test.probability, test.peak), s.labels[one.experiment], test))
    worst = sorted((min(each, key=lambda row: row[0]), name) for name, each in by_name.items())
    clear = [row for row in worst if row[0][0] * len(left.series) < SINGLE] or worst[:1]
    return [
        f"'{name}'{f' of {label}' if len(s.labels) > 1 else ''} ({test.finding})" for (_, label, test), name in clear
    ]


COLOURS = {"neighbours", "all neighbours", "peak", "common peak", "slow", "signals"}  # tests of form


def _is_faint(fit: "Estimate", label: str, name: str) -> bool:
    """True for residuals that are the integration's error, or as small as those of exact data."""
    s = fit.objective.stacked
    size = float(np.nanmax(np.abs(s.values[s.labels.index(label), :, s.outputs.index(name)]), initial=0.0))
    rms = float(np.sqrt(np.nanmean(fit.residuals[label][name] ** 2)))
    least = EXACT if fit.minimum.resolution <= NOTICED else max(EXACT, FAINT * fit.minimum.tolerance)
    return fit.rms[label][name] < least * size or rms < BELOW


def _resolution(fit: "Estimate") -> list[str]:
    """The integration's error, if it counts beside the noise and could not be made less."""
    error = fit.minimum.resolution
    if not error > NOTICED or all(_is_faint(fit, label, name) for label, by in fit.residuals.items() for name in by):
        return []
    return [
        f"errors of the integration move estimates by up to {error:.2g} of their standard deviations, and runs at a "
        f"tolerance below {fit.minimum.tolerance:.0e} fail: allow more with max_steps=, or use method=Shooting() for "
        "runs that diverge"
    ]


def _freedom(fit: "Estimate") -> list[str]:
    """Noise levels and correlations to be estimated, of which too few samples are left to tell."""
    s, evidence, rows = fit.objective.stacked, fit.objective.evidence, fit.objective.rows
    share, taken = fit.minimum.weights.share, fit.taken
    found = []
    for k, name in enumerate(evidence.labels):
        own = evidence.noise == k
        colours = np.count_nonzero(np.isnan(s.rho[np.unique(rows[2][own])]))
        if np.sum(share[own] ** 2 - taken[own]) - colours < LEAST:
            found.append(
                f"of '{name}' there are too few samples ({np.count_nonzero(own)}) to tell, beside the model's numbers, "
                f"how large{' and how correlated' * bool(colours)} the noise is: give more of them, or "
                f"sigma={{'{name}': ...}}"
            )
    return found


def _held_out(fit: "Estimate") -> list[str]:
    """Experiments held out that are missed by more than noise and intervals explain."""
    found = missed(fit.objective, fit.point, fit.root, fit.sigma, fit.freedom)
    if not found:
        return []
    worst = max(found, key=lambda label: found[label][0] / found[label][1])
    rms, expected = found[worst]
    others = f", and {len(found) - 1} other experiments held out" if len(found) > 1 else ""
    return [
        f"'{worst}', which was held out, is missed by {rms:.3g} σ where noise and intervals make it {expected:.2g}"
        f"{others}: what was fitted does not carry over. Fit it, too, by holdout=False, and look which residuals stay"
    ]


def _pushed(fit: "Estimate") -> list[str]:
    """Numbers that the data push against a bound: a right model's rarely are, even where the truth lies on it."""
    pushed = {fit.objective.coordinates.names[k] for k, at in fit.at_bounds.items() if at.is_pushed}
    return [row.name for row in fit.table() if row.name in pushed]


def _table(fit: "Estimate") -> list[str]:
    """Numbers that the data push against a bound, or do not determine."""
    rows, found = fit.table(), []
    ends = _pushed(fit)
    lost = [row.name for row in rows if row.note == "not determined"]
    away = [row.name for row in rows if row.note == "ran away"]
    if away:
        found.append(
            f"nothing in the data keeps {listed(away, 6)} from running away, further than {AWAY:.0e} times its start: "
            "begin closer, freeze it, or give it a prior, priors=, or bounds="
        )
    if ends:
        found.append(f"a bound was reached by {listed(ends, 6)}: widen bounds=, or look whether it should be there")
    if lost:
        found.append(
            f"the data do not determine {listed(lost, 6)}: freeze it, give it a prior, or see fit.identifiability()"
        )
    return found
