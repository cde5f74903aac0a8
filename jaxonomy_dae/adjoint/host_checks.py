"""Programs without the run-time checks that libraries write into them.

`equinox.error_if` puts a host callback into a program, and one callback is enough to keep it out of JAX's persistent
compilation cache and out of `jax.export`. Diffrax checks in this way that the times given are sorted and inside the
interval. Where the caller has checked that already, or asked for a result instead of an error (`throw=False`), the
program is traced inside `without_host_checks()`.
"""

import contextlib
import functools
import threading
from collections.abc import Iterator
from typing import Any

import diffrax
import jax
from jax.core import Tracer

from .private_names import equinox_errors

_lock = threading.Lock()
_here = threading.local()
_active = 0  # contexts entered, by all threads
_original: Any = equinox_errors.branched_error_if


class _Unchecked(diffrax.NoProgressMeter):
    """No progress meter. Its type keeps a solve without checks apart from the same solve with them in JAX's caches."""


def no_progress_meter() -> diffrax.AbstractProgressMeter:
    """What `diffeqsolve` is to be given where no progress is shown."""
    return _Unchecked() if getattr(_here, "depth", 0) else diffrax.NoProgressMeter()


@functools.wraps(_original)
def _unless_traced(x: Any, pred: Any, index: Any, msgs: Any, *, on_error: str = "default") -> Any:
    """Equinox' check, left out where it would have to wait until the program runs."""
    quiet = getattr(_here, "depth", 0) > 0 and on_error == "default"
    if quiet and any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((pred, index))):
        return x
    return _original(x, pred, index, msgs, on_error=on_error)


@contextlib.contextmanager
def without_host_checks(active: bool = True) -> Iterator[None]:
    """What this thread traces inside holds none of Equinox' run-time checks; errors that are known while tracing are
    raised as ever."""
    global _active
    if not active:
        yield
        return
    with _lock:
        _active += 1
        equinox_errors.branched_error_if = _unless_traced
    _here.depth = getattr(_here, "depth", 0) + 1
    try:
        yield
    finally:
        _here.depth -= 1
        with _lock:
            _active -= 1
            if not _active:
                equinox_errors.branched_error_if = _original
