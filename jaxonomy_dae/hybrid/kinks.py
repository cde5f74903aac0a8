"""Events where equations only bend.

Where max(u, 0) turns, dx/dt has the same value on both sides: the saltation matrix is the identity (`event_map`), no
other guard has jumped, and what is left of the event is that its relation is known to have turned.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .event_map import SLIDES, TURNS
from .first_order import differentiable_once
from .problem import AbstractHybridProblem, HybridState
from .side import ABOVE, BELOW, RESTS, rounding


def turned(problem: AbstractHybridProblem, t: Any, state: HybridState, values: Any, due: Any, args: Any) -> HybridState:
    """The state after the relations that are `due` have turned, at guards with these values.

    The guard of a relation falls, and the one of its opposite is armed: it rises, or rests at zero.
    """
    opposite = np.array(problem.opposite)
    risen = jnp.where(-values > rounding(state.size), ABOVE, RESTS)
    armed = jnp.where(due[opposite], risen[opposite], state.armed)
    armed = jnp.where(due, BELOW, armed).astype(state.armed.dtype)
    q = problem.settled(t, state.x, state.q, due, args)
    turns = state.turns + jnp.sum(due).astype(state.turns.dtype)
    slides = jnp.any(due) & (turns > SLIDES + TURNS * len(opposite))
    stuck = jnp.where(slides, problem.n_clocks + jnp.argmax(due), -1).astype(state.stuck.dtype)
    # The time at which it turns moves, which second derivatives would see.
    return state.but(x=differentiable_once(state.x), q=q, armed=armed, turns=turns, stuck=stuck)
