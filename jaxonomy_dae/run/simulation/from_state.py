"""A run that begins at a whole state, such as where another one ended."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Args, PyTree, Time
from ...base.errors import InitializationError, ModelError
from ...host.staging import is_traced
from ...write.events import EventFlag
from ..start.initialize import InitialPoint, is_consistent
from ..system.system import AcausalSystem

ITERATIONS = 8  # Gauss–Newton steps onto the constraints; they converge quadratically, from 0.1 in four to rounding


def from_state(system: AcausalSystem, t0: Time, inputs: Args, x: Float[Array, " n"]) -> InitialPoint:
    """The consistent point next to a state. The search is not differentiated; a last step carries first derivatives by
    the state and by parameters, which are those of the projection at the point found."""
    limit = jnp.sqrt(jnp.finfo(x.dtype).eps) * (jnp.abs(x) + system.state_sizes)
    nothing = jnp.zeros((), jnp.int32)
    zero = jnp.zeros_like(x)
    given = InitialPoint(
        x=x, solved=x[:0], residual=zero, limit=limit, target=zero, method=nothing, evaluations=nothing, jacobian=None
    )
    if not system.is_constrained:
        return given
    frozen = jax.lax.stop_gradient
    still, driving = (
        jax.tree.map(lambda leaf: frozen(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)
        for tree in (system, inputs)
    )
    near = still.project(frozen(t0), frozen(x), driving, iterations=ITERATIONS)
    # near has the value of the search and, by x − frozen(x), the derivative of x: the last step carries it over.
    moved = system.project(t0, near + (x - frozen(x)), inputs, iterations=1)
    return given._replace(x=moved, residual=frozen(moved - near))


def check_array(system: AcausalSystem, initial: PyTree) -> None:
    """Raises a `ModelError` if an array cannot be, or does not say, the state of this system."""
    n, events = system.plan.n_state, system.plan.events
    if events is not None:
        relation = events.table.are(EventFlag.RELATION)
        written = [events.names[e] for e in events.table.event.tolist() if not relation[e]]
        if written:
            discrete = f", nor the discrete variables ('{system.discretes[0]}')" if system.discretes else ""
            raise ModelError(
                f"initial: this array does not hold what is known of events ('{written[0]}'){discrete}: go on from "
                "another run with initial=solution.at(k), or start anew with values by names, initial={'m.x': 1.0}"
            )
    if jnp.shape(initial) != (n,):
        raise ModelError(
            f"initial: a whole state of this system has shape ({n},); got shape {jnp.shape(initial)}. Single values go "
            "by names, initial={'m.x': 1.0}"
        )
    if not jnp.issubdtype(jnp.result_type(initial), jnp.number) or jnp.iscomplexobj(initial):
        raise ModelError(f"initial: a state consists of real numbers; got {jnp.result_type(initial)}")
    if not is_traced(initial) and not np.isfinite(np.asarray(initial, float)).all():
        k = int(np.flatnonzero(~np.isfinite(np.asarray(initial, float)))[0])
        raise ModelError(f"initial: entry {k} of the state is {float(initial[k])}; entries must be finite")


def check_state(found: InitialPoint) -> None:
    """Raises an `InitializationError` where a state was not moved onto the constraints."""
    if not is_consistent(found):
        raise InitializationError(
            "no state that satisfies the constraints was found near the one given: give solution.at(k) of a run of "
            "the same model, or values by names, initial={'m.x': 1.0}"
        )
