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

from ..adjoint.closure_conversion import any_member, written
from ..adjoint.resting import still
from .first_order import constant_once
from .problem import AbstractHybridProblem, HybridState, one_hot

CONDITIONS_AT_ONE_INSTANT = 32  # more than these take another step, of no length to speak of
SMALL = 1e-12  # of a guard's size in the step before: counts as zero
REACHED = 1e-9  # of that size: counts as zero at an instant that the guard has reached
CLOSE = 0.01  # of that size: what is farther away is not at zero, however fast it is
FLAT = 1e-9  # of that size, over a step: a change so small may be one of rates alone
ROUNDING = 1e-12  # of that size, over a step: counts as no change
STEADY = 0.1  # of a slope: a change during the delay that leaves it worth following back
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

    - `slope`: dx/dt there, before any event.
    - `rate`: how fast the guards change, shape (guards,); at the initial time only.
    - `due`: which events happen, shape (clocks + guards,).
    - `jumped`: which guards jumped over zero, so that their events do not move in time, shape (guards,).
    - `size`: of the guards of late, shape (guards,).
    - `window`: the time within which a guard counts as having reached zero; `span`: how long steps have been of late.
    """

    slope: Any
    rate: Any
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
        state, q, before = instant.state, instant.state.q, instant.slope
        # Where nothing is left, as in some members of a batch, nothing happens: derivatives of what would have happened
        # need not be finite.
        event = jnp.where(jnp.any(instant.left), jnp.argmax(instant.left), c + g)
        is_clock = event < c
        k = jnp.clip(event - c, 0, max(g - 1, 0))
        delay = rate = jnp.zeros_like(t)
        if at_start and g:
            rate = arrival.rate[k]
        elif g:
            values = problem.guards(t, state.x, q, args)
            rate = problem.rates(t, state.x, q, args, before)[1][k]
            crossing = -values[k] / jnp.where(rate == 0, 1.0, rate)
            # Where another event has made the guard slow, rounding is all that is left of its value.
            frozen = lax.stop_gradient(crossing)
            crossing = crossing + (jnp.clip(frozen, -arrival.window, arrival.window) - frozen)
            crossing = jnp.where(instant.caused[k], instant.delay, crossing)
            delay = jnp.where(is_clock, delay, crossing)
        if c and not at_start:
            exact = problem.due(state.ticks)[jnp.clip(event, 0, c - 1)]
            delay = jnp.where(is_clock, exact - lax.stop_gradient(exact), delay)
        time = t + delay
        reached = state.x + before * delay
        x, new = problem.written(time, reached, q, instant.previous, event, args)
        ticks = state.ticks + one_hot(event, c).astype(state.ticks.dtype)
        logged = (~is_clock & noted[event] & (not at_start)) | (ends[event] > 0)
        row = jnp.where(logged, state.count.astype(int), state.times.shape[0] + 1)
        after, slow, armed, left, caused = _following(problem, t, x, new, instant, event, arrival, delay, args)
        # What is too fast to be followed back, as a current that a blocked diode stops, has that value at once.
        back = delay - (1.0 - slow) * lax.stop_gradient(delay)
        state = HybridState(
            x - after * back,
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

    start = Instant(state, arrival.due, arrival.jumped, jnp.zeros_like(t), state.q, arrival.slope, state.x)
    length = c + min(2 * g, CONDITIONS_AT_ONE_INSTANT)
    instant, _ = lax.scan(step, start, length=length)
    return instant.state, instant.slope


def _noted(rows: Any, row: Any, value: Any) -> Any:
    """Rows with one of them written; nothing is if there is no such row."""
    return rows.at[row].set(value.astype(rows.dtype), mode="drop") if rows.shape[0] else rows


def _following(problem, t, x, q, instant: Instant, event, arrival: Arrival, delay, args):
    """(dx/dt, in which states it hardly changes during the delay, armed guards, events left, which guards an event made
    true) after an event, not differentiated."""
    c, g = problem.n_clocks, problem.n_guards
    left = instant.left & ~one_hot(event, c + g)
    if not g:
        return problem.slope(t, x, q, args), jnp.ones_like(x), instant.state.armed, left, instant.caused
    problem, t, x, q, delay, args = still(constant_once((problem, t, x, q, delay, args)))
    instant = still(instant)
    here = event - c == jnp.arange(g)
    rounding = jnp.where(left[c:], REACHED, SMALL) * arrival.size
    ahead = AHEAD * arrival.span

    def within(rate):
        """How far from zero a guard may be that reaches it, or has left it, within the window."""
        return jnp.minimum(jnp.abs(rate) * arrival.window, CLOSE * arrival.size)

    def is_zero(value, rate):
        return jnp.abs(value) <= jnp.maximum(rounding, within(rate))

    def is_flat(value, rate):
        return is_zero(value, rate) & (jnp.abs(rate) * arrival.span <= FLAT * arrival.size)

    # Slopes, guards and their rates after the event, with what was before it, before the delay, and, where a guard is
    # flat, a little ahead: in a loop, for XLA compiles the equations as often as they are written.
    def look(carry):
        k, slopes, values, rates = carry
        slope = slopes[0]
        places = jnp.stack([x, instant.arrived, x - slope * delay, x + slope * ahead])
        time = jnp.where(k == 3, t + ahead, t)
        own = problem.slope(time, places[k], q, args)
        slopes = written(slopes, k, own)
        value, rate = problem.rates(time, places[k], q, args, jnp.where((k == 0) | (k == 3), own, slope))
        return k + 1, slopes, written(values, k, value), written(rates, k, rate)

    def unfinished(carry):
        k, _, values, rates = carry
        return (k < 3) | ((k == 3) & jnp.any(is_flat(values[0], rates[0])))

    rows = jnp.zeros((4, g), x.dtype)
    begin = jnp.array(0), jnp.zeros((4, *x.shape), x.dtype), rows, rows
    _, (slope, _, earlier, _), values, rates = lax.while_loop(unfinished, look, begin)
    slow = (jnp.abs(earlier - slope) <= STEADY * jnp.abs(slope)).astype(x.dtype)
    (value, at_arrival, _, _), (rate, rate_there, _, rate_ahead) = values, rates
    # A force that keeps a contact closed leaves a guard of the open contact at zero without a slope: what it does next
    # decides. One that seems to fall by rounding alone is waited for: if it does fall, the next step finds it.
    falling = jnp.where(is_flat(value, rate), 0.5 * (rate + rate_ahead), rate)
    zero = is_zero(value, rate)
    true = jnp.where(zero, falling * arrival.span < -ROUNDING * arrival.size, value < 0)
    was_armed = (instant.state.armed > 0.5) & ~here
    # What this event made true happens next. What was to happen does so, though a state starts anew: unless what was
    # assigned makes its condition false, or it is revocable and undone.
    reached = at_arrival <= jnp.maximum(SMALL * arrival.size, within(rate_there))
    stands = left[c:] & ~np.array(problem.revocable[c:], bool) & reached
    caused = ((was_armed & true) | stands) & ~zero
    next_ones = ((was_armed | left[c:]) & true & ~here) | stands
    armed = jnp.where(true, next_ones, True)
    return slope, slow, armed.astype(instant.state.armed.dtype), jnp.concatenate([left[:c], next_ones]), caused
