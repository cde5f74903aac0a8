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

from ..base.aliases import Args, Time
from ..base.tolerances import AT_REST, ZERO_WITHIN, spacing
from ..compile.lowering.plan import SystemPlan
from ..compile.model.declared import declared_scale, quantity_bounds
from ..host.cache import compiled
from ..run.start.ladder import FAILED, find_root, looking
from ..run.start.problem import frozen_inputs
from ..run.start.sizes import Sizes
from ..run.system.system import AcausalSystem
from ..solve.linear.dense import least_squares
from .events_at_rest import left_by_ticks, recomputed, resting_events
from .settled_modes import Point, Root, settle
from .transient import pseudo_transient

PASSES = 4  # of equilibration: the first one takes scales away, the others balance


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


class _Rows:
    """The rows of an equilibrium at a frozen time, as functions of the unknowns w: the entries `free` of the state
    array, and the discrete values `solved_for`. `given` are system, time and inputs, `still` the same, not
    differentiated."""

    def __init__(
        self, given: tuple[AcausalSystem, Time, Args], x0: Array, drifting: tuple[int, ...], kept: tuple[int, ...]
    ):
        system, t, inputs = given
        self.plan = plan = system.plan
        self.given, self.still = given, (frozen_inputs(system), frozen_inputs(t), frozen_inputs(inputs))
        self.free, self.events = unknowns(plan, drifting), resting_events(plan, kept, drifting)
        self.solved_for = np.zeros(0, np.int64) if self.events is None else self.events.unknown
        sizes = jax.lax.stop_gradient(system.typical_sizes[plan.states])
        self.slowest = jnp.append(AT_REST * sizes, jnp.zeros(len(plan.carried), sizes.dtype))
        self.everywhere = np.concatenate([plan.states, plan.carried]).astype(np.int64)
        self.scale = jnp.asarray(declared_scale(plan.model)[self.everywhere], x0.dtype)
        q0 = self.still[0].discrete_values.astype(x0.dtype)
        self.begin = Point(x0, q0, jnp.full(q0.shape, -1), jnp.zeros(q0.shape, bool))
        self.k = len(self.free) + len(self.solved_for)
        # Rows are counted by tracing them: which there are depends on events, constraints and branches.
        self.m = jax.eval_shape(lambda: self.residual(self.start(self.begin), self.begin, *self.still)).shape[0]

    def start(self, base: Point) -> Array:
        """The unknowns of a point."""
        return jnp.append(base.x[self.free], base.q[self.solved_for])

    def parts(self, w: Array, base: Point) -> tuple[Array, Array]:
        """The state array and the discrete values; those that are not solved for are as in `base`."""
        n = len(self.free)
        q = base.q.at[self.solved_for].set(w[n:]) if len(self.solved_for) else base.q
        return base.x.at[self.free].set(w[:n]), q

    def residual(self, w: Array, base: Point, system: AcausalSystem, t: Time, inputs: Args) -> Array:
        """The slopes, the residuals of nonlinear blocks and the hidden constraints, and what ticks would change."""
        x, q = self.parts(w, base)
        here = system.holding(q).at(t, inputs)
        slopes = here.semi_explicit(x)
        now = jax.lax.stop_gradient(slopes)
        # Its value is taken away and not its derivative, so that the Jacobian still sees how it creeps.
        slopes = slopes - jnp.where(jnp.abs(now) <= self.slowest, now, 0)  # what creeps is at rest
        rows = [slopes[self.free], here.projected_onto(x)]
        if self.events is not None and len(self.events.ticking):
            rows.append(left_by_ticks(system, t, inputs, self.events, x, q))
        return jnp.concatenate(rows)

    def followed(self, w: Array, base: Point, system: AcausalSystem, t: Time, inputs: Args) -> Array:
        """The residual where discrete values that events compute follow the unknowns."""
        if self.events is not None and len(self.events.computed):
            base = base._replace(q=self.computed(w, base, system, t, inputs))
        return self.residual(w, base, system, t, inputs)

    def computed(self, w: Array, base: Point, system: AcausalSystem, t: Time, inputs: Args) -> Array:
        """The discrete values, those included that events compute."""
        x, q = self.parts(w, base)
        if self.events is None or not len(self.events.computed):
            return q
        return recomputed(system, t, inputs, self.events, x, q, base.writer)

    def magnitude(self, w: Array, base: Point) -> Array:
        """How large the terms of each row are."""
        (system, t, inputs), (x, q) = self.still, self.parts(w, base)
        here, reach = system.holding(q).at(t, inputs), jnp.maximum(jnp.abs(x), self.scale)
        slopes = here.slope_magnitudes(x, reach)
        rows = [slopes, here.carried_magnitudes(x, reach)] if len(self.plan.carried) else [slopes]
        known = jnp.concatenate([jnp.concatenate(rows)[self.free], here.constraint_magnitudes(x, reach)])
        return jnp.append(known, jnp.full((self.m - len(known),), jnp.nan, x.dtype))  # slopes stand for the others

    def search(self, base: Point) -> tuple[Point, Root]:
        """The equilibrium of the equations with the modes of a point."""
        start, dtype = self.start(base), base.x.dtype
        if not self.k:
            # Without unknowns there is nothing to search: an event or a clock alone decides whether the system rests.
            rest = self.residual(start, base, *self.still)
            none = jnp.zeros((self.m, 0), dtype)
            return base, Root(start, none, jnp.zeros_like(rest), start, jnp.all(rest == 0))
        more = np.zeros(self.k - len(self.free))
        everywhere = self.everywhere[self.free]
        nominal = jnp.append(self.scale[self.free], jnp.asarray(more, dtype))
        typical = jnp.append(self.still[0].typical_sizes[everywhere], jnp.asarray(more + 1, dtype))
        open_ = np.tile([-np.inf, np.inf], (len(more), 1))
        bounds = np.concatenate([quantity_bounds(self.plan.model)[everywhere], open_])
        # With more rows than unknowns there is no square system for the homotopy to follow.
        core = np.arange(self.m) if self.m == self.k else None

        def function(w: Array) -> Array:
            return self.residual(w, base, *self.still)

        def root_from(start: Array) -> Root:
            zero = jnp.zeros((self.m,), dtype)
            sizes = Sizes(nominal, jnp.maximum(jnp.abs(start), nominal), zero, zero)
            look = looking(function, lambda w: self.magnitude(w, base))
            found = jax.lax.stop_gradient(find_root(look, self.m, start, sizes, core, bounds=bounds, typical=typical))
            parts = found.x, found.jacobian, found.limit, found.unit, found.method < FAILED
            return Root(*map(jnp.asarray, parts))

        # Steps in time need a square system: one row for each unknown.
        if self.events is None or self.m > self.k:
            root = root_from(start)
        else:  # relations may hold slopes constant, and no step of a search for a root leads on
            mass = jnp.append(jnp.asarray(self.given[0].mass[self.free], dtype), jnp.asarray(more + 1, dtype))

            def again(carry: tuple[Array, Root]) -> tuple[Array, Root]:
                count, _ = carry
                # Only where the first search has failed, since a path in time costs up to 200 Jacobians.
                led = jax.lax.cond(count == 0, lambda: start, lambda: pseudo_transient(function, mass, start, typical))
                return count + 1, root_from(led)

            shape = jax.eval_shape(root_from, start)
            none = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shape)
            _, root = jax.lax.while_loop(lambda c: (c[0] < 2) & ~c[1].good, again, (jnp.array(0), none))
        x, q = self.parts(root.w, base)
        return base._replace(x=x, q=q), root

    def sharpened(self, root: Root, base: Point) -> tuple[Array, Array]:
        """(The unknowns after the two steps that carry derivatives, the rows there)."""
        if not self.k:
            return root.w, self.followed(root.w, base, *self.given)
        matrix = root.jacobian
        if self.events is not None and len(self.events.computed):
            # The search has held what events compute. Derivatives follow it, and so need another Jacobian.
            matrix = jax.lax.stop_gradient(jax.jacfwd(lambda w: self.followed(w, base, *self.still))(root.w))
        # Where nothing was found, there is nothing to differentiate, and the others of a batch must not notice.
        idle = jnp.asarray(np.eye(self.m, self.k), matrix.dtype)
        matrix = jnp.where(root.good, matrix * root.unit[None, :], idle)

        def correct(w: Array, _: None) -> tuple[Array, Array]:
            remaining = self.followed(w, base, *self.given)
            return w - root.unit * least_squares(matrix, jnp.where(root.good, remaining, 0)), remaining

        # One step carries first derivatives, the second one second derivatives.
        w, remaining = jax.lax.scan(correct, root.w, length=2)
        return w, remaining[-1]


def find_equilibrium(
    system: AcausalSystem, t: Time, x0: Array, inputs: Args, drifting: tuple[int, ...], kept: tuple[int, ...] = ()
) -> Equilibrium:
    """Searches from `x0`; a pure function, to be used inside jit. `drifting` are the places of states, `kept` those of
    discrete values, that stay as they are."""
    given = system, t, inputs
    rows = _Rows(given, jax.lax.stop_gradient(x0), drifting, kept)
    if rows.events is None or not rows.events.acting.any():
        base, root = rows.search(rows.begin)
        event = jnp.array(-1)
    else:
        base, root, event = settle(*rows.still, rows.events, rows.begin, rows.search)
    # Discrete values that no event has written follow the starts, and so do their derivatives.
    base = base._replace(q=jnp.where(base.changed, base.q, system.discrete_values))
    w, remaining = rows.sharpened(root, base)
    holds = root.good & (event < 0) & jnp.all(jnp.abs(remaining) <= root.limit) & jnp.all(jnp.isfinite(w))
    return Equilibrium(
        x=rows.parts(w, base)[0], q=rows.computed(w, base, *given), residual=remaining, limit=root.limit,
        jacobian=root.jacobian, unit=root.unit, event=event, holds=holds,
    )  # fmt: skip


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
    # Of fewer rows than unknowns, the decomposition would leave out directions that no row sees. Rows of zeros bring
    # them back.
    padded = jnp.concatenate([matrix, jnp.zeros((max(k - m, 0), k), matrix.dtype)])
    _, values, directions = jnp.linalg.svd(padded, full_matrices=False)
    return values / jnp.where(values[0] > 0, values[0], 1), directions


def is_open(values: Float[Array, " k"]) -> Bool[Array, " k"]:
    """True for directions that nothing determines: their singular values are zero up to rounding."""
    # n·eps alone is the usual measure for a matrix with exact entries (NumPy's matrix_rank). These entries have
    # rounding errors of their own.
    return values <= ZERO_WITHIN * values.shape[0] * spacing(values.dtype)
