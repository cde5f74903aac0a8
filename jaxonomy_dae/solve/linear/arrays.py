"""One source for NumPy and JAX: where values are known, a search runs in NumPy, and nothing of it is compiled."""

from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.linalg.blas import get_blas_funcs

_S = TypeVar("_S")
Numbers = jax.Array | np.ndarray
Scalar = float | jax.Array  # a number that is known while a program is traced, or an array
Verdict = Numbers | np.bool_  # true or false


def namespace(x: object) -> ModuleType:
    """`numpy` for its own arrays and numbers, `jax.numpy` for all others."""
    return np if isinstance(x, np.ndarray | np.generic) else jnp


def where(condition: ArrayLike, a: ArrayLike, b: ArrayLike) -> Any:
    """a where the condition holds, b elsewhere; one of the two itself if the condition is one known value."""
    if not isinstance(condition, jax.Array) and np.ndim(condition) == 0:
        return a if condition else b
    return (jnp if any(isinstance(v, jax.Array) for v in (condition, a, b)) else np).where(condition, a, b)


def triangular(r: Numbers, right: Numbers) -> Numbers:
    """R⁻¹ b for an upper triangular R, what is below its diagonal not being read; not finite where R is singular."""
    if namespace(r) is jnp:
        return jax.scipy.linalg.solve_triangular(r, right)
    # SciPy's `solve_triangular` raises an error for a zero on the diagonal; BLAS divides by it.
    trsm: Any = get_blas_funcs("trsm", (r, right))
    return trsm(1.0, r, right)


def loop(going: Callable[[_S], Verdict], body: Callable[[_S], _S], state: _S) -> _S:
    """`jax.lax.while_loop`, or a loop of Python over NumPy's arrays.

    XLA compiles a kernel for each array that a loop carries, and each computes anew what several need: in programs,
    all numbers are carried as one array, and all arrays of one shape. A search of 2 unknowns compiles in 1.9 s like
    this, in 2.1 s otherwise.
    """
    leaves, structure = jax.tree.flatten(state)
    if namespace(leaves[0]) is np:
        while going(state):
            state = body(state)
        return state
    # Flags and counts travel as numbers of this dtype, which are exact up to 2²⁴ in single precision.
    dtype = jnp.result_type(*(leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)))
    places: dict[tuple[int, ...], list[int]] = {}
    for k, leaf in enumerate(leaves):
        places.setdefault(leaf.shape, []).append(k)

    def packed(state: _S) -> list[jax.Array]:
        new = [jnp.asarray(leaf, dtype) for leaf in jax.tree.leaves(state)]
        return [(jnp.stack if shape else _joined)([new[k] for k in chosen]) for shape, chosen in places.items()]

    def unpacked(arrays: list[jax.Array]) -> _S:
        out = list(leaves)
        for array, chosen in zip(arrays, places.values(), strict=True):
            for row, k in enumerate(chosen):
                out[k] = array[row].astype(leaves[k].dtype)
        return jax.tree.unflatten(structure, out)

    return unpacked(
        jax.lax.while_loop(lambda s: going(unpacked(s)), lambda s: packed(body(unpacked(s))), packed(state))
    )


def _joined(numbers: list[jax.Array]) -> jax.Array:
    """Numbers as one array, by selects: unlike a stack, these become one kernel."""
    place, out = np.arange(len(numbers)), jnp.broadcast_to(numbers[0], (len(numbers),))
    for k, number in enumerate(numbers[1:], 1):
        out = jnp.where(place == k, number, out)
    return out
