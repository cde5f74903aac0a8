"""Interrupted work that goes on as if it had not been: a file with what identifies it in its first line, then arrays.

The arrays are Equinox's (`tree_serialise_leaves`), bit for bit.
"""

import hashlib
import json
import os
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
