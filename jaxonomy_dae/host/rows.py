"""Rows of any number: filled up to few different numbers, so that records of different lengths share a program; and
evaluated in blocks that fit into memory."""

from collections.abc import Callable

import jax
import numpy as np
from jax import Array

from ..base.aliases import PyTree
from .staging import on_device

DOUBLED = 1024  # up to so many, the next power of two: what more rows cost is nothing beside a compilation
PARTS = 8  # of each doubling beyond, so that at most an eighth is computed in vain


def size_for(n: int) -> int:
    """The number of rows to which n are filled up."""
    doubled = 1 << max(n - 1, 0).bit_length()
    if doubled <= DOUBLED:
        return doubled
    # `doubled // 2` is the last power of two below n.
    part = doubled // 2 // PARTS
    return -(-n // part) * part


def filled_up(rows: PyTree) -> PyTree:
    """Arrays with one length, filled up with copies of the last row, outside of jit."""

    def filled(array: Array) -> Array:
        values = np.asarray(array)
        more = size_for(len(values)) - len(values)
        # Copies of the last row rather than zeros: they are times inside the run, and cost no step.
        return on_device(np.concatenate([values, np.repeat(values[-1:], more, axis=0)])) if more else array

    return jax.tree.map(filled, rows)


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
