"""The identity of a tree of structure: a digest over all of it, found by walking.

Given a tree of records, containers, arrays, templates and texts, returns a digest that two trees share only if they are
equal in every part, and the functions in them. There is no list of what counts: a record counts with all its fields, an
array with its dtype, shape and entries, an expression by its canonical form; a function, a class or a callable object
of the user's as the object that it is. What is of no known type is refused, so that nothing is forgotten.

Two plans are equal if their digests are equal and their functions are the same objects. What these functions compute
may change while they stay the same objects, so that programs are looked up by their content as well, at each call
(`host/content.py`).
"""

import dataclasses
import enum
import functools
import hashlib
import types
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import sympy

from ...base.aliases import PyTree
from ...graph.expressions.node import Node
from ...host.libraries import PACKAGE, Owner, owner
from ...solve.linear.sparse import SparsePattern
from .provenance import Lines
from .template import AbstractTemplate


@dataclasses.dataclass(frozen=True, eq=False)
class Identity:
    """The digest of a tree, and the functions and classes in it in the order in which the walk meets them."""

    digest: str
    functions: tuple[Callable, ...]

    @classmethod
    def of(cls, tree: PyTree) -> "Identity":
        """The identity of a tree.

        **Raises:**

        - `TypeError` for an object of a type of which it is not known what makes two of them equal.
        """
        walk = _Walk()
        return cls(walk.digest(tree).hex(), tuple(walk.functions))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.digest == other.digest and self._has_those_of(other)

    def _has_those_of(self, other: "Identity") -> bool:
        pairs = zip(self.functions, other.functions, strict=False)
        return len(self.functions) == len(other.functions) and all(_is_same(a, b) for a, b in pairs)

    def __hash__(self) -> int:
        return hash(self.digest)


def _is_same(one: object, other: object) -> bool:
    """True for one object, or for one method of one object, which Python makes anew whenever it is read."""
    if isinstance(one, types.MethodType) and isinstance(other, types.MethodType):
        return one.__func__ is other.__func__ and one.__self__ is other.__self__
    return one is other


_PLAIN = frozenset({type(None), bool, int, float, complex, str, bytes})  # whose `repr` says all


class _Walk:
    """A walk over one tree. Parts that are one object are visited once; none is let go before the walk ends, so that
    their ids stay taken."""

    def __init__(self):
        self.functions: list[Callable] = []
        self._seen: dict[int, tuple[object, bytes]] = {}

    def digest(self, part: object) -> bytes:
        if type(part) in _PLAIN:
            return _digest(type(part).__name__, repr(part).encode())
        if id(part) not in self._seen:
            self._seen[id(part)] = part, self._of(part)
        return self._seen[id(part)][1]

    def _of(self, part: object) -> bytes:
        name = f"{type(part).__module__}.{type(part).__qualname__}"
        match part:
            case np.ndarray() if part.dtype == object:
                return self._all(f"{name} {part.shape}", part.ravel().tolist())
            case np.ndarray() | np.generic() | jax.Array():
                array = np.ascontiguousarray(part)  # which makes a vector of what has no axes
                return _digest(f"{name} {array.dtype} {part.shape}", array.data if array.size else b"")
            case list() | tuple() if _PLAIN.issuperset(map(type, part)):
                return _digest(name, repr(part).encode())  # at once: there may be millions of names
            case list() | tuple():
                return self._all(name, part)
            case dict():
                return self._all(name, [*part, *part.values()])
            case set() | frozenset():
                # The order of a set depends on the hash seed of the process.
                return _digest(name, *sorted(map(self.digest, part)))
            case enum.Enum():
                return _digest(name, repr(part.value).encode())
            case type():
                return _digest("type", self._class(part))
            case Node():
                return _digest(name, part.digest)
            # The key leaves functions out, which have no text that identifies them.
            case AbstractTemplate():
                return _digest(name, part.key.encode(), self.digest(part.opaque))
            case Lines():
                return _digest(name)  # where a model is written does not change what it is
            case SparsePattern():
                return _digest(name, part.digest.encode())
            case sympy.Basic():
                return _digest(name, sympy.srepr(part).encode())
            case types.BuiltinMethodType() if not isinstance(part.__self__, types.ModuleType | None):
                return self._all(f"method {part.__name__}", [part.__self__])  # of a list, say
        if owner(type(part).__module__) is Owner.KNOWN:
            if dataclasses.is_dataclass(part):
                fields = dataclasses.fields(part)
                return _digest(name, *(self.digest(getattr(part, field.name)) for field in fields))
            if type(part).__module__.startswith(f"{PACKAGE}."):
                return self._all(name, _attributes(part))
        if dataclasses.is_dataclass(part) and not callable(part):
            return self._all(name, [type(part), *_attributes(part)])
        if callable(part):
            # A function counts by when it is met: two models that use one function twice, or two functions once,
            # differ.
            return _digest("function", self._number(part), getattr(part, "__qualname__", name).encode())
        raise TypeError(f"it is not known what makes two objects of type {type(part)} equal")

    def _all(self, name: str, parts: Sequence[object]) -> bytes:
        each = {id(part): part for part in parts}  # a few objects may stand at millions of places
        digests = {key: self.digest(part) for key, part in each.items()}
        return _digest(name, b"".join([digests[id(part)] for part in parts]))

    def _class(self, kind: type) -> bytes:
        """A class, which may be one of the user's: two of them may have one name."""
        return self._number(kind) + f"{kind.__module__}.{kind.__qualname__}".encode()

    def _number(self, function: Callable) -> bytes:
        """The place of a function, or of a class, among those met so far."""
        place = next((k for k, other in enumerate(self.functions) if _is_same(other, function)), len(self.functions))
        if place == len(self.functions):
            self.functions.append(function)
        return str(place).encode()


def _attributes(part: object) -> list[object]:
    """All attributes of an object that is no dataclass, but for those that are computed from others when asked for."""
    kind = type(part)
    slots = [name for base in kind.__mro__ for name in getattr(base, "__slots__", ()) if name != "__weakref__"]
    computed = functools.cached_property
    own = [name for name in getattr(part, "__dict__", ()) if not isinstance(getattr(kind, name, None), computed)]
    return [(name, getattr(part, name)) for name in sorted({*slots, *own})]


def _digest(kind: str, *parts: Any) -> bytes:
    found = hashlib.sha256(kind.encode())
    for part in parts:
        # Without lengths, parts ("ab", "c") and ("a", "bc") would have one digest.
        found.update(len(part).to_bytes(8, "little") if isinstance(part, bytes) else b"")
        found.update(part)
    return found.digest()
