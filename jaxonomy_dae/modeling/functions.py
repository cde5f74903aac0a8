"""JAX functions that stand in equations as they are."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


class OfScalars(eqx.Module):
    """A function of scalars as a function of one vector, u ↦ (outputs,); the arrays it holds are leaves."""

    function: Any

    def __call__(self, u: Any) -> Any:
        return jnp.atleast_1d(jnp.asarray(self.function(*u)))


def of_scalars(function: Any) -> OfScalars:
    """`function(x, y, …) -> scalar or (outputs,)` as a module; NumPy arrays in it become JAX arrays."""
    return OfScalars(jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, function))
