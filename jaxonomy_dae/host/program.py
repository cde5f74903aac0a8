"""One compiled program: compiled quickly, or with all optimizations, as its caller says beforehand.

A program that is called once should not wait for optimizations, and one that is called a thousand times should not do
without. Only the caller knows which it will be: runs outside of jit are compiled quickly, fits and trainings and what
`jax.jit` compiles with all optimizations. The outcomes of both differ by rounding, so a program stays what it is: the
same call has the same bits for ever, and no clock decides what numbers come out.
"""

import functools
import hashlib
import os
import weakref
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
from jax import Array

from ..base.aliases import PyTree
from ..base.private_names import constants
from . import kept
from .compilations import Compilation, noted, timed
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


@functools.cache
def _chosen_by_the_user() -> bool:
    """True if `XLA_FLAGS` says how much to optimize: then programs are compiled in that way only."""
    return any(f"--{name}" in os.environ.get("XLA_FLAGS", "") for name in QUICK)


def quick() -> kept.Options:
    """Compiler options of a quick compilation; none on other processors."""
    return QUICK | ONE_PART if platform() == "cpu" and not _chosen_by_the_user() and not _REFUSED else {}


_REFUSED: list[Exception] = []  # what an XLA without these options said


def types_of(arrays: Iterable[Array]) -> str:
    """All of arrays that a program is made for."""
    return repr([
        (a.shape, a.dtype.name, a.weak_type, sorted((d.platform, d.device_kind, d.id) for d in a.devices()))
        for a in arrays
    ])  # fmt: skip


class _Executable:
    """What XLA has made of a text; one for all programs of this text, as long as one of them is there."""

    def __init__(self, run: Callable[..., Any]):
        self.run = run


_EXECUTABLES: "weakref.WeakValueDictionary[str, _Executable]" = weakref.WeakValueDictionary()


class Program:
    """A function of a list of arrays that returns any pytree, compiled for the shapes of its first call.

    `function` and `arrays` are those of the first call; `why` says what made the program necessary. With `optimize`, it
    is compiled with all optimizations. `stands_alone` False: it is not compiled, and cannot be called. `identity`: a
    digest of what the function computes, the same in every process (`cache.py`), or None: an earlier process may have
    kept the program.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        arrays: list[Array],
        name: str,
        why: str,
        optimize: bool,
        identity: str | None = None,
    ):
        self._name, self._why = name, why
        self._outcome: PyTree = None  # structure, and what is not an array
        self._arrays = [
            jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=a.sharding, weak_type=a.weak_type) for a in arrays
        ]
        self._times = 0.0, 0.0
        self.stands_alone = True
        on_cpu = all(device.platform == "cpu" for a in arrays for device in a.devices())
        self._options = quick() if on_cpu and not optimize else {}
        known = None if identity is None else kept.key(f"{identity} {types_of(arrays)}")
        if self._recalled(known):
            return
        text, lowered = self._staged(function, arrays)
        if not self.stands_alone:
            return
        self.text = hashlib.sha256(text).hexdigest()
        if not self._read():
            self._take(self._compiled(lowered))
        if known is not None:
            kept.save_record(known, record(self.text, called(text), self._outcome))

    def _take(self, run: Callable[..., Any], doubted: bool = False) -> None:
        """Runs this executable from now on. One that was read may not run (`doubted`)."""
        self._executable, self._doubted = _Executable(run), doubted
        if not doubted:
            _EXECUTABLES[self._key] = self._executable

    @property
    def _key(self) -> str:
        return f"{self.text} {sorted(self._options.items())} {types_of_structs(self._arrays)}"

    def _staged(self, function: Callable[..., PyTree], arrays: list[Any]) -> tuple[bytes, Any]:
        """Traces and lowers the program; returns it as StableHLO, and as what compiles it."""

        def flat(arrays: list[Array]) -> list[Array]:
            leaves, structure = jax.tree.flatten(function(arrays))
            fixed = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
            self._outcome = structure, fixed, tuple(map(eqx.is_array, leaves))
            return [leaf for leaf in leaves if eqx.is_array(leaf)]

        flat.__name__ = flat.__qualname__ = self._name  # what profiles and errors show
        with timed() as traced:
            # With all arguments: of two programs that read different ones of equal types, the texts would be the same.
            stage = jax.jit(flat, keep_unused=True).trace(arrays)
        with timed() as spent:
            lowered = stage.lower()
            text = lowered.as_text().encode()
        # Python is called from it, or it needs a value that is traced around it.
        self.stands_alone = not kept.calls_python(text) and not is_traced(constants(stage))
        self._times = traced[0], spent[0]
        return text, lowered

    def _recalled(self, known: str | None) -> bool:
        """Reads what an earlier process knew of this program, and its executable. True if both are there."""
        content = kept.load_record(known)
        found = None if content is None else recalled(content)
        if found is None:
            return False
        with timed() as spent:
            self.text, calls, self._outcome = found
            known_calls = register(calls)
        self._times = spent[0], 0.0
        return known_calls and self._read()

    def restaged(self, function: Callable[..., PyTree]) -> PyTree:
        """Traces a program that was recalled. Returns its outcome (structure, and what is no array); None if it has
        become another program."""
        before = self._outcome
        text, _ = self._staged(function, [_unplaced(a) for a in self._arrays])
        outcome, self._outcome = self._outcome, before  # the calls to come return what those before did
        alike = self.stands_alone and hashlib.sha256(text).hexdigest() == self.text
        self.stands_alone = True
        return outcome if alike else None

    def _read(self) -> bool:
        """Takes the executable that another program of this process has, or that an earlier process has kept. True if
        there is one."""
        # Functions of different content may compute the same, and then have one text.
        there = _EXECUTABLES.get(self._key)
        if there is not None:
            self._executable, self._doubted = there, False
            return True
        with timed() as spent:
            run = kept.load(kept.key(self.text), self._options, sum(self._outcome[2]), self._arrays)
        if run is None:
            return False
        self._note("loaded", spent[0])
        self._take(run, doubted=True)
        return True

    def _compiled(self, lowered: Any) -> Callable[..., Any]:
        """The executable."""
        with timed() as spent:
            try:
                run = lowered.compile(compiler_options=self._options or None)
            except Exception as error:  # JAX promises no type of error for an XLA without an option
                if not self._options or "option" not in str(error):
                    raise
                _REFUSED.append(error)
                self._options = {}
                run = lowered.compile()
        self._note("quick" if self._options else "optimized", spent[0])
        kept.save(kept.key(self.text), self._options, run)
        return run

    def _note(self, how: str, seconds: float) -> None:
        noted(Compilation(self._name, how, self._why, *self._times, seconds))
        self._times = 0.0, 0.0  # counted once

    def __call__(self, arrays: list[Any], function: Callable[..., PyTree]) -> PyTree:
        """The outcome; `function` is traced again if an executable that was read does not run."""
        found = self._first_run(arrays, function) if self._doubted else self._executable.run(arrays)
        structure, fixed, is_array = self._outcome
        rest = iter(found)
        return jax.tree.unflatten(
            structure, [next(rest) if a else leaf for a, leaf in zip(is_array, fixed, strict=True)]
        )

    def _first_run(self, arrays: list[Array], function: Callable[..., PyTree]) -> list[Array]:
        """The first run of an executable that was read: one that does not run is compiled anew."""
        try:
            # An executable that was read may fail only when it runs. JAX returns before that, so the error is waited
            # for.
            found = jax.block_until_ready(self._executable.run(arrays))
        except jax.errors.JaxRuntimeError:
            text, lowered = self._staged(function, arrays)
            self.text = hashlib.sha256(text).hexdigest()
            self._take(self._compiled(lowered))
            return self._executable.run(arrays)
        self._take(self._executable.run)
        return found


def types_of_structs(arrays: Iterable[jax.ShapeDtypeStruct]) -> str:
    """As `types_of`, for structs that stand for arrays."""
    return repr([(a.shape, a.dtype.name, a.weak_type, str(a.sharding)) for a in arrays])


def _unplaced(array: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype, weak_type=array.weak_type)
