"""Roots by a solver of the user's: any of Optimistix' root finders and least-squares solvers."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float

from ...base.errors import ModelError
from ...base.tolerances import solved
from ...solve.linear.dense import least_squares
from .ladder import FAILED, GIVEN, Found
from .sizes import Sizes, column_sizes, row_sizes, soft_weight, terms_of, weighed

MAX_STEPS = 1000  # of a solver of the user's, some of which take many cheap steps


def check_solver(solver: Any):
    """**Raises:** `ModelError` if this is not an Optimistix solver that can find roots."""
    if not isinstance(solver, optimistix.AbstractRootFinder | optimistix.AbstractLeastSquaresSolver):
        raise ModelError(
            "solver is an Optimistix root finder or least-squares solver, such as "
            f"optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8); got {solver!r}"
        )


def find_root_with(
    solver: Any,
    function: Callable[[Any], Any],
    start: Float[Array, " n"],
    sizes: Sizes,
    soft: Bool[np.ndarray, " m"],
    square: bool,
    magnitude: Callable[[Any], Any],
) -> Found:
    """Solves F(x) = 0 in units of the unknowns, every row divided by the size of its terms; one Newton step sharpens
    what the solver's tolerances leave.

    **Arguments:**

    - `square`: whether all rows, soft ones included, are as many as the unknowns and independent; else soft rows are
        weighed down, and a least-squares solver is needed.
    - `magnitude`: how large the terms of each row are, as for `find_root`.
    """

    def linearized(x):
        jacobian, value = jax.jacfwd(lambda y: (function(y),) * 2, has_aux=True)(x)
        return jax.lax.stop_gradient((value, jacobian))

    dtype = start.dtype
    value, jacobian = linearized(start)
    unit = column_sizes(terms_of(value, magnitude(start)), jacobian, sizes)
    largest = jnp.max(jnp.where(jnp.isfinite(jacobian), jnp.abs(jacobian * unit[None, :]), 0), axis=1, initial=0.0)
    weight = 1 / jnp.where(largest > 0, largest, 1)
    if not square:
        weight = weight * jnp.asarray(np.where(soft, soft_weight(dtype), 1.0), dtype)
    found = optimistix.root_find(
        lambda v, _: weight * function(v * unit), solver, start / unit, max_steps=MAX_STEPS, throw=False
    )
    x = jax.lax.stop_gradient(found.value) * unit
    value, jacobian = linearized(x)
    # A solver with loose tolerances ends short of a root, and what counts as one is not the user's to loosen.
    sharper = x - unit * least_squares(weight[:, None] * jacobian * unit[None, :], weight * value)
    x = jnp.where(jnp.all(jnp.isfinite(sharper)), sharper, x)
    value, jacobian = linearized(x)
    size, noise = row_sizes(weighed(jacobian), x, sizes, unit, magnitude(x))
    limit = solved(dtype) * size + noise
    holds = jnp.all((jnp.abs(value) <= limit) | jnp.asarray(soft & (not square)))
    method = jnp.where(holds, GIVEN, FAILED).astype(jnp.int32)
    return Found(x, jacobian, limit, unit, method, jnp.asarray(found.stats["num_steps"], jnp.int32))
