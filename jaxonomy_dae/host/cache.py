"""Programs compiled for calls with plain arrays, kept while there is room.

`equinox.filter_jit` keeps every program for ever, also those of models and functions that are gone: its cache refers
to the functions that it is looked up by. Here each program can be dropped, with its derivatives and batches.
"""

import functools
import gc
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..base.aliases import PyTree
from .kept import folder
from .lasting import lasting
from .machine import Use, mappings, memory, return_memory
from .reasons import Place, reason
from .staging import is_traced
from .transformed import Function

# Of the mappings that Linux allows, and of the memory that this process could have. What is left must hold what is
# compiled until use is measured next: a gradient takes 800 (two states) to 4,500 mappings (double pendulum), 7 %.
SHARE = 0.5  # beyond which programs kept here go, the least recently used first
FULL = 0.75  # beyond which, with none left here to go, JAX's own caches are cleared
AGAIN = 0.125  # by which use must have grown since something was freed: programs in use must not push each other out
COUNT = 64  # programs kept where the system says nothing: 4 GB at the 66 MB of the tutorial's
PART = 4  # one of so many programs goes before use is measured again
PAUSE = 100  # a measurement takes some 2 µs for each mapping, up to 0.1 s; 1 % of the time may go into it

_P = ParamSpec("_P")
_T = TypeVar("_T")


class _Called:
    """A function for certain static values; `calls` counts the calls that have not returned yet."""

    def __init__(self, function: Callable, runs_once: bool, structure: Any, static: tuple[Any, ...], why: str):
        def run(arrays: list[Array]) -> PyTree:
            rest = iter(arrays)
            leaves = [next(rest) if leaf is Place.ARRAY else leaf for leaf in static]
            args, kwargs = jax.tree.unflatten(structure, leaves)
            return function(*args, **kwargs)

        self.calls = 0
        identity = None if folder() is None else lasting(function, structure, static)
        self.function = Function(run, getattr(function, "__name__", "run"), why, runs_once, identity)


def _surroundings(arrays: list[Array]) -> Hashable:
    """What else decides about a program: where its arrays lie, and JAX's options."""
    config: Any = jax.config
    where = frozenset(d for a in arrays if not is_traced(a) for d in a.devices())
    return (
        where, config.jax_default_device, config.jax_enable_x64, config.jax_default_matmul_precision,
        config.jax_numpy_dtype_promotion, config.jax_numpy_rank_promotion,
    )  # fmt: skip


class ProgramCache:
    """Programs by function, structure, static values, shapes and dtypes; the most recently used is the last."""

    def __init__(self):
        self._programs: OrderedDict[Hashable, _Called] = OrderedDict()
        self._lock = threading.RLock()
        self._next = 0.0  # when use may be measured again, in seconds of `time.perf_counter`
        self._left: dict[Callable, int] = {mappings: 0, memory: 0}  # what freeing left, of each
        self._warned = False

    def __len__(self) -> int:
        return len(self._programs)

    def call(self, function: Callable, runs_once: bool, args: tuple[PyTree, ...], kwargs: dict[str, PyTree]) -> PyTree:
        """Calls `function(*args, **kwargs)` through the program compiled at the first call of this kind."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        # Those of NumPy, such as weights of a user's, lie nowhere yet.
        arrays = [leaf if isinstance(leaf, jax.Array) else jnp.asarray(leaf) for leaf in leaves if eqx.is_array(leaf)]
        static = tuple(Place.ARRAY if eqx.is_array(leaf) else leaf for leaf in leaves)
        key = function, structure, static, tuple(jax.typeof(a) for a in arrays), _surroundings(arrays)
        with self._lock:
            program = self._programs.get(key)
            if program is None:
                self.make_room()
                why = reason(key, self._programs)
                program = self._programs[key] = _Called(function, runs_once, structure, static, why)
            self._programs.move_to_end(key)
            program.calls += 1
        try:
            outcome = program.function(arrays)
        finally:
            with self._lock:
                program.calls -= 1
        if not is_traced(arrays) and is_traced(jax.tree.leaves(outcome)):
            # The function closed over a traced value, which is another one at the next call.
            with self._lock:
                self._programs.pop(key, program).function.clear()
        return outcome

    def clear(self) -> None:
        """Drops all programs that are not running."""
        with self._lock:
            self._let_go(len(self))

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


PROGRAMS = ProgramCache()


def compiled(function: Callable[_P, _T], runs_once: bool = True) -> Callable[_P, _T]:
    """The function, compiled at the first call for each structure, static values and shapes, as by
    `equinox.filter_jit`. Programs are let go if there are more than the machine has room for.

    `runs_once` False says that its runs take more time than any compilation: it is optimized at once (`tiers.py`).
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return PROGRAMS.call(function, runs_once, args, kwargs)

    return call
