"""What an event leaves behind: the slope, the sides of the guards, and the events that it makes due."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import Args, Time
from ...write.events import EventFlag
from ..adjoint.closure_conversion import written
from ..adjoint.resting import still
from .first_order import constant_once
from .instant import Arrival, Happening, Instant, is_zero, within
from .modes import Search, sets_to_flip
from .problem import AbstractHybridProblem
from .side import ABOVE, BELOW, RESTS, rounding

# After an event the state is followed back along its new slope over the delay δ, so that the step ends at a constant
# time. A state whose slope changes by more than this part during δ is not: it is faster than δ, and the way back is
# wrong.
# The value is set by hand: test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
STEADY = 0.1
# The rate of a guard at zero is evaluated this part of a step ahead, for the sign of its second derivative. The
# derivative is found up to a part AHEAD, and rounding in it is 1/AHEAD times that of rates. The value is set by hand:
# the tests named above pass with ten times it and a tenth.
AHEAD = 1e-3
# A guard that is really pulled out of the band about zero leaves it within so many steps. Rounding in the forces on
# what is at rest takes longer. With a tenth, test_hybrid_runs.py::test_nothing_falls_through_a_floor fails; ten times
# it passes.
SINKING = 4.0


class Aftermath(NamedTuple):
    """The situation after an event. Only `q` is differentiated.

    - `q`, `slope`: the discrete values, and dx/dt.
    - `slow`: 1.0 for states whose slope hardly changes during the delay, shape (n,).
    - `armed`: the side of zero on which each guard is, shape (guards,).
    - `left`: the events still to happen, shape (clocks + guards,).
    - `caused`, `stuck`: guards that an event of this instant made true, and guards that one left at zero, about to fall
        again, shape (guards,); `later`: guards that turn when repeated events are over, shape (guards,).
    """

    q: Array
    slope: Array
    slow: Array
    armed: Array
    left: Array
    caused: Array
    stuck: Array
    later: Array


class _Outlook(NamedTuple):
    """What the equations say with the new discrete values: `flips` of them, dx/dt, dx/dt before the delay, and the
    values and rates of the guards at four places, shape (4, guards): after the event, before it, before the delay, and
    `ahead` (second)."""

    flips: Array
    slope: Array
    earlier: Array
    values: Array
    rates: Array
    ahead: Time


def aftermath(
    problem: AbstractHybridProblem, t: Time, time: Time, x: Array, q: Array, instant: Instant, arrival: Arrival,
    now: Happening, args: Args,
) -> Aftermath:  # fmt: skip
    """The situation after the events that happen `now`, at the `time` of their own, which have left x and q.

    Where the equations are singular with q, for example where a switch closes onto a diode that conducts, modes that
    are chosen by their conditions change along with it (`modes`).
    """
    c, g = problem.facts.n_clocks, problem.facts.n_guards
    left = instant.left & ~now.these
    # Without conditions, only clocks are left: nothing falls, and the slope alone is new.
    if not g:
        slope = problem.slope(t, x, q, args)
        unchanged = instant.caused, instant.stuck, instant.later
        return Aftermath(q, slope, jnp.ones_like(x), instant.state.armed, left, *unchanged)
    # What the event wrote keeps its derivatives; everything that is decided below is decided on numbers.
    written_q = q
    problem, t, time, x, q, delay, args = still(constant_once((problem, t, time, x, q, now.delay, args)))
    instant, now = still(instant), now._replace(delay=delay)
    rested = now.these[c:] & (instant.state.armed == RESTS)
    turns_back = jnp.asarray(problem.facts.opposite)[jnp.clip(now.event - c, 0, g - 1)] == jnp.arange(g)
    band, ahead = rounding(arrival.size), AHEAD * arrival.span

    def is_flat(value: Array, rate: Array) -> Array:
        """True for guards at zero whose rate may not take them out of the rounding band: the rate is too small, or was
        so before."""
        return is_zero(value, rate, arrival) & ((jnp.abs(rate) * ahead <= band) | rested)

    outlook = _outlook(problem, (t, time, x, q, delay, args), instant, arrival, ahead, is_flat)
    written_q = jnp.where(outlook.flips, 1.0 - written_q, written_q) if problem.facts.choices else written_q
    slow = (jnp.abs(outlook.earlier - outlook.slope) <= STEADY * jnp.abs(outlook.slope)).astype(x.dtype)
    side, next_ones, *others = _sides(problem, instant, arrival, now, left, turns_back, outlook, is_flat)
    return Aftermath(written_q, outlook.slope, slow, side, jnp.concatenate([left[:c], next_ones]), *others)


def _outlook(
    problem: AbstractHybridProblem, point: tuple[Time, Time, Array, Array, Time, Args], instant: Instant,
    arrival: Arrival, ahead: Time, is_flat: Callable[[Array, Array], Array],
) -> _Outlook:  # fmt: skip
    """Evaluates slopes, guards and their rates at the four places, the last one only where a guard is flat; `point` is
    (t, time of the event, x, q, its delay, args). It does so in a loop, for XLA compiles the equations as often as they
    are written."""
    t, own_time, x, q, delay, args = point
    g = problem.facts.n_guards
    sets, conditions = (
        jnp.asarray(sets_to_flip(problem.facts.choices, len(q))),
        np.array(problem.facts.choice_guards, int),
    )

    def look(carry):
        k, search, slopes, values, rates = carry
        slope, now = slopes[0], jnp.where(search.flipped(sets), 1.0 - q, q) if problem.facts.choices else q
        # The place before the event shows how far its guards were from zero: one that waits for its turn still counts
        # as at zero there. The one before the delay shows which slopes change while the state is followed back.
        places = jnp.stack([x, instant.arrived, x - slope * delay, x + slope * ahead])
        time = jnp.stack([own_time, t, t, t + ahead])[k]
        own = problem.slope(time, places[k], now, args)
        slopes = written(slopes, k, own)
        value, rate = problem.rates(time, places[k], now, args, jnp.where((k == 0) | (k == 3), own, slope))
        carry = slopes, written(values, k, value), written(rates, k, rate)
        if not problem.facts.choices:
            return k + 1, search, *carry
        violated = (value < 0) & ~is_zero(value, rate, arrival)
        after, found = search.after(sets, own, value, violated[conditions])
        # Modes are searched for at the first place only. The others are looked at with what was found.
        after = jax.tree.map(lambda new, old: jnp.where(k == 0, new, old), after, search)
        return k + (found | (k > 0)).astype(k.dtype), after, *carry

    def unfinished(carry):
        k, _, _, values, rates = carry
        return (k < 3) | ((k == 3) & jnp.any(is_flat(values[0], rates[0])))

    rows = jnp.zeros((4, g), x.dtype)
    begin = jnp.array(0), Search.begin(len(q), x.dtype), jnp.zeros((4, *x.shape), x.dtype), rows, rows
    _, search, (slope, _, earlier, _), values, rates = lax.while_loop(unfinished, look, begin)
    return _Outlook(search.base, slope, earlier, values, rates, ahead)


def _sides(
    problem: AbstractHybridProblem, instant: Instant, arrival: Arrival, now: Happening, left: Array, turns_back: Array,
    outlook: _Outlook, is_flat: Callable[[Array, Array], Array],
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Returns (the sides of the guards after an event, the guards whose events happen next, those that an event of this
    instant made true, those that are stuck, those that turn when repeated events are over)."""
    c = problem.facts.n_clocks
    relations = problem.facts.are(EventFlag.RELATION)
    repeated = problem.facts.are(EventFlag.REPEATED)[c:]
    here, armed, event = now.these[c:] & ~repeated, instant.state.armed, now.event
    band, ahead = rounding(arrival.size), outlook.ahead
    (value, at_arrival, _, _), (rate, rate_there, _, rate_ahead) = outlook.values, outlook.rates
    reached = at_arrival <= jnp.maximum(band, within(rate_there, arrival))
    # A pending event counts as at zero while its guard is no farther from zero than when the instant began. A guard
    # that jumped does not.
    arrived = left[c:] & ~instant.caused & reached
    zero = is_zero(value, rate, arrival) | (arrived & (jnp.abs(value) <= jnp.abs(at_arrival)))
    zero = zero | (here & is_zero(value + band, rate, arrival))  # a guard that rested falls where it leaves the band
    # A force that keeps a contact closed leaves the guard of the open contact at zero with no slope: its rate a little
    # ahead decides. Where rounding alone may make it fall, nothing happens yet: if it falls, the next step finds it.
    flat = is_flat(value, rate)
    falling = jnp.where(flat, 0.5 * (rate + rate_ahead), rate)
    # Where an event makes sides equal that do not move, for example sides made of other relations, a relation that is
    # not strict has become true. So has a condition whose side jumped there when an equation changed its branch. Other
    # conditions wait until they leave zero: modes of a system at rest would turn for ever.
    equal = zero & (rate == 0) & (armed == ABOVE) & ~here & problem.facts.true_at_zero
    equal = equal & (relations[c:] | jnp.asarray(relations)[event])
    # A condition whose guard was above zero, and which an event set onto it, is true if it is not strict.
    landed = zero & (armed == ABOVE) & ~here & ~reached & (jnp.abs(value) <= band)
    landed = landed & (now.moved | (left[c:] & instant.caused)) & problem.facts.true_at_zero & ~relations[c:]
    stays = (left[c:] & now.onto & (value == 0)) | equal | landed
    falls = (falling * arrival.span < -band) & ~now.waits
    if repeated.any():  # what crosses at this instant does so whatever the others change
        stays = stays | (left[c:] & ~instant.later & jnp.asarray(relations[c:]) & reached)
    true = jnp.where(zero, falls | stays, value < 0)
    was_armed = ((armed > 0) & ~here) | (turns_back & (event >= c)) | (now.rose & ~here) | repeated
    # What this event made true happens next. A pending event still happens, even if a state was set anew: unless the
    # new values make its condition false, or it is revocable and undone. Otherwise, of two balls that reach the floor
    # at one instant, the bounce of the first would cancel that of the other.
    stands = left[c:] & ~problem.facts.are(EventFlag.REVOCABLE)[c:] & reached
    caused = (((was_armed | (left[c:] & instant.caused)) & true) | stands) & (~zero | equal | landed)
    next_ones = ((was_armed | left[c:]) & true & ~here) | stands
    rests = was_armed | left[c:] | (falling * arrival.span > band)  # an event that was undone may happen later
    # While discrete equations are repeated, time stands still: what they make move turns thereafter.
    later = zero & falls & ~stays & (~left[c:] | instant.later) if repeated.any() else instant.later
    side = jnp.where(zero, jnp.where(rests, RESTS, BELOW), ABOVE)
    side = jnp.where(true, jnp.where(next_ones, ABOVE, BELOW), side)
    # If the event leaves its own guard at zero, the guard's rate says whether it falls on or has turned. A rate below
    # √eps of the rate before means that the event stopped it: a difference of two speeds has no more digits.
    slowest = jnp.sqrt(jnp.finfo(value.dtype).eps) * jnp.abs(now.approach)
    own = jnp.where(jnp.where(now.moved, rate >= -slowest, rate > slowest), RESTS, BELOW)
    side = jnp.where(here & zero, own, side)
    # A guard is stuck if the event stopped or turned it, and the equations pull it back before it has left the band:
    # the event would happen again and again at one instant.
    pull = jnp.maximum(rate - rate_ahead, 0.0) / ahead
    rise = jnp.maximum(rate, 0.0)
    sinks = pull * (SINKING * arrival.span) >= rise + jnp.sqrt(rise**2 + 4 * pull * band)
    held = flat & (pull > 0) & (rise**2 <= 4 * pull * band) & sinks  # it would rise to twice the band
    stuck = ((here & now.moved & (side == RESTS)) | instant.stuck) & held
    return side.astype(armed.dtype), next_ones, caused, stuck, later
