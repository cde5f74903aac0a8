"""Steps that end at events."""

import diffrax
import jax
import jax.numpy as jnp
from jax import Array, lax

from ...base.aliases import Result
from ..adjoint.ends import AttemptedStep, End
from .problem import HybridState, bound

ENDED: Result = diffrax.RESULTS.event_occurred  # Diffrax asks the controller last, so that it must say so
# By how much the step after one that an event made short may be longer than it, up to the length that was planned
# before. Controllers allow a factor of 8 to 10 a step, and would need several steps to get there after each event.
# Set by hand: test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
GROWTH = 1e3


class AtEvents(End):
    """A step in which an event was found early is rejected and retried up to it, and no step goes beyond the next tick
    of a clock. The state of this end is the length that a step shortened by an event would have had; infinity if there
    was none."""

    def inside(self, terms, y):
        # The controller by errors sees the continuous state alone. Counts and times of the bookkeeping have no error,
        # and would dilute a norm.
        return None if terms is None else bound(terms, y), y.x

    def first(self, t, end, y, args, span):
        return jnp.minimum(end, _due(y)), jnp.full_like(jnp.asarray(t), jnp.inf)

    def next(self, step: AttemptedStep, args, state):
        keep, start, h, wished = step.accepted, step.start, step.end - step.start, state
        request = lax.stop_gradient(step.y1.request)
        early = keep & jnp.isfinite(request)
        h = jnp.where(keep & ~early & jnp.isfinite(wished), jnp.maximum(h, jnp.minimum(wished, GROWTH * h)), h)
        end = start + lax.stop_gradient(h)
        kept = keep & ~early
        start = jnp.where(early, step.t0, start)
        end = jnp.where(early, request, end)
        due = jnp.where(kept, _due(step.y1), _due(step.y0))
        # A step that is cut short for a clock is followed by one of the size that the controller had chosen.
        cut = end > due
        wished = jnp.where(early, step.t1 - step.t0, jnp.where(keep, jnp.inf, wished))
        wished = lax.stop_gradient(jnp.where(cut & ~early, h, wished))
        end = jnp.where(cut, due, end)
        result = diffrax.RESULTS.where(kept & (step.y1.ended > 0), ENDED, step.result)
        # A step that is retried for an event leaves the controller by errors as it was.
        before, after = step.states
        after = jax.tree.map(lambda a, b: jnp.where(early, b, a), after, before)
        return step.but(accepted=kept, start=start, end=end, result=result, states=(before, after)), wished


def _due(y: HybridState) -> Array:
    ends = y.due if y.past is None else jnp.append(y.due, y.past.until)
    return lax.stop_gradient(jnp.min(ends, initial=jnp.inf))
