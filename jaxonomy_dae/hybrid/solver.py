"""Any solver, with steps that end at events."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from .event_map import AHEAD, CLOSE, Arrival, handle
from .problem import HybridState
from .search import first_crossing
from .side import ABOVE, BELOW, RESTS, rounding
from .term import bound, problem_of

WINDOW = 1e-6  # of a step: a guard that reaches zero so close to its end counts as having done so
# Where guards are looked at, as parts of a step; and how far, as a part of its size, a guard may be from the parabola
# through its values at the first, the middle and the last of these. One that bends more may cross zero unseen, and the
# step is taken in halves.
LOOKS = np.array([0.0, 0.13, 0.31, 0.5, 0.67, 0.86, 1.0])
FITTED = [0, 3, 6]
BEND = 0.1
FORGOTTEN = 0.8  # what a step leaves of how long steps have been: next to events they are short
MOVED = 1e3  # times the resolution: a step so long goes on

TOO_MANY: Any = diffrax.RESULTS.max_steps_rejected  # events
STUCK: Any = diffrax.RESULTS.stagnation  # an event happens again and again at one instant
NOT_FINITE: Any = diffrax.RESULTS.nonlinear_divergence  # what an event wrote


def _off_parabola() -> np.ndarray:
    """The distances of the values at LOOKS from the parabola through the first, the middle and the last."""
    others = [k for k in range(len(LOOKS)) if k not in FITTED]
    out = np.eye(len(LOOKS))[others]
    out[:, FITTED] = -np.vander(LOOKS[others], 3) @ np.linalg.inv(np.vander(LOOKS[FITTED], 3))
    return out


_OFF_PARABOLA = _off_parabola()


class HybridInterpolation(diffrax.AbstractLocalInterpolation):
    """Within a step, x of the inner solver's dense output; at its end, what events made of it."""

    t0: Any
    t1: Any
    inner: Any
    y0: HybridState
    y1: HybridState
    fired: Any
    slope: Any
    resolution: Any

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        before = eqx.tree_at(lambda y: y.x, self.y0, self.inner(self.t0, self.t1, t0))
        # Times within rounding of the event are those of the event; one that moves goes along the solution after it.
        at_end = self.fired & (t0 >= self.t1 - self.resolution)
        after = eqx.tree_at(lambda y: y.x, self.y1, self.y1.x + self.slope * (t0 - lax.stop_gradient(self.t1)))
        return jax.tree.map(lambda a, b: jnp.where(at_end, a, b), after, before)


class _Dense(eqx.Module):
    """The inner solver's dense output."""

    interpolation: Any = eqx.field(static=True)
    info: Any

    def __call__(self, t0: Any, t1: Any, t: Any) -> Any:
        return self.interpolation(t0=t0, t1=t1, **self.info).evaluate(t)


class WithEvents(diffrax.AbstractWrappedSolver):
    """Takes the steps of a solver, and ends one where an event happens.

    - `solver`: the problem prepares it for the discrete values at hand.
    - `max_events`: more of them end the run with `TOO_MANY`.
    """

    solver: diffrax.AbstractSolver
    max_events: int = eqx.field(static=True)

    term_structure = diffrax.AbstractTerm
    interpolation_cls = HybridInterpolation  # pyright: ignore[reportAssignmentType]

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return {}

    @property
    def scan_kind(self):
        """How the wrapped solver loops over its stages."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_finder(self):
        """How the wrapped solver finds roots."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self):
        """How long the wrapped solver looks for roots."""
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def func(self, terms, t0, y0, args):
        if isinstance(y0, HybridState):
            return self.solver.func(bound(terms, y0.q), t0, y0.x, args)
        return self.solver.func(terms, t0, y0, args)

    def between_events(self, terms, y0, y1):
        """(terms, solver, state) after a step from y0 to y1, and whether an event at its end changed them."""
        solver = problem_of(terms).prepared(self.solver, y1.q)
        return bound(terms, y1.q), solver, y1.x, jnp.any(y0.q != y1.q)

    def init(self, terms, t0, t1, y0, args):
        solver = problem_of(terms).prepared(self.solver, y0.q)
        return solver.init(bound(terms, y0.q), t0, t1, y0.x, args), jnp.array(False)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        problem = problem_of(terms)
        inner_state, jumped = solver_state
        made_jump = jumped if made_jump is False else made_jump | jumped
        solver = problem.prepared(self.solver, y0.q)
        x1, y_error, info, inner_state, result = solver.step(
            bound(terms, y0.q), t0, t1, y0.x, args, inner_state, made_jump
        )
        dense = _Dense(solver.interpolation_cls, info)
        request, armed, arrival = _looked_at(problem, dense, t0, t1, y0, x1, args)
        turns = jnp.where(t1 - t0 > MOVED * problem.resolution, jnp.zeros_like(y0.turns), y0.turns)
        changed = x1, armed, arrival.size, arrival.span, jnp.full_like(t1, jnp.inf), turns
        state = eqx.tree_at(lambda y: (y.x, y.armed, y.size, y.span, y.request, y.turns), y0, changed)
        fired = jnp.any(arrival.due)

        def events(state):
            return handle(problem, t1, state, arrival, args)

        y1, slope = lax.cond(any_member(fired), events, lambda state: (state, jnp.zeros_like(x1)), state)
        y1 = jax.tree.map(lambda a, b: jnp.where(fired, a, b), y1, state)
        dense_info = dict(inner=dense, y0=y0, y1=y1, fired=fired, slope=slope, resolution=problem.resolution)
        y1 = eqx.tree_at(lambda y: y.request, y1, request)
        finite = jnp.all(jnp.isfinite(y1.x)) & jnp.all(jnp.isfinite(y1.q))
        result = diffrax.RESULTS.where(fired & ~finite & jnp.all(jnp.isfinite(x1)), NOT_FINITE, result)
        result = diffrax.RESULTS.where(y1.count > self.max_events, TOO_MANY, result)
        result = diffrax.RESULTS.where((y1.stuck >= 0) & (y1.ended == 0), STUCK, result)
        return y1, y_error, dense_info, (inner_state, fired), result


def _looked_at(problem, dense, t0, t1, y0: HybridState, x1, args):
    """(the end of the step to take instead, or infinity; on which side guards are at its end; what it meets there), not
    differentiated."""
    problem, dense, t0, t1, y0, x1, args = still((problem, dense, t0, t1, y0, x1, args))
    h, q, g = t1 - t0, y0.q, problem.n_guards
    span = jnp.maximum(h, FORGOTTEN * y0.span)
    window = jnp.maximum(WINDOW * span, problem.resolution)
    ticking = y0.due <= t1 + 0.25 * problem.resolution

    def slope():
        return problem.slope(t1, x1, q, args)

    if not g:
        none = jnp.zeros((0,), bool)
        before = lax.cond(any_member(jnp.any(ticking)), slope, lambda: jnp.zeros_like(x1))
        return jnp.full_like(t1, jnp.inf), y0.armed, Arrival(before, y0.size, ticking, none, y0.size, window, span)

    times = jnp.append(t0 + h * jnp.asarray(LOOKS[:-1], t1.dtype), t1)
    states = jnp.concatenate([jax.vmap(lambda t: dense(t0, t1, t))(times[:-1]), x1[None]])
    values = jax.vmap(lambda t, x: problem.guards(t, x, q, args))(times, states)
    size = jnp.max(jnp.abs(values), axis=0)
    largest = jnp.maximum(size, y0.size)
    band = rounding(largest)
    # What has left the band above zero anywhere before is above, and armed, as is what rests.
    rises = jnp.concatenate([(y0.armed == ABOVE)[None], values[1:] > band])
    above = lax.associative_scan(jnp.logical_or, rises)
    armed = above | (y0.armed == RESTS)
    raised = jnp.where((y0.armed == RESTS) & ~above, band, 0.0)  # what rests falls where it leaves the band
    values = values + raised
    # One may also reach zero and stay.
    crossed = armed[:-1] & ((values[1:] < 0) | ((values[1:] == 0) & (values[:-1] > 0)))
    last = values[-1]

    def at_end():
        before = slope()
        _, rate = problem.rates(t1, x1, q, args, before)
        # A step that was to end at zero does so up to rounding in what the guard is the difference of.
        rounded = jnp.minimum(band, -rate * (AHEAD * span))
        return before, (rate < 0) & (jnp.abs(last) <= jnp.maximum(-rate * window, rounded))

    short = h <= 4 * problem.resolution
    doubtful = jnp.any(armed[-1] & (last <= CLOSE * size)) | jnp.any(ticking) | short
    before, near = lax.cond(any_member(doubtful), at_end, lambda: (jnp.zeros_like(x1), jnp.zeros((g,), bool)))
    near = near & armed[-1]
    off = jnp.max(jnp.abs(jnp.asarray(_OFF_PARABOLA, values.dtype) @ values), axis=0)
    bent = jnp.any(off > jnp.maximum(BEND * size, band))
    long = h > 1e3 * jnp.maximum(WINDOW * h, problem.resolution)
    bent = bent & long
    # In a step too short to be parted, what has crossed has jumped.
    jumped = jnp.any(crossed, axis=0) & ~near & short
    near = near | jumped
    within = jnp.any(crossed[:-1], axis=0) & ~short
    inside = jnp.any(within | (crossed[-1] & ~near))

    def located():
        place = jnp.argmax(jnp.any(crossed, axis=1))

        def guards(t):
            return problem.guards(t, dense(t0, t1, t), q, args) + raised[place + 1]

        return first_crossing(
            guards, crossed[place], times[place], times[place + 1], values[place], values[place + 1], inside
        )

    where = lax.cond(any_member(inside), located, lambda: t1)
    where = jnp.maximum(where, t0 + 2 * problem.resolution)
    dip = jnp.where(long, _dip(values, armed, jnp.any(crossed, axis=0), 2 * off - band), jnp.inf)
    request = jnp.minimum(jnp.where(inside, where, jnp.inf), t0 + dip * h)
    request = jnp.where(bent, t0 + 0.5 * h, request)
    due = jnp.concatenate([ticking, near]) & ~jnp.isfinite(request)
    arrival = Arrival(before, y0.size, due, jumped, largest, window, span)
    side = jnp.where(above[-1], ABOVE, jnp.where(armed[-1], RESTS, BELOW))
    return request, side.astype(y0.armed.dtype), arrival


def _dip(values, armed, crossed, doubt):
    """Where, as a part of the step, a guard that is positive wherever it was looked at is lowest by the parabola
    through its values at the ends and in the middle, if it may be negative there; or infinity. The step is taken up to
    there, and so on until what the parabola leaves in `doubt` is decided."""
    left, middle, right = values[jnp.array(FITTED)]
    bend = 2 * (left - 2 * middle + right)
    slope = 4 * middle - 3 * left - right
    curved = bend > 0
    bend = jnp.where(curved, bend, 1.0)
    place = -0.5 * slope / bend
    before = jnp.sum(jnp.asarray(LOOKS, values.dtype)[:, None] <= place, axis=0) - 1
    was_armed = jnp.take_along_axis(armed, jnp.clip(before, 0, len(LOOKS) - 1)[None], axis=0)[0]
    lowest = left + 0.5 * slope * place
    dips = curved & was_armed & ~crossed & (1e-3 < place) & (place < 1) & (lowest < doubt)
    return jnp.min(jnp.where(dips, place, jnp.inf))
