"""Intervals of admissible parameter values."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..base.errors import ModelError


@dataclasses.dataclass(frozen=True)
class Interval:
    """The values from `low` to `high`. An open end is not admissible itself, and an infinite end never is.

    `Interval(0.0, math.inf, open_low=True)` holds the positive numbers. Training approaches an open end without
    reaching it, and can reach a closed end.
    """

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False

    def __post_init__(self):
        # Infinity is no value, so an end there leaves nothing out by being open. Whoever reads `open_low` may then take
        # it for a number beside the interval.
        object.__setattr__(self, "open_low", bool(self.open_low and math.isfinite(self.low)))
        object.__setattr__(self, "open_high", bool(self.open_high and math.isfinite(self.high)))

    def __contains__(self, value: float) -> bool:
        above = self.low < value if self.open_low else self.low <= value
        below = value < self.high if self.open_high else value <= self.high
        return math.isfinite(value) and above and below

    def __str__(self):
        left = "(" if self.open_low or math.isinf(self.low) else "["
        right = ")" if self.open_high or math.isinf(self.high) else "]"
        return f"{left}{self.low:g}, {self.high:g}{right}"


POSITIVE = Interval(0.0, math.inf, open_low=True)
NONNEGATIVE = Interval(0.0, math.inf)


def as_interval(bounds: Any, where: str) -> Interval:
    """The interval that `bounds` declares: an `Interval`, or a pair (low, high) for a closed interval."""
    if isinstance(bounds, Interval):
        found = bounds
    else:
        try:
            if any(isinstance(end, str) for end in bounds):
                raise TypeError
            low, high = (float(end) for end in bounds)
        except (TypeError, ValueError):
            raise ModelError(f"{where}: bounds are a pair (low, high) or an Interval; got {bounds!r}") from None
        found = Interval(low, high)
    empty = not found.low <= found.high or (found.low == found.high and (found.open_low or found.open_high))
    if empty:  # comparisons with NaN are false
        raise ModelError(f"{where}: the bounds {found} contain no number")
    return found


def closed_ends(intervals: Sequence[Interval]) -> Float[np.ndarray, "n 2"]:
    """The least and the greatest number of each interval, in double precision."""
    distinct, which = distinct_intervals(intervals)
    ends = np.array([(i.low, i.high) for i in distinct], float).reshape(-1, 2)
    opened = np.array([(i.open_low, i.open_high) for i in distinct], bool).reshape(-1, 2)
    # The nearest number inside an open end, so that searches can treat all ends as closed.
    inside = np.nextafter(ends, np.array([np.inf, -np.inf]))
    return np.where(opened, inside, ends)[which]


def distinct_intervals(intervals: Sequence[Interval]) -> tuple[list[Interval], Int[np.ndarray, " n"]]:
    """The objects among intervals, of which arrays of components share a few, and which of them each is."""
    # By identity: intervals hash field by field, which takes long for a million parameters.
    objects = {id(i): i for i in intervals}
    place = {key: k for k, key in enumerate(objects)}
    return list(objects.values()), np.array([place[key] for key in map(id, intervals)], np.int64)
