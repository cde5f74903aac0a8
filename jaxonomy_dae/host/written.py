"""Structures of outcomes as data: what a program returns beside its arrays, written as JSON and read back.

Reading makes objects, and runs nothing: numbers, texts, containers, structures of pytrees, and records whose class is
found by name in the package or in a library, with their fields set as they were. Whatever else there is cannot be
written, and the program that returns it is traced again by the next process.
"""

import dataclasses
import enum
import importlib
import json
import sys
import types
from typing import Any

import jax
import numpy as np
from jax.tree_util import PyTreeDef

from ..base.aliases import PyTree
from .libraries import LIBRARIES, PACKAGE, Owner, is_as_written, owner, place


class NotData(Exception):
    """A part that is not written as data, or a text that is none."""


def written(part: PyTree) -> bytes:
    """**Raises:** `NotData` for what cannot be read back as it is."""
    return json.dumps(_out(part), separators=(",", ":")).encode()


def read(text: bytes) -> PyTree:
    """What `written` wrote.

    **Raises:**

    - `NotData` for anything else.
    """
    try:
        return _in(json.loads(text))
    except NotData:
        raise
    except Exception as error:  # of a text that something else wrote
        raise NotData(str(error)) from error


def _out(part: Any) -> Any:
    kind = type(part)
    # By their very types: an object of a subclass would come back as one of its base.
    if part is None or kind in (bool, int, str):
        return part
    if kind in (tuple, list):
        return [kind.__name__, *map(_out, part)]
    if kind is float:
        # Exact, and with texts for infinity and not-a-number, which JSON lacks.
        return ["float", part.hex()]
    if kind is dict:
        return ["dict", *([_out(key), _out(value)] for key, value in part.items())]
    if isinstance(part, PyTreeDef):
        # A structure cannot be written itself: a tree that has it is, with zeros for leaves.
        return ["structure", _out(jax.tree.unflatten(part, [0] * part.num_leaves))]
    if isinstance(part, np.dtype):
        return ["dtype", part.str]
    if isinstance(part, enum.Enum):
        return ["member", _class(kind), part.name]
    if isinstance(part, type | types.FunctionType):
        return ["named", _class(part)]
    if isinstance(part, tuple) and hasattr(kind, "_fields"):
        return ["record", _class(kind), *map(_out, part)]
    if dataclasses.is_dataclass(part):
        part = getattr(part, "as_data", lambda: part)()  # without what a file cannot hold
        fields = {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if hasattr(part, f.name)}
        if set(getattr(part, "__dict__", ())) <= set(fields):
            return ["object", _class(kind), *([name, _out(value)] for name, value in fields.items())]
    raise NotData(f"a {kind.__module__}.{kind.__qualname__}")


def _class(thing: Any) -> str:
    if thing in _BUILT_IN:
        return f"builtins:{thing.__name__}"
    found = place(thing)
    if found is None or "," in found or (isinstance(thing, type) and not is_as_written(thing)):
        raise NotData(f"the name of {thing!r}")
    return found


_BUILT_IN = (type(None), tuple, list, dict)


def _in(part: Any) -> Any:
    if not isinstance(part, list):
        return part
    kind, *rest = part
    match kind:
        case "tuple":
            return tuple(map(_in, rest))
        case "list":
            return list(map(_in, rest))
        case "float":
            return float.fromhex(rest[0])
        case "dict":
            return {_in(key): _in(value) for key, value in rest}
        case "dtype":
            return np.dtype(rest[0])
        case "named":
            return _found(rest[0])
        case "member":
            return _class_of(rest[0], enum.Enum)[rest[1]]
        case "record":
            return tuple.__new__(_class_of(rest[0], tuple), map(_in, rest[1:]))
        case "object":
            made = object.__new__(_class_of(rest[0], object))
            for name, value in rest[1:]:
                object.__setattr__(made, name, _in(value))
            return made
        case "structure":
            return jax.tree.structure(_in(rest[0]))
    raise NotData(f"a part of kind {kind}")


def _found(name: str) -> Any:
    module, _, path = name.partition(":")
    if module == "builtins":
        return next(one for one in _BUILT_IN if one.__name__ == path)
    # No other module is imported: a file must not choose what code runs.
    if module.partition(".")[0] in (PACKAGE, *LIBRARIES):
        importlib.import_module(module)
    if owner(module) is not Owner.KNOWN:
        raise NotData(f"the module {module}")
    found: Any = sys.modules[module]
    for inside in path.split("."):
        found = getattr(found, inside)
    if place(found) != name:
        raise NotData(f"the name {name}")
    return found


def _class_of(name: str, of: type) -> Any:
    found = _found(name)
    if (
        not isinstance(found, type)
        or not issubclass(found, of)
        or not (dataclasses.is_dataclass(found) or of is not object)
    ):
        raise NotData(f"{name} is not a record")
    return found
