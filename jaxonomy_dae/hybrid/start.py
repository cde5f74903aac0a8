"""Where a run with events begins."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..adjoint.resting import still
from ..aliases import Args, State, Time
from .event_map import Arrival, handle
from .problem import AbstractHybridProblem, HybridState
from .side import ABOVE, BELOW, RESTS

ROUNDS = 4  # each settles relations that depend on those settled before: a relation within a relation takes two


def start(
    problem: AbstractHybridProblem, t0: Time, x0: State, q0: Any, args: Args, logged: int, sides: bool
) -> HybridState:
    """The state at the initial time, after the clocks that tick there, and after the events that are immediate.

    `logged` says for how many events there is room, `sides` whether the states before and after them are kept.
    """
    c, g = problem.n_clocks, problem.n_guards
    dtype = t0.dtype
    nothing, infinite = jnp.zeros((), dtype), jnp.full((logged,), jnp.inf, dtype)
    period, offset = (lax.stop_gradient(v) for v in problem.clocks())
    tolerance = problem.resolution
    passed = t0 - tolerance - offset
    ticks = jnp.where(jnp.isinf(period), (passed > 0).astype(dtype), jnp.ceil(passed / period))
    relations = np.array(problem.relations, bool)
    ticks = jnp.where(relations[:c], ticks, jnp.maximum(ticks, 0.0))  # relations have turned at all times
    due = problem.due(ticks) <= t0 + tolerance
    q0, rate, value = _settled(problem, t0, x0, q0, due, args)
    ticks = ticks + (due & relations[:c]).astype(dtype)
    holding, size = _holds(value, rate), jnp.abs(value)
    armed = jnp.zeros((0,), dtype)
    if g:
        armed = jnp.where(holding, BELOW, jnp.where(value == 0, RESTS, ABOVE)).astype(dtype)
    rows = jnp.full((logged if sides else 0, len(x0) + len(q0)), jnp.nan, dtype)
    state = HybridState.of(
        x0, q0, armed=armed, size=size, ticks=ticks, due=lax.stop_gradient(problem.due(ticks)), span=nothing,
        request=jnp.full_like(t0, jnp.inf), ended=nothing, stuck=nothing - 1.0, turns=nothing, count=nothing,
        times=infinite, which=jnp.full_like(infinite, -1.0), rate=jnp.zeros_like(infinite), before=rows, after=rows,
    )  # fmt: skip
    at_once = np.array(problem.immediate[c:], bool) & ~relations[c:]
    if relations[:c].all() and not at_once.any():
        return state
    due_conditions = holding & at_once
    due = jnp.concatenate([state.due <= t0 + tolerance, due_conditions])
    # What holds at the start need not be near zero.
    arrival = Arrival(jnp.zeros_like(x0), rate, due, due_conditions, size, tolerance, tolerance)
    return handle(problem, t0, state, arrival, args, at_start=True)[0]


def _holds(value: Any, rate: Any) -> Any:
    """True for conditions that hold at the start. A guard at zero is judged by its rate: the condition holds if the
    guard is falling."""
    return jnp.where(value == 0, rate < 0, value < 0)


def _settled(
    problem: AbstractHybridProblem, t0: Time, x0: State, q0: Any, due: Any, args: Args
) -> tuple[Any, Any, Any]:
    """Settles the relations at the initial time: each gets the truth of its sides, or, if its clock is `due`, what that
    writes. Returns (q, rates of the guards, values of the guards); q does not move with parameters."""
    c, g = problem.n_clocks, problem.n_guards
    relations = np.array(problem.relations, bool)
    given = still((problem, t0, x0, q0, due, args))
    problem, t0, x0, begin, due, args = given

    def written(q: Any, clocks: Any, holding: Any) -> Any:
        return problem.settled(t0, x0, q, jnp.concatenate([clocks, holding]) & relations, args)

    def looked_at(q: Any) -> tuple[Any, Any]:
        if problem.only_kinks:  # which of two that are opposite holds at zero does not matter
            first = np.arange(g) < np.array(problem.opposite)
            return problem.guards(t0, x0, q, args), jnp.where(first, -1.0, 1.0).astype(x0.dtype)
        return problem.rates(t0, x0, q, args, problem.slope(t0, x0, q, args))

    def once(k: Any, carry: Any) -> Any:
        """One round: relations are set by the guards of the round before, and the guards are evaluated again."""
        q, rate, value = carry
        q = jnp.where(k > 0, written(q, jnp.zeros((c,), bool), _holds(value, rate)), q)
        value, rate = looked_at(q)
        return q, rate, value

    found, none = begin, jnp.zeros((g,), bool)
    if relations[:c].any():
        found = lax.fori_loop(0, 2, lambda k, q: written(q, due | (k == 0), none), found)
    rate = value = jnp.zeros((g,), x0.dtype)
    if g:  # in a loop, for XLA compiles the equations as often as they are written
        rounds = ROUNDS if relations[c:].any() else 0
        found, rate, value = lax.fori_loop(0, rounds + 1, once, (found, rate, value))
    return jnp.where(found == begin, q0, found), rate, value
