"""How types are checked while tests run."""

from pathlib import Path
from typing import Any

import beartype

PACKAGE = Path(__file__).parents[1] / "jaxonomy_dae"


def checked(function: Any) -> Any:
    """Beartype's checks, for what is defined once.

    A function inside another is defined at every call of that one, and making its checks costs 10 ms: half of the time
    in which a model of 275 equations is compiled.
    """
    return function if "<locals>" in getattr(function, "__qualname__", "") else beartype.beartype(function)


def modules_with_shapes() -> list[str]:
    """The modules whose signatures say shapes and dtypes, a fifth of all: pyright proves the types of the others.

    Checked at every call, and wrapped at every definition, these took 45 % of the processor time of a run whose
    programs had been compiled before.
    """
    sources = (file for file in PACKAGE.rglob("*.py") if "from jaxtyping import" in file.read_text())
    return [".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts) for file in sorted(sources)]
