"""Which of several models, and how well one does on data that it was not fitted to."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError, check_handed_on, explained_keywords, nearest, whole_number
from .data import Data
from .estimate import Estimate
from .problem import Problem
from .unseen import Score


@dataclasses.dataclass(frozen=True, repr=False)
class CrossValidation:
    """The result of `cross_validate`: for each fold, the names of the held-out experiments, the fit to the others, and
    a `Score` for each held-out experiment."""

    folds: tuple[tuple[str, ...], ...]
    fits: tuple[Estimate, ...]
    scores: dict[str, Score]

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square errors of the experiments left out, by name, over all folds."""
        names = dict.fromkeys(name for score in self.scores.values() for name in score.rms)
        each = {name: [score.rms[name] for score in self.scores.values() if name in score.rms] for name in names}
        return {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in each.items()}

    @property
    def log_likelihood(self) -> float:
        """ln L of the held-out experiments. A better model has a greater one."""
        return float(sum(score.log_likelihood for score in self.scores.values()))

    def __repr__(self):
        lines = [f"{label}: {score!r}" for label, score in self.scores.items()]
        errors = ", ".join(f"{name}: {value:.4g}" for name, value in self.rms.items())
        return "\n".join([f"CrossValidation({len(self.folds)} folds; rms of what was left out: {errors})", *lines])


def cross_validate(
    problem: Problem, folds: int | Sequence[Sequence[str]] | None = None, **options: Any
) -> CrossValidation:
    """Fits to all experiments but some, and predicts those. This is repeated until each experiment was held out once.

    **Arguments:**

    - `problem`: a problem with several experiments. `Experiment.window` makes several out of a long record.
    - `folds`: the number of folds, to which experiments are dealt in turn; or the names of the held-out experiments of
        each fold. Default: one experiment at a time.
    - `options`: as for `problem.fit`.

    **Raises:**

    - `ModelError` for fewer than two experiments, for folds that leave nothing to fit, and for unknown names.
    """
    check_handed_on("cross_validate", options, problem.fit, ("folds",), ("data",))
    # Those that are held out anyway are no part of it.
    labels = [k for k, one in zip(problem.data.labels, problem.data.experiments, strict=True) if not one.holdout]
    if len(labels) < 2:
        raise ModelError("cross_validate needs two experiments or more: cut a record into windows, Experiment.window")
    if folds is None or isinstance(folds, int | np.integer):
        count = len(labels) if folds is None else whole_number(folds, "folds", least=2)
        if count > len(labels):
            raise ModelError(f"folds: there are {len(labels)} experiments, too few for {count} folds")
        chosen = tuple(tuple(labels[k::count]) for k in range(count))
    else:
        chosen = tuple((one,) if isinstance(one, str) else tuple(one) for one in folds)
    for names in chosen:
        for name in names:
            if name not in labels:
                raise ModelError(f"folds: there is no experiment '{name}': " + nearest(name, labels))
        if not names or len(set(names)) == len(labels):
            raise ModelError(f"folds: {list(names)} leaves {'all' if not names else 'none'} of {labels} to be fitted")
    fits, scores = [], {}
    given: dict[str, Any] = {"warn": False} | options
    for names in chosen:
        fit = problem.fit(left_out(problem.data, names), **given)
        fits.append(fit)
        for name in names:
            scores[name] = fit.score(problem.data.experiments[problem.data.labels.index(name)])
    return CrossValidation(chosen, tuple(fits), scores)


def left_out(data: Data, names: Sequence[str]) -> Data:
    """The same experiments with some held out, under the same names."""
    pairs = zip(data.labels, data.experiments, strict=True)
    return Data(*(one.changed(holdout=one.holdout or n in names, name=n) for n, one in pairs))


@dataclasses.dataclass(frozen=True)
class Compared:
    """One of several fits: χ² and its degrees of freedom; the number of coordinates that the data determine,
    `effective`; Schwarz's criterion `bic` (less is better) and its distance from the best one; and ln L of held-out
    experiments (NaN if there are none)."""

    chi2: float
    freedom: float
    effective: float
    bic: float
    behind: float
    held_out: float


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison:
    """The outcome of `compare`: by name, the best first."""

    rows: dict[str, Compared]

    @property
    def best(self) -> str:
        """The name of the one with the least criterion."""
        return next(iter(self.rows))

    def __getitem__(self, name: str) -> Compared:
        return self.rows[name]

    def __repr__(self):
        cells: list[tuple[str, ...]] = [("", "χ²", "freedom", "numbers", "BIC", "behind", "ln L held out")]
        for name, r in self.rows.items():
            held_out = "—" if np.isnan(r.held_out) else f"{r.held_out:.5g}"
            numbers = (r.chi2, r.freedom, r.effective, r.bic, r.behind)
            cells.append((name, *(f"{v:.5g}" for v in numbers), held_out))
        widths = [max(len(line[k]) for line in cells) for k in range(len(cells[0]))]
        return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)


@explained_keywords()
def compare(fits: Mapping[str, Estimate]) -> Comparison:
    """Compares fits of several models to the same data, by Schwarz's criterion with the effective number of
    coordinates, and by held-out experiments. A difference above 6 is strong evidence, and a difference below 2 is
    hardly any (Kass & Raftery 1995, J. Am. Stat. Assoc. 90:773).

    **Raises:**

    - `ModelError` for fits to different data.
    """
    if not isinstance(fits, Mapping) or not fits:
        raise ModelError(f"compare takes fits by name, {{'linear': fit, 'learned': other}}; got {fits!r}")
    first, found = next(iter(fits)), {}
    for name, fit in fits.items():
        if not isinstance(fit, Estimate):
            raise ModelError(f"compare: '{name}' is a {type(fit).__name__}, not what Problem.fit returns")
        if _data_of(fit) != _data_of(fits[first]):
            raise ModelError(f"compare: '{name}' was fitted to other data than '{first}': fit all to the same")
        samples = fit.minimum.weights.samples
        effective = samples - fit.freedom + len(fit.sigma) + len(fit.rho)
        held = fit.objective.held_out(fit.minimum.z, fit.minimum.weights)[1]
        bic = float(effective * np.log(samples) - 2 * fit.log_likelihood)
        found[name] = Compared(fit.chi2, fit.freedom, effective, bic, 0.0, -held)
    best = min(one.bic for one in found.values())
    order = sorted(found, key=lambda name: found[name].bic)
    return Comparison({name: dataclasses.replace(found[name], behind=found[name].bic - best) for name in order})


def _data_of(fit: Estimate) -> bytes:
    """What must agree: names, times, values, and what is held out."""
    s = fit.objective.stacked
    order = np.argsort(s.outputs)
    parts = [s.times, s.values[..., order], s.observed[..., order], s.weight, s.holdout]
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts) + repr(sorted(s.outputs)).encode()
