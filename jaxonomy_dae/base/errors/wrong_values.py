"""Checks of values, and suggestions of names, that all rooms share."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .kinds import ModelError


def nearest(name: str, known: Iterable[str]) -> str:
    """A clause that suggests known names near `name` (or lists a few of them)."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    if close:
        return "did you mean " + " or ".join(repr(c) for c in close) + "?"
    if not known:
        return "there are none."
    shown = ", ".join(repr(k) for k in known[:8])
    return f"known names: {shown}{', …' if len(known) > 8 else '.'}"


def by_name(what: str, given: object, example: str) -> dict[str, Any]:
    """A copy of what the argument `what` says by name; nothing, if it is None.

    **Raises:**

    - `ModelError` for what is no dictionary, with an `example` of an entry.
    """
    if given is not None and not isinstance(given, Mapping):
        raise ModelError(f"{what} is a dictionary by names, {what}={{{example}}}; got {given!r}")
    return dict(given or {})


def whole_number(value: object, what: str, least: int = 1) -> int:
    """The value, if it is an integer, of NumPy too, and not less than `least`.

    **Raises:**

    - `ModelError` for anything else, `what` it was for.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ModelError(f"{what} is a whole number ≥ {least}; got {value!r}")
    return int(value)
