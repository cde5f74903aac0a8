"""JAX functions that stand in equations as they are."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


def _on_device(leaf: Any) -> Any:
    """A NumPy array as one of JAX; with its type, for which `asarray` compiles no program."""
    return jnp.asarray(leaf, jnp.result_type(leaf.dtype)) if isinstance(leaf, np.ndarray) else leaf


class OfScalars(eqx.Module):
    """A function of scalars as a function of one vector, u ↦ (outputs,); the arrays it holds are leaves."""

    function: Any

    def __call__(self, u: Any) -> Any:
        return jnp.atleast_1d(jnp.asarray(self.function(*u)))


def of_scalars(function: Any) -> OfScalars:
    """`function(x, y, …) -> scalar or (outputs,)` as a module; NumPy arrays in it become JAX arrays."""
    return OfScalars(jax.tree.map(_on_device, function))
