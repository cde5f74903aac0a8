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
