"""What happens at one instant: events one after another, each a map at a frozen time.

A step ends at a time t₁ that counts as a constant. The event happens at τ = t₁ + δ with δ = −g/ġ, zero but for
rounding; its derivative is that of the time of the crossing, by the implicit function theorem. The map

    xₑ = x₁ + f⁻·δ,   (x⁺, q⁺) = R(τ, xₑ, q),   x₁' = x⁺ − f⁺·δ

has the value R and, f⁻ and f⁺ being constants, the saltation matrix as its derivative (Aizerman & Gantmacher 1958). Its
second derivative is not that of the flow, and is refused. A clock ticks at τ = offset + k·period, a function of
parameters, in the same manner.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from .problem import AbstractHybridProblem, HybridState, one_hot

CONDITIONS_AT_ONE_INSTANT = 32  # more than these take another step, of no length to speak of
SMALL = 1e-12  # of a guard's size in the step before: counts as zero
REACHED = 1e-9  # of that size: counts as zero at an instant that the guard has reached
FLAT = 1e-9  # of that size, over a step: a change so small may be one of rates alone
ROUNDING = 1e-12  # of that size, over a step: counts as no change
AHEAD = 1e-3  # of a step: how far ahead a guard that is flat at zero is looked at


class Instant(eqx.Module):
    """An instant while it is handled: the events that are left, which of them were made true by another event, the
    delay δ of the last one, the discrete values before the instant, dx/dt after the last event, and the state before
    the instant."""

    state: HybridState
    left: Any
    caused: Any
    delay: Any
    previous: Any
    slope: Any
    arrived: Any


class Arrival(NamedTuple):
    """What a step meets at its end, not differentiated.

    - `due`: which events happen, shape (clocks + guards,).
    - `jumped`: which guards jumped over zero, so that their events do not move in time, shape (guards,).
    - `size`: of the guards of late, shape (guards,).
    - `window`: the time within which a guard counts as having reached zero; `span`: how long steps have been of late.
    """

    due: Any
    jumped: Any
    size: Any
    window: Any
    span: Any


def handle(
    problem: AbstractHybridProblem, t: Any, state: HybridState, arrival: Arrival, args: Any, at_start: bool = False
) -> tuple[HybridState, Any]:
    """The state after all events of an instant, and dx/dt there.

    At the initial time, `at_start`, events do not move with parameters, and are logged only if they end the run.
    """
    c, g = problem.n_clocks, problem.n_guards
    noted = jnp.asarray(problem.noted)
    ends = jnp.asarray(problem.ends).astype(t.dtype)

    def one(instant: Instant) -> Instant:
        state, q = instant.state, instant.state.q
        before = problem.slope(t, state.x, q, args)
        # Where nothing is left, as in some members of a batch, nothing happens: derivatives of what would have happened
        # need not be finite.
        event = jnp.where(jnp.any(instant.left), jnp.argmax(instant.left), c + g)
        is_clock = event < c
        delay = jnp.zeros_like(t)
        if g:
            values = problem.guards(t, state.x, q, args)
            _, rates = problem.rates(t, state.x, q, args, before)
            k = jnp.clip(event - c, 0, g - 1)
            rate = rates[k]
            crossing = -values[k] / jnp.where(rate == 0, 1.0, rate)
            # Where another event has made the guard slow, rounding is all that is left of its value.
            frozen = lax.stop_gradient(crossing)
            crossing = crossing + (jnp.clip(frozen, -arrival.window, arrival.window) - frozen)
            crossing = jnp.where(instant.caused[k], instant.delay, crossing)
            delay = jnp.where(is_clock, delay, crossing)
        else:
            rate = jnp.zeros_like(t)
        if at_start:
            delay = jnp.zeros_like(t)
        elif c:
            exact = problem.due(state.ticks)[jnp.clip(event, 0, c - 1)]
            delay = jnp.where(is_clock, exact - lax.stop_gradient(exact), delay)
        time = t + delay
        reached = state.x + before * delay
        x, new = problem.written(time, reached, q, instant.previous, event, args)
        after = problem.slope(t, x, new, args)
        ticks = state.ticks + one_hot(event, c).astype(state.ticks.dtype)
        logged = (~is_clock & noted[event] & (not at_start)) | (ends[event] > 0)
        row = jnp.where(logged, state.count.astype(int), state.times.shape[0] + 1)
        armed, left, caused = _following(problem, t, x, new, after, instant, event, arrival, args)
        state = HybridState(
            x - after * delay,
            new,
            armed,
            state.size,
            state.span,
            state.request,
            ticks,
            lax.stop_gradient(problem.due(ticks)),
            state.count + logged.astype(state.count.dtype),
            _noted(state.times, row, time),
            _noted(state.which, row, event),
            _noted(state.rate, row, lax.stop_gradient(rate)),
            jnp.maximum(state.ended, ends[event]),
            _noted(state.before, row, jnp.concatenate([reached, q])),
            _noted(state.after, row, jnp.concatenate([x, new])),
        )
        # Clocks that tick together read what was before all of them.
        previous = jnp.where(jnp.any(left[:c]), instant.previous, new) if c else new
        return Instant(state, left, caused, delay, previous, after, instant.arrived)

    def step(instant: Instant, _: None) -> tuple[Instant, None]:
        going = jnp.any(instant.left)

        def go(instant: Instant) -> Instant:
            return jax.tree.map(lambda a, b: jnp.where(going, a, b), one(instant), instant)

        return lax.cond(any_member(going), go, lambda instant: instant, instant), None

    start = Instant(state, arrival.due, arrival.jumped, jnp.zeros_like(t), state.q, jnp.zeros_like(state.x), state.x)
    length = c + min(2 * g, CONDITIONS_AT_ONE_INSTANT)
    instant, _ = lax.scan(step, start, length=length)
    return instant.state, instant.slope


def _noted(rows: Any, row: Any, value: Any) -> Any:
    """Rows with one of them written; nothing is if there is no such row."""
    return rows.at[row].set(value.astype(rows.dtype), mode="drop") if rows.shape[0] else rows


def _following(problem, t, x, q, slope, instant: Instant, event, arrival: Arrival, args):
    """(armed guards, events left, which guards an event made true) after an event, not differentiated."""
    problem, t, x, q, slope, instant, args = still((problem, t, x, q, slope, instant, args))
    c, g = problem.n_clocks, problem.n_guards
    left = instant.left & ~one_hot(event, c + g)
    if not g:
        return instant.state.armed, left, instant.caused
    value, rate = problem.rates(t, x, q, args, slope)
    here = event - c == jnp.arange(g)
    rounding = jnp.where(left[c:], REACHED, SMALL) * arrival.size
    zero = jnp.abs(value) <= jnp.maximum(rounding, jnp.abs(rate) * arrival.window)
    # A force that keeps a contact closed leaves a guard of the open contact at zero without a slope: what it does next
    # decides. One that seems to fall by rounding alone is waited for: if it does fall, the next step finds it.
    flat = zero & (jnp.abs(rate) * arrival.span <= FLAT * arrival.size)

    def mean_rate():
        later, ahead = t + AHEAD * arrival.span, x + slope * AHEAD * arrival.span
        return 0.5 * (rate + problem.rates(later, ahead, q, args, problem.slope(later, ahead, q, args))[1])

    falling = jnp.where(flat, lax.cond(any_member(jnp.any(flat)), mean_rate, lambda: rate), rate)
    true = jnp.where(zero, falling * arrival.span < -ROUNDING * arrival.size, value < 0)
    was_armed = (instant.state.armed > 0.5) & ~here
    # What this event made true happens next. What was to happen does so, though a state starts anew: unless what was
    # assigned makes its condition false, or it is revocable and undone.
    at_arrival, rate_there = problem.rates(t, instant.arrived, q, args, slope)
    reached = at_arrival <= jnp.maximum(SMALL * arrival.size, jnp.abs(rate_there) * arrival.window)
    stands = left[c:] & ~np.array(problem.revocable[c:], bool) & reached
    caused = ((was_armed & true) | stands) & ~zero
    next_ones = ((was_armed | left[c:]) & true & ~here) | stands
    armed = jnp.where(true, next_ones, True)
    return armed.astype(instant.state.armed.dtype), jnp.concatenate([left[:c], next_ones]), caused
