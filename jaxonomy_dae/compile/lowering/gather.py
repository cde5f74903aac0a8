"""Static gathers: how values that lie in several arrays come together as one.

Where every quantity lies is known when the system is compiled: in which chunk, at which offset. A gather is therefore
planned once, as the cheapest of a scalar read, a (strided) slice, a take, or a take from a concatenation.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...base.aliases import Numeric
from ...graph.structure.integers import distinct
from ...solve.linear.once import joined

Chunk = Any  # an array of shape (n,), a scalar, or a tuple of scalars


FEW = 256  # entries that are read as scalars together
# A gather takes so many operations beside one for each array that it reads. Values that come in no more pieces are
# sliced and joined instead.
GATHER = 2
SCALARS = 32  # up to this many states, or inputs, tracing is done on scalars


def entries(array: Numeric) -> list[Numeric]:
    """The entries of an array of shape (n,), as scalars. Backwards, their cotangents are joined; those of entries read
    one by one would be padded and summed, and XLA may compute each anew for every place of the sum."""
    n = array.shape[0]
    return [jnp.reshape(v, ()) for v in jax.lax.split(array, (1,) * n)] if n else []


def take(array: Numeric, index: np.ndarray) -> Numeric:
    """array[index] for a static index, as a slice where the index is an arithmetic progression."""
    n = len(index)
    if isinstance(array, tuple):
        if n == len(array) and np.array_equal(index, np.arange(n)):
            return jnp.stack(array)
        return jnp.stack([array[k] for k in index])
    if n == array.shape[0] and index[0] == 0 and np.array_equal(index, np.arange(n)):
        return array
    if n > 1:
        # A slice is cheaper than a gather, and its transpose is a pad rather than a scatter.
        step = int(index[1] - index[0])
        if step > 0 and np.array_equal(index, index[0] + step * np.arange(n)):
            return jax.lax.slice(array, (int(index[0]),), (int(index[-1]) + 1,), (step,))
    if n == 1:
        return jax.lax.slice(array, (int(index[0]),), (int(index[0]) + 1,))
    # The index is right as it is: XLA need not look whether it is.
    return jnp.asarray(array).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def times(factor: Numeric, value: Numeric) -> Numeric:
    """factor·value; nothing is multiplied by 1 or −1, if the factor is a Python number."""
    if isinstance(factor, float) and abs(factor) == 1.0:
        return value if factor > 0 else -value
    return factor * value


@dataclasses.dataclass(frozen=True)
class Gather:
    """n values, each times a factor. `chunk` −1 in all places is the constant zero."""

    chunk: np.ndarray
    offset: np.ndarray
    factor: np.ndarray

    def only(self, k: int) -> "Gather":
        """The gather of one of the values."""
        return Gather(self.chunk[k : k + 1], self.offset[k : k + 1], self.factor[k : k + 1])

    def read(self, chunks: list[Chunk], dtype) -> Numeric:
        """The values: a scalar if n is 1 (or a Python 0.0 where all are zero), else an array of shape (n,)."""
        n = len(self.chunk)
        if (self.chunk < 0).all():
            return 0.0
        if n == 1:
            value = _entry(chunks[self.chunk[0]], int(self.offset[0]))
            return times(float(self.factor[0]), value)
        if (self.chunk == self.chunk[0]).all():
            source = chunks[self.chunk[0]]
            value = source if _is_scalar(source) else take(source, self.offset)
        else:
            value = self._from_several(chunks, dtype)
        # One factor for all is a number of the program, and ±1 costs nothing.
        same = (self.factor == self.factor[0]).all()
        return times(float(self.factor[0]) if same else jnp.asarray(self.factor, dtype), value)

    def _from_several(self, chunks: list[Chunk], dtype) -> Numeric:
        breaks = np.flatnonzero((np.diff(self.chunk) != 0) | (np.diff(self.offset) != 1)) + 1
        used = distinct(self.chunk)
        # Values that come in few runs are sliced and joined. Concatenating all sources first costs their whole length.
        if len(breaks) < len(used) + GATHER:
            runs = np.split(np.arange(len(self.chunk)), breaks)
            return joined([self._run(chunks, run, dtype) for run in runs])
        parts, start, position = [], np.zeros(int(used.max()) + 2, np.int64), 0
        for c in used:
            part = jnp.zeros(1, dtype) if c < 0 else _as_vector(chunks[c])
            start[c] = position
            parts.append(part)
            position += part.shape[0]
        return take(joined(parts), start[self.chunk] + np.maximum(self.offset, 0))

    def _run(self, chunks: list[Chunk], run: np.ndarray, dtype) -> Numeric:
        """Values that lie beside each other, shape (len(run),)."""
        chunk, offset = int(self.chunk[run[0]]), self.offset[run]
        if chunk < 0:
            return jnp.zeros(len(run), dtype)
        source = chunks[chunk]
        return jnp.reshape(source, (-1,)) if _is_scalar(source) else take(source, offset)


NOTHING = Gather(*(np.zeros(0, np.int64),) * 3)


def _is_scalar(chunk: Chunk) -> bool:
    return not isinstance(chunk, tuple) and jnp.ndim(chunk) == 0


def _as_vector(chunk: Chunk) -> Numeric:
    if isinstance(chunk, tuple):
        return jnp.stack(chunk)
    return jnp.reshape(chunk, (-1,))


def _entry(chunk: Chunk, offset: int) -> Numeric:
    return chunk if _is_scalar(chunk) else chunk[offset]
