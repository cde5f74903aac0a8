"""Towards an equilibrium along the trajectory that leads to it.

Where a saturation holds everything back, slopes do not depend on the states: no Newton step leads away. Implicit Euler
steps of growing length do (pseudo-transient continuation, Kelley & Keyes 1998). One Newton step is taken for each, and
the step is shortened where that does not solve its equation, as where it would jump over the range in which a
controller is not saturated.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..solve.linear.dense import least_squares

STEPS = 200  # from a hundredth of the fastest time constant, three times as long each, they pass thirty decades
LONGER, SHORTER = 3.0, 0.25
# A step is kept if its Newton step has left at most this part of the slope in the step's equation.
LEFT = 0.5
# Relative to slopes at the start. From slopes so small on, Newton's method does the rest.
NEAR = 1e-3


def pseudo_transient(
    function: Callable[[Array], Array], mass: Float[Array, " n"], start: Float[Array, " n"], unit: Float[Array, " n"]
) -> Float[Array, " n"]:
    """A point near the equilibrium of mass·dx/dt = F(x) that a start leads to, or where the steps end; `unit` are sizes
    of the unknowns."""

    def scaled(w):
        return function(w * unit)

    def slopes(w):
        return jax.jacfwd(lambda w: (scaled(w),) * 2, has_aux=True)(w)

    def sizes(jacobian, value):
        # Rows have units of their own. In units of what its terms can change by, each counts alike.
        size = jnp.sum(jnp.abs(jacobian), axis=1) + jnp.abs(value)
        return jnp.where(size > 0, size, 1)

    inertia = mass * unit
    w = start / unit
    jacobian, value = slopes(w)
    fastest = jnp.max(jnp.where(inertia > 0, sizes(jacobian, value) / jnp.where(inertia > 0, inertia, 1), 0))
    first = jnp.max(jnp.abs(value) / sizes(jacobian, value))

    def goes_on(carry):
        count, _, _, left = carry
        return (count < STEPS) & (left > NEAR * first)

    def step(carry):
        count, w, h, left = carry
        jacobian, value = slopes(w)
        size = sizes(jacobian, value)
        matrix = (jnp.diag(inertia / h) - jacobian) / size[:, None]
        change = least_squares(matrix, value / size)
        after = scaled(w + change)
        off = jnp.max(jnp.abs(inertia * change / h - after) / size)
        now = jnp.max(jnp.abs(value) / size)
        # `off` is what is left of the implicit Euler equation after its one Newton step.
        fine = jnp.isfinite(off) & (off <= LEFT * now)
        # A step that is not kept is tried again, shorter, from the same point.
        w = jnp.where(fine, w + change, w)
        left = jnp.where(fine, jnp.max(jnp.abs(after) / size), left)
        return count + 1, w, h * jnp.where(fine, LONGER, SHORTER), left

    begin = jnp.array(0), w, 0.01 / jnp.where(fastest > 0, fastest, 1), first
    return jax.lax.while_loop(goes_on, step, begin)[1] * unit
