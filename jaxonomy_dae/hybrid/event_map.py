"""What happens at one instant: events one after another, each a map at a frozen time.

A step ends at a time t₁ that counts as a constant. The event happens at τ = t₁ + δ with δ = −g/ġ, zero but for
rounding; its derivative is that of the time of the crossing, by the implicit function theorem. The map

    xₑ = x₁ + f⁻·δ,   (x⁺, q⁺) = R(τ, xₑ, q),   x₁' = x⁺ − f⁺·δ

has the value R and, f⁻ and f⁺ being constants, the saltation matrix as its derivative (Aizerman & Gantmacher 1958). Its
second derivative is not that of the flow, and is refused. A clock ticks at τ = offset + k·period, a function of
parameters, in the same manner.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ..adjoint.closure_conversion import any_member
from ..aliases import Args, Time
from ..modeling.events import EventFlag
from .after_event import aftermath
from .instant import Arrival, Happening, Instant, is_zero
from .log import EventRows
from .problem import AbstractHybridProblem, HybridState, one_hot
from .rivals import Rivals
from .side import BELOW, RESTS

CONDITIONS_AT_ONE_INSTANT = 32  # if more events are due, the rest happen in another step, which is as good as none
# How often guards may fall while time does not go on, beside so often for each. Beyond, relations turn back and forth,
# or conditions make each other true without end.
SLIDES, TURNS = 64, 4


def most_at_once(problem: AbstractHybridProblem) -> int:
    """The largest number of events that can be listed at one instant."""
    return _most_in_turn(problem) * max(int(problem.facts.are(EventFlag.STRIKE).sum()), 1)


def _most_in_turn(problem: AbstractHybridProblem) -> int:
    return problem.facts.n_clocks + min(2 * problem.facts.n_guards, CONDITIONS_AT_ONE_INSTANT)


def handle(
    problem: AbstractHybridProblem, t: Time, state: HybridState, arrival: Arrival, args: Args, noted: EventRows,
    at_start: bool = False,
) -> tuple[HybridState, Array, EventRows]:  # fmt: skip
    """Returns (the state after all events of an instant, dx/dt there, `noted` with the events that are listed).

    At the initial time, `at_start`, events do not move with parameters, and are logged only if they end the run.
    """
    c, g = problem.facts.n_clocks, problem.facts.n_guards
    listed = problem.facts.are(EventFlag.LISTED) & (np.arange(c + g) >= c) & (not at_start)
    ends = jnp.asarray(problem.facts.ends).astype(t.dtype)
    relations = jnp.asarray(problem.facts.are(EventFlag.RELATION))
    # At the initial time, a guard that is zero and begins to fall has its event in the first step, not at this instant.
    waits = (arrival.size == 0) & (arrival.rate < 0) & ~arrival.due[c:] if at_start else np.zeros(g, bool)
    several = problem.facts.are(EventFlag.STRIKE).sum() > 1
    strikes = jnp.asarray(problem.facts.are(EventFlag.STRIKE))
    first = state.count
    rivals = Rivals.of(problem.facts)

    def next_event(instant: Instant) -> Instant:
        """The instant after the next event, or the next ones that strike together."""
        state, q, before = instant.state, instant.state.q, instant.slope
        # Where nothing is left, as in some members of a batch, nothing happens: derivatives of what would have happened
        # need not be finite.
        goes_on = jnp.any(instant.round & instant.left)
        together = instant.left & (instant.round | ~goes_on)
        base, base_slope, previous = (
            jnp.where(goes_on, kept, now)
            for kept, now in ((instant.before, state.x), (instant.approach, before), (instant.previous, q))
        )
        event = jnp.where(jnp.any(together), jnp.argmax(together), c + g)
        is_clock = event < c
        delay, rates = jnp.zeros_like(t), arrival.rate
        rose = onto = jnp.zeros((g,), bool)
        if g and not at_start:
            crossing, rates, rose, onto = _crossing(problem, t, instant, event, relations, arrival, args)
            delay = jnp.where(is_clock, delay, crossing)
        if c and not at_start:
            exact = problem.due(state.ticks)[jnp.clip(event, 0, c - 1)]
            delay = jnp.where(is_clock, exact - lax.stop_gradient(exact), delay)
        time = t + delay
        reached = state.x + before * delay
        # Parts that strike at the same instant do so at once, whatever the order: a box that falls flat does not turn.
        # All share the δ of the first: if a parameter parts their instants, the derivative is one-sided, as at any
        # kink.
        happening = one_hot(event, c + g)
        if several:
            happening = happening | (instant.left & strikes & strikes[event])
        x, written = problem.written(time, reached, base + base_slope * delay, q, previous, happening, args)
        ticks = state.ticks + one_hot(event, c).astype(state.ticks.dtype)
        logged = happening & (listed | (ends > 0))
        shown = jnp.arange(c + g) if several else event[None]
        row = (state.count - first).astype(int) + jnp.cumsum(logged[shown]) - 1
        row = jnp.where(logged[shown], row, noted.log.shape[0])
        rate = jnp.concatenate([jnp.zeros((c,), t.dtype), rates])[shown]
        now = Happening(
            event=event,
            these=happening,
            delay=delay,
            moved=jnp.any(x != reached) & ~relations[event],
            approach=jnp.where(instant.caused | at_start, 0.0, rates),
            rose=rose,
            onto=onto,
            waits=waits,
        )
        after = aftermath(problem, t, x, written, instant, arrival, now, args)
        turns = state.turns + (~is_clock).astype(t.dtype)
        slides = ~is_clock & (turns > SLIDES + TURNS * g)
        sticks = jnp.any(after.stuck)
        again = jnp.where(slides, event, jnp.where(sticks, c + jnp.argmax(after.stuck), -1)) if g else jnp.array(-1)
        wrote = instant.wrote
        if rivals.places:
            both = jnp.concatenate([reached, q]), jnp.concatenate([x, written])
            clash, wrote = rivals.after(event, *both, jnp.where(goes_on, wrote, rivals.nobody))
            again = jnp.where(clash < -1, clash, jnp.where(state.stuck < -1, state.stuck.astype(int), again))
        # States whose slope changes during the delay, for example a current that a blocked diode stops, are not
        # followed back over it: they keep the value after the event.
        back = delay - (1.0 - after.slow) * lax.stop_gradient(delay)
        now_noted = instant.noted.written(
            row, time, shown, rate, jnp.concatenate([reached, q]), jnp.concatenate([x, after.q])
        )
        state = state.but(
            x=x - after.slope * back,
            q=after.q,
            armed=after.armed,
            ticks=ticks,
            due=lax.stop_gradient(problem.due(ticks)),
            count=state.count + jnp.sum(logged).astype(state.count.dtype),
            ended=jnp.maximum(state.ended, jnp.max(jnp.where(happening, ends, 0.0))),
            stuck=again.astype(t.dtype),
            turns=turns,
        )
        return Instant(
            state=state,
            left=after.left,
            caused=after.caused,
            delay=delay,
            round=together,
            before=base,
            approach=base_slope,
            previous=previous,
            slope=after.slope,
            arrived=instant.arrived,
            stuck=after.stuck,
            noted=now_noted,
            wrote=wrote,
        )

    none = jnp.zeros((g,), bool)
    start = Instant(
        state=state,
        left=arrival.due,
        caused=arrival.jumped,
        delay=jnp.zeros_like(t),
        round=arrival.due,
        before=state.x,
        approach=arrival.slope,
        previous=state.q,
        slope=arrival.slope,
        arrived=state.x,
        stuck=none,
        noted=noted,
        wrote=rivals.nobody,
    )
    length = _most_in_turn(problem)
    # Loops of fixed length, whose bodies are skipped where nothing is left: reverse mode cannot go back over a `while`.
    # Of a thousand clocks, few tick at once: loops in a loop pass over the others in √1000 steps.
    inner = max(math.isqrt(length), min(length, CONDITIONS_AT_ONE_INSTANT))
    handled = _while_any_is_left(next_event, inner)
    if length > inner:
        handled = _while_any_is_left(handled, -(-length // inner))
    instant = handled(start)
    return instant.state, instant.slope, instant.noted


def _crossing(
    problem: AbstractHybridProblem,
    t: Time,
    instant: Instant,
    event: Array,
    relations: Array,
    arrival: Arrival,
    args: Args,
) -> tuple[Time, Array, Array, Array]:
    """Returns (δ of the event if it is one of a condition, the rates of the guards before it, the guards that have just
    risen to zero, those that have jumped onto zero)."""
    c, g, state = problem.facts.n_clocks, problem.facts.n_guards, instant.state
    k = jnp.clip(event - c, 0, max(g - 1, 0))
    values = problem.guards(t, state.x, state.q, args)
    value, rates = problem.rates(t, state.x, state.q, args, instant.slope)
    # A guard that has just risen to zero would be above it but for this event: it falls if the event turns it back. A
    # relation has an opposite, which falls then.
    rose = (state.armed == BELOW) & is_zero(value, rates, arrival) & (rates > 0) & ~relations[c:]
    # A condition whose guard has jumped onto zero and does not move there is true unless it is strict.
    onto = arrival.jumped & (value == 0) & (rates == 0) & ~problem.facts.are(EventFlag.STRICT)[c:]
    crossing = -values[k] / jnp.where(rates[k] == 0, 1.0, rates[k])
    # Where another event has made the guard slow, rounding is all that is left of its value.
    frozen = lax.stop_gradient(crossing)
    crossing = crossing + (jnp.clip(frozen, -arrival.window, arrival.window) - frozen)
    # A guard that rested falls where it leaves the band, perhaps so slowly that its slope is another one at zero.
    crossing = crossing - jnp.where(state.armed[k] == RESTS, lax.stop_gradient(crossing), 0.0)
    return jnp.where(instant.caused[k], instant.delay, crossing), rates, rose, onto


def _while_any_is_left(step: Callable[[Instant], Instant], times: int) -> Callable[[Instant], Instant]:
    """The step repeated so many times; it is skipped where no event is left."""

    def once(instant: Instant, _: None) -> tuple[Instant, None]:
        going = jnp.any(instant.left)

        def go(instant: Instant) -> Instant:
            return jax.tree.map(lambda a, b: jnp.where(going, a, b), step(instant), instant)

        return lax.cond(any_member(going), go, lambda instant: instant, instant), None

    return lambda instant: lax.scan(once, instant, length=times)[0]
