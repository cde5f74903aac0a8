"""A record of what was compiled outside of jit, why, and how long it took."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

MOST = 10_000  # records that are kept: 2 MB


class Compilation(NamedTuple):
    """One program that was compiled, or read from the folder of kept programs.

    - `name`: the name of the function. "gradient of run" is the transposed program.
    - `how`: "quick", "optimized", or "loaded" from the folder; "refused" if a folder is not used, and `why` says why.
    - `why`: why the program was necessary.
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
    """The programs that this process has compiled so far for calls outside of jit, in this order, with their reasons
    and processor seconds.

    `len(jaxonomy_dae.compilations())` before and after a call says how many programs the call needed. The list leaves
    out programs of your own `jax.jit`, of `jax.jvp` and `jax.jacfwd`, programs that call Python, and single operations
    of `jax.numpy`.
    """
    with _LOCK:
        return tuple(_RECORDS)


@contextmanager
def timed() -> Iterator[list[float]]:
    """Appends the processor seconds spent within it to the list."""
    spent: list[float] = []
    # Processor time: a clock would count other processes, and waiting for them.
    begin = time.process_time()
    try:
        yield spent
    finally:
        spent.append(time.process_time() - begin)
