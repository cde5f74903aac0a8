"""The search for an equilibrium.

Given are a system at a frozen time and states that may drift. The unknowns are the entries of the state array, drifting
ones left out. The rows are the slopes of the states, the residuals of nonlinear blocks, and the hidden constraints: of
redundant states (kept as candidates and projected) there are more rows than unknowns, which agree where there is an
equilibrium. The ladder of initialization finds the point, kept out of differentiation. Two Gauss–Newton steps with the
Jacobian there carry first and second derivatives, by the implicit function theorem.

Discrete values that clocks or expressions write are unknowns, too; modes are settled around the search
(`settled_modes.py`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..aliases import Args, Time
from ..initialization.ladder import FAILED, find_root, looking
from ..initialization.problem import frozen_inputs
from ..initialization.sizes import Sizes
from ..linear.dense import least_squares
from ..lowering.plan import SystemPlan
from ..model.declared import declared_scale, quantity_bounds
from ..programs.cache import compiled
from ..system.system import AcausalSystem
from ..tolerances import AT_REST, ZERO_WITHIN, spacing
from .events_at_rest import left_by_ticks, recomputed, resting_events
from .settled_modes import Point, Root, settle
from .transient import pseudo_transient

PASSES = 4  # of equilibration: the first one takes scales away, the others balance
# A singular value below SINGULAR·n·eps of the largest one is rounding. n·eps alone is the usual measure for a matrix
# with exact entries (NumPy's matrix_rank).


class Equilibrium(NamedTuple):
    """The result of the search for an equilibrium.

    - `x`: the state array, shape (n_state,); `q`: the discrete values, hidden ones included.
    - `residual`, `limit`: the residual of each row, and the largest one that counts as rounding.
    - `jacobian`: the rows' derivatives with respect to the unknowns, shape (rows, unknowns).
    - `unit`: the sizes of the unknowns, shape (unknowns,).
    - `event`: the number of an event that would not let the system rest there, or −1.
    - `holds`: True if all rows hold, and no event is left.
    """

    x: Float[Array, " n"]
    q: Float[Array, " q"]
    residual: Float[Array, " m"]
    limit: Float[Array, " m"]
    jacobian: Float[Array, "m k"]
    unit: Float[Array, " k"]
    event: Int[Array, ""]
    holds: Bool[Array, ""]


def unknowns(plan: SystemPlan, drifting: tuple[int, ...]) -> np.ndarray:
    """The places in the state array that are solved for."""
    return np.setdiff1d(np.arange(plan.n_state), drifting)


def find_equilibrium(
    system: AcausalSystem, t: Time, x0: Array, inputs: Args, drifting: tuple[int, ...], kept: tuple[int, ...] = ()
) -> Equilibrium:
    """Searches from `x0`; a pure function, to be used inside jit. `drifting` are the places of states, `kept` those of
    discrete values, that stay as they are."""
    plan = system.plan
    free = unknowns(plan, drifting)
    events = resting_events(plan, kept, drifting)
    solved_for = np.zeros(0, np.int64) if events is None else events.unknown
    n = len(free)
    x0 = jax.lax.stop_gradient(x0)

    def parts(w, base: Point):
        return base.x.at[free].set(w[:n]), base.q.at[solved_for].set(w[n:]) if len(solved_for) else base.q

    sizes = jax.lax.stop_gradient(system.typical_sizes[plan.states])
    slowest = jnp.append(AT_REST * sizes, jnp.zeros(len(plan.carried), sizes.dtype))

    def residual(w, base: Point, system, t, inputs):
        x, q = parts(w, base)
        here = system.holding(q).at(t, inputs)
        slopes = here.semi_explicit(x)
        creeping = jnp.abs(slopes) <= slowest
        slopes = slopes - jax.lax.stop_gradient(jnp.where(creeping, slopes, 0))
        rows = [slopes[free], here.projected_onto(x)]
        if events is not None and len(events.ticking):
            rows.append(left_by_ticks(system, t, inputs, events, x, q))
        return jnp.concatenate(rows)

    frozen = still, still_t, still_inputs = tuple(frozen_inputs(given) for given in (system, t, inputs))
    everywhere = np.concatenate([plan.states, plan.carried]).astype(np.int64)
    scale = jnp.asarray(declared_scale(plan.model)[everywhere], x0.dtype)
    q0 = still.discrete_values.astype(x0.dtype)
    begin = Point(x0, q0, jnp.full(q0.shape, -1), jnp.zeros(q0.shape, bool))
    m = jax.eval_shape(lambda: residual(jnp.append(x0[free], q0[solved_for]), begin, *frozen)).shape[0]

    def magnitude(w, base: Point):
        x, q = parts(w, base)
        here, reach = still.holding(q).at(still_t, still_inputs), jnp.maximum(jnp.abs(x), scale)
        slopes = here.slope_magnitudes(x, reach)
        rows = [slopes, here.carried_magnitudes(x, reach)] if len(plan.carried) else [slopes]
        known = jnp.concatenate([jnp.concatenate(rows)[free], here.constraint_magnitudes(x, reach)])
        return jnp.append(known, jnp.full((m - len(known),), jnp.nan, x.dtype))  # slopes stand for the others

    k = n + len(solved_for)
    # With more rows than unknowns there is no square system for the homotopy to follow.
    core = np.arange(m) if m == k else None
    bounds = np.concatenate([quantity_bounds(plan.model)[everywhere[free]], np.full((k - n, 2), [-np.inf, np.inf])])
    typical = jnp.append(still.typical_sizes[everywhere[free]], jnp.ones((k - n,), x0.dtype))

    def search(base: Point) -> tuple[Point, Root]:
        """The equilibrium of the equations with these modes."""
        start = jnp.append(base.x[free], base.q[solved_for])
        if not k:
            rest = residual(start, base, *frozen)
            none = jnp.zeros((m, 0), x0.dtype)
            return base, Root(start, none, jnp.zeros_like(rest), start, jnp.all(rest == 0))
        zero = jnp.zeros((m,), x0.dtype)
        nominal = jnp.append(scale[free], jnp.zeros((k - n,), x0.dtype))

        def function(w):
            return residual(w, base, *frozen)

        def root_from(start):
            sizes = Sizes(nominal, jnp.maximum(jnp.abs(start), nominal), zero, zero)
            look = looking(function, lambda w: magnitude(w, base))
            found = jax.lax.stop_gradient(find_root(look, m, start, sizes, core, bounds=bounds, typical=typical))
            return Root(found.x, found.jacobian, found.limit, found.unit, found.method < FAILED)

        if events is None or m > k:
            root = root_from(start)
        else:  # relations may hold slopes constant, and no step of a search for a root leads on
            mass = jnp.append(jnp.asarray(system.mass[free], x0.dtype), jnp.ones((k - n,), x0.dtype))

            def again(carry: tuple[Array, Root]) -> tuple[Array, Root]:
                count, _ = carry
                led = jax.lax.cond(count == 0, lambda: start, lambda: pseudo_transient(function, mass, start, typical))
                return count + 1, root_from(led)

            shape = jax.eval_shape(root_from, start)
            none = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shape)
            _, root = jax.lax.while_loop(lambda c: (c[0] < 2) & ~c[1].good, again, (jnp.array(0), none))
        x, q = parts(root.w, base)
        return base._replace(x=x, q=q), root

    if events is None or not events.acting.any():
        base, root = search(begin)
        event = jnp.array(-1)
    else:
        base, root, event = settle(still, still_t, still_inputs, events, begin, search)
    # Discrete values that no event has written follow the starts, and so do their derivatives.
    base = base._replace(q=jnp.where(base.changed, base.q, system.discrete_values))
    w, matrix = root.w, root.jacobian

    def rows(w, base: Point, system, t, inputs):
        if events is not None and len(events.computed):
            x, q = parts(w, base)
            base = base._replace(q=recomputed(system, t, inputs, events, x, q, base.writer))
        return residual(w, base, system, t, inputs)

    if events is not None and len(events.computed):
        matrix = jax.lax.stop_gradient(jax.jacfwd(lambda w: rows(w, base, *frozen))(w))
    if k:
        # Where nothing was found, there is nothing to differentiate, and the others of a batch must not notice.
        matrix = jnp.where(root.good, matrix * root.unit[None, :], jnp.asarray(np.eye(m, k), x0.dtype))

        def correct(w, _):
            remaining = rows(w, base, system, t, inputs)
            return w - root.unit * least_squares(matrix, jnp.where(root.good, remaining, 0)), remaining

        w, remaining = jax.lax.scan(correct, w, length=2)
        remaining = remaining[-1]
    else:
        remaining = rows(w, base, system, t, inputs)
    holds = root.good & (event < 0) & jnp.all(jnp.abs(remaining) <= root.limit) & jnp.all(jnp.isfinite(w))
    x, q = parts(w, base)
    if events is not None and len(events.computed):
        q = recomputed(system, t, inputs, events, x, q, base.writer)
    return Equilibrium(
        x=x, q=q, residual=remaining, limit=root.limit, jacobian=root.jacobian, unit=root.unit, event=event, holds=holds
    )


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
