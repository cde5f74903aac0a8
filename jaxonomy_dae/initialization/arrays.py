"""One source for NumPy and JAX: where values are known, a search runs in NumPy, and nothing of it is compiled."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg.blas import get_blas_funcs

_S = TypeVar("_S")
Numbers = jax.Array | np.ndarray


def namespace(x: Any) -> Any:
    """`numpy` for its own arrays and numbers, `jax.numpy` for all others."""
    return np if isinstance(x, np.ndarray | np.generic) else jnp


def triangular(r: Any, right: Any) -> Any:
    """R⁻¹ b for an upper triangular R, what is below its diagonal not being read; not finite where R is singular."""
    if namespace(r) is jnp:
        return jax.scipy.linalg.solve_triangular(r, right)
    # SciPy's `solve_triangular` raises an error for a zero on the diagonal; BLAS divides by it.
    trsm: Any = get_blas_funcs("trsm", (r, right))
    return trsm(1.0, r, right)


def loop(going: Callable[[_S], Any], body: Callable[[_S], _S], state: _S) -> _S:
    """`jax.lax.while_loop`, or a loop of Python over NumPy's arrays."""
    if namespace(jax.tree.leaves(state)[0]) is jnp:
        return jax.lax.while_loop(going, body, state)
    while going(state):
        state = body(state)
    return state
