"""What a step meets: guards looked at together at a few places, and where the first one falls through zero."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import Args, State, Time
from ...base.tolerances import WINDOW
from ...write.events import EventFlag
from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from .after_event import AHEAD
from .instant import CLOSE, Arrival
from .problem import AbstractHybridProblem, HybridState
from .search import first_crossing
from .side import ABOVE, BELOW, RESTS, rounding

# Where guards are looked at, as parts of a step; and how far, as a part of its size, a guard may be from the parabola
# through its values at the first, the middle and the last of these. One that bends more may cross zero unseen, and the
# step is taken in halves. With ten times BEND, test_hybrid_runs.py::test_guards_faster_than_the_states fails; a tenth
# passes.
LOOKS = np.array([0.0, 0.13, 0.31, 0.5, 0.67, 0.86, 1.0])
FITTED = [0, 3, 6]
BEND = 0.1
# What counts as "at the same time" is measured by how long steps have been of late, because steps next to events are
# short. Each step leaves this part of that length.
FORGOTTEN = 0.8
BESIDE = 2.0**-20  # of a state: far beyond rounding, also in single precision


def _off_parabola() -> np.ndarray:
    """A matrix, shape (looks − 3, looks): the distances of values at LOOKS from the parabola through the first, the
    middle and the last of them."""
    others = [k for k in range(len(LOOKS)) if k not in FITTED]
    out = np.eye(len(LOOKS))[others]
    out[:, FITTED] = -np.vander(LOOKS[others], 3) @ np.linalg.inv(np.vander(LOOKS[FITTED], 3))
    return out


_OFF_PARABOLA = _off_parabola()
# Barycentric weights (Berrut & Trefethen 2004), and the derivative at the end of the polynomial through all values.
_WEIGHTS = np.array([1 / np.prod([a - b for b in LOOKS if b != a]) for a in LOOKS])
_DIVIDED = _WEIGHTS[:-1] / _WEIGHTS[-1] / (1.0 - LOOKS[:-1])
_RATE_AT_END = np.append(_DIVIDED, -_DIVIDED.sum())


def _between(place: Array, values: Array) -> Array:
    """Evaluates the polynomial through `values` at LOOKS, shape (looks, guards), at `place`, a fraction of the step."""
    # The search stays strictly between two looks, so nothing is divided by zero.
    weights = jnp.asarray(_WEIGHTS, values.dtype) / (place - jnp.asarray(LOOKS, values.dtype))
    return weights @ values / jnp.sum(weights)


def _apart(n: int) -> np.ndarray:
    """Factors from 1 to 2, no two of them alike: by these, errors of states that are equal do not cancel. They are
    multiples of the golden ratio, which are the farthest apart (Knuth, volume 3, section 6.4)."""
    return 1.0 + np.arange(n) * (0.5 * (np.sqrt(5.0) - 1.0)) % 1.0


class _Step(NamedTuple):
    """The step from y0 at t0 to x1 at t1, whose states are `dense(t0, t1, t)`; not differentiated."""

    problem: AbstractHybridProblem
    dense: Callable[[Time, Time, Time], State]
    t0: Time
    t1: Time
    y0: HybridState
    x1: State
    args: Args


class Met(NamedTuple):
    """The result of looking for events in a step, not differentiated.

    - `request`: the end of the shorter step to take instead; infinity to keep this one.
    - `armed`: the side of zero on which each guard is at the end of the step, shape (guards,); `values`: their values
        there.
    - `arrival`: the events due at the end of the step.
    """

    request: Array
    armed: Array
    values: Array
    arrival: Arrival


def looked_at(
    problem: AbstractHybridProblem, dense: Callable[[Time, Time, Time], State], t0: Time, t1: Time, y0: HybridState,
    x1: State, args: Args,
) -> Met:  # fmt: skip
    """Looks for events in the step from y0 to x1, whose states are `dense(t0, t1, t)`.

    At kinks the state is continuous, so the crossing is taken from the polynomial through the guards' values, and so is
    their rate at the end. At jumps the crossing is solved for with the equations, which give the rate, too.
    """
    # Decisions are made on numbers alone, and the map of the event carries all derivatives. So reverse mode goes back
    # over no search, which was half of the time of a gradient.
    step = still(_Step(problem, dense, t0, t1, y0, x1, args))
    problem, dense, t0, t1, y0, x1, args = step
    h, q, g = t1 - t0, y0.q, problem.facts.n_guards
    span = jnp.maximum(h, FORGOTTEN * y0.span)
    window = jnp.maximum(WINDOW * span, problem.resolution)
    # The controller lets steps end at ticks, up to rounding.
    ticking = y0.due <= t1 + 0.25 * problem.resolution

    never, none, zero = jnp.full_like(t1, jnp.inf), jnp.zeros((g,), bool), jnp.zeros_like(x1)

    if not g:
        before = zero
        if not problem.facts.only_kinks:
            # The field is evaluated once more for a tick alone, of which most steps have none.
            before = lax.cond(any_member(jnp.any(ticking)), lambda: problem.slope(t1, x1, q, args), lambda: zero)
        return Met(never, y0.armed, y0.size, Arrival(before, y0.size, ticking, none, y0.size, window, span))

    # The last place is the end itself: t0 + h may be rounded off it, and off a tick or a saved time.
    times = jnp.append(t0 + h * jnp.asarray(LOOKS[:-1], t1.dtype), t1)
    states = jnp.concatenate([jax.vmap(lambda t: dense(t0, t1, t))(times[:-1]), x1[None]])
    # A guard that is small beside its terms, as the speed of what is locked, is as exact as these are. Looked at beside
    # the end, with each state off by a part of its own, it tells their sizes.
    beside = x1 * (1 + BESIDE * jnp.asarray(_apart(len(x1)), x1.dtype))
    *values, there = jax.vmap(lambda t, x: problem.guards(t, x, q, args))(
        jnp.append(times, t1), jnp.concatenate([states, beside[None]])
    )
    values = jnp.stack(values)
    size = jnp.abs(values)
    terms = jnp.abs(there - values[-1]) / BESIDE
    largest = jnp.maximum(jnp.maximum(jnp.max(size, axis=0), y0.size), terms)
    off = jnp.max(jnp.abs(jnp.asarray(_OFF_PARABOLA, values.dtype) @ values), axis=0)
    # Most steps meet nothing: all guards are farther from zero than they were seen to move.
    moves = jnp.max(values, axis=0) - jnp.min(values, axis=0)
    side = jnp.where(values[-1] > 0, ABOVE, BELOW)
    # Between two looks, guards are taken to move by no more than the looks show and twice what a parabola misses.
    far = jnp.min(size, axis=0) > moves + 2 * off + rounding(largest)
    quiet = jnp.all(far & (side == y0.armed)) & ~jnp.any(ticking)

    due = jnp.concatenate([ticking, none])
    clocks = Met(never, y0.armed, values[-1], Arrival(zero, y0.size, due, none, largest, window, span))

    def something():
        return _met(step, times, values, off, clocks)

    return lax.cond(any_member(~quiet), something, lambda: clocks)


def _met(step: _Step, times: Array, values: Array, off: Array, clocks: Met) -> Met:
    """Looks for events in a step, given the guards' `values` at `times`, shape (looks, guards), `off`, their distance
    from a parabola, shape (guards,), and the result `clocks` for sampled events alone."""
    problem, dense, t0, t1, y0, x1, args = step
    h, q, g, arrival = t1 - t0, y0.q, problem.facts.n_guards, clocks.arrival
    span, window, ticking = arrival.span, arrival.window, arrival.due[: problem.facts.n_clocks]
    size = jnp.max(jnp.abs(values), axis=0)
    band = rounding(arrival.size)
    # A guard that has left the band above zero at an earlier place is above. It is armed then, as a resting guard is.
    rises = jnp.concatenate([(y0.armed == ABOVE)[None], values[1:] > band])
    above = lax.associative_scan(jnp.logical_or, rises)
    armed = above | (y0.armed == RESTS)
    raised = jnp.where((y0.armed == RESTS) & ~above, band, 0.0)  # a resting guard falls where it leaves the band
    values = values + raised
    # A resting guard may start slightly negative and rise, by no more than rounding or its rise within the window. One
    # that is farther below has jumped, as an input does where a step begins.
    rise = (values[1:] - values[:-1]) / (h * jnp.asarray(np.diff(LOOKS), values.dtype)[:, None])
    left_there = jnp.maximum(band, jnp.minimum(rise * window, CLOSE * size))
    below = (values[1:] < 0) & (above[:-1] | (rise <= 0) | (values[1:] < -left_there))
    # A guard may also reach zero and stay, or have jumped there: its condition is then true if it is not strict.
    strict = problem.facts.are(EventFlag.STRICT)[problem.facts.n_clocks :]
    stays = (values[1:] == 0) & ((values[:-1] > 0) | ((values[:-1] == 0) & above[:-1] & ~strict))
    crossed = armed[:-1] & (below | stays)
    last = values[-1]

    def reaches_zero(rate, doubt):
        # A step that was shortened to end at zero does so up to rounding.
        return (rate < 0) & (jnp.abs(last) <= jnp.maximum(-rate * window, jnp.minimum(doubt, -rate * (AHEAD * span))))

    def at_end():
        before = problem.slope(t1, x1, q, args)
        # How much of a guard is rounding in the states: little, where it meets zero flatly, whatever its values were.
        along = jnp.stack([before, jnp.asarray(_apart(len(x1)), x1.dtype) * x1])
        rate, by_rounding = jax.vmap(lambda direction: problem.rates(t1, x1, q, args, direction)[1])(along)
        return before, reaches_zero(rate, rounding(jnp.abs(by_rounding)))

    # A step so short that points inside cannot be distinguished from its ends.
    short = h <= 4 * problem.resolution
    if problem.facts.only_kinks:
        before, near = jnp.zeros_like(x1), reaches_zero(jnp.asarray(_RATE_AT_END, values.dtype) @ values / h, band)
    else:
        doubtful = jnp.any(armed[-1] & (last <= CLOSE * size)) | jnp.any(ticking) | short
        before, near = lax.cond(any_member(doubtful), at_end, lambda: (jnp.zeros_like(x1), jnp.zeros((g,), bool)))
    near = near & armed[-1]
    # One that falls or rises from look to look crosses zero once, however it bends: where it does so flatly, as h³, the
    # halves would bend as much, without end. The polynomial through the looks is not good enough for it.
    monotone = jnp.all(rise < 0, axis=0) | jnp.all(rise > 0, axis=0)
    bent = (off > jnp.maximum(BEND * size, band)) & (problem.facts.only_kinks | ~monotone)
    bent = jnp.any(bent)
    long = h > 1e3 * jnp.maximum(WINDOW * h, problem.resolution)
    bent = bent & long
    # In a step too short to be split, a guard that crossed zero has jumped, unless rounding alone could take it there:
    # where it meets zero flatly, its sign is that of its rounding errors.
    falls = jnp.any(crossed, axis=0) & ~near & short
    jumped = falls & (size > band)
    near = near | falls
    within = jnp.any(crossed[:-1], axis=0) & ~short
    inside = jnp.any(within | (crossed[-1] & ~near))

    def located():
        place = jnp.argmax(jnp.any(crossed, axis=1))

        def guards(t):
            if problem.facts.only_kinks:
                return _between((t - t0) / h, values - raised) + raised[place + 1]
            return problem.guards(t, dense(t0, t1, t), q, args) + raised[place + 1]

        return first_crossing(
            guards, crossed[place], times[place], times[place + 1], values[place], values[place + 1], inside
        )

    # The search evaluates the equations some ten times, which steps without a crossing need not pay for.
    where = lax.cond(any_member(inside), located, lambda: t1)
    # A retried step must be long enough for time to go on.
    where = jnp.maximum(where, t0 + 2 * problem.resolution)
    dip = jnp.where(long, _dip(values, armed, jnp.any(crossed, axis=0), 2 * off - band), jnp.inf)
    request = jnp.minimum(jnp.where(inside, where, jnp.inf), t0 + dip * h)
    # Halves come before all else: what was located in a guard that is not resolved may not be the first crossing.
    request = jnp.where(bent, t0 + 0.5 * h, request)
    # Nothing happens at the end of a step that is taken again.
    due = jnp.concatenate([ticking, near]) & ~jnp.isfinite(request)
    arrival = arrival._replace(slope=before, due=due, jumped=jumped)
    side = jnp.where(above[-1], ABOVE, jnp.where(armed[-1], RESTS, BELOW))
    return Met(request, side.astype(y0.armed.dtype), last - raised[-1], arrival)


def _dip(values, armed, crossed, doubt):
    """The place (a fraction of the step) where a guard that is positive at all looks has the minimum of the parabola
    through its values at both ends and in the middle, if that minimum is below `doubt`; infinity otherwise. The caller
    ends the step there and looks again, until the minimum is decided.

    A guard that falls at the end of the step and from look to look has no minimum inside, whatever the parabola says:
    it has one in a later step.
    """
    left, middle, right = values[jnp.array(FITTED)]
    bend = 2 * (left - 2 * middle + right)
    slope = 4 * middle - 3 * left - right
    curved = bend > 0
    bend = jnp.where(curved, bend, 1.0)
    place = -0.5 * slope / bend
    before = jnp.sum(jnp.asarray(LOOKS, values.dtype)[:, None] <= place, axis=0) - 1
    was_armed = jnp.take_along_axis(armed, jnp.clip(before, 0, len(LOOKS) - 1)[None], axis=0)[0]
    lowest = left + 0.5 * slope * place
    rate_at_end = jnp.asarray(_RATE_AT_END, values.dtype) @ values
    turns = jnp.any(values[1:] >= values[:-1], axis=0) | (rate_at_end > 0)
    dips = curved & turns & was_armed & ~crossed & (1e-3 < place) & (place < 1) & (lowest < doubt)
    return jnp.min(jnp.where(dips, place, jnp.inf))
