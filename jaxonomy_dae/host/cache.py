"""Programs compiled for calls with plain arrays, kept while there is room.

A program is looked up by what it computes: the content of its function and of all that is static among its arguments
(`content.py`), the types of its arrays, the options of JAX. So it serves whatever has the same content, and nothing
else. Where the content cannot be seen, the function is traced at every call, and the text of the program decides.

`equinox.filter_jit` keeps every program for ever, also those of models and functions that are gone: its cache refers
to the functions that it is looked up by. Here each program can be dropped, with its derivatives and batches, and none
holds the function, nor what it closes over.
"""

import functools
import gc
import operator
import os
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import PyTree
from .content import content
from .kept import folder
from .libraries import Changed, code
from .machine import Use, mappings, memory, return_memory
from .reasons import Call, Place, reason
from .staging import is_traced
from .transformed import Function, Traceable

# Of the mappings that Linux allows, and of the memory that this process could have. What is left must hold what is
# compiled until use is measured next: a gradient takes 800 (two states) to 4,500 mappings (double pendulum), 7 %.
SHARE = 0.5  # above this use, the least recently used programs are dropped
FULL = 0.75  # above this use, with no program left to drop, JAX's own caches are cleared
# Nothing is dropped again before use has grown by this much. If the programs of a loop do not fit together, each call
# would otherwise drop the program that the next one needs.
AGAIN = 0.125
COUNT = 64  # programs kept where the system does not tell its use: 4 GB at the 66 MB of the tutorial's program
PART = 4  # one of so many programs goes before use is measured again
MOST_TEXTS = 1000  # digests of texts that are remembered
PAUSE = 100  # a measurement takes some 2 µs for each mapping, up to 0.1 s; 1 % of the time may go into it

_P = ParamSpec("_P")
_T = TypeVar("_T")


class _Called:
    """The programs of one content; `calls` counts the calls that have not returned yet, `call` is what they are."""

    def __init__(self, call: Call, why: str, optimize: bool, identity: str | None):
        self.call, self.calls = call.without_function(), 0
        self.function = Function(getattr(call.function, "__name__", "run"), why, optimize, identity)


def _flat(call: Call) -> Traceable:
    """The function of a call, of the arrays among its arguments alone."""
    function, structure, static = call.function, call.structure, call.static

    def run(arrays: list[Array]) -> PyTree:
        rest = iter(arrays)
        leaves = [next(rest) if leaf is Place.ARRAY else leaf for leaf in static]
        args, kwargs = jax.tree.unflatten(structure, leaves)
        return function(*args, **kwargs)

    return run


def _call_of(function: Callable, args: tuple[PyTree, ...], kwargs: dict[str, PyTree]) -> tuple[Call, list[Array]]:
    leaves, structure = jax.tree.flatten((args, kwargs))
    arrays = [_array(leaf) for leaf in leaves if eqx.is_array(leaf)]
    static = tuple(Place.ARRAY if eqx.is_array(leaf) else leaf for leaf in leaves)
    return Call(function, structure, static, tuple(jax.typeof(a) for a in arrays), _surroundings(arrays)), arrays


def _array(leaf: Any) -> Any:
    """An array that a program takes: JAX' own, or one of NumPy, which lies nowhere yet, of a type that JAX has."""
    if isinstance(leaf, jax.Array):
        return leaf
    fits = isinstance(leaf, np.ndarray) and jax.dtypes.canonicalize_dtype(leaf.dtype) == leaf.dtype
    config: Any = jax.config
    return leaf if fits and config.jax_default_device is None else jnp.asarray(leaf)


def options() -> list[tuple[str, object]]:
    """JAX's options as they are now, in this thread."""
    config: Any = jax.config
    return [(name, getattr(config, name, value)) for name, value in config.values.items()]


class _Options(NamedTuple):
    """Options as they were seen last: what reads those of this thread, all their values, and the digest."""

    of_thread: Callable[[Any], tuple[object, ...]]
    values: tuple[object, ...]
    digest: str


_OPTIONS: list[_Options] = []


def _of_options() -> str:
    """The digest of JAX's options. Every eager call asks for it, so objects that are still the same ones are not looked
    at by name: 10 µs in place of 70."""
    config: Any = jax.config
    for of_thread, values, digest in _OPTIONS:
        now = *config.values.values(), *of_thread(config)
        # Libraries that are imported later may add options, and none is ever taken away.
        if len(now) == len(values) and all(map(operator.is_, now, values)):
            return digest
    # A few options are no attributes: a thread cannot change these for itself.
    of_thread = operator.attrgetter(*(name for name in config.values if hasattr(config, name)))
    digest = content(options()).digest
    _OPTIONS[:] = [_Options(of_thread, (*config.values.values(), *of_thread(config)), digest)]
    return digest


def _surroundings(arrays: list[Array]) -> Hashable:
    """What else decides about a program: where its arrays lie, and JAX's options."""
    known = [a for a in arrays if not is_traced(a)]
    there = {d for a in known if isinstance(a, jax.Array) for d in a.devices()}
    # Arrays of NumPy go where the others lie, and else to the first device.
    return frozenset(there or (jax.local_devices()[:1] if known else ())), _of_options()


def _identity(digest: str) -> str | None:
    """A digest of what a call computes, the same in every process; None if programs are not kept for other processes,
    or if the code that runs may be another one than its files say."""
    if folder() is None:
        return None
    try:
        return content(digest, code(), options(), _environment()).digest
    except Changed:
        return None


def _environment() -> list[object]:
    variables = [(k, v) for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_", "EQX_", "JAXTYPING"))]
    return [*sorted(variables), jax.device_count()]


class ProgramCache:
    """Programs by content, types and options; the most recently used is the last."""

    def __init__(self):
        self._programs: OrderedDict[Hashable, _Called] = OrderedDict()
        self._lock = threading.RLock()
        self._next = 0.0  # when use may be measured again, in seconds of `time.perf_counter`
        self._left: dict[Callable, int] = {mappings: 0, memory: 0}  # what freeing left, of each
        self._warned = False
        self._texts: dict[Hashable, str | None] = {}  # of programs whose content was not seen
        self._held: list[Function] = []  # the last of these, so that what was compiled of them stays

    def __len__(self) -> int:
        return len(self._programs)

    def __content__(self) -> tuple[str, tuple]:
        """For `content.py`: which programs there are decides nothing of what they compute."""
        return "programs", ()

    def call(self, function: Callable, optimize: bool, args: tuple[PyTree, ...], kwargs: dict[str, PyTree]) -> PyTree:
        """Calls `function(*args, **kwargs)` through the program compiled at the first call of this kind."""
        call, arrays = _call_of(function, args, kwargs)
        found = content(call.function, call.structure, call.static)
        # By content rather than by the object: a law that is defined again in a notebook's cell is the same law, and
        # one that reads a global which has changed is another.
        key = found.digest, optimize, call.types, call.around
        if found.unseen:
            return self._called_unseen(call, key, optimize, arrays, found.unseen)
        return self._run(key, self._program(key, call, optimize), call, arrays)

    def _program(self, key: tuple[str, bool, Hashable, Hashable], call: Call, optimize: bool) -> _Called:
        with self._lock:
            program = self._programs.get(key)
            if program is None:
                self.make_room()
                why = reason(call, [one.call for one in self._programs.values()])
                program = self._programs[key] = _Called(call, why, optimize, _identity(key[0]))
            self._programs.move_to_end(key)
            return program

    def _run(self, key: Hashable, program: _Called, call: Call, arrays: list[Array]) -> PyTree:
        with self._lock:
            program.calls += 1
        try:
            outcome = program.function(_flat(call), arrays)
        finally:
            with self._lock:
                program.calls -= 1
        if not is_traced(arrays) and is_traced(jax.tree.leaves(outcome)):
            # The function closed over a traced value, which is another one at the next call.
            with self._lock:
                self._programs.pop(key, program).function.clear()
        return outcome

    def looped(self, function: Callable[_P, _T], optimize: bool = False) -> Callable[_P, _T]:
        """The function for a loop of calls, compiled as by `call`, with what it reads as it is at the first call of
        each kind: the calls that follow do not look at it again. Hold it no longer than the loop lasts."""
        known: dict[Hashable, tuple[Hashable, _Called]] = {}

        @functools.wraps(function)
        def called(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            call, arrays = _call_of(function, args, kwargs)
            # Types count beside values: 1, 1.0 and True are equal, and are not the same static argument.
            kind = call.structure, call.static, tuple(map(type, call.static)), call.types, call.around
            if kind not in known:
                found = content(call.function, call.structure, call.static)
                key = found.digest, optimize, call.types, call.around
                why = "it belongs to one loop, as nothing tells what it reads"
                known[kind] = (
                    key,
                    (_Called(call, why, optimize, None) if found.unseen else self._program(key, call, optimize)),
                )
            return self._run(*known[kind], call, arrays)

        return called

    def _called_unseen(
        self, call: Call, key: Hashable, optimize: bool, arrays: list[Array], unseen: tuple[str, ...]
    ) -> PyTree:
        """Calls a function whose content is not seen: it is traced, and what is compiled serves as long as its text
        stays the same. Says so where it does not."""
        name = getattr(call.function, "__name__", "run")
        program = Function(name, f"nothing tells whether it has changed: it reads {unseen[0]}", optimize)
        outcome = program(_flat(call), arrays)
        with self._lock:
            if len(self._texts) > MOST_TEXTS:
                self._texts.clear()
            before = self._texts.get(key)
            self._texts[key] = program.text
            self._held.append(program)
            del self._held[:-COUNT]
        if before is not None and program.text is not None and before != program.text:
            warnings.warn(_changing(unseen), RuntimeWarning, stacklevel=4)
        return outcome

    def clear(self) -> None:
        """Drops all programs that are not running."""
        with self._lock:
            self._let_go(len(self))
            self._held.clear()

    def make_room(self) -> None:
        """Drops programs if they use too much of the machine. Called before a program is compiled."""
        with self._lock:
            start = time.perf_counter()
            if start < self._next:
                return
            use = mappings()
            took = time.perf_counter() - start
            if use is None:
                self._let_go(len(self) - COUNT)
            elif self._is_too_much(mappings, use):
                self._free_mappings()
            if self._is_too_much(memory, memory()):
                # Arrays of the user's may be what takes it, so half of the programs stay.
                self._let_go((len(self) + 1) // 2)
                self._after_freeing(memory)
            self._next = time.perf_counter() + PAUSE * took

    def _free_mappings(self) -> None:
        gc.collect()  # jitted functions that a user is done with often wait for it
        use = mappings()
        while use is not None and use.share > SHARE and self._let_go(max(len(self) // PART, 1)):
            use = mappings()
        if use is not None and use.share > FULL:
            if not self._warned:
                self._warned = True
                warnings.warn(_text(use), RuntimeWarning, stacklevel=2)
            jax.clear_caches()
        self._after_freeing(mappings)

    def _is_too_much(self, measure: Callable[[], Use | None], use: Use | None) -> bool:
        return use is not None and use.share > SHARE and use.used > self._left[measure] + AGAIN * use.allowed

    def _after_freeing(self, measure: Callable[[], Use | None]) -> None:
        gc.collect()
        return_memory()
        use = measure()
        self._left[measure] = 0 if use is None else use.used

    def _let_go(self, count: int) -> int:
        """Drops the `count` least recently used programs that are not running; returns how many were dropped."""
        # A program that runs in another thread, or further up the stack, must not be freed under it.
        idle = [key for key, program in self._programs.items() if not program.calls][: max(count, 0)]
        for key in idle:
            self._programs.pop(key).function.clear()
        return len(idle)


def _text(use: Use) -> str:
    return (
        f"the compiled programs of this process take {use.used:,} of the {use.allowed:,} memory mappings that Linux "
        "allows it (vm.max_map_count), beyond which it would crash. All of them are let go now, by jax.clear_caches(), "
        "and are compiled anew when they are called again. Use fewer distinct programs (jit one function of the "
        "parameters instead of one for each model or value), call jax.clear_caches() yourself where you are done with "
        "some, or raise the limit: sysctl -w vm.max_map_count=1000000"
    )


def _changing(unseen: tuple[str, ...]) -> str:
    return (
        f"a function computes something else than when it was called last, and is compiled anew: it reads "
        f"{', '.join(unseen[:3])}. What it reads is fixed when it is traced. Give it as a parameter, an input or an "
        "argument, so that it may change without a compilation"
    )


PROGRAMS = ProgramCache()


def compiled(function: Callable[_P, _T], optimize: bool = False) -> Callable[_P, _T]:
    """The function, compiled at the first call for each content, structure, static values and shapes. Programs are let
    go if there are more than the machine has room for.

    `optimize`: compile it with all optimizations, for what is called so often, or runs so long, that this pays.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return PROGRAMS.call(function, optimize, args, kwargs)

    return call
