"""Dense least squares that also answers where a matrix leaves directions open."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..tolerances import ridge


def least_squares(matrix: Float[Array, "m n"], right: Float[Array, " m"]) -> Float[Array, " n"]:
    """The least-squares solution of A·x = b, rows equilibrated; near the one of least norm where A leaves directions
    open. Rows of zeros say nothing, whatever stands in b. Differentiable with respect to b alone."""
    m, n = matrix.shape
    largest = jnp.max(jnp.abs(matrix), axis=1, initial=0.0)
    empty = largest < float(jnp.finfo(matrix.dtype).tiny)
    scale = jnp.where(empty, 0, 1 / jnp.where(empty, 1, largest))
    held = jnp.asarray(ridge(matrix.dtype) * np.eye(n), matrix.dtype)
    stacked = jnp.concatenate([scale[:, None] * matrix, held])
    q, r = jnp.linalg.qr(jax.lax.stop_gradient(stacked))
    return jax.scipy.linalg.solve_triangular(r, q[:m].T @ (scale * right))
