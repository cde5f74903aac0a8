"""Differentiable acausal modeling: components and equations in, one Equinox module out."""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # for editors and type checkers
    from .names import *  # noqa: F403

__version__ = "0.1.0"


def _public() -> list[str]:
    """Reads all public names. They rest on some three hundred modules, whose import takes half as long as that of JAX
    and its libraries: what uses none of them, or a part of the package alone, does without."""
    names = {name: value for name, value in vars(import_module(".names", __name__)).items() if name[0] != "_"}
    globals().update(names)
    return sorted(names)


def __getattr__(name: str) -> object:
    if name == "__all__":
        return _public()
    if not name.startswith("__"):  # what Python and its tools look for in every module
        if find_spec(f"{__name__}.{name}") is not None:
            return import_module(f".{name}", __name__)
        if name in _public():
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    _public()
    return sorted(globals())
