"""What a later process must know of a program to run its executable without tracing it: the structure of the outcome,
and the functions outside of XLA that it calls."""

import functools
import io
import pickle
import re
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef

from ..base.aliases import PyTree


def record(program: str, calls: list[str], outcome: PyTree) -> bytes | None:
    """The digest of a program's text, what it calls, and what its outcome is beside arrays, in bytes; None if reading
    would not give the same."""
    try:
        content = _written((program, calls, outcome))
        return content if _written(pickle.loads(content)) == content else None
    except Exception:  # whatever classes of the user's own raise
        return None


def recalled(content: bytes) -> tuple[str, list[str], PyTree] | None:
    """What `record` wrote; None if it cannot be read."""
    try:
        return pickle.loads(content)
    except Exception:  # written by something else
        return None


class _Pickler(pickle.Pickler):
    """Writes structures of pytrees, too; and the same bytes for what is equal."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.fast = True  # without remembering which parts are one object

    def reducer_override(self, part: Any) -> Any:
        if isinstance(part, PyTreeDef):
            return jax.tree.structure, (jax.tree.unflatten(part, [0] * part.num_leaves),)
        return NotImplemented


def _written(part: object) -> bytes:
    file = io.BytesIO()
    _Pickler(file).dump(part)
    return file.getvalue()


# By parts of the names of what programs call: what makes it known to a fresh process, which crashes otherwise. Modules
# that bring functions of their own add them.
REGISTERED: dict[str, Callable[[], object]] = {
    "lapack": functools.cache(lambda: jax.jit(jnp.linalg.inv).lower(np.eye(1))),
}


def called(text: bytes) -> list[str]:
    """What a program calls outside of XLA, given as StableHLO."""
    return sorted(set(re.findall(r"custom_call @([\w.]+)", text.decode())))


def register(targets: Iterable[str]) -> bool:
    """Makes known what a program calls. False if something is not of a known kind."""
    found = [[make for part, make in REGISTERED.items() if part in target] for target in targets]
    for makes in found:
        for make in makes:
            make()
    return all(found)
