"""What the loop over the events of one instant carries, and when a guard counts as zero there."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Time
from .log import EventRows
from .problem import HybridState
from .side import rounding

# A guard farther from zero than this part of its recent maximum has not reached zero, however fast it moves: with stiff
# dynamics behind an event, a guard may be about to cross its whole range within `window`. Set by hand:
# test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
CLOSE = 0.01


class Instant(eqx.Module):
    """The state of the loop over the events of one instant.

    - `state`: the state after the events so far.
    - `left`: the events still to happen, shape (clocks + guards,).
    - `caused`: the guards that another event of this instant made fall, shape (guards,).
    - `delay`: δ of the last event (second); `time`: when it happened.
    - `round`: the events that happen as one: all read what was before the first of them; what they cause comes after.
    - `before`, `approach`, `previous`: the continuous state before this round, its slope, and the discrete values.
    - `there`: the continuous state after the last event, at its own time; `slope`: dx/dt then.
    - `arrived`: the continuous state before the instant.
    - `stuck`: the guards that an event has left at zero, about to fall again, shape (guards,).
    - `later`: the guards at zero that turn when repeated events are over, shape (guards,).
    - `noted`: the events of this instant that are listed.
    - `wrote`: which event of this round wrote each contested place last.
    """

    state: HybridState
    left: Array
    caused: Array
    delay: Time
    time: Time
    round: Array
    before: Array
    approach: Array
    previous: Array
    there: Array
    slope: Array
    arrived: Array
    stuck: Array
    later: Array
    noted: EventRows
    wrote: Array


class Arrival(NamedTuple):
    """The events due at the end of a step, not differentiated.

    - `slope`: dx/dt there, before any event.
    - `rate`: how fast the guards change, shape (guards,); at the initial time only.
    - `due`: which events happen, shape (clocks + guards,).
    - `jumped`: which guards jumped over zero, so that their events do not move in time, shape (guards,).
    - `size`: the largest magnitude of each guard so far, shape (guards,).
    - `window`: the time within which a guard counts as having reached zero; `span`: how long steps have been of late.
    """

    slope: Array
    rate: Array
    due: Array
    jumped: Array
    size: Array
    window: Time
    span: Time


class Happening(NamedTuple):
    """What happens now, as one: an event, or several that strike together.

    - `event`: the number of the first of them; `is_clock`: whether that is one of a clock, `tick`: its
        time then, which moves with parameters.
    - `these`: all of them, shape (clocks + guards,).
    - `delay`: δ of the first (second).
    - `moved`: whether they wrote states.
    - `rates`: how fast guards changed before, shape (guards,); `approach`: the same, zero where that is not known.
    - `rose`, `onto`: the guards that had just risen to zero, and those that had jumped onto it, shape (guards,).
    - `waits`: the guards that begin to fall from zero after this instant, shape (guards,).
    """

    event: Array
    is_clock: Array
    tick: Time
    these: Array
    delay: Time
    rates: Array
    moved: Array | np.bool_
    approach: Array
    rose: Array
    onto: Array
    waits: Array | np.ndarray


def within(rate: Array, arrival: Arrival) -> Array:
    """How far from zero a guard with this rate may be that reaches zero, or has left it, within the window."""
    # The step that ends at a crossing was located in another step, with other errors: it ends off the crossing by a
    # time, which the rate turns into a distance.
    return jnp.minimum(jnp.abs(rate) * arrival.window, CLOSE * arrival.size)


def is_zero(value: Array, rate: Array, arrival: Arrival) -> Array:
    """True for guards that are at zero, or reach it or have left it within the window."""
    return jnp.abs(value) <= jnp.maximum(rounding(arrival.size), within(rate, arrival))
