"""Conditions that can never become true: whose sides the equations keep equal, whatever the states are."""

import jax
import jax.numpy as jnp
import numpy as np

from ...base.tolerances import BAND
from ...compile.diagnosis.wording import listed
from ...write.events import EventFlag
from .solution import Solution


def always_equal(solution: Solution) -> str:
    """Names the events that never happen, because both sides of their conditions were equal in the whole run and depend
    on no state, no discrete variable and no time, in a sentence; "" if there are none."""
    log, system = solution.event_log, solution.system
    if log is None or log.size is None or not log.size.size:
        return ""
    plan = system.plan.some_events
    c, x = plan.n_clocks, solution.states[-1]
    rounding = BAND * jnp.finfo(x.dtype).eps * max(1.0, float(jnp.max(jnp.abs(x), initial=0.0)))
    waits = plan.table.are(EventFlag.LISTED) & ~plan.table.are(EventFlag.AT_START)
    waits[np.asarray(log.which, int)[np.asarray(log.which) >= 0]] = False
    zero = waits[c:] & (np.asarray(log.size) <= rounding)
    if not zero.any():
        return ""

    def guards(t, x, q):
        return system.holding(q).at(t, solution.inputs).guards(x)

    slopes = jax.jacfwd(guards, (0, 1, 2))(solution.ts[-1], x, jnp.asarray(system.discrete_values, x.dtype))
    moves = np.any([np.any(np.reshape(s, (len(zero), -1)) != 0, axis=1) for s in slopes], axis=0)
    names = [plan.names[k] for k in c + np.flatnonzero(zero & ~moves)]
    if not names:
        return ""
    one = len(names) == 1
    return (
        f"{listed(names)} never {'happens' if one else 'happen'}: from t={float(solution.ts[0]):g} to "
        f"t={float(solution.ts[-1]):g} both sides of the condition are equal, because the equations keep them so, and "
        "it does not become true. Compare what the equations leave apart, or leave the event out"
    )
