"""The events of a run."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from ...base.aliases import Args, Numeric, PyTree, State, Time, Times
from ...base.errors import ModelError
from ...host.staging import is_traced, on_device
from ...solve.events.iteration import Iteration
from ...solve.events.problem import HybridState
from ..system.system import AcausalSystem

SHOWN = 12  # events in the text of a log


class EventLog(eqx.Module):
    """The events of a run, one row each, up to the log's capacity; `count` counts those beyond it, too. `iteration` is
    how far repeated events were at the last instant, `size` the largest magnitude of each guard of late."""

    ts: Float[Array, "*batch events"]
    which: Float[Array, "*batch events"]
    transversality: Float[Array, "*batch events"]
    count: Float[Array, "*batch"]
    stuck: Float[Array, "*batch"]
    before: Float[Array, "*batch rows m"]
    after: Float[Array, "*batch rows m"]
    iteration: Iteration | None = None
    size: Float[Array, "*batch guards"] | None = None

    @classmethod
    def empty(cls, batch: tuple[int, ...], m: int, dtype: DTypeLike) -> "EventLog":
        """The log of runs of a model without events."""
        none, rows, zero = (on_device(np.zeros((*batch, *shape), dtype)) for shape in ((0,), (0, m), ()))
        return cls(none, none, none, zero, on_device(np.full(batch, -1.0, dtype)), rows, rows)

    @classmethod
    def of(cls, state: HybridState) -> "EventLog":
        """The log in the last state of a run."""
        table: Any = state.table
        ts, which, rate = (table.log[:, k] for k in range(3))
        frozen = jax.lax.stop_gradient((which, jnp.abs(rate), state.count, state.stuck))
        last = jax.lax.stop_gradient((state.iteration, state.size))
        return cls(ts, *frozen, table.sides[:, 0], table.sides[:, 1], *last)


class Events:
    """`solution.events`: the events of conditions in the order in which they happened. Sampled ones and those at the
    initial time are listed only if they end the run. Empty if the model has no events.

    - `ts`: the times, shape `(room,)`, infinite beyond the last event; differentiable. There is room for `max_events`;
        if that is not given, for all events outside jit, grad and vmap, and for the first 100 inside.
    - `which`: the number of each event among `all_names`, −1 where there was none.
    - `names`: what happened, in order: the conditions as they were written.
    - `transversality`: how fast the condition was reached, in its units per second. An event whose transversality is
        near zero only grazes its condition, and its time hardly has a derivative.
    - `before`, `after`: variables on both sides, `solution.events.before["ball.v"]` has shape `(room,)`, NaN
        beyond the last event; differentiable, along with the time of the event.
    - `count`: how many there were, those without room included: an int, inside jit and of a batch an array; outside jit
        also `len(solution.events)`.
    - `terminated`: with what `terminate(...)` ended the run, or None; several at one instant are joined by "; ".
    """

    def __init__(self, log: EventLog, system: AcausalSystem, inputs: Args, first: Callable[[], tuple[Time, State]]):
        """`first()` is a time of the run and (x, q) there."""
        self._log, self._system, self._inputs, self._first = log, system, inputs, first
        self._table = system.plan.events

    @property
    def ts(self) -> Array:
        return self._log.ts

    @property
    def which(self) -> Array:
        return self._log.which

    @property
    def transversality(self) -> Array:
        return self._log.transversality

    @property
    def count(self) -> int | Int[Array, "*batch"]:
        count = self._log.count
        one = not is_traced(count) and not count.ndim
        return int(count) if one else count.astype(int)

    @property
    def all_names(self) -> Sequence[str]:
        return () if self._table is None else self._table.names

    @property
    def names(self) -> list[str]:
        return [self.all_names[k] for k in self._numbers()]

    @property
    def terminated(self) -> str | None:
        plan = self._system.plan
        messages = [plan.some_events.table.events[k].message for k in self._numbers()]
        # Others may be listed at the last instant beside those that end the run.
        return "; ".join(dict.fromkeys(m for m in messages if m is not None)) or None

    @property
    def before(self) -> "Side":
        return Side(self._log.ts, self._log.before, self._system, self._inputs, self._first)

    @property
    def after(self) -> "Side":
        return Side(self._log.ts, self._log.after, self._system, self._inputs, self._first)

    def _numbers(self) -> list[int]:
        if is_traced(self.which) or self.which.ndim != 1:
            raise ModelError("the names of events are those of one run, outside jit: read .which and .all_names")
        return [int(k) for k in np.asarray(self.which) if k >= 0]

    def __len__(self) -> int:
        return int(self.count)

    def __repr__(self):
        if not isinstance(self.count, int):
            return f"Events(ts of shape {self.ts.shape})"
        rows = [f"  {t:.9g}  {name}" for t, name in zip(np.asarray(self.ts)[:SHOWN], self.names, strict=False)]
        more = [f"  … and {len(self) - SHOWN} more"] if len(self) > SHOWN else []
        return "\n".join([f"Events({len(self)})", *rows, *more])


class Side:
    """Variables by name, on one side of the events."""

    def __init__(
        self, ts: Times, rows: PyTree, system: AcausalSystem, inputs: Args, first: Callable[[], tuple[Time, State]]
    ):  # fmt: skip
        self._given, self._first = (system, ts, rows, inputs), first

    def __getitem__(self, name: str) -> Array:
        system, ts, rows, inputs = self._given
        if ts.shape[-1] and not rows.shape[-2]:
            raise ModelError(
                "states on both sides of events were not kept, which costs memory in a large model or inside jit: "
                "give simulate(..., save_events=True)"
            )
        if name in system.discretes:
            return rows[..., len(system.plan.nominal) + system.discretes.index(name)]
        array = system.plan.entries(name)
        if array is not None:
            each = jnp.stack([self[one] for one in array[0]], axis=-1)
            return each.reshape(*each.shape[:-1], *array[1])
        quantity, factor = system.plan.resolve([name])
        if not ts.shape[-1]:
            return ts
        first = self._first()
        observed = _observed
        for _ in range(rows.ndim - 2):  # the axes of a batch
            observed = eqx.filter_vmap(observed, in_axes=(eqx.if_array(0), 0, 0, eqx.if_array(0), 0, None, None))
        return observed(system, ts, rows, inputs, first, quantity, factor)


def _observed(
    system: AcausalSystem, ts: Times, rows: PyTree, inputs: Args, first: tuple[Time, State], quantity: np.ndarray,
    factor: np.ndarray,
) -> Numeric:  # fmt: skip
    n, happened = len(system.plan.nominal), jnp.isfinite(ts)

    def one(t, row):
        point = system.holding(row[n:]).at(t, inputs)
        return point.quantities(row[:n], np.maximum(quantity, 0), factor)[0]

    # Rows without an event are evaluated at the first one, or without any at another point of the run, and left out.
    t, row = jnp.where(happened[0], ts[0], first[0]), jnp.where(happened[0], rows[0], first[1])
    safe_t, safe = jnp.where(happened, ts, t), jnp.where(happened[:, None], rows, row)
    values = jnp.where(quantity[0] < 0, 0.0, jax.vmap(one)(safe_t, safe))
    return jnp.where(happened, values, jnp.nan)
