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
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..adjoint.closure_conversion import any_member, written
from ..adjoint.resting import still
from ..aliases import Args, Time
from ..modeling.event_flags import EventFlag
from .first_order import constant_once
from .log import EventRows
from .modes import Search, sets_to_flip
from .problem import AbstractHybridProblem, HybridState, one_hot
from .rivals import Rivals
from .side import ABOVE, BELOW, RESTS, rounding

CONDITIONS_AT_ONE_INSTANT = 32  # if more events are due, the rest happen in another step, which is as good as none
# A guard farther from zero than this part of its recent maximum has not reached zero, however fast it moves: with stiff
# dynamics behind an event, a guard may be about to cross its whole range within `window`. Set by hand:
# test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
CLOSE = 0.01
# After an event the state is followed back along its new slope over the delay δ, so that the step ends at a constant
# time. A state whose slope changes by more than this part during δ is not: it is faster than δ, and the way back is
# wrong.
# Set by hand: the tests named above pass with ten times it and a tenth.
STEADY = 0.1
# Of a step: how far ahead the rate of a guard at zero is looked at, for the sign of its second derivative. That is
# found up to a part AHEAD, and rounding in it is 1/AHEAD times that of rates. Set by hand: the tests named above pass
# with ten times it and a tenth.
AHEAD = 1e-3
# Steps within which a guard leaves the band about zero that is really pulled out of it: rounding in the forces on what
# is at rest takes longer. With a tenth, test_hybrid_runs.py::test_nothing_falls_through_a_floor fails; ten times it
# passes.
SINKING = 4.0
# How often guards may fall while time does not go on, beside so often for each. Beyond, relations turn back and forth,
# or conditions make each other true without end.
SLIDES, TURNS = 64, 4


class Instant(eqx.Module):
    """The state of the loop over the events of one instant.

    - `state`: the state after the events so far.
    - `left`: the events still to happen, shape (clocks + guards,).
    - `caused`: the guards that another event of this instant made fall, shape (guards,).
    - `delay`: δ of the last event (second).
    - `round`: the events that happen as one: all read what was before the first of them; what they cause comes after.
    - `before`, `approach`, `previous`: the continuous state before this round, its slope, and the discrete values.
    - `slope`: dx/dt after the last event.
    - `arrived`: the continuous state before the instant.
    - `stuck`: the guards that an event has left at zero, about to fall again, shape (guards,).
    - `noted`: the events of this instant that are listed.
    - `wrote`: which event of this round wrote each contested place last.
    """

    state: HybridState
    left: Any
    caused: Any
    delay: Time
    round: Any
    before: Any
    approach: Any
    previous: Any
    slope: Any
    arrived: Any
    stuck: Any
    noted: EventRows
    wrote: Any


class Arrival(NamedTuple):
    """The events due at the end of a step, not differentiated.

    - `slope`: dx/dt there, before any event.
    - `rate`: how fast the guards change, shape (guards,); at the initial time only.
    - `due`: which events happen, shape (clocks + guards,).
    - `jumped`: which guards jumped over zero, so that their events do not move in time, shape (guards,).
    - `size`: the largest magnitude of each guard so far, shape (guards,).
    - `window`: the time within which a guard counts as having reached zero; `span`: how long steps have been of late.
    """

    slope: Any
    rate: Any
    due: Any
    jumped: Any
    size: Any
    window: Time
    span: Time


def most_at_once(problem: AbstractHybridProblem) -> int:
    """The largest number of events that can be listed at one instant."""
    return _most_in_turn(problem) * max(int(problem.facts.are(EventFlag.STRIKE).sum()), 1)


def _most_in_turn(problem: AbstractHybridProblem) -> int:
    return problem.facts.n_clocks + min(2 * problem.facts.n_guards, CONDITIONS_AT_ONE_INSTANT)


def handle(
    problem: AbstractHybridProblem, t: Time, state: HybridState, arrival: Arrival, args: Args, noted: EventRows,
    at_start: bool = False,
) -> tuple[HybridState, Any, EventRows]:  # fmt: skip
    """Returns (the state after all events of an instant, dx/dt there, `noted` with the events that are listed).

    At the initial time, `at_start`, events do not move with parameters, and are logged only if they end the run.
    """
    c, g = problem.facts.n_clocks, problem.facts.n_guards
    listed = problem.facts.are(EventFlag.LISTED) & (np.arange(c + g) >= c) & (not at_start)
    ends = jnp.asarray(problem.facts.ends).astype(t.dtype)
    relations = jnp.asarray(problem.facts.are(EventFlag.RELATION))
    # At the initial time, what is zero and begins to fall is an event of the first step, and no part of this instant.
    waits = (arrival.size == 0) & (arrival.rate < 0) & ~arrival.due[c:] if at_start else np.zeros(g, bool)
    several = problem.facts.are(EventFlag.STRIKE).sum() > 1
    strikes = jnp.asarray(problem.facts.are(EventFlag.STRIKE))
    first = state.count
    rivals = Rivals.of(problem.facts)

    def one(instant: Instant) -> Instant:
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
        k = jnp.clip(event - c, 0, max(g - 1, 0))
        delay, rates = jnp.zeros_like(t), arrival.rate
        rose = onto = jnp.zeros((g,), bool)
        if g and not at_start:
            values = problem.guards(t, state.x, q, args)
            value, rates = problem.rates(t, state.x, q, args, before)
            # What has just risen to zero would be above it but for this event: it falls if the event turns it back. A
            # relation has an opposite, which falls then.
            rose = (state.armed == BELOW) & _is_zero(value, rates, arrival) & (rates > 0) & ~relations[c:]
            # What has jumped onto zero and does not move there is true unless it is strict.
            onto = arrival.jumped & (value == 0) & (rates == 0) & ~problem.facts.are(EventFlag.STRICT)[c:]
            crossing = -values[k] / jnp.where(rates[k] == 0, 1.0, rates[k])
            # Where another event has made the guard slow, rounding is all that is left of its value.
            frozen = lax.stop_gradient(crossing)
            crossing = crossing + (jnp.clip(frozen, -arrival.window, arrival.window) - frozen)
            # What rested falls where it leaves the band, perhaps so slowly that its slope is another one at zero.
            crossing = crossing - jnp.where(state.armed[k] == RESTS, lax.stop_gradient(crossing), 0.0)
            crossing = jnp.where(instant.caused[k], instant.delay, crossing)
            delay = jnp.where(is_clock, delay, crossing)
        if c and not at_start:
            exact = problem.due(state.ticks)[jnp.clip(event, 0, c - 1)]
            delay = jnp.where(is_clock, exact - lax.stop_gradient(exact), delay)
        time = t + delay
        reached = state.x + before * delay
        # What strikes at the same instant does so at once, whatever the order: a box that falls flat does not turn. All
        # share the δ of the first: if a parameter parts their instants, the derivative is one-sided, as at any kink.
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
        moved = jnp.any(x != reached) & ~relations[event]
        approach = jnp.where(instant.caused | at_start, 0.0, rates)
        new, after, slow, armed, left, caused, stuck = _following(
            problem, t, x, written, instant, event, happening, arrival, delay, moved, approach, rose, onto, waits, args
        )
        turns = state.turns + (~is_clock).astype(t.dtype)
        slides = ~is_clock & (turns > SLIDES + TURNS * g)
        again = jnp.where(slides, event, jnp.where(jnp.any(stuck), c + jnp.argmax(stuck), -1)) if g else jnp.array(-1)
        wrote = instant.wrote
        if rivals.places:
            both = jnp.concatenate([reached, q]), jnp.concatenate([x, written])
            clash, wrote = rivals.after(event, *both, jnp.where(goes_on, wrote, rivals.nobody))
            again = jnp.where(clash < -1, clash, jnp.where(state.stuck < -1, state.stuck.astype(int), again))
        # What is too fast to be followed back, as a current that a blocked diode stops, has that value at once.
        back = delay - (1.0 - slow) * lax.stop_gradient(delay)
        now_noted = instant.noted.written(
            row, time, shown, rate, jnp.concatenate([reached, q]), jnp.concatenate([x, new])
        )
        state = state.but(
            x=x - after * back,
            q=new,
            armed=armed,
            ticks=ticks,
            due=lax.stop_gradient(problem.due(ticks)),
            count=state.count + jnp.sum(logged).astype(state.count.dtype),
            ended=jnp.maximum(state.ended, jnp.max(jnp.where(happening, ends, 0.0))),
            stuck=again.astype(t.dtype),
            turns=turns,
        )
        return Instant(
            state=state,
            left=left,
            caused=caused,
            delay=delay,
            round=together,
            before=base,
            approach=base_slope,
            previous=previous,
            slope=after,
            arrived=instant.arrived,
            stuck=stuck,
            noted=now_noted,
            wrote=wrote,
        )

    def while_any_is_left(step: Callable[[Instant], Instant], times: int) -> Callable[[Instant], Instant]:
        def once(instant: Instant, _: None) -> tuple[Instant, None]:
            going = jnp.any(instant.left)

            def go(instant: Instant) -> Instant:
                return jax.tree.map(lambda a, b: jnp.where(going, a, b), step(instant), instant)

            return lax.cond(any_member(going), go, lambda instant: instant, instant), None

        return lambda instant: lax.scan(once, instant, length=times)[0]

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
    handled = while_any_is_left(one, inner)
    if length > inner:
        handled = while_any_is_left(handled, -(-length // inner))
    instant = handled(start)
    return instant.state, instant.slope, instant.noted


def _within(rate: Any, arrival: Arrival) -> Any:
    """How far from zero a guard with this rate may be that reaches zero, or has left it, within the window."""
    return jnp.minimum(jnp.abs(rate) * arrival.window, CLOSE * arrival.size)


def _is_zero(value: Any, rate: Any, arrival: Arrival) -> Any:
    """True for guards that are at zero, or reach it or have left it within the window."""
    return jnp.abs(value) <= jnp.maximum(rounding(arrival.size), _within(rate, arrival))


def _following(
    problem, t, x, q, instant: Instant, event, happening, arrival: Arrival, delay, moved, approach, rose, onto, waits,
    args,
):  # fmt: skip
    """The situation after an event, or after all that are `happening`, of which it is the first.

    `moved` says whether they wrote states, `approach` how fast the guards fell before, or zero. Where the equations
    are singular with q, as where a switch closes onto a diode that conducts, modes that are chosen by their conditions
    change along with it (`modes`).

    `rose` says which guards had risen to zero before the event, `onto` which had jumped onto it, `waits` which fall
    from zero after this instant. Returns (q, dx/dt, the
    states whose slope hardly changes during the delay, the sides of the guards, events left, guards that an event made
    true, guards that are stuck); only q is differentiated.
    """
    c, g = problem.facts.n_clocks, problem.facts.n_guards
    left = instant.left & ~happening
    if not g:
        slope = problem.slope(t, x, q, args)
        return q, slope, jnp.ones_like(x), instant.state.armed, left, instant.caused, instant.stuck
    written_q = q
    problem, t, x, q, delay, args = still(constant_once((problem, t, x, q, delay, args)))
    instant = still(instant)
    here = happening[c:]
    rested = here & (instant.state.armed == RESTS)
    turns_back = jnp.asarray(problem.facts.opposite)[jnp.clip(event - c, 0, g - 1)] == jnp.arange(g)
    band = rounding(arrival.size)
    ahead = AHEAD * arrival.span

    def is_flat(value, rate):
        """True for guards at zero whose rate may not take them out of the rounding band: the rate is too small, or was
        so before."""
        return _is_zero(value, rate, arrival) & ((jnp.abs(rate) * ahead <= band) | rested)

    sets, conditions = (
        jnp.asarray(sets_to_flip(problem.facts.choices, len(q))),
        np.array(problem.facts.choice_guards, int),
    )

    # Slopes, guards and their rates after the event, with what was before it, before the delay, and, where a guard is
    # flat, a little ahead: in a loop, for XLA compiles the equations as often as they are written.
    def look(carry):
        k, search, slopes, values, rates = carry
        slope, now = slopes[0], jnp.where(search.flipped(sets), 1.0 - q, q) if problem.facts.choices else q
        places = jnp.stack([x, instant.arrived, x - slope * delay, x + slope * ahead])
        time = t + jnp.stack([delay, jnp.zeros_like(t), jnp.zeros_like(t), ahead])[k]
        own = problem.slope(time, places[k], now, args)
        slopes = written(slopes, k, own)
        value, rate = problem.rates(time, places[k], now, args, jnp.where((k == 0) | (k == 3), own, slope))
        carry = slopes, written(values, k, value), written(rates, k, rate)
        if not problem.facts.choices:
            return k + 1, search, *carry
        violated = (value < 0) & ~_is_zero(value, rate, arrival)
        after, found = search.after(sets, own, value, violated[conditions])
        after = jax.tree.map(lambda new, old: jnp.where(k == 0, new, old), after, search)
        return k + (found | (k > 0)).astype(k.dtype), after, *carry

    def unfinished(carry):
        k, _, _, values, rates = carry
        return (k < 3) | ((k == 3) & jnp.any(is_flat(values[0], rates[0])))

    rows = jnp.zeros((4, g), x.dtype)
    begin = jnp.array(0), Search.begin(len(q), x.dtype), jnp.zeros((4, *x.shape), x.dtype), rows, rows
    _, search, (slope, _, earlier, _), values, rates = lax.while_loop(unfinished, look, begin)
    written_q = jnp.where(search.base, 1.0 - written_q, written_q) if problem.facts.choices else written_q
    slow = (jnp.abs(earlier - slope) <= STEADY * jnp.abs(slope)).astype(x.dtype)
    (value, at_arrival, _, _), (rate, rate_there, _, rate_ahead) = values, rates
    reached = at_arrival <= jnp.maximum(band, _within(rate_there, arrival))
    # What was to happen is at zero if it is not farther from it than it was when the instant began; unless it jumped.
    arrived = left[c:] & ~instant.caused & reached
    zero = _is_zero(value, rate, arrival) | (arrived & (jnp.abs(value) <= jnp.abs(at_arrival)))
    zero = zero | (here & _is_zero(value + band, rate, arrival))  # one that rested falls where it leaves the band
    # A force that keeps a contact closed leaves a guard of the open contact at zero without a slope: what it does next
    # decides. One that seems to fall by rounding alone is waited for: if it does fall, the next step finds it.
    flat = is_flat(value, rate)
    falling = jnp.where(flat, 0.5 * (rate + rate_ahead), rate)
    # Where an event makes sides equal that do not move, as sides made of other relations, a relation that is not strict
    # has become true, and so has a condition whose side jumped there when an equation changed its branch. Other
    # conditions wait until they leave zero: modes of something at rest would turn for ever.
    equal = zero & (rate == 0) & (instant.state.armed == ABOVE) & ~here & problem.facts.true_at_zero
    relations = problem.facts.are(EventFlag.RELATION)
    equal = equal & (relations[c:] | jnp.asarray(relations)[event])
    stays = (left[c:] & onto & (value == 0)) | equal
    true = jnp.where(zero, ((falling * arrival.span < -band) & ~waits) | stays, value < 0)
    was_armed = ((instant.state.armed > 0) & ~here) | (turns_back & (event >= c)) | (rose & ~here)
    # What this event made true happens next. What was to happen does so, though a state starts anew: unless what was
    # assigned makes its condition false, or it is revocable and undone.
    stands = left[c:] & ~problem.facts.are(EventFlag.REVOCABLE)[c:] & reached
    caused = (((was_armed | (left[c:] & instant.caused)) & true) | stands) & (~zero | equal)
    next_ones = ((was_armed | left[c:]) & true & ~here) | stands
    rests = was_armed | left[c:] | (falling * arrival.span > band)  # what was undone may happen later
    side = jnp.where(zero, jnp.where(rests, RESTS, BELOW), ABOVE)
    side = jnp.where(true, jnp.where(next_ones, ABOVE, BELOW), side)
    # The guard of the event itself, if it is left at zero: by how much of its speed it falls on, or has turned. Less
    # than the root of eps has stopped it: a speed beside others of which it is the difference has no more digits.
    slowest = jnp.sqrt(jnp.finfo(x.dtype).eps) * jnp.abs(approach)
    own = jnp.where(jnp.where(moved, rate >= -slowest, rate > slowest), RESTS, BELOW)
    side = jnp.where(here & zero, own, side)
    # One that was stopped, or turned, by what the event wrote, but is pulled back before it has left the band: the
    # event would happen again and again at one instant.
    pull = jnp.maximum(rate - rate_ahead, 0.0) / ahead
    rise = jnp.maximum(rate, 0.0)
    sinks = pull * (SINKING * arrival.span) >= rise + jnp.sqrt(rise**2 + 4 * pull * band)
    held = flat & (pull > 0) & (rise**2 <= 4 * pull * band) & sinks  # it would rise to twice the band
    stuck = ((here & moved & (side == RESTS)) | instant.stuck) & held
    side = side.astype(instant.state.armed.dtype)
    return written_q, slope, slow, side, jnp.concatenate([left[:c], next_ones]), caused, stuck
