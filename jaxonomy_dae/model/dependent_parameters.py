"""Parameters that are expressions in others: computed, level by level, from those that are set."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from .tables import DependentParameters


def complete(dependents: Sequence[DependentParameters], array: Any) -> Any:
    """All parameters, shape (*batch, n), with the dependent ones computed from the others; NumPy or JAX."""
    for group in dependents:
        given = [array[..., column] for column in group.parameter.T]
        if isinstance(array, np.ndarray):
            array = array.copy()
            with np.errstate(all="ignore"):  # what is not finite is named by those who call
                array[..., group.target] = group.template.residual([], given, [], 0.0, None, backend="numpy")
        else:
            value = group.template.residual([], given, [], 0.0, None)
            array = array.at[..., group.target].set(jnp.asarray(value, array.dtype))
    return array
