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
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import Args, Time
from ...base.tolerances import CONSISTENT
from ...write.events import EventFlag
from ..adjoint.closure_conversion import any_member
from ..adjoint.resting import still
from .after_event import aftermath
from .instant import Arrival, Happening, Instant, is_zero
from .log import EventRows
from .problem import AbstractHybridProblem, HybridState, one_hot
from .rivals import Rivals
from .side import BELOW, RESTS, rounding

CONDITIONS_AT_ONE_INSTANT = 32  # if more events are due, the rest happen in another step, which is as good as none
# How often guards may fall while time does not go on, beside so often for each. Beyond, relations turn back and forth,
# or conditions make each other true without end. An iteration of repeated events counts as one, however many there are.
SLIDES, TURNS = 64, 4


def most_at_once(problem: AbstractHybridProblem) -> int:
    """The largest number of events that can be listed at one instant."""
    at_once = (int(problem.facts.are(kind).sum()) for kind in (EventFlag.STRIKE, EventFlag.LAST))
    return _most_in_turn(problem) * max(*at_once, 1)


def _most_in_turn(problem: AbstractHybridProblem) -> int:
    facts = problem.facts
    if facts.are(EventFlag.REPEATED).any():
        return facts.n_clocks + 2 * CONDITIONS_AT_ONE_INSTANT
    return facts.n_clocks + min(2 * facts.n_guards, CONDITIONS_AT_ONE_INSTANT)


def handle(
    problem: AbstractHybridProblem, t: Time, state: HybridState, arrival: Arrival, args: Args, noted: EventRows,
    at_start: bool = False,
) -> tuple[HybridState, Array, EventRows, Time]:  # fmt: skip
    """Returns (the state after all events of an instant, dx/dt there, `noted` with the events that are listed, the time
    of the last of them, which moves with parameters).

    At the initial time, `at_start`, events do not move with parameters, and are logged only if they end the run.
    """
    earlier, (problem, args, may_jump) = (problem, args), problem.at_instant(args)
    first = arrival.due
    # At the initial time there is no before against which something could have jumped.
    if may_jump and problem.facts.n_guards and not at_start:
        arrival, first = _with_jumps(problem, t, state, arrival, args)
    events = _Events.of(problem, t, state, arrival, args, at_start, earlier)
    start = Instant(
        state=state, left=arrival.due, caused=arrival.jumped, delay=jnp.zeros_like(t), time=t, round=first,
        before=state.x, approach=arrival.slope, previous=state.q, there=state.x, slope=arrival.slope, arrived=state.x,
        stuck=jnp.zeros((problem.facts.n_guards,), bool), later=jnp.zeros((problem.facts.n_guards,), bool),
        noted=noted, wrote=events.rivals.nobody,
    )  # fmt: skip
    length = _most_in_turn(problem)
    # Loops of fixed length, whose bodies are skipped where nothing is left: reverse mode cannot go back over a `while`.
    # Of a thousand clocks, few tick at once: loops in a loop pass over the others in √1000 steps.
    inner = max(math.isqrt(length), min(length, CONDITIONS_AT_ONE_INSTANT))
    handled = _while_any_is_left(events.after_next, inner)
    if length > inner:
        handled = _while_any_is_left(handled, -(-length // inner))
    instant = handled(start)
    return instant.state, instant.slope, instant.noted, instant.time


def _with_jumps(
    problem: AbstractHybridProblem, t: Time, state: HybridState, arrival: Arrival, args: Args
) -> tuple[Arrival, Array]:
    """Returns (the arrival with the guards that fall because what the equations read jumps at this instant, the events
    of the first round). Relations that turn by the jump turn before all else: other events read equations of one
    time."""
    c = problem.facts.n_clocks
    problem, *point = still((problem, t, state.x, state.q, args))
    value = problem.guards(*point)
    size = jnp.maximum(arrival.size, jnp.abs(value))
    falls = (state.armed != BELOW) & (value < -rounding(size)) & ~arrival.due[c:]
    of_clocks = jnp.zeros((c,), bool)
    due = arrival.due | jnp.concatenate([of_clocks, falls])
    turned = jnp.concatenate([of_clocks, falls]) & problem.facts.are(EventFlag.RELATION)
    first = jnp.where(jnp.any(turned), turned, due)
    # What jumps does so at a time that the input or the clock gives: the crossing has no δ of its own.
    return arrival._replace(due=due, jumped=arrival.jumped | falls, size=size), first


class _Events(NamedTuple):
    """What the events of one instant share: the time, at which the step ends; what is due; `first`, the events that
    were listed before; `turns`, those that there were while time did not go on; what events are, by their numbers; and
    the problem and inputs as they were `earlier`, just before."""

    problem: AbstractHybridProblem
    t: Time
    arrival: Arrival
    args: Args
    at_start: bool
    first: Array
    turns: Array
    rivals: Rivals
    listed: np.ndarray
    ends: Array
    relations: Array
    strikes: Array
    last: np.ndarray
    waits: Array | np.ndarray
    earlier: tuple[AbstractHybridProblem, Args]

    @staticmethod
    def of(
        problem: AbstractHybridProblem, t: Time, state: HybridState, arrival: Arrival, args: Args, at_start: bool,
        earlier: tuple[AbstractHybridProblem, Args],
    ) -> "_Events":  # fmt: skip
        """The events of the instant t at which a step arrives."""
        facts = problem.facts
        c, g = facts.n_clocks, facts.n_guards
        # At the initial time, a guard that is zero and begins to fall has its event in the first step, not now.
        waits = (arrival.size == 0) & (arrival.rate < 0) & ~arrival.due[c:] if at_start else np.zeros(g, bool)
        return _Events(
            problem=problem, t=t, arrival=arrival, args=args, at_start=at_start, first=state.count,
            turns=state.turns, rivals=Rivals.of(facts),
            listed=facts.are(EventFlag.LISTED) & (np.arange(c + g) >= c) & (not at_start),
            ends=jnp.asarray(facts.ends).astype(t.dtype), relations=jnp.asarray(facts.are(EventFlag.RELATION)),
            strikes=jnp.asarray(facts.are(EventFlag.STRIKE)), last=facts.are(EventFlag.LAST), waits=waits,
            earlier=earlier,
        )  # fmt: skip

    @property
    def several(self) -> bool:
        """True if events may happen together."""
        return any(self.problem.facts.are(kind).sum() > 1 for kind in (EventFlag.STRIKE, EventFlag.LAST))

    def after_next(self, instant: Instant) -> Instant:
        """The instant after the next event, or the next ones that strike together."""
        problem, t, arrival, args, rivals = self.problem, self.t, self.arrival, self.args, self.rivals
        c, g = problem.facts.n_clocks, problem.facts.n_guards
        state, q = instant.state, instant.state.q
        # Where nothing is left, as in some members of a batch, nothing happens: derivatives of what would have happened
        # need not be finite.
        candidates, begun = instant.left, instant.round & instant.left
        if self.last.any():
            candidates = self._first_ones(instant)
            begun = begun & candidates & ~self.last  # they read what all others have left
        goes_on = jnp.any(begun)
        together = candidates & (instant.round | ~goes_on)
        # All events of a round read what was before the first of them. Otherwise the order of declaration would decide
        # what they see.
        base, base_slope, previous = (
            jnp.where(goes_on, kept, now)
            for kept, now in ((instant.before, state.x), (instant.approach, instant.slope), (instant.previous, q))
        )
        # Beyond all numbers where nothing is left: `one_hot` of that is empty, and nothing is written.
        now = self._happening(instant, jnp.where(jnp.any(together), jnp.argmax(together), c + g))
        event, delay = now.event, now.delay
        # What another event caused happens at the time of that one, where the state is what it left. The slope between
        # them may be as large as you please, as that of parts that are held to see what force it takes.
        caused = ~now.is_clock & instant.caused[jnp.clip(event - c, 0, max(g - 1, 0))] if g else jnp.array(False)
        # Events that follow one another at one instant have a δ each: parameters part their times, and with one δ for
        # all the Jacobian is wrong.
        time, reached = t + delay, jnp.where(caused, instant.there, state.x + instant.slope * delay)
        if c:  # a step may end a rounding error off the tick, at whose time equations read
            time = jnp.where(now.is_clock, now.tick, jnp.where(caused, instant.time, time))
        x, written = problem.written(time, reached, base + base_slope * delay, q, previous, now.these, args)
        now = now._replace(moved=jnp.any(x != reached) & ~self.relations[event])
        after = aftermath(problem, t, time, x, written, instant, arrival, now, args)
        # Ticks are counted, and times follow from the count: a sum of periods would drift by a rounding at each tick.
        ticks = state.ticks + one_hot(event, c).astype(state.ticks.dtype)
        turns = state.turns + (~now.is_clock).astype(t.dtype)
        iteration = state.iteration
        circles = jnp.array(False)
        if iteration is not None:
            ends = jnp.asarray(self.last)[event]  # an iteration; relations may turn anew in the next one
            turns = jnp.where(ends, self.turns + 1, turns)
            moved = jnp.any(jnp.abs(x - reached) > CONSISTENT * (jnp.abs(x) + jnp.abs(reached)))
            one_more = iteration.after(after.q, lax.stop_gradient(moved))
            iteration = jax.tree.map(lambda a, b: jnp.where(ends, a, b), one_more, iteration)
            circles = iteration.count < 0
        again = jnp.where(circles, event, self._again(now, after.stuck, turns))
        wrote = instant.wrote
        if rivals.places:
            both = jnp.concatenate([reached, q]), jnp.concatenate([x, written])
            clash, wrote = rivals.after(event, *both, jnp.where(goes_on, wrote, rivals.nobody))
            again = jnp.where(clash < -1, clash, jnp.where(state.stuck < -1, state.stuck.astype(int), again))
        # States whose slope changes during the delay, for example a current that a blocked diode stops, are not
        # followed back over it: they keep the value after the event.
        back = delay - (1.0 - after.slow) * lax.stop_gradient(delay)
        logged = now.these & (self.listed | (self.ends > 0))
        there, here = q, after.q
        if state.past is not None:
            before, given = self.earlier
            there, here = before.with_past_read(t, reached, q, given), problem.with_past_read(t, x, here, args)
        sides = jnp.concatenate([reached, there]), jnp.concatenate([x, here])
        return Instant(
            state=state.but(
                x=x - after.slope * back,
                q=after.q,
                armed=after.armed,
                ticks=ticks,
                due=lax.stop_gradient(problem.due(ticks)),
                count=state.count + jnp.sum(logged).astype(state.count.dtype),
                ended=jnp.maximum(state.ended, jnp.max(jnp.where(now.these, self.ends, 0.0))),
                stuck=again.astype(t.dtype),
                turns=turns,
                iteration=iteration,
            ),
            left=after.left,
            caused=after.caused,
            delay=delay,
            time=time,
            round=together,
            before=base,
            approach=base_slope,
            previous=previous,
            there=x,
            slope=after.slope,
            arrived=instant.arrived,
            stuck=after.stuck,
            later=after.later,
            noted=self._noted(instant, now, logged, time, sides),
            wrote=wrote,
        )

    def _first_ones(self, instant: Instant) -> Array:
        """The events that are left and wait for no other one."""
        later = jnp.concatenate([jnp.zeros((self.problem.facts.n_clocks,), bool), instant.later])
        first = instant.left & ~later & ~self.last
        last = instant.left & self.last
        return jnp.where(jnp.any(first), first, jnp.where(jnp.any(last), last, instant.left))

    def _happening(self, instant: Instant, event: Array) -> Happening:
        """The event, when it happens, and what happens with it; whether it writes states is not known yet."""
        problem, state = self.problem, instant.state
        c, g = problem.facts.n_clocks, problem.facts.n_guards
        is_clock = event < c
        delay, rates = jnp.zeros_like(self.t), self.arrival.rate
        rose = onto = jnp.zeros((g,), bool)
        tick = self.t
        if g and not self.at_start:
            crossing, rates, rose, onto = _crossing(self, instant, event)
            delay = jnp.where(is_clock, delay, crossing)
        if c and not self.at_start:
            tick = problem.due(state.ticks)[jnp.clip(event, 0, c - 1)]
            # Zero, with the derivative of the tick's time by parameters.
            delay = jnp.where(is_clock, tick - lax.stop_gradient(tick), delay)
        # Parts that strike at the same instant do so at once, whatever the order: a box that falls flat does not turn.
        # All share the δ of the first: if a parameter parts their instants, the derivative is one-sided, as at any
        # kink.
        these = one_hot(event, c + g)
        if self.several:
            for kind in (self.strikes, jnp.asarray(self.last)):
                these = these | (instant.left & kind & kind[event])
        return Happening(
            event=event, is_clock=is_clock, tick=tick, these=these, delay=delay, rates=rates, moved=np.False_,
            approach=jnp.where(instant.caused | self.at_start, 0.0, rates), rose=rose, onto=onto, waits=self.waits,
        )  # fmt: skip

    def _again(self, now: Happening, stuck: Array, turns: Array) -> Array:
        """The number of an event that happens again and again at this instant, or −1."""
        c, g = self.problem.facts.n_clocks, self.problem.facts.n_guards
        if not g:
            return jnp.array(-1)
        slides = ~now.is_clock & (turns > SLIDES + TURNS * g)
        return jnp.where(slides, now.event, jnp.where(jnp.any(stuck), c + jnp.argmax(stuck), -1))

    def _noted(
        self, instant: Instant, now: Happening, logged: Array, time: Time, sides: tuple[Array, Array]
    ) -> EventRows:
        """The rows of this instant with those of events that are logged."""
        c, n = self.problem.facts.n_clocks, len(logged)
        shown = jnp.arange(n) if self.several else now.event[None]
        row = (instant.state.count - self.first).astype(int) + jnp.cumsum(logged[shown]) - 1
        row = jnp.where(logged[shown], row, instant.noted.log.shape[0])
        rate = jnp.concatenate([jnp.zeros((c,), self.t.dtype), now.rates])[shown]
        return instant.noted.written(row, time, shown, rate, *sides)


def _crossing(events: _Events, instant: Instant, event: Array) -> tuple[Time, Array, Array, Array]:
    """Returns (δ of the event if it is one of a condition, the rates of the guards before it, the guards that have just
    risen to zero, those that have jumped onto zero)."""
    problem, t, arrival, args, relations = events.problem, events.t, events.arrival, events.args, events.relations
    c, g, state = problem.facts.n_clocks, problem.facts.n_guards, instant.state
    k = jnp.clip(event - c, 0, max(g - 1, 0))
    # The derivative of δ is that of −g/ġ with ġ constant, so the guards are evaluated once with and once without
    # derivatives.
    values = problem.guards(t, state.x, state.q, args)
    value, rates = problem.rates(t, state.x, state.q, args, instant.slope)
    # A guard that has just risen to zero would be above it but for this event: it falls if the event turns it back. A
    # relation has an opposite, which falls then.
    rose = (state.armed == BELOW) & is_zero(value, rates, arrival) & (rates > 0) & ~relations[c:]
    # A condition whose guard has jumped onto zero and does not move there is true unless it is strict.
    onto = arrival.jumped & (value == 0) & (rates == 0) & ~problem.facts.are(EventFlag.STRICT)[c:]
    # A guard without a rate has jumped or rests, and its δ counts nowhere. A division by zero would still make its
    # derivative not-a-number.
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
        # Under vmap a condition that differs by member makes `cond` a select, which computes both branches in every
        # turn. So the branch is taken where any member goes on, and the others keep what they have.
        going = jnp.any(instant.left)

        def go(instant: Instant) -> Instant:
            return jax.tree.map(lambda a, b: jnp.where(going, a, b), step(instant), instant)

        return lax.cond(any_member(going), go, lambda instant: instant, instant), None

    return lambda instant: lax.scan(once, instant, length=times)[0]
