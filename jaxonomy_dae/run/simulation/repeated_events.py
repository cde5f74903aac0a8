"""What events that happen again and again at one instant have in common: relations that turn in turn, and events that
change nothing."""

import jax
import jax.numpy as jnp
import numpy as np

from ...base.aliases import Inputs, State, Time
from ...compile.lowering.plan_events import EventPlan
from ...write.events import EventFlag
from ..system.system import AcausalSystem

# Of the whole run: a relation counts as about to turn if its sides are equal within so long.
AT_ONCE = 1e-6


def turning_in_turn(
    system: AcausalSystem, event: int, at: tuple[Time, State], duration: float, inputs: Inputs
) -> list[int]:
    """The events of the relations that turn together with `event`, if there are several of them and the equations do
    not drive the solution back to the surface of `event` from both sides: none of them is slid along. Else empty."""
    plan = system.plan.some_events
    q = np.asarray(system.discrete_values, float)
    value, rate = _guards(system, q, at, inputs)
    c = plan.n_clocks
    relations = np.flatnonzero(plan.table.are(EventFlag.RELATION))
    relations = relations[relations >= c]
    near = np.abs(value[relations - c]) <= AT_ONCE * duration * np.abs(rate[relations - c])
    turning = {_relation_of(plan, k): int(k) for k in relations[near | (relations == event)].tolist()}
    own = _relation_of(plan, event)
    if len(turning) < 2 or own < 0:
        return []
    other = q.copy()
    other[own] = 1.0 - other[own]
    turned = _guards(system, other, at, inputs)[1]
    k = event - c
    return [] if rate[k] * turned[k] < 0 else sorted(turning.values())


def writes_what_holds(
    system: AcausalSystem, event: int, at: tuple[Time, State], inputs: Inputs
) -> list[tuple[str, float]]:
    """The discrete variables that an event writes, with their values, if it writes nothing else and all of them have
    these values already; else empty."""
    plan = system.plan.some_events
    q = np.asarray(system.discrete_values, float)
    rows = plan.table.event == event
    if (plan.state[rows] >= 0).any():
        return []
    t, x = at
    values = np.asarray(system.around_event(t, q, q, inputs).event_values(x))
    place = plan.table.discrete[rows]
    if not len(place) or (place >= plan.n_visible).any() or not np.array_equal(values[rows], q[place]):
        return []
    return [(system.discretes[p], float(q[p])) for p in place.tolist()]


def _relation_of(plan: EventPlan, event: int) -> int:
    """The hidden discrete variable that an event of a relation writes; −1 if it writes none."""
    place = plan.table.discrete[plan.table.event == event]
    return int(place[0]) if len(place) else -1


def _guards(
    system: AcausalSystem, q: np.ndarray, at: tuple[Time, State], inputs: Inputs
) -> tuple[np.ndarray, np.ndarray]:
    """The values of the guards with the discrete values q, and their rates."""
    held = system.holding(jnp.asarray(q))
    t, x = map(jnp.asarray, at)
    slope = held.vector_field(t, x, inputs)
    one = jnp.ones_like(t)
    value, rate = jax.jvp(lambda t, x: held.at(t, inputs).guards(x), (t, x), (one, slope))
    return np.asarray(value), np.asarray(rate)
