"""Checks of values, and suggestions of names, that all rooms share."""

import difflib
from collections.abc import Iterable

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


def whole_number(value: object, what: str, least: int = 1) -> int:
    """The value, if it is an integer and not less than `least`.

    **Raises:**

    - `ModelError` for anything else, `what` it was for.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ModelError(f"{what} is a whole number ≥ {least}; got {value!r}")
    return value
