"""Saved rows that the integration did not fill."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...base.aliases import Numeric, PyTree


def padded(
    ts: Float[Array, " n"], x: Float[Array, "n x"], steps: Numeric
) -> tuple[Float[Array, " n"], Float[Array, "n x"]]:
    """Replaces the rows beyond the steps taken by the last row, so that `[-1]` is the end, its derivatives included."""
    filled = jnp.arange(ts.shape[0]) <= steps
    return jnp.where(filled, ts, ts[steps]), jnp.where(filled[:, None], x, x[steps])


def not_a_number(x: Float[Array, "n x"], reached: Bool[Array, " n"], *sources: PyTree) -> Float[Array, "n x"]:
    """Sets the rows that were not reached to NaN, and the derivatives of these rows with respect to `sources`, too.

    Where such a row does not count (its cotangent is zero), as after `jnp.where(okay, loss, 0)`, derivatives are not
    touched.
    """
    leaves = [leaf for leaf in jax.tree.leaves(sources) if eqx.is_inexact_array(leaf)]
    total = sum((jnp.sum(leaf) for leaf in leaves), jnp.zeros((), x.dtype)).astype(x.dtype)
    # The function is linear, with factors that overflow. Backwards, a cotangent that is not zero becomes infinity minus
    # infinity, which is not a number, and one that is zero stays zero. The factors depend on data, so that no compiler
    # multiplies them beforehand.
    large = jnp.asarray(float(jnp.finfo(x.dtype).max) ** 0.7, x.dtype)
    one = jnp.ones((), x.dtype)
    factor, other = (jnp.where(jnp.all(reached), one, f * large) for f in (1, 2))
    moving = total - jax.lax.stop_gradient(total)
    nothing = moving * factor * factor * factor - moving * other * other * other
    return jnp.where(reached[:, None], x, nothing + jnp.nan)
