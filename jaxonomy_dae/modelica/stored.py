"""Records of classes as data: JSON of lists, texts and numbers, which a reader does not execute."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from ..base.errors import ModelError
from . import tree
from .flat_model import FlatModel
from .open_class import OpenClass, OpenPort

FORMAT = 6  # to be raised with every change of what stands in these records
_TREE = (
    tree.Number, tree.Truth, tree.Text, tree.Reference, tree.Whole, tree.End, tree.Call, tree.Unary, tree.Binary,
    tree.Choice, tree.Array, tree.Matrix, tree.Several, tree.Range, tree.Comprehension, tree.Part, tree.Equality,
    tree.Assignment, tree.Effect, tree.Branches, tree.Loop, tree.Jump, tree.Declaration, tree.Class,
)  # fmt: skip
_NODES: dict[str, Callable[..., Any]] = {c.__name__: c for c in _TREE}
_TUPLE, _SET, _FLOAT = "(", "{", "float"


def written(c: OpenClass) -> dict[str, Any]:
    """A class as an object of JSON."""
    fields = {f.name: getattr(c, f.name) for f in dataclasses.fields(c) if f.name not in ("flat", "ports")}
    return {
        "format": FORMAT,
        **{name: list(value) if isinstance(value, tuple) else value for name, value in fields.items()},
        "ports": [[p.name, p.potentials, p.flows, p.streams, p.orientation] for p in c.ports],
        "model": _written(c.flat.model),
        "classes": [_written(each) for each in c.flat.classes.values()],
    }


def read(data: Any) -> OpenClass:
    """The class that was written.

    **Raises:**

    - `ModelError` for what is no such record, or one of another format.
    """
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else None
        raise ModelError(f"this is no class of format {FORMAT}: it has format {found!r}")
    try:
        classes = {c.name: c for c in map(_read, data["classes"])}
        names = {key: tuple(data[key]) for key in ("inputs", "outputs", "tunable", "required", "fixed", "roots")}
        names["branches"] = tuple(map(tuple, data["branches"]))
        return OpenClass(
            data["name"], data["description"], FlatModel(_read(data["model"]), classes),
            tuple(map(_port, data["ports"])), **names,
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise ModelError(f"the record of a class is damaged ({type(error).__name__}: {error}); write it anew") from None


def _port(data: list[Any]) -> OpenPort:
    name, *sides, orientation = data
    potentials, flows, streams = (tuple(map(tuple, side)) for side in sides)
    return OpenPort(name, potentials, flows, streams, tuple(orientation))


def _written(x: Any) -> Any:
    # Nodes of the tree are tuples themselves, and so come first.
    if type(x).__name__ in _NODES:
        return [type(x).__name__, *map(_written, x)]
    if isinstance(x, tuple | list):
        return [_TUPLE, *map(_written, x)]
    if isinstance(x, frozenset):
        return [_SET, *sorted(x)]
    if isinstance(x, dict):
        return {k: _written(v) for k, v in x.items()}
    if isinstance(x, float) and not math.isfinite(x):
        return [_FLOAT, repr(x)]
    if x is None or isinstance(x, bool | int | float | str):
        return x
    raise ModelError(f"a class with a part of the type {type(x).__name__} is not written")


def _read(x: Any) -> Any:
    if isinstance(x, list):
        kind, *parts = x
        if kind == _TUPLE:
            return tuple(map(_read, parts))
        if kind == _SET:
            return frozenset(parts)
        return float(parts[0]) if kind == _FLOAT else _NODES[kind](*map(_read, parts))
    return {k: _read(v) for k, v in x.items()} if isinstance(x, dict) else x
