"""Values that XLA computes once.

A kernel for CPUs computes anew what it reads, if that is cheap, and what that reads again: sums of products that many
outputs share, exponentially often. What a call returns that XLA does not take apart is computed once.

Functions with a `custom_vmap` that are differentiated have one argument, and return what is not batched as such. JAX
(0.10.2) batches twice what only the tangents of one of several arguments have in batches; a `custom_jvp` around it does
not help within loops, where JAX forgets it when it takes a gradient: Hessians of steady states failed.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ...base.private_names import MissingName, private
from ...host.platform import platform


def joined(parts: Sequence[Any]) -> Any:
    """The concatenation of arrays, computed once."""
    return _called(_concatenation, parts)


def stacked(rows: Sequence[Any]) -> Any:
    """Arrays of one shape as the rows of one, computed once."""
    return _called(_stack, rows)


def once(values: Sequence[Any], in_batches_only: bool = False) -> list[Any]:
    """Arrays of one shape, computed once; perhaps only if they are batched: to read them back costs time, too, more
    than a few scalars do."""
    return _once_in_batches(list(values)) if in_batches_only else _once(values)


def _once(values: Sequence[Any]) -> list[Any]:
    rows = stacked(values)
    return [rows[k] for k in range(len(values))]


@jax.custom_batching.custom_vmap
def _once_in_batches(values):
    return values


@_once_in_batches.def_vmap
def _(size, batched, values):
    (batched,) = batched
    if not any(batched):
        return values, batched
    values = [v if b else jnp.broadcast_to(v, (size, *v.shape)) for v, b in zip(values, batched, strict=True)]
    return _once(values), [True] * len(values)


@jax.custom_jvp
def once_in_batches(vector: Any) -> Any:
    """The vector; in a batch it is computed once, and each entry lies together for all members: its readers read
    entries, and XLA would add these up anew for each of them, across the members."""
    return _together(vector)


@once_in_batches.defjvp
def _(primals, tangents):
    return once_in_batches(*primals), *tangents  # JAX has no transpose of a `custom_vmap` function


@jax.custom_batching.custom_vmap
def _together(vector):
    return vector


@_together.def_vmap
def _(size, batched, vector):
    del size
    return (joined([vector.T]).T, True) if batched[0] else (vector, False)


@jax.custom_jvp
def stacked_in_batches(values: list[Any]) -> Any:
    """Scalars as a vector. In a batch each is computed by a loop of its own: XLA would compute all within the one that
    puts them together, anew for each of them and without vector instructions, which took five times as long for
    10,000 pendulums."""
    return jnp.stack([_apart(value) for value in values])


@stacked_in_batches.defjvp
def _(primals, tangents):
    return stacked_in_batches(*primals), jnp.stack(tangents[0])


@jax.custom_batching.custom_vmap
def _apart(value):
    return value


@_apart.def_vmap
def _(size, batched, value):
    del size
    return (stacked([value])[0], True) if batched[0] else (value, False)


@jax.jit
def _concatenation(*parts: Any) -> Any:
    return jnp.concatenate(parts)


@jax.jit
def _stack(*rows: Any) -> Any:
    return jnp.stack(rows)


def _called(function: Any, parts: Sequence[Any]) -> Any:
    # XLA for GPUs takes a call that stays for a graph of commands.
    if platform() != "cpu":
        return function(*parts)
    try:
        mark = private("set_xla_metadata")
    except MissingName:
        return function(*parts)
    with mark(inlineable="false"):
        return function(*parts)
