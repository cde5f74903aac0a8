"""Events of a system that rests.

Given are a system at a frozen time and a point (x, q) of its states and discrete values. At a steady state an event has
nothing left to change: of each condition that holds, what its event writes is there already. Sampled events have
happened so often that another tick changes nothing.

Discrete values that clocks write are `unknown`: they are solved for together with the states. All others are chosen by
the events of conditions, one after the other, and stay as they are while the states are looked for.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import Args, Numeric, Time
from ..base.errors import ModelError
from ..base.tolerances import solved
from ..compile.lowering.plan import SystemPlan
from ..compile.model.declared import declared_scale
from ..run.system.system import AcausalSystem
from ..write.events import EventFlag

# Sets of modes that are tried where the equations of the first have no equilibrium: all of six pairs of which one side
# is zero, or any one of 127. Each costs a search of its own.
MODES = 128


@dataclasses.dataclass(frozen=True)
class RestingEvents:
    """The events that decide where a system rests; all arrays are static.

    - `unknown`: the places of discrete values that are solved for.
    - `ticking`: the actions of sampled events; each asks for one equation.
    - `computed`: the places of other discrete values that events may set to what an expression says.
    - `acting`: True for events of conditions that may write something.
    - `ignored`: True for actions whose target is left as it starts.
    - `flips`: the sets of modes that are changed in turn where no equilibrium is found, shape (sets, discrete values).
    """

    unknown: np.ndarray
    ticking: np.ndarray
    computed: np.ndarray
    acting: np.ndarray
    ignored: np.ndarray
    flips: np.ndarray


def resting_events(plan: SystemPlan, kept: Sequence[int] = (), drifting: Sequence[int] = ()) -> RestingEvents | None:
    """The events of a system, but for those that say what relations are: relations are as their sides say. `kept` are
    the places of discrete values, `drifting` those of states, that stay as they start. None if there are no events.

    **Raises:**

    - `ModelError` for discrete equations that read the ticks of a clock.
    """
    events = plan.events
    if events is None:
        return None
    table = events.table
    _check_ticks(plan, table.discrete[(table.event < events.n_clocks) & (table.discrete >= 0)])
    relation = table.are(EventFlag.RELATION)
    ignored = np.isin(table.discrete, list(kept)) & (table.discrete >= 0)
    ignored |= np.isin(events.state, list(drifting)) & (events.state >= 0)
    mine = ~relation[table.event] & ~ignored
    clocked = table.event < events.n_clocks
    ticking = np.flatnonzero(mine & clocked)
    sampled = np.unique(table.discrete[ticking])
    sampled = sampled[sampled >= 0]
    computed = np.unique(table.discrete[mine & ~clocked & (table.value >= 0) & (table.discrete >= 0)])
    unknown, computed = sampled.astype(np.int64), np.setdiff1d(computed, sampled).astype(np.int64)
    acting = np.zeros(len(table), bool)
    acting[table.event[mine & ~clocked]] = True
    acting |= table.ends & ~relation
    acting[: events.n_clocks] = False
    chooses = mine & ~clocked & table.are(EventFlag.REVOCABLE)[table.event]
    chooses &= (table.discrete >= 0) & (table.discrete < events.n_visible)
    # Hidden discrete values leave no choice: relations follow their sides.
    flips = _flips(np.unique(table.discrete[chooses]).tolist(), len(events.discrete))
    return RestingEvents(unknown, ticking, computed, acting, ignored, flips)


def _check_ticks(plan: SystemPlan, ticking: np.ndarray):
    """Raises an error for discrete equations that tell at which instants clocks tick: what they leave at rest is not
    solved for. `ticking` are the discrete values that clocks write."""
    events, names = plan.some_events, plan.flat.parameters.names
    if not events.table.are(EventFlag.REPEATED).any():
        return
    every = {names[p] for p in events.discrete}
    for name in sorted({names[events.discrete[k]] for k in ticking}):
        owner, _, own = name.rpartition(".")
        if own.startswith(":tick[") or f"{owner}.:pre({own})" in every:
            what = "a clock" if own.startswith(":") else f"by '{name}' when a clock ticks"
            raise ModelError(
                f"the discrete equations of '{owner}' read {what}, and where they rest is not solved for: write "
                "what is sampled as self.when(self.sampled(T), assign(…)), or let simulate run until nothing changes"
            )


def _flips(choices: list[int], n: int) -> np.ndarray:
    """Sets of modes to change, small ones first: none, each, each pair, …; shape (sets, n)."""
    subsets = itertools.chain.from_iterable(itertools.combinations(choices, k) for k in range(len(choices) + 1))
    sets = list(itertools.islice(subsets, MODES))
    rows = np.zeros((len(sets), n), bool)
    for row, chosen in zip(rows, sets, strict=True):
        row[list(chosen)] = True
    return rows


def left_by_ticks(system: AcausalSystem, t: Time, inputs: Args, events: RestingEvents, x: Array, q: Array) -> Array:
    """How far a tick of the clocks would move what it writes, shape (ticking,)."""
    values, now = _written(system, t, inputs, x, q)
    return values[events.ticking] - now[events.ticking]


def recomputed(
    system: AcausalSystem, t: Time, inputs: Args, events: RestingEvents, x: Array, q: Array, writer: Array
) -> Array:
    """The discrete values with the derivatives of the expressions that events set them to; `writer` is the action that
    wrote each, or −1."""
    values, _ = _written(system, t, inputs, x, q)
    place = events.computed
    # Values stay as the search has found them: what is added is zero, and has the expression's derivative.
    moving = values[jnp.maximum(writer[place], 0)]
    return q.at[place].add(jnp.where(writer[place] >= 0, moving - jax.lax.stop_gradient(moving), 0.0))


def next_event(
    system: AcausalSystem, t: Time, inputs: Args, events: RestingEvents, x: Array, q: Array, at_start: bool
) -> Array:
    """The number of the first event of a condition that holds and that would change something, or −1; at the start, of
    those that happen there. Not differentiated."""
    plan = system.plan.some_events
    table = plan.table
    here = system.holding(q).at(t, inputs)
    value = here.guards(x)
    none = guard_rounding(system, here, x)
    # A condition such as v <= 0 holds at zero. Of the two sides of a complementary pair both may be zero, and then
    # either mode will do.
    at_zero = ~table.are(EventFlag.STRICT | EventFlag.REVOCABLE)[plan.n_clocks :]
    holds = jnp.concatenate([jnp.zeros(plan.n_clocks, bool), (value < -none) | (at_zero & (value <= none))])
    values, now = _written(system, t, inputs, x, q)
    differs = jnp.abs(values - now) > solved(x.dtype) * jnp.maximum(jnp.abs(values), jnp.abs(now))
    changes = jnp.zeros(len(table), bool).at[table.event].max(differs & ~events.ignored)
    acting = events.acting & (table.are(EventFlag.AT_START) if at_start else True)
    happens = holds & acting & (changes | table.ends)
    return jnp.where(jnp.any(happens), jnp.argmax(happens), -1)


def after_event(
    system: AcausalSystem, t: Time, inputs: Args, events: RestingEvents, event: Array, x: Array, q: Array, writer: Array
) -> tuple[Array, Array, Array]:
    """(x, q, the action that wrote each discrete value or −1) after an event."""
    plan = system.plan.some_events
    table = plan.table
    values, _ = _written(system, t, inputs, x, q)
    happens = (jnp.asarray(table.event) == event) & ~events.ignored
    is_state, is_discrete = np.flatnonzero(plan.state >= 0), np.flatnonzero(table.discrete >= 0)
    place = plan.state[is_state]
    # Added, not set: of several actions on one state, those whose events do not happen add zero, whatever their order.
    x = x.at[place].add(jnp.where(happens[is_state], values[is_state] - x[place], 0.0))
    place, mine = table.discrete[is_discrete], happens[is_discrete]
    q = q.at[place].add(jnp.where(mine, values[is_discrete] - q[place], 0.0))
    # Of those that an event does not write, the writer stays.
    new = jnp.full_like(writer, -1).at[place].max(jnp.where(mine, is_discrete, -1))
    return x, q, jnp.where(new >= 0, new, writer)


def both_sides(
    system: AcausalSystem, t: Time, inputs: Args, events: RestingEvents, x: Array, q: Array
) -> tuple[Array, Array]:
    """Where small deviations make events happen. Returns (the discrete values as they are, and after all events at
    whose levels the point lies, relations being true in one row and false in the other, shape (3, q); for each event,
    whether the point lies at its level, shape (events,)). Not differentiated."""
    plan = system.plan.some_events
    table = plan.table
    here = system.holding(q).at(t, inputs)
    level = jnp.abs(here.guards(x)) <= guard_rounding(system, here, x)
    near = jnp.concatenate([jnp.zeros(plan.n_clocks, bool), level])
    values, _ = _written(system, t, inputs, x, q)
    rows = np.flatnonzero((table.discrete >= 0) & ~events.ignored)
    place, mine = table.discrete[rows], near[table.event[rows]]
    # A relation has an event for each direction, which write 1 and 0: the largest and the least are its two sides.
    most = jnp.full_like(q, -jnp.inf).at[place].max(jnp.where(mine, values[rows], -jnp.inf))
    least = jnp.full_like(q, jnp.inf).at[place].min(jnp.where(mine, values[rows], jnp.inf))
    written = jnp.isfinite(most)
    return jnp.stack([q, jnp.where(written, most, q), jnp.where(written, least, q)]), near


def ticked(
    system: AcausalSystem, t: Time, inputs: Args, ticking: Sequence[int], x: Array, q: Array
) -> tuple[Array, Array]:
    """(x, q) after the sampled events with these numbers, in order, at one instant."""
    plan = system.plan.some_events
    table, previous = plan.table, q
    # One after the other: each reads what those before it have written at this instant, and `previous` from before all.
    for event in ticking:
        values = system.around_event(t, q, previous, inputs).event_values(x) / jnp.asarray(plan.factor, x.dtype)
        rows = np.flatnonzero(table.event == event)
        states, discrete = (rows[of[rows] >= 0] for of in (plan.state, table.discrete))
        x = x.at[plan.state[states]].set(values[states])
        q = q.at[table.discrete[discrete]].set(values[discrete])
    return x, q


def _written(system: AcausalSystem, t: Time, inputs: Args, x: Array, q: Array) -> tuple[Array, Array]:
    """What all actions would write, and what is there now, in units of the state array, shape (actions,) each."""
    plan = system.plan.some_events
    values = system.around_event(t, q, q, inputs).event_values(x) / jnp.asarray(plan.factor, x.dtype)
    now = jnp.zeros_like(values)
    # An empty array cannot be indexed, even where the result is not used.
    if len(x):
        now = jnp.where(plan.state >= 0, x[np.maximum(plan.state, 0)], now)
    if len(q):
        now = jnp.where(plan.table.discrete >= 0, q[np.maximum(plan.table.discrete, 0)], now)
    return values, now


def guard_rounding(system: AcausalSystem, here: Numeric, x: Numeric) -> Array:
    """The distance from zero that a guard may have by what is left of the equations at an equilibrium, shape
    (guards,)."""
    plan = system.plan
    places = np.concatenate([plan.states, plan.carried]).astype(np.int64)
    # Equations are solved to a part of each unknown's size, which its guard is off by in turn.
    sizes = jnp.maximum(jnp.abs(x), jnp.asarray(declared_scale(plan.model)[places], x.dtype))
    return solved(x.dtype) * (jnp.abs(jax.jacfwd(here.guards)(x)) @ sizes)
