"""The discrete-time state space of a model with sampled controllers.

Given are the partial derivatives of a model at a point, and its clocks. Over the period after which all clocks repeat,
ticks and flows take turns: a tick is linear with the Jacobian of what its events write; between ticks, where discrete
values z and inputs u are constant, deviations follow d(x, z, u)/dt = F·(x, z, u), whose solution is exp(F·duration).
Their product is the state space. (Franklin, Powell & Workman 1998, section 4.3.)
"""

from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from ..base.aliases import PyTree
from ..base.errors import ModelError
from ..base.tolerances import KNOWN_ROUNDINGS, MEANT_EQUAL, spacing
from ..compile.diagnosis.wording import some
from ..host.staging import is_traced
from ..run.system.system import AcausalSystem
from ..run.system.system_at import SystemAt
from .events_at_rest import RestingEvents, resting_events, ticked
from .partials import Driven, Partials, on_tangent
from .state_space import StateSpace
from .tangent import Coordinates

RATIO = 1000  # the largest denominator of a ratio of two periods that counts as one of integers
TICKS = 1000  # in a period of all clocks: each instant is a matrix exponential


class Instants(NamedTuple):
    """The ticks of one period of all clocks: of each instant the events, and their numbers of ticks; and how many ticks
    of each clock it takes until all repeat."""

    events: tuple[tuple[int, ...], ...]
    numbers: tuple[tuple[int, ...], ...]
    counts: dict[int, int]


def sampled_space(system: AcausalSystem, point: Driven, partials: Partials, coordinates: Coordinates) -> StateSpace:
    """The discrete-time state space, of the states and the discrete variables that clocks write, before the first tick
    of a period."""
    plan, events = system.plan, resting_events(system.plan)
    if events is None or not len(events.ticking):
        raise ModelError("sampled=True is for models with events of clocks, when(self.sampled(T), ...); this has none")
    plan_of_events = plan.some_events
    if plan.n_projected and (plan_of_events.state[events.ticking] >= 0).any():
        raise ModelError(
            "a clock writes states of a model with hidden constraints, which has no linear model from tick to tick yet"
        )
    instants = instants_of(system, events)
    times, fine = _times(system, instants)
    fine &= jnp.all(partials.of_constraints[2] == 0)  # otherwise states jump at ticks, by more than events write
    n, k, m = len(plan.states), len(events.unknown), len(point.u)
    kept = coordinates.kept
    follow, slopes = on_tangent(partials, coordinates)
    dtype, size = point.x.dtype, len(kept) + k + m + 1
    inner = slice(0, len(kept) + k)

    # Deviations are (coordinates, discrete values, inputs, 1): the last carries what changes without any.
    flow = jnp.zeros((size, size), dtype)
    of_slopes = jnp.concatenate(
        [slopes[kept], partials.of_slopes[2][kept], partials.of_slopes[1][kept], partials.slopes[kept, None]], axis=1
    )
    flow = flow.at[: len(kept)].set(of_slopes)
    spread = jnp.zeros((n + k + m, size - 1), dtype)
    spread = spread.at[:n, : len(kept)].set(follow).at[n:, len(kept) :].set(jnp.eye(k + m, dtype=dtype))

    def tick(events_now: tuple[int, ...]) -> PyTree:
        def written(given):
            state, held, u = jnp.split(given, [n, n + k])
            driving = {**point.values, **dict(zip(point.inputs, u, strict=True))}
            x, q = jnp.concatenate([state, point.x[n:]]), point.q.at[events.unknown].set(held)
            x, q = ticked(system, point.t, driving, events_now, x, q)
            after = jnp.concatenate([x[:n][kept], q[events.unknown], u])
            return after, after

        given = jnp.concatenate([point.x[:n], point.q[events.unknown], point.u])
        jacobian, after = jax.jacfwd(written, has_aux=True)(given)
        before = jnp.concatenate([point.x[:n][kept], point.q[events.unknown], point.u])
        moved = jnp.concatenate([jacobian @ spread, (after - before)[:, None]], axis=1)
        return jnp.concatenate([moved, jnp.eye(1, size, size - 1, dtype=dtype)])

    alike = {now: tick(now) for now in dict.fromkeys(instants.events)}
    first = alike[instants.events[0]]
    whole = jnp.eye(size, dtype=dtype)
    for now, duration in zip(instants.events, jnp.diff(times), strict=True):
        whole = jax.scipy.linalg.expm(flow * duration) @ alike[now] @ whole
    y_x, y_u, y_z = partials.of_outputs
    read = jnp.concatenate([y_x @ follow, y_z, y_u, jnp.zeros((len(point.outputs), 1), dtype)], axis=1) @ first
    if not is_traced(fine) and not bool(fine):
        raise ModelError("hidden constraints depend on what a clock writes: states jump at its ticks, which have no "
                         "linear model yet")  # fmt: skip
    whole, read = jnp.where(fine, whole, jnp.nan), jnp.where(fine, read, jnp.nan)
    places = slice(len(kept) + k, len(kept) + k + m)
    names = (*(system.states[c] for c in kept), *(system.every_discrete[c] for c in events.unknown.tolist()))
    return StateSpace(
        whole[inner, inner], whole[inner, places], read[:, inner], read[:, places],
        jnp.append(point.x[:n][kept], point.q[events.unknown]), point.u, partials.outputs + read[:, -1],
        whole[inner, -1], names, point.inputs, point.outputs, times[-1] - times[0],
    )  # fmt: skip


def instants_of(system: AcausalSystem, events: RestingEvents) -> Instants:
    """The ticks of one period of all clocks, in their order.

    **Raises:**

    - `ModelError` if the periods have no common multiple, or if it takes more than `TICKS` ticks; and inside jit, for
        clocks whose periods or offsets differ and are parameters.
    """
    plan = system.plan.some_events
    clocks = np.unique(plan.table.event[events.ticking]).tolist()
    known = system.parameters.known
    declared = [plan.table.events[e].clock for e in clocks]
    if known is None and len(set(declared)) == 1:  # their order is known whatever the period is
        return Instants((tuple(clocks),), ((0,) * len(clocks),), dict.fromkeys(clocks, 1))
    # Numbers can be sorted inside jit, too; values of parameters are not known there.
    if known is None and any(part.parameters for clock in declared for part in clock):
        raise ModelError(
            "inside jit, grad and vmap the order of ticks cannot be told by the values of periods that are parameters: "
            "write them as numbers, or give all clocks one period and one offset"
        )
    # Inside jit, too, times are computed now: they decide in which order clocks tick.
    with jax.ensure_compile_time_eval():
        numbers = jnp.zeros((0,)) if known is None else jnp.asarray(known)
        # Clocks read parameters alone: networks, inputs and sizes of this point are left out.
        both = SystemAt(system.plan, numbers, (), 0.0, {}, jnp.zeros((0,))).clocks()
    periods, offsets = (np.asarray(v, float)[clocks] for v in both)
    equal = _equal(system.parameters.array.dtype)
    shortest = periods.min()
    ratios = [Fraction(p / shortest).limit_denominator(RATIO) for p in periods.tolist()]
    apart = np.abs(np.array([float(r) for r in ratios]) * shortest - periods) > equal * periods
    # In units of the shortest period divided by `grid`, all periods are integers.
    grid = np.lcm.reduce([r.denominator for r in ratios])
    parts = [int(r * int(grid)) for r in ratios]
    common = int(np.lcm.reduce(parts))
    counts = {e: common // part for e, part in zip(clocks, parts, strict=True)}
    if apart.any() or sum(counts.values()) > TICKS:
        listed = some([f"'{plan.names[e]}' every {p:g} s" for e, p in zip(clocks, periods.tolist(), strict=True)])
        raise ModelError(
            f"the clocks {listed} do not tick together again within {TICKS} ticks, so that there is no linear model of "
            "one period: choose periods that are in the ratio of small integers"
        )
    # From the first offset on: others begin their period with the first tick after it.
    first = [-int(np.floor((o - offsets.min()) / p + equal)) for o, p in zip(offsets, periods, strict=True)]
    at = sorted(
        (float(o + number * p), e, number)
        for e, o, p, begin in zip(clocks, offsets.tolist(), periods.tolist(), first, strict=True)
        for number in range(begin, begin + counts[e])
    )
    groups: list[list[tuple[float, int, int]]] = []
    for time, e, number in at:
        if groups and time - groups[-1][0][0] <= equal * shortest:
            groups[-1].append((time, e, number))
        else:
            groups.append([(time, e, number)])
    # Events of one instant happen in the order of their numbers, as in runs.
    ordered = [sorted(group, key=lambda entry: entry[1]) for group in groups]
    return Instants(
        tuple(tuple(e for _, e, _ in group) for group in ordered),
        tuple(tuple(number for _, _, number in group) for group in ordered),
        counts,
    )


def _times(system: AcausalSystem, instants: Instants) -> tuple[Array, Array]:
    """(The times of the instants, and of the first one of the next period; whether ticks are in the order that was
    taken for granted)."""
    periods, offsets = SystemAt(system.plan, system.numbers, (), 0.0, {}, system.typical_sizes).clocks()
    rows = [
        [offsets[e] + number * periods[e] for e, number in zip(now, numbers, strict=True)]
        for now, numbers in zip(instants.events, instants.numbers, strict=True)
    ]
    lengths = jnp.stack([count * periods[e] for e, count in instants.counts.items()])
    times = jnp.stack([row[0] for row in rows] + [rows[0][0] + lengths[0]])
    allowed = _equal(times.dtype) * jnp.min(lengths)
    together = [jnp.max(jnp.abs(jnp.stack(row) - row[0])) <= allowed for row in rows]
    fine = jnp.all(jnp.stack(together)) & jnp.all(jnp.diff(times) > 0)
    return times, fine & (jnp.max(lengths) - jnp.min(lengths) <= allowed)


def _equal(dtype: DTypeLike) -> float:
    """Relative: times that are one."""
    return max(MEANT_EQUAL, KNOWN_ROUNDINGS * spacing(dtype))
