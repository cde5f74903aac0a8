"""What a later process must know of a program to run its executable without tracing it: the structure of the outcome,
and the functions outside of XLA that it calls."""

import functools
import re
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np

from ..base.aliases import PyTree
from .written import NotData, read, written


def record(program: str, calls: list[str], outcome: PyTree) -> bytes | None:
    """The digest of a program's text, what it calls, and what its outcome is beside arrays, as data; None if reading
    would not give the same."""
    try:
        content = written((program, calls, outcome))
        # What does not come back the same would make another outcome in the next process, without a word.
        return content if written(read(content)) == content else None
    except NotData:
        return None


def recalled(content: bytes) -> tuple[str, list[str], PyTree] | None:
    """What `record` wrote; None if it cannot be read."""
    try:
        program, calls, outcome = read(content)
        structure, fixed, is_array = outcome
        whole = isinstance(program, str) and all(isinstance(call, str) for call in calls)
        whole = whole and structure.num_leaves == len(fixed) == len(is_array)
        return (program, calls, outcome) if whole else None
    except (NotData, TypeError, ValueError, AttributeError):  # written by something else
        return None


# Functions that make known to a fresh process what a program calls, by parts of the names of what is called. Without
# them the process crashes. Modules that bring functions of their own add them.
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
