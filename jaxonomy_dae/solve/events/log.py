"""Events as rows of a table: those of a run, and those of one step, which are appended to them."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...base.aliases import Time


class EventRows(eqx.Module):
    """Events, one row each, in the order in which they happened.

    - `log`: the time, the number of the event, and how fast its guard fell.
    - `sides`: (x, q) before and after it; no rows if they are not asked for.
    """

    log: Float[Array, "rows 3"]
    sides: Float[Array, "rows_or_none 2 m"]

    @classmethod
    def empty(cls, rows: int, sides: bool, m: int, dtype: jnp.dtype) -> "EventRows":
        """So many rows in which no event stands: at an infinite time, with the number −1."""
        log = jnp.broadcast_to(jnp.array([jnp.inf, -1.0, 0.0], dtype), (rows, 3))
        return cls(log, jnp.full((rows if sides else 0, 2, m), jnp.nan, dtype))

    def written(
        self,
        row: Int[Array, " events"],
        time: Time,
        events: Int[Array, " events"] | Bool[Array, " events"],
        rate: Float[Array, " events"],
        before: Float[Array, " m"],
        after: Float[Array, " m"],
    ) -> "EventRows":
        """A copy with events that happen at once written to the rows `row`, where there are such rows."""
        log, sides = self.log, self.sides
        if log.shape[0]:
            each = [jnp.broadcast_to(time, rate.shape), events.astype(time.dtype), lax.stop_gradient(rate)]
            # Events beyond the room are counted, so that a run can say how many there were, and not listed.
            log = log.at[row].set(jnp.stack(each, axis=1), mode="drop")
        if sides.shape[0]:
            sides = sides.at[row].set(jnp.stack([before, after])[None], mode="drop")
        return EventRows(log, sides)
