"""The past of a run: what is delayed, recorded step by step and read where it comes out of the delay.

A step leaves one piece: of each source the polynomial through its values at NODES places of the step, along the dense
output of the solver. It is compared with the source in between. A step that is longer than a delay reads what it makes:
that is extrapolated from the piece before, compared afterwards with what was, and the step is taken again, shorter, if
they differ by more than the tolerance.

Where a source jumps or has a kink, a piece begins with its *level*: the order of the derivative that jumps. At the time
at which such a break comes out of a delay, a step ends and an event happens. The solution is smoother than what drives
it by one derivative (Bellen & Zennaro 2003, Numerical Methods for Delay Differential Equations, section 2.2). So what
comes of the break has the next level, unless the source follows what is delayed without an integration between.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from ...base.aliases import Args, Numeric, State, Time
from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from .facts import DelayFacts
from .problem import AbstractHybridProblem, HybridState

NODES = 6  # dense output is of degree 4 or 5, and where a source is linear in the state, so is the piece
BETWEEN = np.array([-0.6, 0.0, 0.6])  # places at which a piece is compared with its source
LONGEST, SAFETY = 5.0, 0.9  # how much longer than the last step the pieces allow the next one; and a part of that
# Breaks of a higher level are passed over: a step of a method of order five, as all here, does not see them.
HIGHEST = 5.0
SMOOTH = 99.0  # the level of a piece that begins without a break
SIDE = 4.0  # times the resolution: nearer to a break, a step reads the piece that belongs to its inside
LEAST = 0.25  # of its length: by no more a step is shortened at once
REACHES = 0.5  # of the last step: what can be extrapolated over less is not tried
SEARCH = 60  # halvings, to rounding

_PLACES = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))  # of Chebyshev and Lobatto, in [−1, 1]
_COEFFICIENTS = np.linalg.inv(np.vander(_PLACES, increasing=True))


class Past(eqx.Module):
    """The pieces of the last steps, in a ring.

    - `pieces`: a row for each: the break that it begins with, start, end, levels (delays), coefficients
        (NODES·delays) in powers of a place in [−1, 1]. Break and start are one time, but a break moves with parameters,
        and the polynomial belongs to the step as it was taken.
    - `now`: the number of pieces so far, the time at which the next one begins, that at which its step must end at the
        latest, its levels, and what sources were at the initial time.
    - `last`: what sources were at the end of the last piece, and 0 for those that were constant in it, else 1.
    """

    pieces: Float[Array, "room row"]
    now: Float[Array, " numbers"]
    last: Float[Array, "2 delays"]

    @classmethod
    def begin(cls, t0: Time, first: Float[Array, " delays"], delay: Float[Array, " delays"], room: int) -> "Past":
        """No past but what the sources are at the initial time, where they begin to move."""
        n = len(first)
        pieces = jnp.zeros((room, 3 + n + NODES * n), first.dtype).at[:, :3].set(jnp.inf)
        # A delay that is zero at the start limits nothing: what the first step reads is compared with what was.
        until = lax.stop_gradient(t0 + jnp.min(jnp.where(delay > 0, delay, jnp.inf)))
        now = jnp.concatenate([jnp.stack([jnp.zeros_like(t0), t0, until]), jnp.ones(n, first.dtype), first])
        return cls(pieces, now, still(jnp.stack([first, jnp.zeros_like(first)])))

    @property
    def n(self) -> int:
        """How many sources there are."""
        return (self.now.shape[-1] - 3) // 2

    count = property(lambda self: self.now[..., 0])
    begun = property(lambda self: self.now[..., 1])
    until = property(lambda self: self.now[..., 2])
    levels = property(lambda self: self.now[..., 3 : 3 + self.n])
    first = property(lambda self: self.now[..., 3 + self.n :])

    @property
    def levels_of_pieces(self) -> Array:
        """The levels of the pieces, shape (room, delays)."""
        return self.pieces[:, 3 : 3 + self.n]

    def extrapolated(self, times: Array, each: bool = False) -> Array:
        """What the last pieces say of later times, not differentiated, shape (times, delays); with `each`, of one time
        for each source, shape (delays,)."""
        pieces, count, first, times = still((self.pieces, self.count, self.first, times))
        row = pieces[(count.astype(int) - 1) % len(pieces)]
        half = jnp.where(count > 0, 0.5 * (row[2] - row[1]), 1.0)
        places = jnp.where(count > 0, (times - row[1]) / half - 1.0, 0.0)
        polynomials = jnp.where(count > 0, row[3 + self.n :].reshape(NODES, self.n), 0.0)
        value = _evaluated(polynomials, places if each else places[:, None])[0]
        return jnp.where(count > 0, value, first)

    def between(self, t0: Time, t1: Time, resolution: Time) -> "Remembered":
        """The past as the step from t0 to t1 reads it."""
        middle, side = 0.5 * (t0 + t1), SIDE * resolution
        low, high = jnp.minimum(t0 + side, middle), jnp.maximum(t1 - side, middle)
        return Remembered(self, still(low), still(high), jnp.zeros_like(t0))

    def onwards(self, resolution: Time) -> "Remembered":
        """The past as it is read at an instant and from then on."""
        endless = jnp.full_like(self.begun, jnp.inf)
        return Remembered(self, -endless, endless, SIDE * jnp.asarray(resolution, endless.dtype))


class Remembered(eqx.Module):
    """The past on one side of its breaks: pieces are chosen by times moved into [low, high], and `ahead`; of sources
    whose break waits for its event, back."""

    past: Past
    low: Time
    high: Time
    ahead: Time

    def of(self, past: Past) -> "Remembered":
        """The same side of another past."""
        return dataclasses.replace(self, past=past)

    def read(
        self, t: Time, instant: Float[Array, " delays"], waits: Bool[Array, " delays"]
    ) -> tuple[Array, Array, Array]:
        """Returns (what the sources were, their rates, the rates of these) at an instant for each, at the time t;
        constant under derivatives by `t` and `instant`."""
        past, n = self.past, self.past.n
        t, instant, moves = still((t, instant, (self.low, self.high, self.ahead)))
        low, high, ahead = moves
        at = instant + (jnp.clip(t, low, high) - t) + jnp.where(waits, -ahead, ahead)
        starts = lax.stop_gradient(past.pieces[:, 0])
        number = jnp.sum(starts[:, None] <= at, axis=0)
        oldest = jnp.maximum(past.count.astype(int) - len(starts), 0)
        # Of rows that are read each source needs its own columns alone.
        rows = past.pieces[(oldest + jnp.maximum(number - 1, 0)) % len(starts)]
        own = rows[:, 3 + n :].reshape(n, NODES, n)[np.arange(n), :, np.arange(n)].T
        begins = number == 0
        start, end = jnp.where(begins[:, None], jnp.arange(2, dtype=rows.dtype), rows[:, 1:3]).T
        half = 0.5 * (end - start)
        place = jnp.where(begins, 0.0, (instant - start) / half - 1.0)
        value, rate = _evaluated(own, place)
        powers = jnp.arange(1, NODES, dtype=own.dtype)[:, None]
        _, bend = _evaluated(own[1:] * powers, place)
        rate, bend = (jnp.where(begins, 0.0, one) for one in (rate / half, bend / half**2))
        return jnp.where(begins, past.first, value), rate, bend


class Reached(NamedTuple):
    """What a step meets that comes out of the delays.

    - `due`: the delays out of which a break comes at the end of the step; `ticks`: when it does, which moves with
        parameters; `level`: the levels of these breaks; shape (delays,) each.
    - `request`: the end of the shorter step to take instead; infinity to keep this one.
    - `vanishes`: a delay is negative, or what it reads changes however short the step is.
    - `allowed`: how long the next step may be, for what it leaves and reads to be as exact as asked for.
    - `past`: with the piece that the step leaves; `instants`: the times at which it is read at the end of the step.
    """

    due: Bool[Array, " delays"]
    ticks: Array
    level: Array
    request: Time
    vanishes: Array
    allowed: Time
    past: Past
    instants: Array


def reached(
    problem: AbstractHybridProblem, dense: Any, t0: Time, t1: Time, y0: HybridState, x1: State, args: Args,
    jumped: Numeric,
) -> Reached:  # fmt: skip
    """Looks at the step from y0 to x1, whose states are `dense(t0, t1, t)`; `jumped` says whether inputs jump where it
    begins."""
    past, tolerance, h = y0.past, problem.resolution, t1 - t0
    inside = t0 + h * jnp.asarray(0.5 * (1 + np.append(_PLACES[1:-1], BETWEEN)), t1.dtype)
    times = jnp.concatenate([t0[None], inside, t1[None]])
    states = jnp.concatenate([y0.x[None], jax.vmap(lambda t: dense(t0, t1, t))(inside), x1[None]])
    values, instants = jax.vmap(lambda t, x: problem.sources(t, x, y0.q, args))(times, states)
    nodes = np.append(np.arange(NODES - 1), len(inside) + 1)
    all_times, all_values, between = times, still(values), still(values[NODES - 1 : -1])
    times, values, instants = times[nodes], values[nodes], instants[nodes]
    levels = jnp.where(jumped, jnp.zeros_like(past.levels), past.levels)
    start = t0 + (past.begun - lax.stop_gradient(past.begun))
    fitted = jnp.asarray(_COEFFICIENTS, values.dtype)
    # Differences are fitted: what is constant, such as a whole number, comes out as it is.
    polynomials = (fitted @ (values - values[0])).at[0].add(values[0])
    compared = jnp.asarray(np.vander(BETWEEN, NODES, increasing=True), values.dtype) @ still(polynomials)
    allowed = problem.allowed(jnp.max(jnp.abs(all_values), axis=0))
    error = jnp.max(jnp.abs(between - compared) / allowed)
    # What was constant, and goes on as it was, has no break: of a network of gates, most have not turned.
    goes_on = _is_constant(still(polynomials)) & (polynomials[0] == past.last[0]) & (past.last[1] == 0)
    levels = jnp.where(goes_on, SMOOTH, levels)
    row = jnp.concatenate([jnp.stack([start, t0, t1]), levels, polynomials.ravel()])
    moves = jnp.where(_is_constant(still(polynomials)), 0.0, 1.0).astype(t1.dtype)
    longer = Past(
        past.pieces.at[past.count.astype(int) % len(past.pieces)].set(row),
        past.now.at[0].add(1.0),
        jnp.stack([jnp.sum(still(polynomials), axis=0), moves]),
    )

    now = lax.stop_gradient(instants)
    starts = jnp.append(past.pieces[:, 0], start)
    all_levels = jnp.append(past.levels_of_pieces, levels[None], 0)
    which, left = _next(starts, all_levels, now[0] + 2 * tolerance)
    breaks, level = starts[which], all_levels[which, np.arange(past.n)]
    passed = left & (now[-1] > breaks + tolerance)
    due = left & ~passed & (now[-1] >= breaks - tolerance)
    ticks = t1 + jnp.where(due, (breaks - instants[-1]) / _rates(problem, t1, x1, y0.q, args, due), 0.0)

    def located() -> Time:
        place = _crossing(fitted @ now, lax.stop_gradient(breaks))
        return jnp.min(jnp.where(passed, t0 + 0.5 * h * (1 + place), jnp.inf))

    where = lax.cond(any_member(jnp.any(passed)), located, lambda: jnp.full_like(t1, jnp.inf))
    where = jnp.where(jnp.isfinite(where), jnp.maximum(where, t0 + 2 * tolerance), where)
    # What a step reads beyond its beginning is extrapolated from the piece before.
    ahead = past.extrapolated(all_times)
    differs = jnp.abs(all_values - ahead) / allowed
    beyond, delays = jnp.max(now, axis=0), times[:, None] - now
    wrong = jnp.max(jnp.where(all_times[:, None] <= beyond, differs, 0.0), axis=0)
    own = _evaluated(still(polynomials), (beyond - t0) / (0.5 * h) - 1.0)[0]
    last = jnp.abs(own - past.extrapolated(beyond, each=True)) / allowed
    wrong = jnp.max(jnp.where(beyond > t0 + tolerance, jnp.maximum(wrong, last), 0.0))
    future = jnp.min(delays) < -tolerance
    sooner = jnp.minimum(SAFETY, jnp.maximum(_length(wrong), LEAST)) * h
    sooner = jnp.where(future, LEAST * h, jnp.maximum(sooner, jnp.minimum(jnp.min(delays), SAFETY * h)))
    again = future | (wrong > 1)
    sooner = jnp.where(again, t0 + sooner, jnp.inf)
    coarse = jnp.where((error > 1) & (h > 64 * tolerance), t0 + h * jnp.maximum(_length(error), LEAST), jnp.inf)
    vanishes = again & (h <= 16 * tolerance)
    request = jnp.where(vanishes, jnp.inf, jnp.minimum(jnp.minimum(where, sooner), coarse))
    due = due & ~jnp.isfinite(request)
    # How far beyond the end of this step its pieces may be extrapolated, as the last ones could over this step.
    most = jnp.max(differs, axis=0)
    reach = jnp.where(most == 0, jnp.inf, _length(most) * h)
    reach = jnp.where(reach < REACHES * h, 0.0, reach)
    longest = jnp.minimum(_length(error) * h, jnp.min(delays[-1] + reach))
    return Reached(due, ticks, level, still(request), vanishes, jnp.maximum(longest, LEAST * h), longer, now[-1])


def _length(error: Array) -> Array:
    """The length, as a part of a step, of one whose error is what is allowed, given the error of that step."""
    return SAFETY * jnp.maximum(error, LONGEST**-NODES) ** (-1 / NODES)


def _rates(problem: AbstractHybridProblem, t: Time, x: State, q: Array, args: Args, due: Array) -> Array:
    """How fast the times at which the past is read go on, not zero; 1 for those at which nothing is due."""
    one, constant = jnp.ones_like(due, t.dtype), np.array(_facts(problem).constant)
    if constant.all():
        return one
    problem, t, x, q, args = still((problem, t, x, q, args))

    def along() -> Array:
        direction = jnp.ones_like(t), problem.slope(t, x, q, args)
        return jax.jvp(lambda t, x: problem.sources(t, x, q, args)[1], (t, x), direction)[1]

    rate = lax.cond(any_member(jnp.any(due & ~constant)), along, lambda: one)
    return jnp.where(due & ~constant & (rate != 0), rate, 1.0)


def _facts(problem: AbstractHybridProblem) -> DelayFacts:
    assert problem.facts.delays is not None
    return problem.facts.delays


def begin_due(facts: DelayFacts, t0: Time, delay: Array, due: Array) -> Array:
    """When each clock is due at the beginning of a run, those of the delays included."""
    ends = jnp.where(np.array(facts.constant), t0 + delay, jnp.inf)
    return due.at[np.array(facts.clocks)].set(still(ends))


def waiting(facts: DelayFacts, state: HybridState, due: Bool[Array, " events"]) -> HybridState:
    """The state before the events of an instant. Of several breaks that come out at once each has an event, and a time
    that moves with parameters of its own: equations read on until its event what was before it."""
    waits = due[np.array(facts.clocks)].astype(state.q.dtype)
    return state.but(q=state.q.at[np.array(facts.begins)].set(waits))


def after(
    facts: DelayFacts, t1: Time, y1: HybridState, reach: Reached, time: Time, others: Numeric, tolerance: Time
) -> HybridState:  # fmt: skip
    """The state `y1` after a step, with its past and the times at which the next breaks come out. `time` is that of the
    events at its end, `others` says whether there were any but those of delays."""
    past = reach.past
    # Of several that come out at once the lowest level counts.
    own = jnp.where(np.array(facts.passes), reach.level, reach.level + 1.0)
    levels = jnp.min(jnp.where(reach.due, own, SMOOTH), axis=1)
    levels = still(jnp.where(others, jnp.zeros_like(levels), levels)).astype(t1.dtype)
    head = jnp.stack([past.count, time, still(t1 + reach.allowed)])
    new = dataclasses.replace(past, now=jnp.concatenate([head, levels, past.first]))
    starts = jnp.append(past.pieces[:, 0], t1)
    which, left = _next(starts, jnp.append(past.levels_of_pieces, levels[None], 0), reach.instants + 2 * tolerance)
    due = jnp.where(left & np.array(facts.constant), t1 + (starts[which] - reach.instants), jnp.inf)
    due = y1.due.at[np.array(facts.clocks)].set(still(due))
    return y1.but(past=new, due=due, q=y1.q.at[np.array(facts.begins)].set(0.0))


def is_full(past: Past, t: Time, longest: Array) -> Bool[Array, ""]:
    """True if the piece that is written over next is still needed."""
    oldest = past.pieces[past.count.astype(int) % len(past.pieces)]
    return (past.count >= len(past.pieces)) & (oldest[2] > t - jnp.max(longest))


def _evaluated(polynomials: Array, places: Array) -> tuple[Array, Array]:
    """The values of polynomials and of their derivatives, each at its own place, shape (delays,)."""
    value, rate = polynomials[-1], jnp.zeros_like(places)
    for coefficient in polynomials[-2::-1]:
        value, rate = value * places + coefficient, rate * places + value
    return value, rate


def _is_constant(polynomials: Array) -> Array:
    """True for polynomials without powers, shape (delays,)."""
    return jnp.all(polynomials[1:] == 0, axis=0)


def _next(starts: Array, levels: Array, since: Array) -> tuple[Array, Array]:
    """Returns (the number of the first break of each source since an instant, whether there is one)."""
    counts = (levels <= HIGHEST) & (starts[:, None] > since)
    times = lax.stop_gradient(jnp.where(counts, starts[:, None], jnp.inf))
    which = jnp.argmin(times, axis=0)
    return which, jnp.isfinite(jnp.min(times, axis=0))


def _crossing(coefficients: Array, levels: Array) -> Array:
    """Where in [−1, 1] polynomials pass these levels, shape (delays,)."""

    def halved(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        beyond = _evaluated(coefficients, middle)[0] > levels
        return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

    one = jnp.ones_like(levels)
    return lax.fori_loop(0, SEARCH, halved, (-one, one))[1]
