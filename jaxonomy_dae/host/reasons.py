"""Why a call needs another program, in words."""

import enum
from collections.abc import Hashable, Iterable
from typing import Any

import jax

SHOWN = 3  # arguments that a reason lists
WIDTH = 60  # characters of a value in a reason


class Place(enum.Enum):
    """What stands among static values where an array was."""

    ARRAY = 0


def reason(key: tuple[Any, ...], known: Iterable[Hashable]) -> str:
    """How the key (function, structure, static values, types, surroundings) of a program differs from the one of the
    same function that was used last."""
    function, structure, static, types, around = key
    for other in reversed(list(known)):
        if isinstance(other, tuple) and other[0] is function:
            break
    else:
        return "first call"
    if other[1] != structure:
        return "another model, another option, or arguments of other kinds"
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(
        jax.tree.unflatten(structure, static)
    )[0]]  # fmt: skip
    arrays = [path for path, leaf in zip(paths, static, strict=True) if leaf is Place.ARRAY]
    changed = [
        f"{p} was {_short(a)}, is {_short(b)}" for p, a, b in zip(paths, other[2], static, strict=True) if a != b
    ]
    pairs = zip(arrays, other[3], types, strict=False)
    changed += [f"{p} was {a.str_short()}, is {b.str_short()}" for p, a, b in pairs if a != b]
    if not changed and other[4] != around:
        return "another device, or other options of JAX"
    return "; ".join(changed[:SHOWN]) + (f"; and {len(changed) - SHOWN} more" if len(changed) > SHOWN else "")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= WIDTH else text[: WIDTH - 1] + "…"
