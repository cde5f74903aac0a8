"""Events where equations only bend.

Where max(u, 0) turns, dx/dt has the same value on both sides: the saltation matrix is the identity (`event_map`), no
other guard has jumped, and what is left of the event is that its relation is known to have turned.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ...base.aliases import Args, Time
from .event_map import SLIDES, TURNS
from .first_order import differentiable_once
from .problem import AbstractHybridProblem, HybridState
from .side import ABOVE, BELOW, RESTS, rounding


def turned(
    problem: AbstractHybridProblem, t: Time, state: HybridState, values: Array, due: Array, args: Args
) -> HybridState:
    """The state after the events that are `due`, given the guards' `values`: clocks have ticked and relations have
    turned.

    The guard of a relation falls, and the one of its opposite is armed: it rises, or rests at zero.
    """
    opposite, c = np.array(problem.facts.opposite, int), problem.facts.n_clocks
    ticks = state.ticks + due[:c].astype(state.ticks.dtype)
    q = problem.settled(t, state.x, state.q, due, args)
    events, due = due, due[c:]
    risen = jnp.where(-values > rounding(state.size), ABOVE, RESTS)
    armed = jnp.where(due[opposite], risen[opposite], state.armed)
    armed = jnp.where(due, BELOW, armed).astype(state.armed.dtype)
    turns = state.turns + jnp.sum(due).astype(state.turns.dtype)
    slides = jnp.any(due) & (turns > SLIDES + TURNS * len(opposite))
    stuck = jnp.where(slides, jnp.argmax(events), -1).astype(state.stuck.dtype)
    # The time at which it turns moves, which second derivatives would see.
    return state.but(
        x=differentiable_once(state.x),
        q=q,
        armed=armed,
        ticks=ticks,
        due=lax.stop_gradient(problem.due(ticks)),
        turns=turns,
        stuck=stuck,
    )
