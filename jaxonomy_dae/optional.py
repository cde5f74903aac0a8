"""Packages that only some features need."""

import importlib
from typing import Any


def optional_module(module: str, extra: str, need: str) -> Any:
    """A package that comes with an extra.

    **Raises:**

    - `ImportError` that says what needs it, and how it is installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{need}: pip install 'jaxonomy_dae[{extra}]'") from error


def pyplot() -> Any:
    """`matplotlib.pyplot` (extra `plot`)."""
    return optional_module("matplotlib.pyplot", "plot", "plotting needs Matplotlib")


def new_axes(ax: Any, width: float = 7.0, height: float = 3.5) -> Any:
    """The Matplotlib axes given, or new ones."""
    return pyplot().subplots(figsize=(width, height), layout="constrained")[1] if ax is None else ax
