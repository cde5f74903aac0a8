"""The package's errors. Every message speaks in user names and says what to do."""

import difflib
from collections.abc import Iterable
from typing import Any


class JaxonomyDaeError(Exception):
    """The base class of all errors that this package raises for a model, a start or a run."""


class ModelError(JaxonomyDaeError, ValueError):
    """The model as written is not well formed: a name, a port, a value, a shape."""


class StructuralError(ModelError):
    """The equations and the unknowns do not fit together, whatever their values."""


class UnitError(ModelError):
    """Units do not fit together, or a text is not a unit."""


class InitializationError(JaxonomyDaeError, RuntimeError):
    """No consistent initial point was found."""


class SteadyStateError(JaxonomyDaeError, RuntimeError):
    """No equilibrium was found, or one that does not determine all states."""


class SimulationError(JaxonomyDaeError, RuntimeError):
    """The integration stopped before its end."""


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


def whole_number(value: Any, what: str, least: int = 1) -> int:
    """The value, if it is an integer and not less than `least`.

    **Raises:**

    - `ModelError` for anything else, `what` it was for.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ModelError(f"{what} is a whole number ≥ {least}; got {value!r}")
    return value
