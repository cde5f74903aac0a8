"""Checks of arguments that are no parameters: rows of numbers, counts, values in order; starts that may be left out.

Each check raises a `ModelError` that names the component and the argument.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..write import Component, Value


def finite(values: object, name: str, what: str) -> np.ndarray:
    """An array of the values.

    **Raises:**

    - `ModelError` if they are no array of numbers, or if one of them is not finite.
    """
    try:
        found = np.asarray(values, float)
    except (TypeError, ValueError):
        raise ModelError(f"'{name}': {what} must be numbers, in rows of one length; got {values!r}") from None
    if not np.isfinite(found).all():
        place = int(np.argmin(np.isfinite(found).ravel()))
        raise ModelError(f"'{name}': {what} is not finite at entry {place} ({found.ravel()[place]})")
    return found


def coefficients(values: object, name: str, what: str) -> np.ndarray:
    """An array of numbers in one row; one number is a row, too.

    **Raises:**

    - `ModelError` if they are not, or if one of them is not finite.
    """
    found = np.atleast_1d(finite(values, name, what))
    if found.ndim != 1:
        raise ModelError(f"'{name}': {what} is one row of coefficients; got shape {found.shape}")
    return found


def increasing(values: object, name: str, what: str) -> np.ndarray:
    """An array of at least two increasing points.

    **Raises:**

    - `ModelError` if they are not.
    """
    found = finite(values, name, what)
    if found.ndim != 1 or len(found) < 2:
        raise ModelError(f"'{name}': {what} needs a row of at least 2 points; got shape {found.shape}")
    if not (np.diff(found) > 0).all():
        # The first False: where the order breaks.
        place = int(np.argmin(np.diff(found) > 0))
        twice = found[place + 1] == found[place]
        mend = "part the two points a little, or write a jump as a Piecewise or a Step" if twice else "sort it"
        found_there = f"entry {place + 1} ({found[place + 1]:g}) follows {found[place]:g}"
        raise ModelError(f"'{name}': {what} must increase, but {found_there}: {mend}")
    return found


def row(values: Sequence[Value] | np.ndarray, name: str, what: str) -> list[Value]:
    """A list of the values, which may be expressions.

    **Raises:**

    - `ModelError` if it is one value, or a text.
    """
    if isinstance(values, str) or not hasattr(values, "__len__") or getattr(values, "ndim", 1) == 0:
        raise ModelError(f"'{name}': {what} is a row of values, such as [1.0, 2.0]; got {values!r}")
    return list(values)


def count(value: object, name: str, what: str) -> int:
    """A positive integer.

    **Raises:**

    - `ModelError` if it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ModelError(f"'{name}': {what} must be at least 1, an integer; got {value!r}")
    return int(value)


def in_order(component: Component, low: str, high: str) -> None:
    """Checks that a parameter is not above another, where both are numbers.

    **Raises:**

    - `ModelError` if it is.
    """
    least, most = (component.parameters[name].value for name in (low, high))
    if isinstance(least, float) and isinstance(most, float) and least > most:
        raise ModelError(
            f"'{component.name}': {low} must not be above {high}; got {low}={least:g} and {high}={most:g}: exchange "
            "them"
        )


def yes_or_no(value: Any, name: str, what: str) -> int:
    """1 for True, 0 for False.

    **Raises:**

    - `ModelError` for anything else.
    """
    if value not in (True, False):
        raise ModelError(f"'{name}': {what} is True or False; got {value!r}")
    return int(value)


def start_of(
    component: Component, name: str, given: Value | None, unit: str = "", guess: Value | None = 0.0
) -> dict[str, Any]:
    """Options of a variable that starts at the parameter `name`: at the given value, or else near a guess. Without
    either the variable has no start, and there is no such parameter."""
    value = guess if given is None else given
    if value is None:
        return dict(unit=unit)
    return dict(start=component.parameter(name, value, unit=unit), fixed=given is not None, unit=unit)
