"""One function at many times, in blocks that fit into memory."""

from collections.abc import Callable

import jax

from ..aliases import PyTree

ROOM = 2**21  # numbers that are computed at once on the way to those asked for: 16 MiB in double precision


def fit(n: int, width: int) -> bool:
    """True if `width` numbers at each of n times are few."""
    return n * width <= ROOM


def at_times(function: Callable[..., PyTree], *rows: PyTree, width: int) -> PyTree:
    """`function(*row)` for each row; `width` is how many numbers are computed on the way to each. At a few times of a
    small model all at once, else one block of times after another."""
    if fit(jax.tree.leaves(rows)[0].shape[0], width):
        return jax.vmap(function)(*rows)
    block = max(ROOM // max(width, 1), 1)
    return jax.lax.map(lambda row: function(*row), rows, batch_size=block)
