"""Dense factorizations of moderate size by one thread.

OpenBLAS, which NumPy and SciPy bring along, divides matrices of a few hundred rows among threads that wait for each
other by spinning. QR of 497 × 98 takes 2 ms of one processor, and 41 ms of two that other processes use as well: of a
fit of 97 weights that was two thirds of the time and more.
"""

import contextlib
import functools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

LARGE = 3e8  # multiplications beyond which threads are worth it, some 0.1 s of one


def one_thread(multiplications: float) -> contextlib.AbstractContextManager:
    """Within it, BLAS and LAPACK use one thread for work of this size; as many as ever where it is large."""
    return contextlib.nullcontext() if multiplications > LARGE else _controller().limit(limits=1, user_api="blas")


@functools.cache
def _controller() -> "ThreadpoolController":
    """The thread-pool controller of the libraries that are loaded, made once: the search takes milliseconds. Imported
    here, as the import changes the environment of the process."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
