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
import hashlib
import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax import Array

from ..base.aliases import PyTree
from ..base.private_names import constants
from . import kept
from .compilations import Compilation, noted, timed
from .lasting import types_of
from .platform import platform
from .recalled import called, recalled, record, register
from .staging import is_traced

# XLA's older code generator for CPUs makes one kernel of what the newer one makes several, and LLVM leaves out its
# expensive passes. Compilation, run (processor seconds; jax 0.10.2): a rod on a pin 7.5 → 3.0 s, 0.6 → 0.9 ms; one
# thermal state 1.2 → 0.4 s, 0.1 ms both ways; its gradient 3.2 → 1.4 s, 0.1 ms both ways.
QUICK: kept.Options = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}
# LLVM gets a program in one part. In 32 parts, for as many threads, gradients take 10 to 20 % more processor seconds,
# and on two cores no less time by the clock: XLA's own passes, in one thread, are most of a quick compilation.
ONE_PART: kept.Options = {"xla_cpu_parallel_codegen_split_count": 1}
OPTIMIZED = 2.5  # times what the quick compilation took (measured above)


@functools.cache
def _chosen_by_the_user() -> bool:
    """True if `XLA_FLAGS` says how much to optimize: then programs are compiled in that way only."""
    return any(f"--{name}" in os.environ.get("XLA_FLAGS", "") for name in QUICK)


def quick() -> kept.Options:
    """Compiler options of the quick tier; none on other processors."""
    return QUICK | ONE_PART if platform() == "cpu" and not _chosen_by_the_user() and not _REFUSED else {}


_REFUSED: list[Exception] = []  # what an XLA without these options said


class Program:
    """A function of a list of arrays that returns any pytree, compiled for the shapes of its first call.

    `arrays` are those of the first call; `why` says what made the program necessary. `runs_once` False: it is
    optimized at once. `stands_alone` False: it is not compiled, and cannot be called. `identity`: a digest of what the
    function computes (`lasting.py`), or None: an earlier process may have kept the program.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        arrays: list[Array],
        name: str,
        why: str,
        runs_once: bool,
        identity: str | None = None,
    ):
        self._name, self._why = name, why
        self._outcome: PyTree = None  # structure, and what is not an array

        def flat(arrays: list[Array]) -> list[Array]:
            leaves, structure = jax.tree.flatten(function(arrays))
            fixed = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
            self._outcome = structure, fixed, tuple(map(eqx.is_array, leaves))
            return [leaf for leaf in leaves if eqx.is_array(leaf)]

        flat.__name__ = flat.__qualname__ = name  # what profiles and errors show
        self._flat = flat
        self._arrays = [
            jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=a.sharding, weak_type=a.weak_type) for a in arrays
        ]
        self._lowered: Any = None
        self._times = 0.0, 0.0
        self._spent, self._switching = 0.0, False
        self._lock = threading.Lock()
        self._cost = 0.0
        self.stands_alone = True
        on_cpu = all(device.platform == "cpu" for a in arrays for device in a.devices())
        # What an earlier process has optimized is as good as new.
        tiers = [{}, *([quick()] if runs_once and on_cpu and quick() else [])]
        known = None if identity is None else kept.key(f"{identity} {types_of(arrays)}")
        if self._recalled(known, tiers):
            return
        text = self._staged(arrays)
        if not self.stands_alone:
            return
        self._text = hashlib.sha256(text).hexdigest()
        if not self._read(tiers):
            self._take(*self._compiled(tiers[-1]))
        if known is not None:
            kept.save_record(known, record(self._text, called(text), self._outcome))

    def _take(self, run: Callable[..., Any], options: kept.Options, doubted: bool = False) -> None:
        """Runs this executable from now on. One that was read may not run (`doubted`)."""
        self._run, self._options, self._doubted = run, options, doubted
        if not options and not doubted:
            self._lowered = None  # nothing is left to be compiled

    def _staged(self, arrays: list[Any]) -> bytes:
        """Traces and lowers the program; returns it as StableHLO."""
        with timed() as traced:
            stage = jax.jit(self._flat).trace(arrays)
        with timed() as lowered:
            self._lowered = stage.lower()
            text = self._lowered.as_text().encode()
        # Python is called from it, or it needs a value that is traced around it.
        self.stands_alone = kept.CALLBACK not in text and not is_traced(constants(stage))
        self._times = traced[0], lowered[0]
        return text

    def _recalled(self, known: str | None, tiers: list[kept.Options]) -> bool:
        """Reads what an earlier process knew of this program, and its executable. True if both are there."""
        content = kept.load_record(known)
        found = None if content is None else recalled(content)
        if found is None:
            return False
        self._text, calls, self._outcome = found
        with timed() as spent:
            known_calls = register(calls)
        self._times = spent[0], 0.0
        return known_calls and self._read(tiers)

    def restaged(self) -> PyTree:
        """Traces a program that was recalled, so that it can be compiled. Returns its outcome (structure, and what is
        no array); None if it has become another program."""
        before = self._outcome
        text = self._staged([jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in self._arrays])
        outcome, self._outcome = self._outcome, before  # the calls to come return what those before did
        if self.stands_alone and hashlib.sha256(text).hexdigest() == self._text:
            return outcome
        self._lowered, self.stands_alone = None, True
        return None

    def _read(self, tiers: list[kept.Options]) -> bool:
        """Reads the best executable that an earlier process has kept. True if there is one."""
        for options in tiers:
            run = self._loaded(options)
            if run is not None:
                self._take(run, options, doubted=True)
                return True
        return False

    def _loaded(self, options: kept.Options) -> Callable[..., PyTree] | None:
        """The executable that an earlier process has kept; None if there is none."""
        with timed() as spent:
            found = kept.load(kept.key(self._text), options, sum(self._outcome[2]), self._arrays)
        if found is None:
            return None
        self._note("loaded", spent[0])
        run, self._cost = found
        return run

    def _compiled(self, options: kept.Options) -> tuple[Callable[..., Any], kept.Options]:
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
        kept.save(kept.key(self._text), options, run, spent[0])
        return run, options

    def _note(self, how: str, seconds: float) -> None:
        noted(Compilation(self._name, how, self._why, *self._times, seconds))
        self._times = 0.0, 0.0  # counted once

    def __call__(self, arrays: list[Any]) -> PyTree:
        if self._doubted:
            found = self._first_run(arrays)
        elif not self._options:
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
        try:
            found = jax.block_until_ready(self._run(arrays))
        except jax.errors.JaxRuntimeError:
            if self._lowered is None and self.restaged() is None:
                raise
            self._take(*self._compiled(self._options))
            return self._run(arrays)
        self._take(self._run, self._options)
        return found

    def _reconsider(self) -> None:
        """Starts a thread that compiles the optimized program, if the runs have taken as long as this would."""
        with self._lock:
            if self._switching or self._spent < OPTIMIZED * self._cost:
                return
            self._switching = True
        with contextlib.suppress(Exception):  # what cannot be traced any more stays as it is
            # Not in the thread, which does not have JAX's options of this one.
            if self._lowered is not None or self.restaged() is not None:
                _start(self._optimize)

    def _optimize(self) -> None:
        with contextlib.suppress(Exception):  # of memory that is short: the quick program goes on
            self._take(self._loaded({}) or self._compiled({})[0], {})
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
