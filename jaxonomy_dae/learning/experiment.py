"""Experiments: what was measured, how well, and under which conditions; and those that have not been made yet."""

import csv
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jax.typing import ArrayLike

from ..base.errors import ModelError, by_name, explained, explained_keywords, nearest, whole_number
from ..compile.lowering.plan import SystemPlan
from .noise import ESTIMATE, Noise
from .priors import is_finite, unwrapped
from .records import interpolated, low_pass, smoothed, untrended

Numbers: TypeAlias = ArrayLike | Sequence[float]
Samples: TypeAlias = float | tuple[Numbers, Numbers] | tuple[Numbers, Numbers, str]  # of an input

UNEVEN = 1e-3  # of a time step, by which steps may differ and still count as even


@explained
@dataclasses.dataclass(frozen=True)
class Unknown:
    """A start that is estimated.

    - `guess`: the start of the search.
    - `spread`: the standard deviation of a normal prior around the guess; None: no prior.
    - `shared`: whether all experiments share one value.
    """

    guess: float
    spread: float | None = None
    shared: bool = False

    def __post_init__(self):
        for name in ("guess", "spread"):
            object.__setattr__(self, name, unwrapped(getattr(self, name)))
        if not is_finite(self.guess):
            raise ModelError(f"Unknown needs a finite guess; got {self.guess!r}")
        if self.spread is not None and not (is_finite(self.spread) and self.spread > 0):
            raise ModelError(f"Unknown: spread is a standard deviation > 0, or None; got {self.spread!r}")


@explained
@dataclasses.dataclass(frozen=True, eq=False)
class Experiment:
    """One record.

    - `times`: the sampling times, increasing, shape `(n,)`.
    - `data`: by the variables' names, shape `(n,)`, or `(n, *shape)` for the name of an array; NaN where there is no
        sample.
    - `sigma`: standard deviations of the noise, by name or one number for all, in the variables' units: numbers, or
        arrays with one value for each sample, such as `0.01 + 0.02 * abs(y)` for partly relative errors; or
        `"estimate"`: estimated from the residuals, one for each name, the same in all experiments; or `Noise(...)`, for
        levels that are shared by sensors or proportional to a scale, and for outliers.
    - `inputs`: by name, `(times, values)`, or with `"held"`, `"spline"` or `"cubic"` as a third entry, or a constant.
    - `initial`: values at `t0` by variables' names, known (numbers) or `Unknown`. The name of a parameter gives this
        experiment a value of its own.
    - `weight`: the weight of the record.
    - `holdout`: whether to keep the record out of the fit and score the fit with it. Only its own unknown starts are
        fitted to it, with everything else held.
    - `t0`: the time at which the experiment starts.
    - `name`: the name in reports.

    **Raises:**

    - `ModelError` if times do not increase or lie before `t0`, if shapes do not fit, and if data are infinite; the text
        names variable and index.
    """

    times: Any
    data: Mapping[str, Any]
    sigma: Mapping[str, Any] | float | str | np.ndarray | Noise = ESTIMATE
    inputs: Mapping[str, Samples] = dataclasses.field(default_factory=dict)
    initial: Mapping[str, float | Unknown] = dataclasses.field(default_factory=dict)
    weight: float = 1.0
    holdout: bool = False
    t0: float = 0.0
    name: str = ""

    def __post_init__(self):
        for name in ("t0", "weight"):
            object.__setattr__(self, name, unwrapped(getattr(self, name)))
        object.__setattr__(self, "times", _times(self.times, self.t0))
        if not isinstance(self.data, Mapping) or not self.data:
            raise ModelError(f"data is a dictionary by variables' names, {{'m.x': values}}; got {self.data!r}")
        for name, example in (("initial", "'motor.w': Unknown(0.0)"), ("inputs", "'motor.u': (times, values)")):
            given = by_name(name, getattr(self, name), example)
            object.__setattr__(self, name, {key: unwrapped(value) for key, value in given.items()})
        count = len(self.times)
        object.__setattr__(self, "data", {name: _samples(name, v, count) for name, v in self.data.items()})
        object.__setattr__(self, "sigma", self._sigmas())
        if not (is_finite(self.weight) and self.weight >= 0):
            raise ModelError(f"weight is a number ≥ 0; got {self.weight!r}")

    def _sigmas(self) -> "dict[str, float | np.ndarray | Noise]":
        """The standard deviation for each name, or for each of its samples; NaN where it is to be estimated; or its
        noise."""
        given = self.sigma
        if isinstance(given, Mapping):
            unknown = [name for name in given if name not in self.data]
            if unknown:
                raise ModelError(f"sigma: there are no data of '{unknown[0]}': " + nearest(unknown[0], self.data))
        by_name = given if isinstance(given, Mapping) else dict.fromkeys(self.data, given)
        out: dict[str, float | np.ndarray | Noise] = {}
        for name, samples in self.data.items():
            value: Any = unwrapped(by_name.get(name, ESTIMATE))
            if isinstance(value, str) and value == ESTIMATE:
                out[name] = math.nan
            elif not isinstance(value, str) and is_finite(value) and value > 0:
                out[name] = float(value)
            elif not isinstance(value, str) and (isinstance(value, list | tuple) or hasattr(value, "shape")):
                out[name] = _levels_of(name, value, samples)
            elif isinstance(value, Noise):
                scale = None if value.scale is None else _levels_of(name, value.scale, samples)
                out[name] = value.number if value.is_plain else dataclasses.replace(value, scale=scale)
            else:
                raise ModelError(f"sigma of '{name}' is a standard deviation > 0, or 'estimate'; got {value!r}")
        return out

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        data: str | Sequence[str] | Mapping[str, str],
        *,
        time: str | None = None,
        inputs: Mapping[str, Samples | str | tuple[str, str]] | None = None,
        **others: Any,
    ) -> "Experiment":
        """A record from a pandas data frame, or from any object with columns by name.

        **Arguments:**

        - `data`: columns by variables' names, `{"room.T": "Ti"}`, or a name or a list if the columns have these names.
        - `time`: the column of times, in seconds or as dates; None: the index. Dates count in seconds from the first.
        - `inputs`: columns by inputs' names, `{"heater.Q": ("Ph", "held")}`; other inputs as in `Experiment`.
        - `others`: as in `Experiment`.
        """
        names = [data] if isinstance(data, str) else data
        columns = names if isinstance(names, Mapping) else {name: name for name in names}
        times = _seconds(frame.index if time is None else _column(frame, time))
        given = {}
        for name, source in (inputs or {}).items():
            parts = (source,) if isinstance(source, str) else source
            if isinstance(parts, tuple | list) and isinstance(parts[0], str):
                given[name] = (times, _numbers(frame, parts[0]), *parts[1:])
            else:
                given[name] = source
        values = {name: _numbers(frame, column) for name, column in columns.items()}
        return cls(times, values, inputs=given, **others)

    @classmethod
    def from_csv(
        cls, path: str | Path, data: str | Sequence[str] | Mapping[str, str], *, time: str, **others: Any
    ) -> "Experiment":
        """A record from a text file with commas, whose first line names the columns; empty cells are missing samples.
        Dates are understood. `data`, `inputs` and `others` as in `from_frame`."""
        with open(path, newline="", encoding="utf-8-sig") as file:  # some programs begin a file with a mark
            rows = list(csv.DictReader(file))
        if not rows:
            raise ModelError(f"{path}: there are no rows below the first line")
        longer = [k for k, row in enumerate(rows) if None in row]
        if longer:
            raise ModelError(
                f"{path}: row {longer[0] + 1} below the first line has more cells than the first line names"
            )
        table = {key: _cells([row[key] for row in rows]) for key in rows[0]}
        return cls.from_frame(table, data, time=time, **others)

    # --- parts of a record, and coarser ones ---------------------------------------------------------------------

    @explained_keywords()
    def window(self, start: float, end: float, initial: Mapping[str, float | Unknown] | None = None) -> "Experiment":
        """The samples from `start` to `end`, as an experiment that begins at `start`. `initial` replaces the values
        known at `t0`, and those of which something is known there: unknown ones with a spread.

        **Raises:**

        - `ModelError` if there are no samples, or if something is known of a value at `t0` but not at `start`.
        """
        if not (is_finite(start) and is_finite(end) and self.t0 <= start < end):
            raise ModelError(f"window: start and end are times, {self.t0:g} ≤ start < end; got {start!r} and {end!r}")
        rows = (self.times >= start) & (self.times <= end)
        if not rows.any():
            raise ModelError(f"window: there is no sample from {start:g} to {end:g}")
        new = dict(initial or {})
        old = [
            name
            for name, value in self.initial.items()
            if name not in new and (not isinstance(value, Unknown) or value.spread is not None)
        ]
        if start > self.t0 and old:
            raise ModelError(
                f"window: '{old[0]}' is known at {self.t0:g}, not at {start:g}: say what it is there, "
                f"initial={{'{old[0]}': Unknown(guess)}}; a parameter keeps its value, {self.initial[old[0]]!r}"
            )
        data = {name: values[rows] for name, values in self.data.items()}
        sigma = {name: _rows(level, rows) for name, level in self._noise.items()}
        return self.changed(times=self.times[rows], data=data, sigma=sigma, initial=dict(self.initial) | new, t0=start)

    @explained_keywords()
    def resample(self, times: Numbers) -> "Experiment":
        """The record at other times, by linear interpolation. Samples are NaN if a neighbour is missing, and outside
        the record. Samples with a common neighbour no longer have independent noise; use `decimate` to reduce the
        number of samples.

        **Raises:**

        - `ModelError` for noise whose level differs from sample to sample, or whose correlation is known: that of other
            neighbours is another.
        """
        new = _times(times, self.t0)
        if len(self.times) < 2:
            raise ModelError("resample: a record of one sample cannot be interpolated")

        def between(values: np.ndarray) -> np.ndarray:
            return interpolated(self.times, values, new)

        varying = [name for name, level in self.levels.items() if np.ndim(level) or self.noise(name).scale is not None]
        if varying:
            raise ModelError(f"resample: '{varying[0]}' has a noise level for each sample: give one for all")
        for name in self.data:
            if is_finite(self.noise(name).rho):
                raise ModelError(f"resample: {_of_neighbours(name)}")
        return self.changed(times=new, data=self._each(between))

    @explained_keywords()
    def decimate(self, factor: int) -> "Experiment":
        """Every `factor`-th sample, after a low-pass filter without delay against aliasing. Known noise levels decrease
        as for white noise. Samples less than `factor` old ones away from an end are left out: there, the filter
        would leave noise as it is.

        **Raises:**

        - `ModelError` for uneven sampling times and missing samples, and for correlated noise, unless both level and
            correlation are estimated.
        """
        factor = whole_number(factor, "decimate: factor")
        steps = np.diff(self.times)
        edge = factor if factor > 1 else 0
        rows = np.arange(0, len(self.times), factor)
        rows = rows[(rows >= edge) & (rows < len(self.times) - edge)]
        if not len(rows) or len(steps) < 1 or np.ptp(steps) > UNEVEN * steps.mean():
            raise ModelError(
                f"decimate needs more than {2 * edge or 1} samples at even steps: resample(times) makes them"
            )
        for name, values in self.data.items():
            if np.isnan(values).any():
                raise ModelError(f"decimate: '{name}' has missing samples, over which no filter goes: window() a part")
            noise = self.noise(name)
            if factor > 1 and (is_finite(noise.rho) or (noise.rho is not None and not math.isnan(noise.number))):
                raise ModelError(f"decimate: {_of_neighbours(name)}")
        response = low_pass(factor) if factor > 1 else np.ones(1)
        quieter = float(np.linalg.norm(response))
        data = self._each(lambda values: smoothed(values, response)[rows])
        sigma = {name: _rows(level, rows, quieter) for name, level in self._noise.items()}
        return self.changed(times=self.times[rows], data=data, sigma=sigma)

    @explained_keywords()
    def detrend(self, names: str | Sequence[str] | None = None, degree: int = 1) -> "Experiment":
        """The record without a polynomial trend (least squares), for all signals or the named ones. Degree 0 removes
        the means."""
        chosen = list(self.data) if names is None else [names] if isinstance(names, str) else list(names)
        whole_number(degree, "detrend: degree", least=0)
        for name in chosen:
            if name not in self.data:
                raise ModelError(f"detrend: there are no data of '{name}': " + nearest(name, self.data))
            least = int(np.isfinite(self.data[name]).sum(axis=0).min())
            if least <= degree:
                raise ModelError(f"detrend: '{name}' has {least} samples, too few for a trend of degree {degree}")
        changed = self._each(lambda values: untrended(self.times, values, degree), chosen)
        return self.changed(data=dict(self.data) | changed)

    @property
    def levels(self) -> "dict[str, float | np.ndarray]":
        """The standard deviation for each name, or for each of its samples; NaN where it is to be estimated."""
        noises = {name: self.noise(name) for name in self.data}
        plain = {name for name, one in noises.items() if one.scale is None or math.isnan(one.number)}
        return {name: one.number if name in plain else one.number * one.scale for name, one in noises.items()}

    @property
    def _noise(self) -> "dict[str, float | np.ndarray | Noise]":
        assert isinstance(self.sigma, Mapping)
        return dict(self.sigma)

    def noise(self, name: str) -> Noise:
        """The noise of a signal; that of a level for each sample has this level as its scale."""
        given = self._noise[name]
        if isinstance(given, Noise):
            return given
        return (
            Noise(1.0, scale=given)
            if isinstance(given, np.ndarray)
            else Noise(ESTIMATE if np.isnan(given) else float(given))
        )

    def _each(
        self, change: Callable[[np.ndarray], np.ndarray], names: Sequence[str] | None = None
    ) -> dict[str, np.ndarray]:
        """The signals, changed as columns, in their shapes."""
        found = {}
        for name in self.data if names is None else names:
            values = self.data[name]
            columns = change(values.reshape(len(values), -1))
            found[name] = columns.reshape(len(columns), *values.shape[1:])
        return found

    def changed(self, **changes: Any) -> "Experiment":
        """A copy with other fields. Noise levels that are estimated are still estimated."""
        levels = changes.get("sigma", self._noise)
        sigma = {
            name: ESTIMATE if isinstance(level, float) and math.isnan(level) else level
            for name, level in levels.items()
        }
        return dataclasses.replace(self, **changes | {"sigma": sigma})


def _rows(
    level: "float | np.ndarray | Noise", rows: slice | np.ndarray, factor: float = 1.0
) -> "float | np.ndarray | Noise":
    """The noise of some rows, of a factor less where its level is known."""
    if isinstance(level, Noise):
        scale = None if level.scale is None else level.scale[rows]
        known = level.level if isinstance(level.level, str) else level.level * factor
        return dataclasses.replace(level, level=known, scale=scale)
    return (level[rows] if isinstance(level, np.ndarray) else level) * factor


def _of_neighbours(name: str) -> str:
    return (
        f"the noise of '{name}' is correlated, rho, from one sample to the next, and otherwise from one of the new "
        "samples to the next: have it estimated, Noise(rho='estimate')"
    )


def _levels_of(name: str, given: Numbers, samples: np.ndarray) -> np.ndarray:
    """A noise level for each sample; one where there is none."""
    levels = np.asarray(given)
    if levels.dtype.kind not in "iuf" or levels.shape != samples.shape:
        raise ModelError(
            f"sigma of '{name}' needs a number for each sample, shape {samples.shape}; got {levels.dtype} of shape "
            f"{levels.shape}"
        )
    levels = np.where(np.isnan(samples), 1.0, levels.astype(float))
    bad = np.argwhere(~(np.isfinite(levels) & (levels > 0)))
    if len(bad):
        where = ", ".join(map(str, bad[0]))
        raise ModelError(f"sigma of '{name}' is a standard deviation > 0; entry [{where}] is {levels[tuple(bad[0])]}")
    return levels


def check_increasing(times: np.ndarray, where: str = "") -> None:
    """Refuses times, shape (n,), of which one does not come after the one before; `where` begins the message."""
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        k = int(back[0])
        raise ModelError(
            f"{where}times must increase; times[{k}]={times[k]:g} is followed by times[{k + 1}]={times[k + 1]:g}"
        )


def _times(given: Numbers, t0: float) -> np.ndarray:
    times = np.asarray(given)
    if times.ndim != 1 or not len(times) or times.dtype.kind not in "iuf":
        raise ModelError(f"times are numbers of shape (n,), n ≥ 1; got {times.dtype} of shape {times.shape}")
    times = times.astype(float)
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise ModelError(f"times[{bad[0]}] is {times[bad[0]]}: every row needs a time")
    check_increasing(times)
    if not is_finite(t0):
        raise ModelError(f"t0 is the time at which the experiment starts, a number; got {t0!r}")
    if times[0] < t0:
        raise ModelError(
            f"times lie outside of the experiment: it starts at t0={t0:g}, the times reach from {times[0]:g} to "
            f"{times[-1]:g}. Give t0={times[0]:g}, or leave earlier rows out"
        )
    return times


def _samples(name: str, given: Numbers, count: int) -> np.ndarray:
    values = np.asarray(given)
    if values.dtype.kind not in "biuf":
        raise ModelError(f"data of '{name}' must be real numbers; got {values.dtype}")
    if values.ndim == 0 or values.shape[0] != count:
        raise ModelError(f"data of '{name}' need a row for each of the {count} times; got shape {values.shape}")
    values = values.astype(float)
    bad = np.argwhere(np.isinf(values))
    if len(bad):
        where = ", ".join(map(str, bad[0]))
        raise ModelError(f"data of '{name}': entry [{where}] is {values[tuple(bad[0])]}; NaN marks a missing sample")
    return values


def _column(frame: Any, name: str) -> Any:
    known = list(getattr(frame, "columns", frame))
    if name not in known:
        raise ModelError(f"there is no column '{name}': " + nearest(name, [str(k) for k in known]))
    return frame[name]


def _numbers(frame: Any, name: str) -> np.ndarray:
    """A column of numbers."""
    column = _column(frame, name)
    try:
        return np.asarray(column, float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"column '{name}' has cells that are no numbers, such as {_text_in(column)!r}") from error


def _text_in(column: Any) -> Any:
    """The first cell that is no number, and not empty."""
    for cell in column:
        try:
            float(cell or math.nan)
        except (TypeError, ValueError):
            return cell
    return ""


def _seconds(column: Any) -> np.ndarray:
    values = np.asarray(column)
    if values.dtype.kind not in "biuf":  # dates, with or without a zone
        try:
            stamps = np.array([np.datetime64(_without_zone(v), "us") for v in column])
        except (TypeError, ValueError) as error:
            raise ModelError(f"times must be numbers or dates; got {next(iter(column))!r}") from error
        return (stamps - stamps[0]) / np.timedelta64(1, "s")
    return values.astype(float)


def _without_zone(stamp: Any) -> Any:
    """A date in universal time, which NumPy has no zones for."""
    if isinstance(stamp, str):
        stamp = datetime.fromisoformat(stamp)
    if getattr(stamp, "tzinfo", None) is not None:
        stamp = stamp.astimezone(UTC).replace(tzinfo=None)
    return stamp


def _cells(texts: list[str]) -> np.ndarray | list[str]:
    """Numbers where all cells are numbers or empty; the texts themselves otherwise."""
    try:
        return np.array([float(t) if t and t.strip() else math.nan for t in texts])
    except ValueError:
        return texts


@explained
@dataclasses.dataclass(frozen=True, eq=False)
class Planned:
    """An experiment that could be made, for `learning.next_experiment`.

    - `times`: the sampling times, increasing, shape `(n,)`.
    - `measure`: the standard deviations of the noise by the names of the measured variables, in their units.
    - `inputs`, `initial`, `weight`, `t0`, `name`: as in `Experiment`. An unknown start reduces the expected
        information, because the samples must determine it, too.
    """

    times: Any
    measure: Mapping[str, float]
    inputs: Mapping[str, Samples] = dataclasses.field(default_factory=dict)
    initial: Mapping[str, float | Unknown] = dataclasses.field(default_factory=dict)
    weight: float = 1.0
    t0: float = 0.0
    name: str = ""

    def __post_init__(self):
        if not isinstance(self.measure, Mapping) or not self.measure:
            raise ModelError(
                f"measure is a dictionary of noise levels by variables' names, {{'m.x': 1e-3}}; got {self.measure!r}"
            )
        for name, sigma in self.measure.items():
            number = isinstance(sigma, int | float | np.number) and not isinstance(sigma, bool)
            if not number or not (np.isfinite(sigma) and sigma > 0):
                raise ModelError(f"measure: '{name}' needs a standard deviation > 0; got {sigma!r}")

    def experiment(self, plan: SystemPlan) -> Experiment:
        """An experiment whose record is zero; only its times count."""
        count = len(np.atleast_1d(np.asarray(self.times)))
        data = {}
        for name in self.measure:
            entries = plan.entries(name)
            data[name] = np.zeros((count, *(() if entries is None else entries[1])))
        return Experiment(
            self.times, data, sigma=dict(self.measure), inputs=self.inputs, initial=self.initial, weight=self.weight,
            t0=self.t0, name=self.name,
        )  # fmt: skip
