"""Where a run with events begins."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import Args, State, Time
from ...write.events import EventFlag
from ..adjoint.resting import still
from .event_map import handle
from .instant import Arrival
from .iteration import Iteration
from .log import EventRows
from .problem import AbstractHybridProblem, HybridState
from .side import ABOVE, BELOW, RESTS, rounding

ROUNDS = 4  # each settles relations that depend on those settled before: a relation within a relation takes two


class Resumed(NamedTuple):
    """The memory of the events of a run from which another one goes on; all events of the instant have happened.

    - `sides`: on which side of zero each guard is, shape (guards,).
    - `ticked`: 1.0 for clocks that have ticked at this instant, shape (clocks,).
    - `sizes`: how large the guards have been, shape (guards,).
    """

    sides: Array
    ticked: Array
    sizes: Array


def start(
    problem: AbstractHybridProblem, t0: Time, x0: State, q0: Array, args: Args, logged: int, sides: bool,
    resumed: Resumed | None = None,
) -> HybridState:  # fmt: skip
    """The state at the initial time, after the clocks that tick there, and after the events that are immediate; or, of
    a run that is `resumed`, after events whose guards have jumped since, as by another input.

    `logged` says for how many events there is room, `sides` whether the states before and after them are kept.
    """
    c, dtype = problem.facts.n_clocks, t0.dtype
    nothing = jnp.zeros((), dtype)
    tolerance = problem.resolution
    relations = problem.facts.are(EventFlag.RELATION)
    ticks = _ticks_before(problem, t0, None if resumed is None else resumed.ticked)
    due = problem.due(ticks) <= t0 + tolerance
    q0, rate, value = _settled(problem, t0, x0, q0, due, args, resumed)
    ticks = ticks + (due & relations[:c]).astype(dtype)
    size = jnp.abs(value)
    if resumed is None:
        # A strict condition whose sides are equal is false: if it becomes true at once, that is an event of the first
        # step. An event that happens at the start if its condition holds happens then, too.
        turned, holds = _turned(problem, value, rate), (value < 0) | ((value == 0) & problem.facts.true_at_zero)
        armed = jnp.where(jnp.where(relations[c:], turned, holds), BELOW, jnp.where(value == 0, RESTS, ABOVE))
        at_once = problem.facts.are(EventFlag.AT_START)[c:] & ~relations[c:]
        due_conditions = holds | ((value == 0) & (rate < 0))
    else:
        size = jnp.maximum(size, resumed.sizes)
        band, far = rounding(size), _beyond_doubt(size)
        due_conditions = (resumed.sides > 0) & (value < -far)
        armed = jnp.where(value > band, ABOVE, jnp.where(value < -far, BELOW, resumed.sides))
        at_once = ~relations[c:]
    table = EventRows.empty(logged, sides, len(x0) + len(q0), dtype)
    repeated = problem.facts.are(EventFlag.REPEATED).any()
    iteration = Iteration.begin(len(q0), dtype) if repeated else None
    state = HybridState.of(
        x0, q0, table, iteration, armed=armed.astype(dtype), size=size, ticks=ticks,
        due=lax.stop_gradient(problem.due(ticks)), span=nothing, request=jnp.full_like(t0, jnp.inf), ended=nothing,
        stuck=nothing - 1.0, turns=nothing, count=nothing,
    )  # fmt: skip
    if relations[:c].all() and not at_once.any():
        return state
    due_conditions = due_conditions & at_once
    due = jnp.concatenate([state.due <= t0 + tolerance, due_conditions])
    # Guards of conditions that hold at the start need not be near zero.
    slope = jnp.zeros_like(x0) if resumed is None else problem.slope(t0, x0, q0, args)
    arrival = Arrival(slope, rate, due, due_conditions, size, tolerance, tolerance)
    state, _, table, _ = handle(problem, t0, state, arrival, args, table, at_start=resumed is None)
    return dataclasses.replace(state, table=table)


def _ticks_before(problem: AbstractHybridProblem, t0: Time, ticked: Array | None) -> Array:
    """How often each clock has ticked before t0, and at t0 if it has `ticked` there."""
    dtype, c = t0.dtype, problem.facts.n_clocks
    period, offset = (lax.stop_gradient(v) for v in problem.clocks())
    relations = problem.facts.are(EventFlag.RELATION)[:c]
    passed = t0 - problem.resolution - offset
    # A tick that falls on t0 up to rounding is still to come: it happens at the start.
    ticks = jnp.where(jnp.isinf(period), (passed > 0).astype(dtype), jnp.ceil(passed / period))
    # Clocks of relations are counted from before t0, too. Other clocks start at tick 0.
    ticks = jnp.where(relations, ticks, jnp.maximum(ticks, 0.0))
    if ticked is None:
        return ticks
    # The next tick of a clock that has ticked here is clearly later, though rounding may have put this one on either
    # side of t0.
    slack = jnp.sqrt(jnp.finfo(dtype).eps)
    next_one = jnp.where(jnp.isinf(period), 1.0, jnp.floor((t0 - offset) / period + slack) + 1.0)
    return jnp.where((ticked > 0) & ~relations, next_one, ticks)


def _turned(problem: AbstractHybridProblem, value: Array, rate: Array) -> Array:
    """True for relations that hold from the initial time on. A guard at zero is judged by its rate, and where that is
    zero, too, by the kind of its relation."""
    return (value < 0) | ((value == 0) & ((rate < 0) | ((rate == 0) & problem.facts.true_at_zero)))


def _beyond_doubt(size: Array) -> Array:
    """How far beyond zero a guard that was on the other side must be when a run is resumed, to have jumped there: saved
    states are on the constraints up to much less than half of the digits."""
    return jnp.sqrt(jnp.finfo(size.dtype).eps) * size


def _settled(
    problem: AbstractHybridProblem, t0: Time, x0: State, q0: Array, due: Array, args: Args, resumed: Resumed | None
) -> tuple[Array, Array, Array]:
    """Settles the relations at the initial time: each gets the truth of its sides, or, if its clock is `due`, what that
    writes; of a run that is `resumed`, one whose sides are equal keeps its truth. Returns (q, rates of the guards,
    values of the guards); q does not move with parameters."""
    c, g = problem.facts.n_clocks, problem.facts.n_guards
    relations = problem.facts.are(EventFlag.RELATION)
    given = still((problem, t0, x0, q0, due, args, resumed))
    problem, t0, x0, begin, due, args, resumed = given

    def written(q: Array, clocks: Array, holding: Array) -> Array:
        return problem.settled(t0, x0, q, jnp.concatenate([clocks, holding]) & relations, args)

    def looked_at(q: Array) -> tuple[Array, Array]:
        if problem.facts.only_kinks:  # which of two that are opposite holds at zero does not matter
            first = np.arange(g) < np.array(problem.facts.opposite)
            return problem.guards(t0, x0, q, args), jnp.where(first, -1.0, 1.0).astype(x0.dtype)
        return problem.rates(t0, x0, q, args, problem.slope(t0, x0, q, args))

    def holding(value: Array, rate: Array) -> Array:
        if resumed is None:
            return _turned(problem, value, rate)
        return value < -_beyond_doubt(jnp.maximum(jnp.abs(value), resumed.sizes))

    def once(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """One round: relations are set by the guards of the round before, and the guards are evaluated again."""
        q, rate, value = carry
        q = jnp.where(k > 0, written(q, jnp.zeros((c,), bool), holding(value, rate)), q)
        value, rate = looked_at(q)
        return q, rate, value

    found, none = begin, jnp.zeros((g,), bool)
    if relations[:c].any():
        found = lax.fori_loop(0, 2, lambda k, q: written(q, due | (k == 0), none), found)
    rate = value = jnp.zeros((g,), x0.dtype)
    if g:  # in a loop, for XLA compiles the equations as often as they are written
        rounds = ROUNDS if relations[c:].any() else 0
        found, rate, value = lax.fori_loop(0, rounds + 1, once, (found, rate, value))
    # A value that has not changed keeps its derivative; one that was decided has none.
    return jnp.where(found == begin, q0, found), rate, value
