"""Interrupted work that goes on as if it had not been: a file with what identifies it in its first line, then arrays.

The arrays are Equinox's (`tree_serialise_leaves`), bit for bit.
"""

import dataclasses
import functools
import hashlib
import json
import os
import re
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import numpy as np

from ..base.aliases import PyTree
from ..base.errors import ModelError

KIND = "jaxonomy_dae training"
Described: TypeAlias = "str | float | None | Sequence[Described]"  # what JSON keeps
State = TypeVar("State", bound=PyTree)


def fingerprint(tree: PyTree) -> str:
    """A digest of all arrays and names in a pytree."""
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        found.update(jax.tree_util.keystr(path).encode())
        if eqx.is_array(leaf) or isinstance(leaf, np.ndarray):
            found.update(f"{leaf.dtype}{leaf.shape}".encode())
            found.update(np.ascontiguousarray(leaf).tobytes())
        else:
            found.update(repr(leaf).encode())
    return found.hexdigest()


def described(value: object, inside: tuple[object, ...] = ()) -> Described:
    """Nested lists of texts that say which functions and settings a value consists of, alike in every process: a
    function by its code, by what it closes over and by the numbers that it reads from its module; a module by its class
    and fields. `inside` are the functions that the value belongs to, which may refer to themselves."""
    if isinstance(value, dict):
        return [[str(key), described(one, inside)] for key, one in value.items()]
    if isinstance(value, list | tuple):
        return [described(one, inside) for one in value]
    if isinstance(value, functools.partial):
        return ["partial", described([value.func, value.args, value.keywords], inside)]
    if isinstance(value, types.MethodType):
        return ["method", described([value.__func__, value.__self__], inside)]
    if isinstance(value, types.FunctionType):
        name = [value.__module__, value.__qualname__]
        if any(value is one for one in inside):
            return name
        names = value.__code__.co_names
        read = {n: value.__globals__[n] for n in names if isinstance(value.__globals__.get(n), _NUMBERS)}
        given = [value.__defaults__, value.__kwdefaults__, [_content(c) for c in value.__closure__ or ()], read]
        return [*name, _code(value.__code__), described(given, (*inside, value))]
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    if eqx.is_array(value) or isinstance(value, np.ndarray):
        return fingerprint(value)
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name, None) for f in dataclasses.fields(value)}
        return [described(type(value)), described(fields, inside)]
    wrapped = getattr(value, "__wrapped__", None)  # such as of what `jax.jit` returns
    if wrapped is not None:
        return described(wrapped, inside)
    return _ADDRESS.sub("", repr(value))


_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
_NUMBERS = (bool, int, float, complex, str, np.ndarray, np.generic, jax.Array)


def _content(cell: types.CellType) -> object:
    try:
        return cell.cell_contents
    except ValueError:  # not yet filled
        return None


def _code(code: types.CodeType) -> list[Described]:
    constants = [
        _code(c) if isinstance(c, types.CodeType) else sorted(map(repr, c)) if isinstance(c, frozenset) else repr(c)
        for c in code.co_consts
    ]
    return [code.co_code.hex(), list(code.co_names), constants]


def save(path: str | Path, facts: Mapping[str, Described], state: PyTree) -> None:
    """Writes a checkpoint; a file that was there stays whole until the new one is."""
    path = Path(path)
    draft = path.with_name(path.name + ".part")
    with open(draft, "wb") as file:
        file.write((json.dumps({"kind": KIND, **facts}) + "\n").encode())
        eqx.tree_serialise_leaves(file, state)
    os.replace(draft, path)


def read_facts(path: str | Path, expected: Mapping[str, Described]) -> dict[str, Any]:
    """The first line of a checkpoint.

    **Raises:**

    - `ModelError` if the file is not a checkpoint, or not one of the work at hand: it names what differs.
    """
    with open(path, "rb") as file:
        line = file.readline()
    try:
        facts = json.loads(line)
    except (UnicodeDecodeError, json.JSONDecodeError):
        facts = None
    if not isinstance(facts, dict) or facts.get("kind") != KIND:
        raise ModelError(f"checkpoint: '{path}' is not a checkpoint of training: give the name of a new file")
    for name, value in expected.items():
        if facts.get(name) != value:
            shown = (
                "" if isinstance(value, str) and len(value) > 40 else f" ({facts.get(name)!r} there, {value!r} here)"
            )
            raise ModelError(
                f"checkpoint: '{path}' is of another {name}{shown}: give the name of a new file, or delete this one"
            )
    return facts


def read_state(path: str | Path, like: State) -> State:
    """The arrays of a checkpoint, in a pytree like the one given.

    **Raises:**

    - `ModelError` if they do not fit, as those of another optimizer.
    """
    with open(path, "rb") as file:
        file.readline()
        try:
            return eqx.tree_deserialise_leaves(file, like)
        except (RuntimeError, ValueError, EOFError, TypeError) as error:
            raise ModelError(
                f"checkpoint: the arrays in '{path}' do not fit: it was written with another optimizer, or broke off. "
                "Give the name of a new file, or delete this one"
            ) from error
