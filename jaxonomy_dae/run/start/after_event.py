"""The unknowns of nonlinear blocks after an event, found as a start is found.

An event may take an equation from one branch of its law to another, far from where its unknowns were: a valve shuts, a
pump is switched off. Where Newton's method does not arrive from there, the ladder of a start is climbed, with the point
before the event as its guess.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...compile.model.declared import quantity_bounds
from ...solve.linear.choice import DENSE_UPTO
from ..system.nonlinear import Refinement
from ..system.system_at import SystemAt
from .ladder import FAILED, find_root, looking
from .sizes import Sizes


def with_blocks_solved(at: SystemAt, x: Array) -> Array:
    """The state with unknowns of nonlinear blocks that solve their equations, the states as they are; not to be
    differentiated. What no search finds stays as it is."""
    plan = at.plan
    n, m = len(plan.states), len(plan.carried)
    if not m:
        return x
    solved = at.refined(x, Refinement.ROOT)
    # The ladder's algebra is dense, and takes too long for many unknowns.
    if m > DENSE_UPTO:
        return jnp.where(jnp.all(jnp.isfinite(solved)), solved, x)

    def residual(z: Array) -> Array:
        return at.carried_vector(at.t, jnp.append(x[:n], z))

    def magnitude(z: Array) -> Array:
        y = jnp.append(x[:n], z)
        return at.carried_magnitudes(y, jnp.maximum(jnp.abs(y), at.typical[np.append(plan.states, plan.carried)]))

    def climbed(state: tuple[Array, Array]) -> tuple[Array, Array]:
        typical, none = at.typical[plan.carried], jnp.zeros((m,), x.dtype)
        sizes = Sizes(none, jnp.maximum(jnp.abs(x[n:]), typical), none, none)
        found = find_root(
            looking(residual, magnitude), m, x[n:], sizes, np.arange(m),
            bounds=quantity_bounds(plan.model)[plan.carried], typical=typical,
        )  # fmt: skip
        return jnp.append(x[:n], jnp.where(found.method < FAILED, found.x, x[n:])), jnp.zeros((), bool)

    # A loop, not a branch, which would be taken for all members of a batch.
    lost = ~jnp.all(jnp.isfinite(solved))
    return jax.lax.while_loop(lambda state: state[1], climbed, (jnp.where(lost, x, solved), lost))[0]
