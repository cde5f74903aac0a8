"""One compiled program, in two tiers: compiled quickly at first, and with all optimizations once that pays.

A program that is called once should not wait for optimizations, and one that runs for hours should not do without.
When the quick program's runs have taken as many processor seconds as the optimization is expected to take, a thread
compiles the optimized program, and later calls use it. This is the rule for renting or buying skis: whatever the
calls to come, the total is at most about twice that of the best choice (Karlin, Manasse, Rudolph & Sleator 1988,
Competitive snoopy caching, Algorithmica 3). The outcomes of both differ by rounding.
"""

import atexit
import contextlib
import functools
import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax import Array

from ..aliases import PyTree
from ..private_names import constants
from . import kept
from .compilations import Compilation, noted, timed
from .platform import platform
from .staging import is_traced

# XLA's older code generator for CPUs makes one kernel of what the newer one makes several, and LLVM leaves out its
# expensive passes. Compilation, run (processor seconds; jax 0.10.2): a rod on a pin 7.5 → 3.0 s, 0.6 → 0.9 ms; one
# thermal state 1.2 → 0.4 s, 0.1 ms both ways; its gradient 3.2 → 1.4 s, 0.1 ms both ways.
QUICK: dict[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
OPTIMIZED = 2.5  # times what the quick compilation took (measured above)


@functools.cache
def _chosen_by_the_user() -> bool:
    """True if `XLA_FLAGS` says how much to optimize: then programs are compiled in that way only."""
    return any(f"--{name}" in os.environ.get("XLA_FLAGS", "") for name in QUICK)


def quick() -> dict[str, Any]:
    """Compiler options of the quick tier; none on other processors."""
    return QUICK if platform() == "cpu" and not _chosen_by_the_user() and not _REFUSED else {}


_REFUSED: list[Exception] = []  # what an XLA without these options said


class Program:
    """A function of a list of arrays that returns any pytree, compiled for the shapes of its first call.

    `arrays` are those of the first call; `why` says what made the program necessary. `runs_once` False: it is
    optimized at once. `stands_alone` False: it is not compiled, and cannot be called.
    """

    def __init__(self, function: Callable[..., PyTree], arrays: list[Array], name: str, why: str, runs_once: bool):
        self._name, self._why = name, why
        self._outcome: PyTree = None  # structure, and what is not an array

        def flat(arrays: list[Array]) -> list[Array]:
            leaves, structure = jax.tree.flatten(function(arrays))
            fixed = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
            self._outcome = structure, fixed, tuple(map(eqx.is_array, leaves))
            return [leaf for leaf in leaves if eqx.is_array(leaf)]

        flat.__name__ = flat.__qualname__ = name  # what profiles and errors show
        with timed() as traced:
            stage = jax.jit(flat).trace(arrays)
        with timed() as lowered:
            self._lowered: Any = stage.lower()
            text = self._lowered.as_text().encode()
        # Python is called from it, or it needs a value that is traced around it.
        self.stands_alone = kept.CALLBACK not in text and not is_traced(constants(stage))
        if not self.stands_alone:
            return
        self._times = traced[0], lowered[0]
        self._spent, self._switching = 0.0, False
        self._lock = threading.Lock()
        self._key = kept.key(text)
        self._cost = 0.0
        on_cpu = all(device.platform == "cpu" for a in arrays for device in a.devices())
        options = quick() if runs_once and on_cpu else {}
        # What an earlier process has optimized is as good as new.
        run = self._loaded({}, arrays)
        if run is not None:
            options = {}
        elif options:
            run = self._loaded(options, arrays)
        self._doubted = None if run is None else options
        if run is None:
            run, options = self._compiled(options)
        self._run = run
        self._arrays = [jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=a.sharding) for a in arrays]
        if not options and self._doubted is None:
            self._lowered = None

    def _loaded(self, options: dict[str, Any], arrays: list[Any]) -> Callable[..., PyTree] | None:
        """The executable that an earlier process has kept; None if there is none."""
        with timed() as spent:
            found = kept.load(self._key, options, self._lowered, arrays)
        if found is None:
            return None
        self._note("loaded", spent[0])
        run, self._cost = found
        return run

    def _compiled(self, options: dict[str, Any]) -> tuple[Callable[..., Any], dict[str, Any]]:
        """The executable, and the options with which it was made."""
        with timed() as spent:
            try:
                run = self._lowered.compile(compiler_options=options or None)
            except Exception as error:  # JAX promises no type of error for an XLA without an option
                if not options or "option" not in str(error):
                    raise
                _REFUSED.append(error)
                options = {}
                run = self._lowered.compile()
        self._note("quick" if options else "optimized", spent[0])
        self._cost = spent[0]
        kept.save(self._key, options, run, spent[0])
        return run, options

    def _note(self, how: str, seconds: float) -> None:
        noted(Compilation(self._name, how, self._why, *self._times, seconds))
        self._times = 0.0, 0.0  # counted once

    def __call__(self, arrays: list[Any]) -> PyTree:
        if self._doubted is not None:
            found = self._first_run(arrays)
        elif self._lowered is None:
            found = self._run(arrays)
        else:
            begin = time.process_time()
            found = jax.block_until_ready(self._run(arrays))
            self._spent += time.process_time() - begin
            self._reconsider()
        structure, fixed, is_array = self._outcome
        rest = iter(found)
        return jax.tree.unflatten(
            structure, [next(rest) if a else leaf for a, leaf in zip(is_array, fixed, strict=True)]
        )

    def _first_run(self, arrays: list[Array]) -> PyTree:
        """The first run of an executable that was read: one that does not run is compiled anew."""
        options, self._doubted = self._doubted, None
        try:
            return jax.block_until_ready(self._run(arrays))
        except jax.errors.JaxRuntimeError:
            self._run, options = self._compiled(options or {})
            return self._run(arrays)
        finally:
            if not options:
                self._lowered = None

    def _reconsider(self) -> None:
        """Starts a thread that compiles the optimized program, if the runs have taken as long as this would."""
        with self._lock:
            if self._switching or self._spent < OPTIMIZED * self._cost:
                return
            self._switching = True
        _start(self._optimize)

    def _optimize(self) -> None:
        lowered = self._lowered
        if lowered is None:
            return
        with contextlib.suppress(Exception):  # of memory that is short: the quick program goes on
            self._run = self._loaded({}, self._arrays) or self._compiled({})[0]
        self._lowered = None


_THREADS: "weakref.WeakSet[threading.Thread]" = weakref.WeakSet()
_LEAVING = threading.Event()


def _start(work: Callable[[], None]) -> None:
    """Does the work in another thread, unless the interpreter is about to leave."""
    if _LEAVING.is_set():
        return
    thread = threading.Thread(target=work, name="jaxonomy_dae: optimize", daemon=True)
    _THREADS.add(thread)
    thread.start()


@atexit.register
def _leave() -> None:
    """Waits for a compilation that is under way: XLA must not be taken away from it. It began after its program had run
    for as long."""
    _LEAVING.set()
    for thread in list(_THREADS):
        thread.join()
