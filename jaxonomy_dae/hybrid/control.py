"""Step sizes with steps that end at events."""

import diffrax
import jax
import jax.numpy as jnp
from jax import Array, lax

from ..adjoint.wrapped_control import WrappedControl
from ..aliases import Result
from .problem import HybridState, bound

ENDED: Result = diffrax.RESULTS.event_occurred  # Diffrax asks the controller last, so that it must say so
# By how much the step after one that an event made short may be longer than it, up to the length that was planned
# before. Controllers allow a factor of 8 to 10 a step, and would need several steps to get there after each event.
# Set by hand: test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
GROWTH = 1e3


class EventControl(WrappedControl):
    """Wraps a controller so that steps end at events: a step in which an event was found is retried up to it, and no
    step goes beyond the next tick of a clock."""

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """Returns (the end of the first step, (the wrapped controller's state, the length that a step shortened by an
        event would have had: infinity, for none has been yet))."""
        end, state = self.controller.init(bound(terms, y0.q), t0, t1, y0.x, dt0, args, func, error_order)
        return jnp.minimum(end, _due(y0)), (state, jnp.full_like(jnp.asarray(t0), jnp.inf))

    def adapt_step_size(self, t0, t1, y0, y1, args, y_error, error_order, controller_state):
        """Accepts or rejects the step and proposes the next one; see `diffrax.AbstractStepSizeController`. A step in
        which an event was found early is rejected and retried up to it, and steps end where a clock ticks."""
        inner, wished = controller_state
        keep, start, end, jump, new, result = self.controller.adapt_step_size(
            t0, t1, y0.x, y1.x, args, y_error, error_order, inner
        )
        request = lax.stop_gradient(y1.request)
        early = keep & jnp.isfinite(request)
        h = end - start
        h = jnp.where(keep & ~early & jnp.isfinite(wished), jnp.maximum(h, jnp.minimum(wished, GROWTH * h)), h)
        end = start + lax.stop_gradient(h)
        kept = keep & ~early
        start = jnp.where(early, t0, start)
        end = jnp.where(early, request, end)
        due = jnp.where(kept, _due(y1), _due(y0))
        # A step that is cut short for a clock is followed by one of the size that the controller had chosen.
        cut = end > due
        wished = jnp.where(early, t1 - t0, jnp.where(keep, jnp.inf, wished))
        wished = jnp.where(cut & ~early, h, wished)
        end = jnp.where(cut, due, end)
        result = diffrax.RESULTS.where(kept & (y1.ended > 0), ENDED, result)
        # A step that is retried for an event leaves the wrapped controller as it was.
        new = jax.tree.map(lambda a, b: jnp.where(early, b, a), new, inner)
        return kept, start, end, jump, (new, lax.stop_gradient(wished)), result


def _due(y: HybridState) -> Array:
    return lax.stop_gradient(jnp.min(y.due, initial=jnp.inf))
