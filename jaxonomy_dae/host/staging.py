"""What tracers tell: whether what is computed now becomes part of a program that somebody else compiles, and how it
will be differentiated."""

from collections.abc import Hashable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike

from ..base.aliases import Numeric, PyTree


def is_traced(tree: PyTree) -> bool:
    """True if a leaf is a tracer: inside `jax.jit`, `jax.grad`, `jax.vmap` and the like."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def is_staged(tree: PyTree) -> bool:
    """True if a leaf has no value yet: inside `jax.jit`, loops, `jax.make_jaxpr`.

    Under `jax.grad`, `jax.jvp` and `jax.vmap` alone, outside of jit, leaves are tracers around arrays, and JAX would
    run each operation by itself: compiling a loop anew at every call. There a compiled program is called, which JAX
    differentiates or batches as a whole.
    """
    return any(isinstance([*layers(leaf)][-1], Tracer) for leaf in jax.tree.leaves(tree))


def as_array(value: Numeric) -> Numeric:
    """Numbers, or lists of numbers, as an array: of NumPy where values are known, so that nothing is compiled."""
    return jnp.asarray(value) if is_traced(value) else np.asarray(value)


def on_device(value: Numeric, dtype: DTypeLike | None = None) -> Numeric:
    """A number, or an array, as JAX' array of this type: where values are known, without a program that converts it."""
    # `jnp.asarray` compiles a program for each shape; `device_put` might share the memory of what it is given.
    return jnp.asarray(value, dtype) if is_traced(value) else jax.device_put(np.array(value, dtype))


def as_argument(value: Numeric, dtype: DTypeLike | None = None) -> Numeric:
    """A number, or an array, of this type for a program: a copy in NumPy where values are known. A program takes it in
    1 µs; to make JAX' array of it before, as `on_device` does, takes 19 (jax 0.10.2)."""
    return jnp.asarray(value, dtype) if is_traced(value) else np.array(value, dtype)


def picked(array: Numeric, place: Numeric) -> Numeric:
    """`array[place]`, by NumPy where values are known, so that nothing is compiled."""
    return array[place] if is_traced(array) else jax.device_put(np.array(np.asarray(array)[place]))


def joined(parts: Sequence[Numeric]) -> Numeric:
    """Arrays joined along their last axis, by NumPy where values are known, so that nothing is compiled."""
    if is_traced(parts):
        return jnp.concatenate(parts, axis=-1)
    return on_device(np.concatenate([np.asarray(part) for part in parts], axis=-1))


def is_forwards(tree: PyTree) -> bool:
    """True if `jax.jvp`, `jax.jacfwd` or `jax.linearize` is at work on a leaf, and no reverse mode.

    `jax.jit(jax.jacfwd(f))` is known for what it is; inside `jax.jacfwd(jax.jit(f))` it cannot be seen.
    """
    kinds = {kind(layer) for leaf in jax.tree.leaves(tree) for layer in layers(leaf)}
    return not kinds.isdisjoint({"JVPTracer", LINEARIZED}) and "LinearizeTracer" not in kinds


def is_reversed_outside(tree: PyTree) -> bool:
    """True if reverse mode is at work on a leaf around another differentiation, as in `jax.grad(jax.grad(f))` and
    `jax.grad(jax.jacfwd(f))`."""
    for leaf in jax.tree.leaves(tree):
        # The layer outside belongs to the differentiation inside, which began last.
        kinds = [k for k in map(kind, layers(leaf)) if k in ("JVPTracer", "LinearizeTracer", LINEARIZED)]
        if "LinearizeTracer" in kinds[1:]:
            return True
    return False


LINEARIZED = "jax.linearize"


def kind(layer: Any) -> str:
    """The class of a tracer; `LINEARIZED` for one of `jax.linearize`, whose result is evaluated forwards, though it is
    of the class that reverse mode has, too."""
    name = type(layer).__name__
    is_reverse = getattr(getattr(layer, "_trace", None), "is_vjp", True)
    return LINEARIZED if name == "LinearizeTracer" and not is_reverse else name


def trace_of(layer: Any) -> Hashable:
    """What tells the transformation that a tracer belongs to from others of its kind around it. If JAX does not say it,
    no two tracers belong to one."""
    trace = getattr(layer, "_trace", layer)
    return id(getattr(trace, "tag", trace))


def layers(leaf: PyTree) -> Iterator[Any]:
    """The leaf and the tracers inside it, from the outside in, as far as differentiation and batching have wrapped it;
    a tracer of another kind is the last."""
    yield leaf
    while isinstance(leaf, Tracer):
        if hasattr(leaf, "primal"):  # JVPTracer, LinearizeTracer
            leaf = leaf.primal  # pyright: ignore[reportAttributeAccessIssue]
        elif hasattr(leaf, "batch_dim"):  # BatchTracer
            leaf = leaf.val  # pyright: ignore[reportAttributeAccessIssue]
        else:
            return
        yield leaf
