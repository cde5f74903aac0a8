"""Whose code something is: this package's, a library's that counts by its name, or the user's.

Code of the package and of the libraries it stands on is told by name in keys of programs: within a process it does not
change, and for other processes `code` is a digest of all its files. A name alone proves nothing. A module counts as a
library's if its file lies where the library lies, and a class if none of its methods was put there from outside.
"""

import builtins
import enum
import functools
import hashlib
import os
import sys
import sysconfig
import time
import types
from pathlib import Path
from typing import Any

PACKAGE = __name__.partition(".")[0]
# Functions and classes of these are told by their names.
LIBRARIES = (
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "sympy",
    "equinox",
    "diffrax",
    "lineax",
    "optimistix",
    "optax",
    "klujax",
)
# These modules of the standard library compute from their arguments alone. All others may read a clock, a file or a
# random state.
PURE = frozenset({
    "abc", "bisect", "builtins", "cmath", "collections", "contextlib", "copy", "copyreg", "dataclasses", "enum",
    "fractions", "functools", "heapq", "itertools", "math", "numbers", "operator", "re", "statistics", "string",
    "textwrap", "types", "typing", "warnings",
})  # fmt: skip
# These built-in functions compute from something else, or from names that no reader of the code can follow.
IMPURE = frozenset({
    "open", "input", "eval", "exec", "compile", "globals", "locals", "vars", "getattr", "setattr", "delattr",
    "__import__", "breakpoint", "id", "memoryview", "dir",
})  # fmt: skip
# Parts of libraries that read files or draw from a state of the process.
STATEFUL = (
    "numpy.random",
    "scipy.io",
    "numpy.lib.npyio",
    "numpy.lib._npyio_impl",
    "numpy.ctypeslib",
    "jax.experimental",
)
_STANDARD = tuple(
    os.path.join(os.path.realpath(sysconfig.get_path(name)), "") for name in ("stdlib", "platstdlib")
)  # fmt: skip
_INSTALLED = ("site-packages", "dist-packages")  # folders inside that of the standard library
_RESOLUTION = 20_000_000  # nanoseconds by which the time of a file may lag behind the clock: two ticks of Linux
_HERE = Path(__file__).parent.parent
_READ_AT = time.time_ns()


class Owner(enum.Enum):
    """Whose a module is."""

    KNOWN = "of the package, of a library, or of the standard library where that is pure"
    STANDARD = "of the standard library, where that may read more than its arguments"
    USER = "of anybody else"


def owner(name: object) -> Owner:
    """Whose the module of this name is, as it is now."""
    module = sys.modules.get(name) if isinstance(name, str) else None
    return Owner.USER if module is None else _owner(str(name), id(module))


@functools.lru_cache(maxsize=8192)
def _owner(name: str, identity: int) -> Owner:
    """`identity` is that of the module, so that another one of the same name is looked at anew."""
    module, root = sys.modules[name], name.partition(".")[0]
    # A name proves nothing: a user's module may be called like one of a library, and lie elsewhere.
    if root == PACKAGE or root in LIBRARIES:
        if not _lies_in(module, root):
            return Owner.USER
        return Owner.STANDARD if name.startswith(STATEFUL) else Owner.KNOWN
    if root in sys.stdlib_module_names and _is_standard(module):
        return Owner.KNOWN if root in PURE else Owner.STANDARD
    return Owner.USER


def _lies_in(module: types.ModuleType, root: str) -> bool:
    file = getattr(module, "__file__", None)
    if file is None:  # made by the library itself, such as NumPy's `numpy.char`
        return getattr(getattr(module, "__spec__", None), "name", "") == module.__name__
    return any(os.path.realpath(file).startswith(os.path.join(folder, "")) for folder in _folders(root))


def _folders(root: str) -> list[str]:
    """Where a package lies."""
    found = sys.modules.get(root)
    return [os.path.realpath(folder) for folder in getattr(found, "__path__", ())]


def _is_standard(module: types.ModuleType) -> bool:
    file = getattr(module, "__file__", None)
    if file is None:
        return module.__name__ in sys.builtin_module_names or getattr(module.__spec__, "origin", "") == "frozen"
    path = os.path.realpath(file)
    return path.startswith(_STANDARD) and not any(part in path for part in _INSTALLED)


def place(thing: Any) -> str | None:
    """The module and the name under which a function, a class or another object of known code is found; None if it is
    not where it says that it is."""
    name = getattr(thing, "__module__", None)
    own = getattr(thing, "__qualname__", None) or getattr(thing, "__name__", None)
    if isinstance(thing, types.BuiltinFunctionType | types.BuiltinMethodType) and name is None:
        name = getattr(getattr(thing, "__self__", None), "__name__", None)
    if name is None and type(thing).__module__ == "numpy":  # a ufunc
        name = "numpy"
    if not isinstance(own, str) or owner(name) is not Owner.KNOWN:
        return None
    module = sys.modules[str(name)]
    found = functools.reduce(lambda inside, part: getattr(inside, part, None), own.split("."), module)
    if found is thing:
        return f"{name}:{own}"
    if getattr(found, "__wrapped__", None) is thing:  # what a decorator has got
        return f"{name}:{own}, inside"
    for other, value in vars(module).items():  # the identity that ends an `eqx.nn.MLP` is a lambda
        if value is thing:
            return f"{name}:{other}"
    return None


def is_as_written(kind: type) -> bool:
    """True if no method of a class of a library, or of what it inherits, was put there by code from elsewhere."""
    return all(_is_as_written(base) for base in kind.__mro__ if base is not object)


_LOOKED_AT: dict[type, tuple[list[object], bool]] = {}


def _is_as_written(base: type) -> bool:
    values = list(vars(base).values())
    known = _LOOKED_AT.get(base)
    if (
        known is not None
        and len(known[0]) == len(values)
        and all(a is b for a, b in zip(known[0], values, strict=True))
    ):
        return known[1]
    found = all(map(_is_of_a_library, values))
    _LOOKED_AT[base] = values, found
    return found


_HELPERS = frozenset({"jaxtyping", "wadler_lindig", "typing_extensions"})  # whose functions libraries take into theirs


def _is_of_a_library(value: object) -> bool:
    """True for what is no function, or one that a library, or the standard library, has written."""
    function = getattr(value, "__func__", getattr(value, "fget", getattr(value, "method", value)))
    if not isinstance(function, types.FunctionType):
        return True
    name = function.__globals__.get("__name__")
    root = name.partition(".")[0] if isinstance(name, str) else ""
    # Some are made by `collections.namedtuple`.
    return owner(name) is not Owner.USER or root in _HELPERS or root.startswith("namedtuple_")


def is_impure(name: str) -> bool:
    """True for built-in functions that read, or change, what is not among their arguments."""
    return name in IMPURE and hasattr(builtins, name)


# --- all processes ---------------------------------------------------------------------------------------------------


class Changed(Exception):
    """A file is not the one that this process has read, or it cannot be told."""


@functools.cache
def code() -> str:
    """A digest of the code of the package and of the libraries.

    The package counts by the content of its files. A library counts by the size and the dates of each of its files:
    some 5,000 files, in some 20 ms. A date of change cannot be set back, so that edits of an editable install are seen,
    and so is a file that a package manager links into its place.

    **Raises:**

    - `Changed` if a file is newer than this process, which then has read another one; if the package has no sources;
        or if a library was patched from outside.
    """
    found = hashlib.sha256(sys.version.encode())
    before, now = _SNAPSHOT, _snapshot()
    if before != now or not now:
        raise Changed
    for name, *_ in now:
        found.update(name.encode() + b"\0" + (_HERE / name).read_bytes() + b"\0")
    for root in LIBRARIES:
        for folder in _folders(root):
            for name, *status in _files(folder):
                # The process has imported an earlier version of this file, whose content nobody knows any more.
                if status[-1] > _READ_AT - _RESOLUTION:
                    raise Changed
                found.update(f"{name}\0{status}\0".encode())
    if _is_patched():
        raise Changed
    return found.hexdigest()


def _files(folder: str) -> list[tuple[str, int, int, int]]:
    """(Name, size, time of writing, time of change) of each file of code, in order."""
    found, folders = [], [""]
    while folders:
        inside = folders.pop()
        with os.scandir(os.path.join(folder, inside)) as entries:
            for entry in entries:
                name = os.path.join(inside, entry.name)
                if entry.name.endswith((".py", ".so", ".pyd")):
                    status = entry.stat()
                    found.append((name, status.st_size, status.st_mtime_ns, status.st_ctime_ns))
                elif "." not in entry.name and entry.name not in ("__pycache__", "tests", "include"):
                    if entry.is_dir():
                        folders.append(name)
    return sorted(found)


def _snapshot() -> list[tuple[str, int, int, int]]:
    return _files(str(_HERE))


# Taken at import: later, a file may be another than the one that was read.
_SNAPSHOT = _snapshot()


def _is_patched() -> bool:
    """True if a function or a method of the small libraries, which runs step through, was replaced from outside."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] not in ("diffrax", "equinox", "lineax", "optimistix") or module is None:
            continue
        for value in list(vars(module).values()):
            if isinstance(value, type) and value.__module__ == name and not is_as_written(value):
                return True
            if not _is_of_a_library(value):
                return True
    return False
