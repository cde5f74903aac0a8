"""Values that XLA computes once.

A kernel for CPUs computes anew what it reads, if that is cheap, and what that reads again: sums of products that many
outputs share, exponentially often. What a call returns that XLA does not take apart is computed once.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

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
    return list(_in_batches.bind(*values, way=_EACH)) if in_batches_only else _once(values)


def _once(values: Sequence[Any]) -> list[Any]:
    rows = stacked(values)
    return [rows[k] for k in range(len(values))]


def once_in_batches(vector: Any) -> Any:
    """The vector; in a batch it is computed once, and each entry lies together for all members: its readers read
    entries, and XLA would add these up anew for each of them, across the members."""
    return _in_batches.bind(vector, way=_VECTOR)[0]


def stacked_in_batches(values: Sequence[Any]) -> Any:
    """Scalars as a vector. In a batch each is computed by a loop of its own: XLA would compute all within the one that
    puts them together, anew for each of them and without vector instructions, which took five times as long for
    10,000 pendulums."""
    dtype = jnp.result_type(*values)
    return _in_batches.bind(*(jnp.asarray(value, dtype) for value in values), way=_STACK)[0]


class _Way(NamedTuple):
    """A linear function: of arrays, and of arrays that all have the batch in front."""

    name: str
    alone: Callable[[Sequence[Any]], list[Any]]
    batched: Callable[[Sequence[Any]], list[Any]]


_EACH = _Way("each", list, _once)
_VECTOR = _Way("vector", list, lambda values: [joined([values[0].T]).T])
_STACK = _Way("stack", lambda values: [jnp.stack(values)], lambda values: [stacked(values).T])

# A primitive, not a `jax.custom_batching.custom_vmap` function. JAX cannot batch the derivative of one (jax 0.10.2: it
# batches twice what only the tangents have in batches), and forgets, when it takes a gradient, rules of `custom_jvp` by
# which one could help oneself: the Hessian of a steady state failed.
_in_batches = Primitive("in_batches")
_in_batches.multiple_results = True


@_in_batches.def_impl
def _(*values: Any, way: _Way) -> list[Any]:
    return way.alone(values)


@_in_batches.def_abstract_eval
def _(*values: Any, way: _Way) -> list[Any]:
    if way is _STACK:
        return [ShapedArray((len(values), *values[0].shape), values[0].dtype)]
    return [ShapedArray(value.shape, value.dtype) for value in values]


def _batched(values: Sequence[Any], axes: Sequence[Any], *, way: _Way) -> tuple[list[Any], list[int]]:
    size = next(v.shape[axis] for v, axis in zip(values, axes, strict=True) if axis is not None)
    spread = [
        jnp.broadcast_to(v, (size, *v.shape)) if axis is None else jnp.moveaxis(v, axis, 0)
        for v, axis in zip(values, axes, strict=True)
    ]
    found = way.batched(spread)
    return found, [0] * len(found)


def _derivative(values: Sequence[Any], tangents: Sequence[Any], *, way: _Way) -> tuple[list[Any], list[Any]]:
    return _in_batches.bind(*values, way=way), way.alone([ad.instantiate_zeros(tangent) for tangent in tangents])


batching.primitive_batchers[_in_batches] = _batched
ad.primitive_jvps[_in_batches] = _derivative
mlir.register_lowering(_in_batches, mlir.lower_fun(lambda *values, way: way.alone(values), multiple_results=True))


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
