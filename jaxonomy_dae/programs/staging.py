"""Whether what is computed now becomes part of a program that somebody else compiles."""

from typing import Any

import jax
from jax.core import Tracer


def is_staged(tree: Any) -> bool:
    """Whether a leaf has no value yet: inside `jax.jit`, loops, `jax.make_jaxpr`.

    Under `jax.grad`, `jax.jvp` and `jax.vmap` alone, outside of jit, leaves are tracers around arrays, and JAX would
    run each operation by itself: compiling a loop anew at every call. There a compiled program is called, which
    JAX differentiates or batches as a whole.
    """
    return any(isinstance(_inside(leaf), Tracer) for leaf in jax.tree.leaves(tree))


def _inside(leaf: Any) -> Any:
    """What differentiation and batching wrapped; a tracer of any other kind is left as it is."""
    while isinstance(leaf, Tracer):
        if hasattr(leaf, "primal"):  # JVPTracer, LinearizeTracer
            leaf = leaf.primal  # pyright: ignore[reportAttributeAccessIssue]
        elif hasattr(leaf, "batch_dim"):  # BatchTracer
            leaf = leaf.val  # pyright: ignore[reportAttributeAccessIssue]
        else:
            return leaf
    return leaf
