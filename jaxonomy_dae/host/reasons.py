"""Why a call needs another program, in words."""

import enum
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import jax

SHOWN = 3  # arguments that a reason lists
WIDTH = 60  # characters of a value in a reason


class Place(enum.Enum):
    """What stands among static values where an array was."""

    ARRAY = 0


class Call(NamedTuple):
    """A call of a function: the structure of its arguments, what is static among them, the types of the arrays, and
    what surrounds the call."""

    function: Any
    structure: Any
    static: tuple[Any, ...]
    types: tuple[Any, ...]
    around: Hashable

    def without_function(self) -> "Call":
        """The same for comparisons: functions of the user's, and what they close over, are not held."""
        name = f"{getattr(self.function, '__module__', '')}.{getattr(self.function, '__qualname__', '')}"
        static = tuple(leaf if type(leaf) in _HELD or leaf is Place.ARRAY else type(leaf) for leaf in self.static)
        return self._replace(function=name, static=static)


_HELD = (bool, int, float, complex, str, bytes, type(None))


def reason(call: Call, known: Sequence[Call]) -> str:
    """How a call differs from the one of the same function that was used last."""
    call = call.without_function()
    other = next((one for one in reversed(known) if one.function == call.function), None)
    if other is None:
        return "first call"
    if other.structure != call.structure:
        return "another model, another option, or arguments of other kinds"
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(
        jax.tree.unflatten(call.structure, call.static)
    )[0]]  # fmt: skip
    arrays = [path for path, leaf in zip(paths, call.static, strict=True) if leaf is Place.ARRAY]
    changed = [
        f"{p} was {_short(a)}, is {_short(b)}"
        for p, a, b in zip(paths, other.static, call.static, strict=True)
        # By their texts, since 1, 1.0 and True are equal and make different programs.
        if repr(a) != repr(b)
    ]
    pairs = zip(arrays, other.types, call.types, strict=False)
    changed += [f"{p} was {a.str_short()}, is {b.str_short()}" for p, a, b in pairs if a != b]
    if not changed:
        if other.around != call.around:
            return "another device, or other options of JAX"
        return "a function, or what it reads, has changed"
    return "; ".join(changed[:SHOWN]) + (f"; and {len(changed) - SHOWN} more" if len(changed) > SHOWN else "")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= WIDTH else text[: WIDTH - 1] + "…"
