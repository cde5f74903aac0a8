"""Experiments of different lengths, inputs and sampling, as arrays of one shape."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline

from ..base.errors import ModelError, explained_keywords, nearest
from ..compile.lowering.plan import SystemPlan
from ..run.system.inputs import KINDS
from .axes import LEGEND, AxesGiven, chosen_names, grid_of_axes
from .experiment import Experiment, Unknown, check_increasing
from .noise import Noise
from .priors import is_finite, unwrapped

Entry = TypeVar("Entry")


class Data:
    """Experiments that are fitted together.

    They may differ in length, sampling and measured variables. All of them must name the same inputs and starts.
    """

    @explained_keywords({"experiments": "Data(first, second)"})
    def __init__(self, *experiments: Experiment):
        for k, one in enumerate(experiments):
            if not isinstance(one, Experiment):
                raise ModelError(f"Data takes Experiments; its argument {k} is a {type(one).__name__}")
        if not experiments:
            raise ModelError("Data needs at least one Experiment")
        if all(one.holdout for one in experiments):
            raise ModelError("every experiment is held out: there is nothing to fit")
        self.experiments = experiments
        self.labels = [one.name or f"experiment {k}" for k, one in enumerate(experiments)]
        doubled = [label for k, label in enumerate(self.labels) if label in self.labels[:k]]
        if doubled:
            raise ModelError(f"two experiments are named '{doubled[0]}'")

    def __len__(self) -> int:
        return len(self.experiments)

    def __repr__(self):
        counts = (f"{label}: {len(e.times)} times" for label, e in zip(self.labels, self.experiments, strict=True))
        return f"Data({', '.join(counts)})"

    def plot(self, names: str | Sequence[str] | None = None, *, axes: AxesGiven = None) -> np.ndarray:
        """Draws the records over time, one row of axes for each name; returns Matplotlib axes."""
        known = list(dict.fromkeys(name for one in self.experiments for name in one.data))
        chosen = chosen_names(names, known, "data of")
        axes = grid_of_axes(axes, len(chosen), 1, "a plot of data")
        for ax, name in zip(axes[:, 0], chosen, strict=True):
            for k, (label, one) in enumerate(zip(self.labels, self.experiments, strict=True)):
                if name not in one.data:
                    continue
                values = one.data[name].reshape(len(one.times), -1)
                style = dict(marker=".", linestyle="none", color=f"C{k % 10}", alpha=0.5 if one.holdout else 1.0)
                lines = ax.plot(one.times, values, **style)
                lines[0].set_label(label + " (held out)" * one.holdout)
            ax.set_ylabel(name)
            ax.grid(True, alpha=0.3)
        axes[-1, 0].set_xlabel("Time / s")
        if len(self) <= LEGEND:
            axes[0, 0].legend()
        return axes[:, 0]


@dataclasses.dataclass(frozen=True)
class Stacked:
    """Data for one program: e experiments, padded to n times, of k outputs.

    Padded times repeat the last, so nothing is integrated beyond it.
    """

    outputs: tuple[str, ...]
    times: Float[np.ndarray, "e n"]
    t0: Float[np.ndarray, " e"]
    values: Float[np.ndarray, "e n k"]
    observed: Bool[np.ndarray, "e n k"]
    sigma: Float[np.ndarray, "e n k"]  # NaN: to be estimated
    unit: Float[np.ndarray, "e n k"]  # by which a level that is estimated is multiplied
    level_of: tuple[str, ...]  # the name of each output's level: its own, or one that outputs share
    tails: Float[np.ndarray, "k 2"]  # of each output's noise: degrees of freedom, and knee
    rho: Float[np.ndarray, " k"]  # the correlation of neighbouring errors; 0: white, NaN: to be estimated
    weight: Float[np.ndarray, " e"]
    holdout: Bool[np.ndarray, " e"]
    inputs: dict[str, tuple[Float[np.ndarray, "e m"], Float[np.ndarray, "e m"]]]
    kinds: tuple[tuple[str, str], ...]  # of inputs
    starts: dict[str, tuple[float | Unknown, ...]]  # a number or an Unknown for each experiment
    labels: tuple[str, ...]
    counts: tuple[int, ...]  # of times

    @property
    def estimated(self) -> Bool[np.ndarray, "e k"]:
        """True where a noise level is to be estimated."""
        return np.isnan(self.sigma[:, 0])

    @property
    def levels(self) -> Float[np.ndarray, "e k"]:
        """Noise levels that are the same for all samples of a name in an experiment; NaN: to be estimated.

        **Raises:**

        - `ModelError` where they differ.
        """
        differs = np.argwhere((np.ptp(self.sigma, axis=1) > 0) | (np.ptp(self.unit, axis=1) > 0))
        if len(differs):
            k, j = differs[0]
            raise ModelError(
                f"{self.labels[k]}: '{self.outputs[j]}' has a noise level for each sample, which filters do not take: "
                "give one for all, or use method='single'"
            )
        return self.sigma[:, 0]

    def check_plain(self, what: str) -> None:
        """Refuses noise that is not normal, or has a level that outputs share, with a `ModelError`; `what` does not
        take it."""
        self.check_white(what)
        bent = np.flatnonzero(np.isfinite(self.tails).any(axis=1))
        shared = [name for name, level in zip(self.outputs, self.level_of, strict=True) if level != name]
        if len(bent) or shared:
            name = self.outputs[bent[0]] if len(bent) else shared[0]
            kind = "has tails" if len(bent) else "shares its level"
            raise ModelError(
                f"the noise of '{name}' {kind}, which {what} does not take: use method='single', or leave it out"
            )

    def check_white(self, what: str) -> None:
        """Refuses noise that is correlated, with a `ModelError`; `what` does not take it."""
        coloured = np.flatnonzero(self.rho != 0)
        if len(coloured):
            raise ModelError(
                f"the noise of '{self.outputs[coloured[0]]}' is correlated, rho, which {what} does not take: use "
                "fit() with method='single', or leave it out"
            )

    def input_at(self, name: str, experiment: int, at: np.ndarray) -> np.ndarray:
        """An input of an experiment at some times: samples that are held, or curves as if they were straight between
        them."""
        times, values = (part[experiment] for part in self.inputs[name])
        if dict(self.kinds)[name] != "held":
            return np.interp(at, times, values)
        return values[np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)]

    def until(self, share: float) -> "Stacked":
        """A copy of the same shapes in which only this share of each experiment's time counts."""
        if share >= 1:
            return self
        ends = self.t0 + share * (self.times[:, -1] - self.t0)
        inside = self.times <= ends[:, None]
        times = np.minimum(self.times, ends[:, None])
        return dataclasses.replace(self, times=times, observed=self.observed & inside[:, :, None])


def stack(
    data: Data, plan: SystemPlan, derived: tuple[str, ...], starts: Mapping[str, object], like: Stacked | None = None
) -> Stacked:
    """The data of a system whose `derived` outputs are computed from its variables; `starts` are for experiments that
    do not name them. Names come in the order in which other data, `like`, have them, and constants of inputs are of the
    kind that they have there."""
    experiments = data.experiments
    outputs: dict[str, None] = {}
    columns: list[dict[str, np.ndarray]] = []
    sigmas: list[dict[str, np.ndarray]] = []
    noises: dict[str, Noise] = {}
    for label, one in zip(data.labels, experiments, strict=True):
        column, sigma, noise = _columns(one, plan, derived, label)
        columns.append(column)
        sigmas.append(sigma)
        outputs |= dict.fromkeys(column)
        for name, own in noise.items():
            first = noises.setdefault(name, own)
            if (own.shared, own.tails, own.rho) != (first.shared, first.tails, first.rho):
                raise ModelError(
                    f"{label}: the noise of '{name}' has another distribution, correlation or shared level than before"
                )
    outputs = _ordered(outputs, () if like is None else like.outputs)
    _check_shared(outputs, noises)
    n = max(len(one.times) for one in experiments)
    shape = (len(experiments), n, len(outputs))
    values, levels, unit = np.full(shape, math.nan), np.full(shape, math.nan), np.ones(shape)
    for k, (one, column) in enumerate(zip(experiments, columns, strict=True)):
        for j, name in enumerate(outputs):
            if name in column:
                values[k, : len(one.times), j] = column[name]
                level, own = sigmas[k][name].T
                for all_of, column_of in ((levels, level), (unit, own)):
                    all_of[k, :, j] = column_of[-1]
                    all_of[k, : len(one.times), j] = column_of
    observed = np.isfinite(values)
    training = ~np.array([one.holdout for one in experiments])
    if not observed[training].any():
        raise ModelError("all samples are missing: the data are NaN throughout")
    times = np.stack([_padded(one.times, n) for one in experiments])
    inputs, kinds = _inputs(data, plan, {} if like is None else dict(like.kinds))
    return Stacked(
        outputs=tuple(outputs),
        times=times,
        t0=np.array([one.t0 for one in experiments], float),
        # What is missing is zero and has the weight zero: not-a-number times zero would not vanish.
        values=np.where(observed, values, 0.0),
        observed=observed,
        sigma=levels,
        unit=unit,
        level_of=tuple(noises[name].shared or name for name in outputs),
        tails=np.array([noises[name].tails for name in outputs]),
        rho=np.array([noises[name].correlation for name in outputs]),
        weight=np.array([one.weight for one in experiments], float),
        holdout=~training,
        inputs=inputs,
        kinds=kinds,
        starts=_ordered(_starts(data, starts), () if like is None else like.starts),
        labels=tuple(data.labels),
        counts=tuple(len(one.times) for one in experiments),
    )


def _check_shared(outputs: Iterable[str], noises: Mapping[str, Noise]) -> None:
    """Refuses a shared level that has the name of an output with another one: the two would be one."""
    for name in outputs:
        shared = noises[name].shared
        if shared in noises and noises[shared].shared != shared:
            raise ModelError(
                f"the noise of '{name}' shares the level '{shared}', which is the name of an output that does not: "
                "give it another name, or that output the same Noise(shared=…)"
            )


def _ordered(found: Mapping[str, Entry], first: Iterable[str]) -> dict[str, Entry]:
    """The same entries, those of the `first` names before all others."""
    return {name: found[name] for name in dict.fromkeys([*first, *found]) if name in found}


def _padded(array: np.ndarray, n: int) -> np.ndarray:
    return np.concatenate([array, np.full(n - len(array), array[-1])])


def _columns(
    one: Experiment, plan: SystemPlan, derived: tuple[str, ...], label: str
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Noise]]:
    """The samples of an experiment, their noise levels with what these are multiplied by, shape (n, 2), and their
    noise; those of arrays by their entries."""
    column: dict[str, np.ndarray] = {}
    sigma: dict[str, np.ndarray] = {}
    noises: dict[str, Noise] = {}
    for name, values in one.data.items():
        entries = None if name in derived else plan.entries(name)
        if entries is None:
            if name not in derived and name not in plan.variable_index:
                known = [*derived, *plan.visible_variables]
                raise ModelError(f"{label}: data of '{name}', which is not a variable: " + nearest(name, known))
            if values.ndim != 1:
                raise ModelError(f"{label}: data of '{name}' must have shape (n,); got {values.shape}")
            names, shape = [name], ()
        else:
            names, shape = entries
        if values.shape[1:] != shape:
            wanted = ", ".join(["n", *map(str, shape)])
            raise ModelError(f"{label}: data of '{name}' must have shape ({wanted}); got {values.shape}")
        flat = values.reshape(len(values), -1)
        noise, level = one.noise(name), one.levels[name]
        unit = 1.0 if noise.scale is None or not np.isnan(level).all() else noise.scale
        pair = [np.broadcast_to(a, values.shape).reshape(flat.shape) for a in (level, unit)]
        for j, entry in enumerate(names):
            if entry in column:
                raise ModelError(f"{label}: data of '{entry}' are given twice, by its own name and as part of an array")
            column[entry], sigma[entry] = flat[:, j], np.stack([a[:, j] for a in pair], axis=1)
            noises[entry] = noise
    return column, sigma, noises


def _inputs(
    data: Data, plan: SystemPlan, like: Mapping[str, str]
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], tuple[tuple[str, str], ...]]:
    """Samples of every input, padded beyond their ends to the same number, and how each is interpolated; `like` are the
    kinds of other data."""
    names = _ordered(dict.fromkeys(name for one in data.experiments for name in one.inputs), like)
    found, kinds = {}, []
    for name in names:
        if name not in plan.inputs.place:
            raise ModelError(f"'{name}' is not an input of this system: " + nearest(name, plan.inputs.names))
        default = plan.inputs.defaults[plan.inputs.place[name]]
        given: list[tuple[np.ndarray, np.ndarray]] = []
        kind, owner = None, ""
        for label, one in zip(data.labels, data.experiments, strict=True):
            if name not in one.inputs and default is None:
                raise ModelError(f"{label} does not give input '{name}', as others do: give it there too")
            source = one.inputs.get(name, default)
            times, values, own = _samples(name, source, one, label)
            if own is not None and kind is not None and own != kind:
                raise ModelError(
                    f"input '{name}' is '{kind}' in {owner} and '{own}' in {label}: one program reads one kind. Give "
                    "the same in all"
                )
            if own is not None:
                kind, owner = own, label
            given.append((times, values))
        m = max(len(times) for times, _ in given)
        padded = [_beyond(times, m) for times, _ in given]
        kind = kind or like.get(name, "held")
        found[name] = (
            np.stack(padded),
            np.stack([_continued(*one, at, kind) for one, at in zip(given, padded, strict=True)]),
        )
        kinds.append((name, kind))
    return found, tuple(kinds)


def _samples(name: str, source: object, one: Experiment, label: str) -> tuple[np.ndarray, np.ndarray, str | None]:
    """(times, values, kind) of an input; a constant is of any kind."""
    end = float(one.times[-1])
    source = unwrapped(source)
    if isinstance(source, int | float | np.number):
        if not np.isfinite(source):
            raise ModelError(f"{label}: input '{name}' must be finite; got {source}")
        # Two times that differ, even for a record of a single sample at its start.
        return np.array([one.t0, max(end, one.t0 + 1.0)]), np.full(2, float(source)), None
    if not isinstance(source, tuple | list) or len(source) not in (2, 3):
        raise ModelError(
            f"{label}: input '{name}' is a number or samples, (times, values) or (times, values, 'held'); got "
            f"{type(source).__name__}"
        )
    kind = source[2] if len(source) == 3 else "linear"
    if kind not in KINDS:
        raise ModelError(f"{label}: input '{name}': samples are 'linear', 'spline', 'cubic' or 'held'; got {kind!r}")
    times, values = np.asarray(source[0], float), np.asarray(source[1], float)
    if times.ndim != 1 or times.shape != values.shape or len(times) < 2:
        raise ModelError(
            f"{label}: input '{name}' needs a value for each of at least two times; got shapes {times.shape} and "
            f"{values.shape}"
        )
    for what, array in (("times", times), ("values", values)):
        bad = np.flatnonzero(~np.isfinite(array))
        if len(bad):
            raise ModelError(f"{label}: input '{name}': {what}[{bad[0]}] is {array[bad[0]]}; leave the sample out")
    check_increasing(times, f"{label}: input '{name}': ")
    slack = 1e-6 * (end - one.t0)
    if times[0] > one.t0 + slack or (times[-1] < end - slack and kind != "held"):
        raise ModelError(
            f"{label}: the samples of input '{name}' reach from {times[0]:g} to {times[-1]:g}, the experiment from "
            f"{one.t0:g} to {end:g}: give samples for all of it"
        )
    return times, values, kind


def _beyond(times: np.ndarray, m: int) -> np.ndarray:
    """Times continued to m of them, in steps like the last."""
    # Interpolations need times that increase, so the last one cannot be repeated.
    step = times[-1] - times[-2]
    return np.concatenate([times, times[-1] + step * np.arange(1, m - len(times) + 1)])


def _continued(times: np.ndarray, values: np.ndarray, longer: np.ndarray, kind: str) -> np.ndarray:
    """Values continued to longer times: by the last one; of a spline along its last slope, so that it stays what it
    is."""
    if kind != "spline" or len(times) == len(longer):
        return _padded(values, len(longer))
    slope = CubicSpline(times, values, bc_type="natural")(times[-1], 1)
    return np.concatenate([values, values[-1] + slope * (longer[len(times) :] - times[-1])])


def _starts(data: Data, given: Mapping[str, Any]) -> dict[str, tuple[float | Unknown, ...]]:
    """The start of each name in each experiment."""
    names = dict.fromkeys([*given, *(name for one in data.experiments for name in one.initial)])
    out = {}
    for name in names:
        values = []
        for label, one in zip(data.labels, data.experiments, strict=True):
            value = one.initial.get(name, given.get(name))
            if value is None:
                raise ModelError(f"{label} does not say how '{name}' starts, as others do: add it to its initial=")
            if not isinstance(value, Unknown):
                value = unwrapped(value)
                if not is_finite(value):
                    raise ModelError(f"{label}: '{name}' starts at a finite number or Unknown(guess); got {value!r}")
                value = float(value)
            values.append(value)
        shared = {v.shared for v in values if isinstance(v, Unknown)}
        if len(shared) == 2 or (True in shared and not all(isinstance(v, Unknown) for v in values)):
            raise ModelError(f"the start of '{name}' is shared in some experiments only: share it in all or in none")
        other = [k for k, v in enumerate(values) if True in shared and v != values[0]]
        if other:
            raise ModelError(
                f"the start of '{name}' is one number, shared by all experiments, but {data.labels[0]} says "
                f"{values[0]} and {data.labels[other[0]]} says {values[other[0]]}: give the same guess and spread"
            )
        out[name] = tuple(values)
    return out
