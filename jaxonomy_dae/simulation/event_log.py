"""The events of a run."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..hybrid.problem import HybridState
from ..lowering.plan_events import EventPlan


class EventLog(eqx.Module):
    """`solution.events`: the events of conditions in the order in which they happened; sampled ones and those
    at the initial time are listed only if they end the run.

    - `ts`: the times, shape `(max_events,)`, infinite beyond the last event; differentiable.
    - `which`: the number of each event among `all_names`, −1 where there was none.
    - `transversality`: how fast the condition was reached, in its units per second. An event whose transversality is
        near zero only grazes its condition, and its time hardly has a derivative.
    - `count`: how many there were.
    """

    ts: Float[Array, "*batch events"]
    which: Float[Array, "*batch events"]
    transversality: Float[Array, "*batch events"]
    count: Float[Array, "*batch"]
    all_names: tuple[str, ...] = eqx.field(static=True)
    messages: tuple[str | None, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, state: HybridState, plan: EventPlan) -> "EventLog":
        """The log in the last state of a run."""
        return cls(
            state.times, jax.lax.stop_gradient(state.which), jnp.abs(state.rate), jax.lax.stop_gradient(state.count),
            plan.names, plan.table.message,
        )  # fmt: skip

    def __len__(self) -> int:
        return int(self.count)

    @property
    def names(self) -> list[str]:
        """What happened, in order: the conditions as they were written."""
        return [self.all_names[int(k)] for k in np.asarray(self.which) if k >= 0]

    @property
    def terminated(self) -> str | None:
        """With what `terminate(...)` ended the run, or None."""
        messages = [self.messages[int(k)] for k in np.asarray(self.which) if k >= 0]
        return messages[-1] if messages else None

    def __repr__(self):
        if isinstance(self.count, Tracer) or self.count.ndim:
            return f"EventLog(ts of shape {self.ts.shape})"
        ts: Any = np.asarray(self.ts)[: len(self)]
        rows = [f"  {t:.9g}  {name}" for t, name in zip(ts[:12], self.names, strict=False)]
        more = [f"  … and {len(self) - 12} more"] if len(self) > 12 else []
        return "\n".join([f"EventLog({len(self)} events)", *rows, *more])
