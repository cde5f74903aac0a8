"""How types are checked while tests run."""

from typing import Any

import beartype


def checked(function: Any) -> Any:
    """Beartype's checks, for what is defined once.

    A function inside another is defined at every call of that one, and making its checks costs 10 ms: half of the time
    in which a model of 275 equations is compiled.
    """
    return function if "<locals>" in getattr(function, "__qualname__", "") else beartype.beartype(function)
