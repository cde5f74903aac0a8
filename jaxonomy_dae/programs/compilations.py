"""A record of what was compiled outside of jit, why, and how long it took."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

MOST = 10_000  # records that are kept: 2 MB


class Compilation(NamedTuple):
    """One program that was compiled, or read from the folder of kept programs.

    - `name`: of the function; "gradient of run" is its transpose.
    - `how`: "quick", "optimized", or "loaded" from the folder.
    - `why`: what made the program necessary.
    - `traced`, `lowered`, `compiled`: processor seconds, all threads together.
    """

    name: str
    how: str
    why: str
    traced: float
    lowered: float
    compiled: float

    @property
    def seconds(self) -> float:
        """All processor seconds that the program took before it could run."""
        return self.traced + self.lowered + self.compiled


_RECORDS: list[Compilation] = []
_LOCK = threading.Lock()


def noted(compilation: Compilation) -> None:
    """Adds a record."""
    with _LOCK:
        _RECORDS.append(compilation)
        del _RECORDS[:-MOST]


def compilations() -> tuple[Compilation, ...]:
    """What this process compiled so far for calls outside of jit, in this order: names, reasons, processor seconds.

    `len(jaxonomy_dae.compilations())` before and after a call says how many programs the call needed. Not among them
    are programs of your own `jax.jit`, those of `jax.jvp` and `jax.jacfwd`, those that call Python, and operations of
    `jax.numpy` by themselves.
    """
    with _LOCK:
        return tuple(_RECORDS)


@contextmanager
def timed() -> Iterator[list[float]]:
    """Appends the processor seconds spent within it to the list."""
    spent: list[float] = []
    begin = time.process_time()
    try:
        yield spent
    finally:
        spent.append(time.process_time() - begin)
