"""Networks as the compiler sees them: their weights as arrays, and how many outputs they have."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..errors import ModelError
from .untraceable import why_untraceable


def as_weights(theta: Any) -> Any:
    """Weights as arrays: Python and NumPy numbers become JAX arrays, everything else stays."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf) if eqx.is_inexact_array_like(leaf) else leaf, theta)


def count_outputs(network: Callable, inputs: int, where: str, theta: Any = None, noun: str = "network") -> int:
    """The number of outputs of `network(u)` or `network(t, u, theta)`, found without computing anything; `noun` is what
    errors call it."""
    dtypes = [leaf.dtype for leaf in jax.tree.leaves((network, theta)) if eqx.is_inexact_array(leaf)]
    dtype = dtypes[0] if dtypes else jnp.result_type(float)
    u = jax.ShapeDtypeStruct((inputs,), dtype)
    try:
        if theta is None:
            out = eqx.filter_eval_shape(network, u)
        else:
            out = eqx.filter_eval_shape(network, jax.ShapeDtypeStruct((), dtype), u, theta)
    except Exception as error:
        if noun == "function":
            why = why_untraceable(error, "its input" if inputs == 1 else f"its {inputs} inputs", "x")
            raise ModelError(f"{where} {why}") from error
        signature = "network(u)" if theta is None else "network(t, u, theta)"
        why = why_untraceable(error, "its inputs", "u[0]")
        raise ModelError(f"{where}: calling {signature} with u of shape ({inputs},) failed: it {why}") from error
    if not (hasattr(out, "shape") and len(out.shape) == 1):
        found = getattr(out, "shape", type(out).__name__)
        scalar = "a scalar or " if noun == "function" else ""
        raise ModelError(f"{where}: the {noun} must return {scalar}a vector of shape (outputs,); got shape {found}")
    return out.shape[0]
