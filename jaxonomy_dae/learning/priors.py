"""What is known of parameters before any data: a prior is a row of least squares, whatever the method.

A prior chooses the scale on which its parameter is searched, so that it is normal there: `Normal` the parameter's own,
`LogNormal` the logarithm. It stays where it was put, wherever a search begins.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypeGuard

import jax
import numpy as np

from ..base.errors import ModelError, explained, nearest
from ..host.staging import is_traced
from ..run.system.parameters import ParameterNames


@explained
@dataclasses.dataclass(frozen=True)
class Normal:
    """A normal prior of a parameter, for `Problem(priors={"motor.R": Normal(1.2, 0.1)})`, with its standard deviation
    `spread` in the parameter's unit. Declared bounds hold."""

    mean: float
    spread: float

    def __post_init__(self):
        if not is_finite(self.mean):
            raise ModelError(f"Normal: mean is a finite number; got {self.mean!r}")
        if not (is_finite(self.spread) and self.spread > 0):
            raise ModelError(f"Normal: spread is a standard deviation > 0; got {self.spread!r}")


@explained
@dataclasses.dataclass(frozen=True)
class LogNormal:
    """A normal prior of a parameter's logarithm, for `Problem(priors={"cell.tau": LogNormal(30.0, 2.0)})`: in two of
    three cases the parameter is within this `factor` of its `median`."""

    median: float
    factor: float

    def __post_init__(self):
        if not (is_finite(self.median) and self.median > 0):
            raise ModelError(f"LogNormal: median is a number > 0; got {self.median!r}")
        if not (is_finite(self.factor) and self.factor > 1):
            raise ModelError(f"LogNormal: factor is a number > 1; got {self.factor!r}")


Prior: TypeAlias = Normal | LogNormal | tuple[float, float]  # a pair is a range


def priors_by_name(given: Mapping[str, object], table: ParameterNames, unknown: Sequence[str]) -> dict[str, Prior]:
    """Priors of single parameters; a name of an array stands for each of its entries. A pair (low, high) is a range.

    **Arguments:**

    - `unknown`: the parameters that are estimated, shared by all experiments or each one's own.

    **Raises:**

    - `ModelError` for names that are not estimated, for other kinds of priors, and for those outside of declared
        bounds.
    """
    found: dict[str, Prior] = {}
    for name, prior in given.items():
        entries = table.entries(name)
        for one in [name] if entries is None else [table.names[k] for k in entries.ravel().tolist()]:
            if one not in unknown:
                raise ModelError(f"priors: '{name}' is not a parameter that is estimated: " + nearest(name, unknown))
            found[one] = _checked(one, prior, table)
    return found


def _checked(name: str, prior: Any, table: ParameterNames) -> Prior:
    interval = table.intervals[table.index(name)]
    if isinstance(prior, Normal | LogNormal):
        centre = prior.mean if isinstance(prior, Normal) else prior.median
        if centre not in interval:
            raise ModelError(f"priors: the centre of '{name}' must lie in {interval}, as declared; got {centre:g}")
        return prior
    try:
        low, high = (float(end) for end in prior)
    except (TypeError, ValueError):
        raise ModelError(
            f"priors: '{name}' takes learning.Normal(mean, spread), learning.LogNormal(median, factor) or a range "
            f"(low, high); got {prior!r}"
        ) from None
    if not (low < high and interval.low <= low and high <= interval.high):
        raise ModelError(f"priors: the range of '{name}' must lie in {interval}, as declared; got ({low:g}, {high:g})")
    return low, high


def unwrapped(value: Any) -> Any:
    """The number in an array of no axes, of NumPy or JAX; anything else as it is."""
    is_number = isinstance(value, np.ndarray | jax.Array) and value.ndim == 0 and not is_traced(value)
    return value.item() if is_number else value


def is_finite(value: object) -> TypeGuard[float]:
    """True for a finite number; True and False are none."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    return math.isfinite(value)
