"""Programs compiled for calls with plain arrays, kept while there is room.

`equinox.filter_jit` keeps every program for ever, also those of models and functions that are gone: its cache refers
to the functions that it is looked up by. Here each program has a `filter_jit` of its own, which can be let go, with
the derivatives that JAX compiled of it.
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

from ..private_names import clear_jitted
from .machine import Use, mappings, memory, return_memory
from .platform import platform
from .staging import is_traced

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

# XLA's older code generator for CPUs makes one kernel of what the newer one makes several. Of the tutorial's pendulum,
# a program takes 290 mappings, 66 MB and 4.5 s instead of 802, 234 MB and 8.8 s; of a double pendulum 679, 196 MB and
# 18 s instead of 1,702, 476 MB and 27 s. It runs in the same time (4.4 ms a call), and 1.25 times as long (49 ms): what
# is saved is spent after some hundred calls. (jax 0.10.2, two cores.)
_QUICK = {"xla_cpu_use_fusion_emitters": False}


class _CompiledFunction:
    """A compiled function for certain static values; `calls` counts the calls that have not returned yet."""

    def __init__(self, function: Callable, runs_once: bool, structure: Any, static: tuple[Any, ...]):
        def run(arrays: list[Any]) -> Any:
            rest = iter(arrays)
            leaves = [next(rest) if leaf is _ARRAY else leaf for leaf in static]
            args, kwargs = jax.tree.unflatten(structure, leaves)
            return function(*args, **kwargs)

        run.__name__ = run.__qualname__ = getattr(function, "__name__", "run")  # what profiles and errors show
        self.calls = 0
        self._run = eqx.filter_jit(run)
        self._run_quick = self._run
        if runs_once and quick():
            self._run_quick = eqx.filter_jit(run, compiler_options=quick())  # pyright: ignore[reportCallIssue]

    def __call__(self, arrays: list[Any], traced: bool) -> Any:
        # JAX takes compiler options for whole programs only, not for what it differentiates, batches or makes a part of
        # another program: there the arguments are traced, or the outcome would be.
        if not traced:
            try:
                return self._run_quick(arrays)
            except ValueError as error:
                if "top-level" not in str(error):
                    raise
        return self._run(arrays)

    def clear(self) -> None:
        """Frees the compiled program, its derivatives by JAX included."""
        for run in (self._run, self._run_quick):
            clear_jitted(run)


_ARRAY = object()  # stands where an array was


class ProgramCache:
    """Programs by function, structure, static values, shapes and dtypes; the most recently used is the last."""

    def __init__(self):
        self._programs: OrderedDict[Hashable, _CompiledFunction] = OrderedDict()
        self._lock = threading.RLock()
        self._next = 0.0  # when use may be measured again, in seconds of `time.perf_counter`
        self._left: dict[Callable, int] = {mappings: 0, memory: 0}  # what freeing left, of each
        self._warned = False

    def __len__(self) -> int:
        return len(self._programs)

    def call(self, function: Callable, runs_once: bool, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Calls `function(*args, **kwargs)` through the program compiled at the first call of this kind."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        static = tuple(_ARRAY if eqx.is_array(leaf) else leaf for leaf in leaves)
        key = function, structure, static, tuple(jax.typeof(a) for a in arrays)
        traced = is_traced(arrays)
        with self._lock:
            program = self._programs.get(key)
            if program is None:
                self.make_room()
                program = self._programs[key] = _CompiledFunction(function, runs_once, structure, static)
            self._programs.move_to_end(key)
            program.calls += 1
        try:
            outcome = program(arrays, traced)
        finally:
            with self._lock:
                program.calls -= 1
        if not traced and is_traced(jax.tree.leaves(outcome)):
            # The function closed over a traced value, which is another one at the next call.
            with self._lock:
                self._programs.pop(key, program).clear()
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
            self._programs.pop(key).clear()
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

    `runs_once` says that a program's runs take less time than its compilation does: it is compiled quickly.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return PROGRAMS.call(function, runs_once, args, kwargs)

    return call


def quick() -> dict[str, bool]:
    """Options of `jax.jit` for a program of which compilation takes longer than its runs; none on other processors."""
    return _quick() if platform() == "cpu" else {}


@functools.cache
def _quick() -> dict[str, bool]:
    try:
        jax.jit(jnp.negative, compiler_options=_QUICK).lower(0.0).compile()
    except Exception:  # an XLA without the older code generator: JAX promises no type of error
        return {}
    return _QUICK
