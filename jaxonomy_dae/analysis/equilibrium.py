"""The search for an equilibrium.

Given are a system at a frozen time and states that may drift. The unknowns are the entries of the state array, drifting
ones left out. The rows are the slopes of the states, the residuals of nonlinear blocks, and the hidden constraints: of
redundant states (kept as candidates and projected) there are more rows than unknowns, which agree where there is an
equilibrium. The ladder of initialization finds the point, kept out of differentiation. Two Gauss–Newton steps with the
Jacobian there carry first and second derivatives, by the implicit function theorem.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..initialization.initialize import frozen_inputs
from ..initialization.ladder import FAILED, find_root
from ..initialization.sizes import Sizes
from ..linear.least_squares import least_squares
from ..lowering.plan import SystemPlan
from ..model.declared import declared_scale, quantity_bounds
from ..programs.cache import compiled
from ..system.system import AcausalSystem
from ..tolerances import ZERO_WITHIN, spacing

PASSES = 4  # of equilibration: the first one takes scales away, the others balance
# A singular value below SINGULAR·n·eps of the largest one is rounding. n·eps alone is the usual measure for a matrix
# with exact entries (NumPy's matrix_rank).


class Equilibrium(NamedTuple):
    """The result of the search for an equilibrium.

    - `x`: the state array, shape (n_state,).
    - `residual`, `limit`: the residual of each row, and the largest one that counts as rounding.
    - `jacobian`: the rows' derivatives with respect to the unknowns, shape (rows, unknowns).
    - `unit`: the sizes of the unknowns, shape (unknowns,).
    - `holds`: True if all rows hold.
    """

    x: Float[Array, " n"]
    residual: Float[Array, " m"]
    limit: Float[Array, " m"]
    jacobian: Float[Array, "m k"]
    unit: Float[Array, " k"]
    holds: Bool[Array, ""]


def unknowns(plan: SystemPlan, drifting: tuple[int, ...]) -> np.ndarray:
    """The places in the state array that are solved for."""
    return np.setdiff1d(np.arange(plan.n_state), drifting)


def find_equilibrium(system: AcausalSystem, t: Any, x0: Any, inputs: Any, drifting: tuple[int, ...]) -> Equilibrium:
    """Searches from `x0`; a pure function, to be used inside jit."""
    plan = system.plan
    free = unknowns(plan, drifting)
    x0 = jax.lax.stop_gradient(x0)

    def residual(w, system, t, inputs):
        x = x0.at[free].set(w)
        here = system.at(t, inputs)
        slopes_and_blocks = here.semi_explicit(x)
        return jnp.concatenate([slopes_and_blocks[free], here.constraint_vector(here.split(x))])

    frozen = tuple(frozen_inputs(given) for given in (system, t, inputs))
    start = x0[free]
    everywhere = np.concatenate([plan.states, plan.carried]).astype(np.int64)
    scale = jnp.asarray(declared_scale(plan.model)[everywhere], x0.dtype)

    def magnitude(w):
        still, t, inputs = frozen
        x = x0.at[free].set(w)
        here, reach = still.at(t, inputs), jnp.maximum(jnp.abs(x), scale)
        slopes = here.slope_magnitudes(x, reach)
        rows = [slopes, here.carried_magnitudes(x, reach)] if len(plan.carried) else [slopes]
        return jnp.concatenate([jnp.concatenate(rows)[free], here.constraint_magnitudes(x, reach)])

    m = len(free) + plan.n_constraints
    if not len(free):
        rest = residual(start, system, t, inputs)
        empty = jnp.zeros((m, 0), x0.dtype)
        return Equilibrium(x0, rest, jnp.zeros_like(rest), empty, start, jnp.all(rest == 0))
    entries, nominal = everywhere[free], scale[free]
    typical = jax.lax.stop_gradient(system.typical_sizes[entries])
    zero = jnp.zeros((m,), x0.dtype)
    sizes = Sizes(nominal, jnp.maximum(jnp.abs(start), nominal), zero, zero)
    # With more rows than unknowns there is no square system for the homotopy to follow.
    core = np.arange(m) if m == len(free) else None
    bounds = quantity_bounds(plan.model)[entries]
    found = find_root(lambda w: residual(w, *frozen), m, start, sizes, core, None, bounds, typical, magnitude)
    found = jax.lax.stop_gradient(found)
    # Where nothing was found, there is nothing to differentiate, and the others of a batch must not notice.
    good = found.method < FAILED
    matrix = jnp.where(good, found.jacobian * found.unit[None, :], jnp.asarray(np.eye(m, len(free)), x0.dtype))

    def correct(w, _):
        remaining = residual(w, system, t, inputs)
        return w - found.unit * least_squares(matrix, jnp.where(good, remaining, 0)), remaining

    w, remaining = jax.lax.scan(correct, found.x, length=2)
    holds = good & jnp.all(jnp.abs(remaining[-1]) <= found.limit) & jnp.all(jnp.isfinite(w))
    return Equilibrium(x0.at[free].set(w), remaining[-1], found.limit, found.jacobian, found.unit, holds)


compiled_search = compiled(find_equilibrium)


def open_directions(found: Equilibrium) -> tuple[Float[Array, " k"], Float[Array, "k k"]]:
    """Returns (singular values of the Jacobian in its own units, relative to the largest; the right singular vectors,
    as rows, in units of the unknowns' scales). Not differentiated."""
    m, k = found.jacobian.shape
    matrix = jax.lax.stop_gradient(found.jacobian * found.unit[None, :])
    for sweep in range(PASSES):  # the first one takes scales of rows and columns away, the others balance (Ruiz 2001)
        for axis in (1, 0):
            largest = jnp.max(jnp.abs(matrix), axis=axis, keepdims=True, initial=0.0)
            largest = jnp.where(largest > 0, largest, 1)
            matrix = matrix / (jnp.sqrt(largest) if sweep else largest)
    padded = jnp.concatenate([matrix, jnp.zeros((max(k - m, 0), k), matrix.dtype)])
    _, values, directions = jnp.linalg.svd(padded, full_matrices=False)
    return values / jnp.where(values[0] > 0, values[0], 1), directions


def is_open(values: Float[Array, " k"]) -> Bool[Array, " k"]:
    """True for directions that nothing determines: their singular values are zero up to rounding."""
    return values <= ZERO_WITHIN * values.shape[0] * spacing(values.dtype)
