"""Hidden constraints that stop having a solution: a mechanism at the end of its reach, a value beyond the range of its
law.

A run that is projected onto hidden constraints stops there, because no step lands near the manifold. This module says
which equation it is, by following the vector field to times just beyond the last accepted one, and looking for a point
on the manifold from there.
"""

import jax
import jax.numpy as jnp
import numpy as np

from ...base.aliases import Inputs, PyTree, State, Time
from ...base.tolerances import solved
from ...host.cache import compiled
from ..system.system import AcausalSystem

ITERATIONS = 20  # Gauss–Newton steps onto the manifold
# A solution is looked for at these parts of what is left of the interval. Speeds become infinite where a mechanism is
# stretched, so that a run stops a little before, and prescribed steps stop up to a step before.
BEYOND = np.concatenate([10.0 ** np.arange(-12, -1), np.arange(0.1, 1.05, 0.1)])
LIMIT = 0.1  # of its size: how far a state is followed, since its slope may be near a pole
# A search may lead back by this part of the way along the field. Along a manifold it leads back by the order of the
# step, and where the manifold ends, all of the way.
BACK = 0.5


def lost_constraint(system: AcausalSystem, inputs: Inputs, t: Time, x: State, t1: Time) -> str:
    """A sentence that names a hidden constraint which has no solution near x just beyond t; "" if all have one."""
    if not system.plan.n_constraints:
        return ""
    equation = np.concatenate([planned.equation.equation for planned in system.plan.constraints])
    level = system.plan.extended.level[equation]
    for dt in np.diff(BEYOND, prepend=0.0) * float(t1 - t):
        dt = jnp.asarray(dt, jnp.asarray(t).dtype)
        found, before, after, leads_back = _search(system, t, dt, x, inputs)
        t, x, before, after = t + dt, found, np.asarray(before), np.asarray(after)
        unmet = ~(after <= solved(after.dtype)) | (bool(leads_back) & (before > solved(before.dtype)))
        # The equation itself rather than its derivatives, which need not hold where it does not.
        unmet &= level == level[unmet].min(initial=level.max())
        if unmet.any():
            worst = int(np.argmax(np.where(unmet, np.nan_to_num(before, nan=np.inf), -1.0)))
            return (
                "an equation has no solution beyond that is near the last point: "
                f"{system.plan.locate(int(equation[worst]))}. It asks for what cannot be (a mechanism out of reach, "
                "a value out of the range of its law). End the run earlier, or change what drives it"
            )
    return ""


@compiled
def _search(system: AcausalSystem, t: Time, dt: Time, x: State, inputs: Inputs) -> PyTree:
    """A point on the manifold after a step along the field; the residuals of the hidden constraints, in units of their
    terms, before and after the search for it; and whether the search led back."""
    size = jnp.abs(x) + system.state_sizes
    way = jnp.clip(dt * system.vector_field(t, x, inputs), -LIMIT * size, LIMIT * size)
    point = system.at(t + dt, inputs)
    ahead = x + jnp.where(jnp.isfinite(way), way, 0.0)
    found = jax.lax.fori_loop(0, ITERATIONS, lambda _, x: point.project(x, 1), ahead)

    def residual(x):
        terms = point.constraint_magnitudes(x, jnp.abs(x) + system.state_sizes)
        return jnp.abs(point.constraint_vector(x)) / terms

    free = jnp.abs(way) < LIMIT * size  # followed all the way
    back = jnp.where(free, (ahead - found) * jnp.sign(way), 0.0) > BACK * jnp.abs(way)
    return found, residual(ahead), residual(found), jnp.any(back)
