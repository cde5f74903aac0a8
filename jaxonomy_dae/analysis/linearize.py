"""`linearize`: a model near a point, as a linear state space."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.aliases import Time
from ..base.errors import ModelError, SteadyStateError, explained_keywords, nearest
from ..compile.diagnosis.wording import some
from ..host.staging import is_staged, is_traced
from ..run.system.input_values import by_entry
from ..run.system.inputs import read_inputs, value_at
from ..run.system.system import AcausalSystem
from .events_at_rest import resting_events
from .many_equilibria import same_beside, wandered
from .operating_point import OperatingPoint
from .partials import Driven, Partials, compiled_partials, on_tangent, partials_at
from .sampled import sampled_space
from .state_space import StateSpace
from .steady_state import Drifting, check_system, equilibrium_from, one_of_many, point_of
from .tangent import Coordinates, choose_coordinates


@explained_keywords()
def linearize(
    system: AcausalSystem,
    inputs: Sequence[str] | Mapping[str, ArrayLike],
    outputs: Sequence[str],
    *,
    at: OperatingPoint | None = None,
    t: Time = 0.0,
    states: Sequence[str] | None = None,
    sampled: bool = False,
) -> StateSpace:
    """The linear state space of small deviations from an operating point, with exact derivatives.

    **Arguments:**

    - `system`: a compiled system.
    - `inputs`: the names of inputs; or a dictionary with their values at the point, where they have no default. An
        array's name stands for those of all entries, here and in `outputs` and `states`.
    - `outputs`: the names of variables; `"der(...)"` of what the model differentiates is one too.
    - `at`: the point, from `steady_state`. By default, the equilibrium that a search from the initial point finds. The
        states on which nothing depends keep their values, such as the angle of a free shaft.
    - `t`: the time, if `at` is left out.
    - `states`: the states to use as coordinates if hidden constraints make some states redundant.
    - `sampled`: whether to describe a model with sampled controllers by its change from tick to tick. The states of the
        result are those of the model and the discrete variables that clocks write, as they are just before a tick;
        inputs stay constant for a period, and outputs are those just after the tick. If clocks have different periods,
        the model describes their common period.

    **Returns:**

    A `StateSpace`, whose states are the system's differential states. Where hidden constraints make states redundant,
    it is reduced to the tangent of the constraints: the coordinates are as many named states as there are degrees of
    freedom, for a hanging pendulum `pend.x` and `pend.vx`. It is differentiable with respect to parameters and
    networks, including the motion of the operating point. Inside `jit`, `grad` and `vmap`, redundant states need
    `states`, since the choice depends on values.

    **Raises:**

    - `ModelError` for unknown names, an input without a value, an input that the model differentiates (its response has
        no state space), `states` that are not coordinates, and a point at which hidden constraints do not hold, as one
        found for other parameters.
    - `ModelError` for a model that depends on variables written by clocks, without `sampled`; with `sampled`, if the
        model has no clock or no common period; and at a point where an event is about to change the model. Inside jit,
        not-a-number stands for errors that depend on values.
    - `SteadyStateError` if `at` is left out and there is no equilibrium; inside jit, grad and vmap the state space is
        then not-a-number. Also if it is one of many with different linear models, as of bodies that exchange heat with
        each other alone; this is not noticed inside jit, grad and vmap.
    """
    check_system(system)
    system.plan.refuse_delays("a delay has no state space of finite size: put library.signal.PadeDelay in its place")
    dtype = system.parameters.values.dtype
    names, outputs = _checked_names(system, inputs, "inputs"), _checked_names(system, outputs, "outputs")
    states = None if states is None else system.plan.entry_names(states)
    given = by_entry(system.plan, read_inputs(system.plan, dtype, inputs)) if isinstance(inputs, Mapping) else {}
    quantity, factor = system.plan.resolve(outputs)
    _check_inputs(system, names, given, at)
    found, way = None, None
    if at is None:
        found, t, read, begin = equilibrium_from(system, t, given, None, Drifting(), throw=None)
        way = None if is_traced((found, begin)) else wandered(found, np.asarray(begin))
        at = point_of(system, found, t, read, drifting=Drifting(), singular_is_error=False, throw=None)
    # Each member of a batch may have coordinates of its own, and so other states.
    if jnp.ndim(at.x) != 1:
        raise ModelError("the operating point is a batch: linearize each with equinox.filter_vmap")
    values = read_inputs(system.plan, dtype, {**by_entry(system.plan, at.inputs), **given})
    u = jnp.stack([_value_at(system, values, name, at.t) for name in names]) if names else at.x[:0]
    q = at.system.discrete_values.astype(at.x.dtype)
    point = Driven(at.t, at.x, q, values, u, tuple(names), tuple(outputs))
    read_as = tuple(quantity.tolist()), tuple(factor.tolist())
    evaluate = partials_at if is_staged((system, point)) else compiled_partials
    partials = evaluate(system, point, *read_as)
    if found is not None and way is not None:
        if not same_beside(lambda x: evaluate(system, point._replace(x=x), *read_as), point.x, way):
            raise SteadyStateError(one_of_many(system, found))
    partials = _smooth(system, _consistent(system, partials))
    coordinates = _coordinates(system, partials, states)
    if sampled:
        return sampled_space(system, point, partials, coordinates)
    return _reduced(system, point, _between_ticks(system, partials), coordinates)


def _consistent(system: AcausalSystem, partials: Partials) -> Partials:
    """The partial derivatives, if the hidden constraints hold at the point."""
    off = jnp.any(partials.off)
    if not is_traced(off) and bool(off):
        constraints = system.plan.selection.constraints[np.asarray(partials.off)]
        texts = some([system.plan.describe(int(e)) for e in constraints])
        raise ModelError(
            f"the point is not one of this system: {texts} does not hold there. Find it with the same parameters, "
            "inputs and time, at=steady_state(system, ...)"
        )
    return jax.tree.map(lambda leaf: _where(~off, leaf), partials)


def _smooth(system: AcausalSystem, partials: Partials) -> Partials:
    """The partial derivatives, if the model has the same on both sides of all events that are near."""
    if not is_traced(partials) and not bool(partials.agree):
        table = system.plan.some_events
        texts = dict.fromkeys(table.names[k] for k in np.flatnonzero(np.asarray(partials.near)).tolist())
        raise ModelError(
            f"the point lies where {some([repr(text) for text in texts])} turns, and the model has another derivative "
            "on the other side: linearize it at a point beside it"
        )
    return jax.tree.map(lambda leaf: _where(partials.agree, leaf), partials)


def _between_ticks(system: AcausalSystem, partials: Partials) -> Partials:
    """The partial derivatives, if no clock writes what they depend on."""
    blocks = [partials.of_slopes[2], partials.of_constraints[2], partials.of_outputs[2]]
    depends = jnp.any(jnp.concatenate(blocks) != 0, axis=0)
    if not is_traced(partials) and bool(jnp.any(depends)):
        events: Any = resting_events(system.plan)
        plan = system.plan.some_events
        place = events.unknown[np.flatnonzero(np.asarray(depends))]
        names = some([repr(system.every_discrete[k]) for k in place.tolist()])
        rows = events.ticking[np.isin(plan.table.discrete[events.ticking], place)]
        clocks = some([repr(t) for t in dict.fromkeys(plan.names[e] for e in plan.table.event[rows].tolist())])
        raise ModelError(
            f"the model is sampled: between ticks it depends on {names}, which {clocks} writes, and a continuous state "
            "space would hold that constant. linearize(..., sampled=True) gives the discrete-time model from tick to "
            "tick; for the plant alone, compile it without its controller"
        )
    return jax.tree.map(lambda leaf: _where(~jnp.any(depends), leaf), partials)


def _where(fine: Array, leaf: Array) -> Array:
    return jnp.where(fine, leaf, jnp.nan) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf


def _reduced(system: AcausalSystem, point: Driven, partials: Partials, coordinates: Coordinates) -> StateSpace:
    """The state space on the tangent of the constraints. Inputs that hidden constraints contain would be
    differentiated; they have been refused before."""
    kept = coordinates.kept
    states = tuple(system.states[k] for k in kept)
    follow, slopes = on_tangent(partials, coordinates)
    y_x, y_u, _ = partials.of_outputs
    return StateSpace(
        slopes[kept], partials.of_slopes[1][kept], y_x @ follow, y_u, point.x[kept], point.u, partials.outputs,
        partials.slopes[kept], states, point.inputs, point.outputs,
    )  # fmt: skip


def _coordinates(system: AcausalSystem, partials: Partials, wanted: Sequence[str] | None) -> Coordinates:
    """Chooses the states that serve as coordinates on the hidden constraints: those in `wanted`, else by the values of
    the constraints' Jacobian at the point."""
    n, c = len(system.states), system.plan.n_constraints
    h_x = partials.of_constraints[0]
    if not c:
        if wanted is not None and set(wanted) != set(system.states):
            raise ModelError(f"states: no hidden constraint makes a state redundant; all are needed: {system.states}")
        return Coordinates(np.arange(n), np.arange(0), np.arange(0))
    # In units of nominal sizes: which entry is large must not depend on the units of states.
    scaled = None if is_traced(h_x) else np.asarray(h_x) * np.asarray(system.plan.nominal[:n])
    chosen = None if scaled is None else choose_coordinates(scaled)
    if wanted is None:
        if chosen is None:
            raise ModelError(
                "inside jit, grad and vmap, which states are coordinates on the hidden constraints cannot be chosen by "
                f"values: name {n - c} of them, linearize(..., states=[...]); the states are {system.states}"
            )
        return chosen
    kept = [_place(system, name) for name in wanted]
    dependent = np.setdiff1d(np.arange(n), kept)
    rows = np.arange(c) if chosen is None else chosen.rows
    if len(set(kept)) != n - len(rows):
        raise ModelError(f"states: {n - len(rows)} coordinates are needed, of {system.states}; got {list(wanted)}")
    # The states named are coordinates if those that are left can be eliminated.
    if scaled is not None and len(choose_coordinates(scaled[rows], dependent).dependent) < len(rows):
        raise ModelError(
            f"states: {list(wanted)} do not determine the other states at this point; "
            f"{[system.states[k] for k in chosen.kept]} do"  # pyright: ignore[reportOptionalMemberAccess]
        )
    return Coordinates(np.array(kept, np.int64), dependent, rows)


def _place(system: AcausalSystem, name: str) -> int:
    if name not in system.states:
        raise ModelError(f"states: '{name}' is not a state: " + nearest(name, system.states))
    return system.states.index(name)


def _checked_names(system: AcausalSystem, given: Any, what: str) -> list[str]:
    if isinstance(given, str):
        raise ModelError(f"{what} is a list of names; write {what}=[{given!r}]")
    names = system.plan.entry_names(given)
    for name in names if what == "inputs" else ():
        if name not in system.inputs:
            raise ModelError(f"'{name}' is not an input of this system: " + nearest(name, system.inputs))
    if len(set(names)) < len(names):
        raise ModelError(f"{what}: a name stands twice in {names}")
    return names


def _check_inputs(system: AcausalSystem, names: list[str], given: Mapping[str, object], at: OperatingPoint | None):
    """Every input has a value, and the model differentiates none that is asked for."""
    table = system.plan.inputs
    known = given if at is None else {**by_entry(system.plan, at.inputs), **given}
    differentiated = {table.names[k] for k in table.owner[table.order > 0].tolist()}
    for name, default in zip(table.names, table.defaults, strict=True):
        if default is None and name not in known:
            where = f"inputs={{'{name}': 0.0}}" if name in names else "at=steady_state(system, inputs={...})"
            raise ModelError(f"input '{name}' has no default, so its value at the point must be given: {where}")
        if name in names and name in differentiated:
            raise ModelError(
                f"the model differentiates input '{name}', so its response has no state space: let it drive the input "
                "through a lag (library.signal), and linearize from the lag's input"
            )


def _value_at(system: AcausalSystem, values: Mapping[str, object], name: str, t: Time) -> Array:
    table = system.plan.inputs
    value = values.get(name, table.defaults[table.names.index(name)])
    return jnp.asarray(value_at(value, t), t.dtype)
