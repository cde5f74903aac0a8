"""A digest of what a call computes, the same in every process. By it, a later process finds a program without tracing.

A program follows from the function, from all that is static among its arguments, from the types of its arrays, from the
options of JAX, and from the code of this package and of the libraries that it calls. All of them are in the digest.
What is of no known kind has none, and neither have functions and classes of the user's own: their code, and all that it
reads, may be another one in the next process.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib.metadata
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jax import Array
from jax.tree_util import PyTreeDef

PACKAGE = __name__.partition(".")[0]
_IMPORTED = time.time()
# Functions and classes of these are told by their names, for their versions are told, too.
LIBRARIES = ("jax", "jaxlib", "numpy", "scipy", "sympy", "equinox", "diffrax", "lineax", "optimistix", "klujax")
_PLAIN = frozenset({type(None), bool, int, float, complex, str, bytes})  # whose `repr` says all


@runtime_checkable
class Told(Protocol):
    """A static part that says itself what it is."""

    def told(self) -> tuple[str, Sequence[Callable]]:
        """A digest that equal parts share in all processes, and what it tells by names alone: functions and classes."""
        ...


class NotLasting(Exception):
    """Something has no digest that is the same in every process."""


def lasting(*parts: object) -> str | None:
    """The digest of a function, of its static arguments, of a structure of pytrees; None if they have none."""
    try:
        return _digest("call", *map(_told, parts), _code().encode(), _options().encode()).hex()
    except NotLasting:
        return None


def types_of(arrays: Iterable[Array]) -> str:
    """All of arrays that a program is made for."""
    return repr([
        (a.shape, a.dtype.name, a.weak_type, sorted((d.platform, d.device_kind, d.id) for d in a.devices()))
        for a in arrays
    ])  # fmt: skip


def _told(part: Any) -> bytes:
    kind = type(part)
    if kind in _PLAIN:
        return _digest(kind.__name__, repr(part).encode())
    match part:
        case PyTreeDef():
            inside = part.node_data()
            if inside is None:
                return _digest("leaf")
            return _digest("tree", _named(inside[0]), _told(inside[1]), *map(_told, part.children()))
        case np.ndarray() | np.generic() | jax.Array() if part.dtype != object:
            array = np.ascontiguousarray(part)
            return _digest(f"{kind.__name__} {array.dtype} {array.shape}", array.tobytes())
        case np.dtype():
            return _digest("dtype", part.str.encode())
        case tuple() | list():
            return _digest("items", _named(kind), *map(_told, part))
        case dict():
            return _digest("dict", _named(kind), *map(_told, [*part, *part.values()]))
        case frozenset():
            return _digest("set", *sorted(map(_told, part)))
        case enum.Enum():
            return _digest("enum", _named(kind), part.name.encode())
        case type():
            return _digest("named", _named(part))
        case Told():
            digest, by_name = part.told()
            return _digest("told", _named(kind), digest.encode(), *map(_named, by_name))
    if dataclasses.is_dataclass(part):
        compared = [field.name for field in dataclasses.fields(part) if field.compare]
        return _digest("record", _named(kind), *(_told(getattr(part, name)) for name in compared))
    return _digest("named", _named(part))


def _named(thing: Any) -> bytes:
    """Where a function, a class or another object of a library is found.

    **Raises:**

    - `NotLasting` for what no module of a library holds.
    """
    if thing is type(None):
        return b"NoneType"  # which `builtins`, its module, does not hold
    name = getattr(thing, "__module__", None) or ""
    root = name.partition(".")[0]
    module = sys.modules.get(name)
    if module is not None and (root in (PACKAGE, *LIBRARIES) or root in sys.stdlib_module_names):
        own = getattr(thing, "__qualname__", "")
        found = _reached(module, own)
        if found is thing:
            return f"{name}:{own}".encode()
        if getattr(found, "__wrapped__", None) is thing:  # what a decorator has got
            return f"{name}:{own}, inside".encode()
        for other, value in vars(module).items():  # the identity that ends an `eqx.nn.MLP` is a lambda
            if value is thing:
                return f"{name}:{other}".encode()
    raise NotLasting


def _reached(module: Any, path: str) -> object:
    return functools.reduce(lambda inside, name: getattr(inside, name, None), path.split("."), module)


@functools.cache
def _code() -> str:
    """The code of this package, file by file, and the versions of the libraries.

    **Raises:**

    - `NotLasting` if a file has changed since this process read it: its programs are those of the code before.
    """
    found = hashlib.sha256()
    root = Path(__file__).parent.parent
    for path in sorted(root.rglob("*.py")):
        if path.stat().st_mtime > _IMPORTED:
            raise NotLasting
        found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    versions = [(name, _version(name)) for name in LIBRARIES]
    return f"{found.hexdigest()} {versions} {sys.version}"


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _options() -> str:
    """JAX's options as they are now, and what else is set for it."""
    config: Any = jax.config
    options = [(name, repr(getattr(config, name, value))) for name, value in sorted(config.values.items())]
    environment = sorted((k, v) for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_", "EQX_", "JAXTYPING")))
    return f"{options} {environment} {jax.device_count()}"


def _digest(kind: str, *parts: bytes) -> bytes:
    found = hashlib.sha256(kind.encode())
    for part in parts:
        found.update(len(part).to_bytes(8, "little") + part)
    return found.digest()
