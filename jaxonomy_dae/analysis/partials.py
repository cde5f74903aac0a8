"""The partial derivatives of a model at a point, of which linear models are made."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import Args
from ..base.tolerances import spacing
from ..compile.lowering.plan import SystemPlan
from ..host.cache import compiled
from ..run.system.nonlinear import Refinement
from ..run.system.system import AcausalSystem
from .events_at_rest import both_sides, resting_events
from .tangent import Coordinates


class Partials(NamedTuple):
    """What a linear model is made of, at a point.

    - `slopes`, `outputs`: dx/dt and y.
    - `of_slopes`, `of_constraints`, `of_outputs`: their derivatives, and those of hidden constraints, with respect to
        states, inputs and the discrete values that clocks write.
    - `off`: which hidden constraints do not hold at the point.
    - `agree`: whether all of it is the same on both sides of events at whose levels the point lies; `near`: which
        events these are.
    """

    slopes: Array
    outputs: Array
    of_slopes: tuple[Array, Array, Array]
    of_constraints: tuple[Array, Array, Array]
    of_outputs: tuple[Array, Array, Array]
    off: Array
    agree: Array
    near: Array


class Driven(NamedTuple):
    """A point, what drives it there, and the names of inputs and outputs."""

    t: Any
    x: Array
    q: Array
    values: Args
    u: Array
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def partials_at(system: AcausalSystem, point: Driven, quantity: tuple[int, ...], factor: tuple[float, ...]) -> Partials:
    """The partial derivatives of a system; `quantity` and `factor` are the outputs."""
    t, x, q, values, u, names, _ = point
    n = len(system.plan.states)
    which, scale = np.array(quantity, np.int64), np.array(factor)
    events = resting_events(system.plan)
    sampled = np.zeros(0, np.int64) if events is None else events.unknown

    def everything(state, u, held, q):
        now = system.holding(q.at[sampled].set(held) if len(sampled) else q)
        here = now.at(t, {**values, **dict(zip(names, u, strict=True))})
        full = jnp.concatenate([state, x[n:]])
        if len(system.plan.carried):  # which follow the states and the inputs
            full = here.refined(full, Refinement.ROOT)
        read = here.quantities(full, np.maximum(which, 0), scale) if len(which) else full[:0]
        y = jnp.where(jnp.asarray(which < 0), 0.0, read)
        return here.semi_explicit(full)[:n], here.constraint_vector(full), y

    def of(q):
        # The values come with their derivatives, from the same evaluation.
        def twice(*given):
            state, u, held = given
            found = everything(state, u, held, q)
            return found, found

        return jax.jacfwd(twice, (0, 1, 2), has_aux=True)(x[:n], u, q[sampled])

    if events is None or not len(system.plan.events or ()):
        (of_slopes, of_constraints, of_outputs), (slopes, left, y) = of(q)
        off = _off(system, point, left)
        return Partials(slopes, y, of_slopes, of_constraints, of_outputs, off, jnp.array(True), jnp.zeros(0, bool))
    sides, near = both_sides(system, t, values, events, x, q)
    # The first side is the point itself, whose derivatives are taken; the others are compared with it.
    on_sides = jax.vmap(of)(sides.at[0].set(q))
    (of_slopes, of_constraints, of_outputs), (slopes, left, y) = jax.tree.map(lambda a: a[0], on_sides)
    agree = jnp.stack([alike(leaf) for leaf in jax.tree.leaves(on_sides)]).all()
    agree, off = agree & ~_moves(system.plan, near), _off(system, point, left)
    return Partials(slopes, y, of_slopes, of_constraints, of_outputs, off, agree, near)


def _off(system: AcausalSystem, point: Driven, left: Array) -> Array:
    """Which hidden constraints do not hold, to half of the digits of their terms; `left` is what is left of them. A
    point may have been found for other parameters."""
    here = system.holding(point.q).at(point.t, {**point.values, **dict(zip(point.inputs, point.u, strict=True))})
    places = np.concatenate([system.plan.states, system.plan.carried]).astype(np.int64)
    reach = jnp.maximum(jnp.abs(point.x), system.typical_sizes[places])
    return jnp.abs(left) > spacing(left.dtype) ** 0.5 * here.constraint_magnitudes(point.x, reach)


def alike(sides: Array) -> Array:
    """Whether rows are the same, to half of the digits of the largest entry."""
    # Branches that meet with one slope differ by rounding alone. Kinks differ by parts of order one.
    allowed = spacing(sides.dtype) ** 0.5 * jnp.max(jnp.abs(sides), initial=0.0)
    return jnp.all(jnp.abs(sides - sides[0]) <= allowed)


def _moves(plan: SystemPlan, near: Array) -> Array:
    """Whether one of these events lets states jump, or ends the run."""
    events = plan.some_events
    # `ends` is a new array at each read, so that writing into it changes no table.
    moves = events.table.ends
    moves[events.table.event[events.state >= 0]] = True
    return jnp.any(near & moves)


def on_tangent(partials: Partials, coordinates: Coordinates) -> tuple[Array, Array]:
    """(how states follow from the coordinates, shape (states, coordinates); the derivatives of slopes with respect to
    states that keep to the constraints). Dependent states d follow from coordinates q by ∂h/∂d·δd + ∂h/∂q·δq = 0."""
    kept, dependent, rows = coordinates
    h_x = partials.of_constraints[0]
    follow = jnp.zeros((h_x.shape[1], len(kept)), h_x.dtype).at[kept, np.arange(len(kept))].set(1.0)
    if len(dependent):
        inner = h_x[rows][:, dependent]
        follow = follow.at[dependent].set(-jnp.linalg.solve(inner, h_x[rows][:, kept]))
    return follow, partials.of_slopes[0] @ follow


compiled_partials = compiled(partials_at)
