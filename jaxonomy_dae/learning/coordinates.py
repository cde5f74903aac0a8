"""One vector of coordinates for all that is estimated.

    [trained parameters | weights of networks and sensor laws | what comes with a method, such as levels of noise
        | shared starts | own starts, experiment by experiment]

Parameters that must be positive are on a logarithmic scale, so a step multiplies them; others, and starts, are measured
by their size, so that 1 is a change that would be natural in any unit. Weights are as they are.

Sizes, bounds and priors belong to the problem. Where a search begins changes `start` alone.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..base.aliases import PyTree
from ..base.errors import ModelError, nearest
from ..run.system.parameters import ParameterNames
from ..write.interval import Interval, closed_ends
from .data import Stacked
from .experiment import Unknown
from .priors import LogNormal, Normal, Prior, is_finite, unwrapped
from .program import Setting


class Coordinate(NamedTuple):
    """One coordinate; fields as those of `Coordinates`."""

    name: str
    unit: str
    group: str
    is_weight: bool
    log: bool
    size: float
    start: float
    low: float = -math.inf
    high: float = math.inf
    spread: float = math.inf
    fixed: bool = False
    centre: float = 0.0


class Shifts(NamedTuple):
    """Coordinates that are values relative to others: the natural value at `into` is larger by `factor` times that at
    `of`. A bias is measured where the inputs of its network have their centre."""

    into: Int[np.ndarray | Array, " s"]
    of: Int[np.ndarray | Array, " s"]
    factor: Float[np.ndarray | Array, " s"]


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """The `p` coordinates of a search, described by position.

    `start`, `low` and `high` are natural values; `z` in signatures is on the scale of the coordinates.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    group: tuple[str, ...]  # the name by which it is trained, frozen and regularized
    is_weight: Bool[np.ndarray, " p"]
    log: Bool[np.ndarray, " p"]
    size: Float[np.ndarray, " p"]  # in which the coordinate is measured; 1 for logarithms and weights
    start: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    spread: Float[np.ndarray, " p"]  # of the prior, on the coordinates' scale; infinite where there is none
    centre: Float[np.ndarray, " p"]  # of this prior, on the coordinates' scale; of weights, those of the problem
    fixed: Bool[np.ndarray, " p"]
    n_shared: int
    n_own: int  # of each experiment
    experiments: int
    shifts: Shifts | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def z_start(self) -> Float[np.ndarray, " p"]:
        """The start on the coordinates' scale, inside the bounds."""
        return self.scaled(np.clip(self.start, self.low, self.high))

    @property
    def z_bounds(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Bounds on the coordinates' scale."""
        low, high = self.low / self.size, self.high / self.size
        with np.errstate(divide="ignore"):
            low[self.log] = np.log(np.maximum(low[self.log], 0.0))
            high[self.log] = np.log(high[self.log])
        # An open bound at zero is the least number above it, where nothing can be computed: no step goes so far.
        low[self.log & (self.low < np.finfo(float).tiny)] = -math.inf
        return low, high

    def scaled(self, natural: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Natural values on the coordinates' scale."""
        out = np.array(natural, float)
        if self.shifts is not None:
            np.subtract.at(out, self.shifts.into, self.shifts.factor * out[self.shifts.of])
        out = out / self.size
        out[self.log] = np.log(out[self.log])
        return out

    def natural(self, z: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """The values that coordinates stand for, inside the bounds."""
        out = np.array(z, float)
        with np.errstate(over="ignore"):
            out[self.log] = np.exp(out[self.log])
        out = np.clip(out * self.size, self.low, self.high)
        if self.shifts is not None:
            np.add.at(out, self.shifts.into, self.shifts.factor * out[self.shifts.of])
        return out

    def natural_at(self, position: int, z: float) -> float:
        """The value that one coordinate stands for, bounds aside."""
        with np.errstate(over="ignore"):
            return float(np.exp(z)) if self.log[position] else float(z * self.size[position])

    def slope(self, z: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """d(natural value)/d(coordinate), of each by itself."""
        return np.where(self.log, self.natural(z), self.size)

    def pulled(self, z: Float[np.ndarray, " p"], by_natural: Float[np.ndarray, "*m p"]) -> Float[np.ndarray, "*m p"]:
        """Derivatives by the coordinates, from those by natural values."""
        out = by_natural * self.slope(z)
        if self.shifts is not None:
            into, of, factor = self.shifts
            out[..., of] += factor * by_natural[..., into] * self.size[of]
        return out

    def moved(self, z: Float[np.ndarray, " p"], changes: Float[np.ndarray, "p r"]) -> Float[np.ndarray, "p r"]:
        """Changes of natural values, from those of coordinates."""
        out = self.slope(z)[:, None] * changes
        if self.shifts is not None:
            np.add.at(out, self.shifts.into, self.shifts.factor[:, None] * out[self.shifts.of])
        return out

    def split(self, natural: Float[np.ndarray, " p"]) -> tuple[np.ndarray, np.ndarray]:
        """Returns (the values that all experiments share, those of each experiment's own, shape (experiments, own))."""
        return natural[: self.n_shared], natural[self.n_shared :].reshape(self.experiments, self.n_own)

    def members(self, name: str) -> Bool[np.ndarray, " p"]:
        """True for the coordinates that a name stands for: the one of this name, or all of a group, shape (p,)."""
        return np.array([name in (own, group) for own, group in zip(self.names, self.group, strict=True)], bool)

    def changed(self, values: Mapping[str, Any], fixed: bool) -> "Coordinates":
        """A copy with other starts, by name. They stay `fixed`, or are only where the search begins."""
        start, held = np.array(self.start), np.array(self.fixed)
        for name, value in values.items():
            chosen = self._known(name)
            if value is not None:
                value = unwrapped(value)
                if not is_finite(value):
                    raise ModelError(f"'{name}' needs a finite number; got {value!r}")
                if name not in self.names:
                    raise ModelError(
                        f"'{name}' stands for {chosen.sum()} weights, which one number cannot set: give a system, "
                        f"start=fit.system, or single weights by their names, such as '{self.names[chosen.argmax()]}'"
                    )
                outside = (value < self.low[chosen]) | (value > self.high[chosen])
                if outside.any():
                    low, high = self.low[chosen][0], self.high[chosen][0]
                    raise ModelError(f"'{name}' must lie in [{end_text(low)}, {end_text(high)}]; got {value:g}")
                start[chosen] = value
            if fixed:
                held |= chosen
        return dataclasses.replace(self, start=start, fixed=held)

    def bounded(self, bounds: Mapping[str, Any]) -> "Coordinates":
        """Narrower bounds by names, pairs of natural values."""
        low, high = np.array(self.low), np.array(self.high)
        for name, given in bounds.items():
            chosen = self._known(name)
            try:
                new_low, new_high = (float(end) for end in given)
            except (TypeError, ValueError):
                raise ModelError(f"bounds of '{name}' are a pair (low, high); got {given!r}") from None
            # What was declared without its end stands here as the number beside it: its end says the same.
            if new_low == np.nextafter(low[chosen].min(), -np.inf):
                new_low = low[chosen].min()
            if new_high == np.nextafter(high[chosen].max(), np.inf):
                new_high = high[chosen].max()
            if not new_low <= new_high or new_low < low[chosen].min() or new_high > high[chosen].max():
                raise ModelError(
                    f"bounds of '{name}' must lie within those declared, "
                    f"[{end_text(low[chosen].min())}, {end_text(high[chosen].max())}]; got [{new_low:g}, {new_high:g}]"
                )
            low[chosen], high[chosen] = new_low, new_high
        return dataclasses.replace(self, low=low, high=high)

    def with_priors(self, priors: Mapping[str, Prior]) -> "Coordinates":
        """A copy with priors of parameters by name, each on the scale on which it is normal; a pair is a range."""
        columns = {name: np.array(getattr(self, name)) for name in ("log", "size", "start", "low", "high", "spread")}
        centre = np.array(self.centre)
        for name, prior in priors.items():
            chosen = np.array([name == group for group in self.group], bool)
            new: dict[str, float | np.ndarray] = {}
            if isinstance(prior, Normal):
                new = {"log": False, "size": prior.spread, "spread": 1.0}
                centre[chosen] = prior.mean / prior.spread
            elif isinstance(prior, LogNormal):
                new = {"log": True, "size": 1.0, "spread": math.log(prior.factor)}
                new["low"] = np.maximum(self.low[chosen], np.finfo(float).tiny)
                new["start"] = np.where(self.start[chosen] > 0, self.start[chosen], prior.median)
                centre[chosen] = math.log(prior.median)
            else:
                new = {"low": prior[0], "high": prior[1]}
            double = np.flatnonzero(chosen & np.isfinite(self.spread))
            if "spread" in new and len(double):
                raise ModelError(f"priors: '{self.names[double[0]]}' has a spread already, by Unknown: leave one out")
            for column, values in new.items():
                columns[column][chosen] = values
        return dataclasses.replace(self, centre=centre, **columns)

    def _known(self, name: str) -> Bool[np.ndarray, " p"]:
        chosen = self.members(name)
        if not chosen.any():
            known = dict.fromkeys(self.group)
            raise ModelError(f"'{name}' is not estimated in this problem: " + nearest(name, known))
        return chosen


def coordinates(
    setting: Setting, stacked: Stacked, extras: tuple[Coordinate, ...], priors: Mapping[str, Prior]
) -> Coordinates:
    """The coordinates of a problem, which start at the values of its system and at the guesses of unknown starts;
    `extras` come with its method, `priors` by names of parameters."""
    system, observers, layout, _ = setting
    table = system.parameters.table
    rows: list[Coordinate] = []
    numbers = np.array(system.parameters.array) if system.parameters.known is None else system.parameters.known
    index = [table.index(name) for name in layout.parameters]
    ends = closed_ends([table.intervals[k] for k in index])
    for k, (low, high) in zip(index, ends, strict=True):
        name, interval, value = table.names[k], table.intervals[k], float(numbers[k])
        log = is_positive(interval)
        size = 1.0 if log else abs(value) or 1.0
        rows.append(Coordinate(name, table.units[k], name, False, log, size, value, low=low, high=high))
    for name in layout.modules:
        module = system.neural[name] if name in system.neural else observers[name]
        for one, value in _named_weights(name, module):
            rows.append(Coordinate(one, "", name, True, False, 1.0, value, centre=value))
    rows.extend(extras)
    n_plain = len(rows)
    units = dict(zip(table.names, table.units, strict=True))
    units |= dict(zip(system.plan.flat.variables.names, system.plan.flat.variables.unit, strict=True))
    for name in layout.shared:
        rows.append(_start(f"{name} at the start", units, name, stacked.starts[name][0], table))
    n_shared = n_plain + len(layout.shared)
    for k, label in enumerate(stacked.labels):
        for name in layout.own:
            rows.append(_start(f"{name}, {label}", units, name, stacked.starts[name][k], table))
    columns = {name: [getattr(row, name) for row in rows] for name in Coordinate._fields}
    names, units, group = (tuple(columns.pop(name)) for name in ("name", "unit", "group"))
    arrays = {name: np.array(column) for name, column in columns.items()}
    return Coordinates(
        names, units, group, **arrays, n_shared=n_shared, n_own=len(layout.own), experiments=len(stacked.labels),
        shifts=None,
    ).with_priors(priors)  # fmt: skip


def end_text(end: float) -> str:
    """A bound as it was declared: an open end at zero stands in coordinates as the least number beside it."""
    return "0" if abs(end) < np.finfo(float).tiny else f"{end:g}"


def is_positive(interval: Interval) -> bool:
    """True if all values are above zero, so that a logarithmic scale can be used. Zero itself, where it is admissible,
    is infinitely far away on it."""
    return interval.low > 0 or (interval.low == 0 and interval.open_low)


def _named_weights(name: str, module: PyTree) -> list[tuple[str, float]]:
    """The numbers of a module, named by the place of their array in it."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(module):
        if eqx.is_inexact_array(leaf):
            own = name + jax.tree_util.keystr(path)
            flat = np.ravel(np.asarray(leaf, float))
            labels = [own] if leaf.ndim == 0 else [f"{own}[{k}]" for k in range(len(flat))]
            found.extend(zip(labels, flat.tolist(), strict=True))
    return found


def _start(label: str, units: dict[str, str], name: str, given: float | Unknown, table: ParameterNames) -> Coordinate:
    low, high = -math.inf, math.inf
    log = False
    spread = float(given.spread) if isinstance(given, Unknown) and given.spread is not None else math.inf
    if name in table.names:
        interval = table.intervals[table.index(name)]
        low, high = closed_ends([interval])[0]
        log = is_positive(interval) and math.isinf(spread)  # a prior is normal on the scale of the search
    known = not isinstance(given, Unknown)
    guess = float(given.guess if isinstance(given, Unknown) else given)
    if not low <= guess <= high:
        raise ModelError(
            f"{label}: the guess must lie in [{end_text(low)}, {end_text(high)}], as '{name}' does; got {guess:g}"
        )
    size = 1.0 if log else spread if math.isfinite(spread) else abs(guess) or 1.0
    spread /= size
    centre = math.log(guess) if log else guess / size
    return Coordinate(
        label, units.get(name, ""), name, False, log, size, guess, low=low, high=high, spread=spread, fixed=known,
        centre=centre,
    )  # fmt: skip
