"""`steady_state`: where all derivatives vanish."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.aliases import Args, Time
from ..base.errors import ModelError, SteadyStateError, explained_keywords, nearest
from ..compile.diagnosis.wording import some
from ..host.staging import is_staged, is_traced
from ..run.start.check import check
from ..run.start.initialize import find_initial
from ..run.system.inputs import read_inputs
from ..run.system.system import AcausalSystem
from ..solve.methods.rows import not_a_number
from .equilibrium import Equilibrium, compiled_search, find_equilibrium, is_open, open_directions, unknowns
from .events_at_rest import resting_events
from .operating_point import OperatingPoint


class Drifting(NamedTuple):
    """What stays as it starts: places in the state array, and places among the discrete values."""

    states: tuple[int, ...] = ()
    discrete: tuple[int, ...] = ()


WORST = 4  # equations, or directions, that an error names
# An unknown belongs to a direction that nothing determines if its entry is at least this part of the largest one.
IN_DIRECTION = 0.1


@explained_keywords()
def steady_state(
    system: AcausalSystem,
    *,
    t: Time = 0.0,
    inputs: Mapping[str, object] | None = None,
    initial: Mapping[str, object] | None = None,
    drifting: Sequence[str] = (),
    throw: bool | None = None,
) -> OperatingPoint:
    """The equilibrium of a system: the point at which the derivatives of all states vanish and every equation holds,
    hidden constraints included.

    Fixed starts are not conditions here. The linear algebra is dense and meant for up to a few thousand states.

    In a model with events, no event changes anything at this point. Relations match their sides, each `complementary`
    pair has the right side at zero, sampled controllers repeat their last output, and every event whose condition holds
    has happened. There is no equilibrium if events follow each other without end (a thermostat), if an event ends the
    run, or if each tick changes something (a counter).

    **Arguments:**

    - `system`: a compiled system.
    - `t`: the time, a scalar; equations and inputs are evaluated at this time.
    - `inputs`: as in `simulate`.
    - `initial`: where the search starts, values by variables' names; default: the initial point. It decides which of
        several equilibria is found.
    - `drifting`: states whose derivatives need not vanish, such as the angle of a shaft at steady speed, and discrete
        variables that need not settle, such as a counter. They keep their start values. Where a sum is conserved, such
        as the fluid in connected tanks, equilibria are many: one state has to be named here, and its start value is the
        one at rest.
    - `throw`: whether to raise an error if there is no such point. With False, its values and their derivatives are
        not-a-number. None: raise outside jit, grad and vmap only. Inside jit, True needs callbacks to the host, and
        JAX's persistent cache does not keep such programs.

    **Returns:**

    An `OperatingPoint`: `point["motor.rotor.w"]`, `point["diode.active"]`. It is differentiable with respect to
    parameters, networks and inputs, by the implicit function theorem, to second order; the search itself is not
    differentiated. It works inside `jit`, `grad` and `vmap`.

    **Raises:**

    - `ModelError` for an unknown name, for a name in `drifting` that is neither a state nor a discrete variable, and
        for discrete equations that read the ticks of a clock.
    - `SteadyStateError` if no equilibrium was found; the text names the derivatives that do not vanish, or the event
        that keeps the system from rest. Also if the equilibrium is singular; the text names the undetermined states.
        Inside jit, these are Equinox run-time errors.
    - `InitializationError` if there is no consistent initial point to start from.
    """
    check_system(system)
    system.plan.refuse_delays("equilibria of models with delays are not searched for: run until it rests, simulate(…)")
    places = _places(system, drifting)
    found, t, inputs, _ = equilibrium_from(system, t, inputs, initial, places, throw)
    return point_of(system, found, t, inputs, drifting=places, singular_is_error=True, throw=throw)


def equilibrium_from(
    system: AcausalSystem,
    t: Time,
    inputs: Args,
    initial: Mapping[str, object] | None,
    drifting: Drifting,
    throw: bool | None,
) -> tuple[Equilibrium, Array, dict[str, Array], Array]:
    """The search from the initial point; the time and the inputs as arrays and as they were read; the state array of
    the initial point."""
    dtype = system.parameters.values.dtype
    initial = system.plan.one_by_one(initial)
    begin = find_initial(system, t, inputs, initial)
    if throw is not False:
        begin = check(system, begin, t, inputs, initial, throw=throw)
    inputs, t = read_inputs(system.plan, dtype, inputs), jnp.asarray(t, dtype)
    given = (system, t, begin.x, inputs)
    if not is_staged(given):
        found = compiled_search(*given, *drifting)
        # An input's function may close over a traced value, which shows in the outcome only.
        if not is_staged(found):
            return found, t, inputs, begin.x
    return find_equilibrium(*given, *drifting), t, inputs, begin.x


def point_of(
    system: AcausalSystem, found: Equilibrium, t: Time, inputs: Args, *, drifting: Drifting,
    singular_is_error: bool, throw: bool | None,
) -> OperatingPoint:  # fmt: skip
    """The point, if it is one."""
    singular = jnp.array(False)
    if singular_is_error and found.jacobian.shape[1]:
        singular = jnp.any(is_open(open_directions(found)[0]))
    x = found.x
    traced = is_traced((found, singular))
    if throw is False or (traced and throw is None):
        x = not_a_number(x[None], (found.holds & ~singular)[None], system, t, inputs)[0]
    elif traced:
        x = eqx.error_if(x, ~found.holds, "no equilibrium was found. steady_state outside jit gives the names")
        x = eqx.error_if(
            x, singular, "the equilibrium is singular: some state is undetermined. steady_state outside jit gives names"
        )
    elif not found.holds:
        raise SteadyStateError(_not_found(system, found, drifting))
    elif singular:
        raise SteadyStateError(_singular(system, found, drifting))
    relative = jnp.abs(found.residual) / jnp.where(found.limit > 0, found.limit, 1)
    resting = system.holding(found.q) if len(found.q) else system
    return OperatingPoint(x, resting, t, inputs, jax.lax.stop_gradient(jnp.max(relative, initial=0.0)))


def check_system(system: object):
    """Raises a `ModelError` for what is not one compiled system."""
    if not isinstance(system, AcausalSystem):
        raise ModelError(f"an AcausalSystem is needed (call the AcausalCompiler); got {type(system).__name__}")
    if system.parameters.batch:
        raise ModelError(
            f"the system is a batch of shape {system.parameters.batch}: take each with "
            "equinox.filter_vmap(lambda s: steady_state(s, ...))(system)"
        )


def _places(system: AcausalSystem, drifting: Sequence[str]) -> Drifting:
    if isinstance(drifting, str):
        raise ModelError(f"drifting is a list of names; write drifting=[{drifting!r}]")
    states = system.plan.states.tolist()
    places, discrete = [], []
    for name in drifting:
        if name in system.discretes:
            discrete.append(system.discretes.index(name))
            continue
        quantity = int(system.plan.resolve([name])[0][0])
        if quantity not in states:
            known = [*system.states, *system.discretes]
            raise ModelError(f"drifting: '{name}' is neither a state nor a discrete variable: " + nearest(name, known))
        places.append(states.index(quantity))
    return Drifting(tuple(sorted(set(places))), tuple(sorted(set(discrete))))


# --- what is said when there is none -------------------------------------------------------------------------------


def _not_found(system: AcausalSystem, found: Equilibrium, drifting: Drifting) -> str:
    if int(found.event) >= 0:
        return _restless(system, int(found.event))
    residual, limit = np.abs(np.asarray(found.residual)), np.asarray(found.limit)
    excess = residual / np.where(limit > 0, limit, np.finfo(limit.dtype).tiny)
    # A row that is not a number is the first to be named.
    excess = np.where(np.isfinite(excess), excess, np.inf)
    rows = _row_names(system, drifting)
    worst = [k for k in np.argsort(-excess, kind="stable")[:WORST].tolist() if excess[k] > 1]
    left = "; ".join(f"{rows[k]} = {float(found.residual[k]):.3g}" for k in worst)
    text = f"no equilibrium was found; where the search ended, these are not zero: {left}."
    written = _written_names(system, drifting)
    # Rows of clocks stand last, so that their places count from the end.
    counted = [written[k - len(rows)] for k in worst if k >= len(rows) - len(written)]
    if counted:
        return f"{text} If what a clock changes at each tick may go on, as a counter does, say drifting={counted}"
    loose = _undetermined(system, found, drifting)
    if loose:
        return (
            f"{text} Nothing there depends on {_directions(loose)}: if that may drift, as the angle of a shaft that "
            f"turns, say drifting={_first_names(loose)}"
        )
    begin = f"initial={{'{system.states[0]}': ...}}" if system.states else "another time, t=..."
    return f"{text} If there is one, start the search nearer to it: {begin}"


def _restless(system: AcausalSystem, event: int) -> str:
    plan = system.plan.some_events
    table = plan.table
    text = table.text[event]
    message = table.events[event].message
    if message is not None:
        return f"no steady state: '{text}' holds at the equilibrium, where it ends the run ({message!r})"
    rows = table.event == event
    names = [system.discretes[k] for k in table.discrete[rows].tolist() if 0 <= k < plan.n_visible]
    names += [system.states[k] for k in plan.state[rows].tolist() if k >= 0]
    return (
        f"no steady state: at each equilibrium of the equations an event happens that leads to another one, and so on "
        f"without end, as '{text}'. If what it writes may stay as it starts, say drifting={names}; if another mode is "
        "meant, start the search nearer to it, with initial={...} and with_parameters({...})"
    )


def _singular(system: AcausalSystem, found: Equilibrium, drifting: Drifting) -> str:
    loose = _undetermined(system, found, drifting)
    return (
        f"the equilibrium is singular: nothing determines {_directions(loose)}. To keep the value at the start, say "
        f"drifting={_enough(system, found, drifting)}; or add what holds it, such as a spring or a load"
    )


def one_of_many(system: AcausalSystem, found: Equilibrium) -> str:
    """Says that the linear model depends on which equilibrium is meant, where nothing determines some directions."""
    drifting = Drifting()
    loose, kept = _directions(_undetermined(system, found, drifting)), _enough(system, found, drifting)
    return (
        f"the equilibrium is one of many: nothing determines {loose}, and the linear model is another one at each. Say "
        f"which is meant: at=steady_state(system, drifting={kept}) keeps the value at the start"
    )


def _directions(loose: list[list[str]]) -> str:
    texts = [f"'{names[0]}'" if len(names) == 1 else f"a common change of {some(names)}" for names in loose[:WORST]]
    return " and ".join(texts) + (" and others" if len(loose) > WORST else "")


def _first_names(loose: list[list[str]]) -> str:
    return f"[{', '.join(repr(names[0]) for names in loose[:WORST])}{', …' if len(loose) > WORST else ''}]"


def _undetermined(system: AcausalSystem, found: Equilibrium, drifting: Drifting) -> list[list[str]]:
    """The states in each direction that nothing determines."""
    if not found.jacobian.shape[1] or not bool(jnp.all(jnp.isfinite(found.jacobian))):
        return []
    values, directions = open_directions(found)
    names = np.array(_unknown_names(system, drifting))
    loose = []
    for direction in np.abs(np.asarray(directions)[np.asarray(is_open(values))]):
        inside = names[direction > IN_DIRECTION * direction.max()].tolist()
        loose.append(inside)
    # Two directions of the same states are one finding for a reader.
    return [names for k, names in enumerate(loose) if names not in loose[:k]]


def _enough(system: AcausalSystem, found: Equilibrium, drifting: Drifting) -> str:
    """States that may drift so that the others are determined: a mass that friction holds keeps its place and speed."""
    names, n_rows = _unknown_names(system, drifting), len(unknowns(system.plan, drifting.states))
    kept, left = list(range(len(names))), found
    # One at a time: to hold a state also takes its row away, which may open another direction.
    while len(kept) and (loose := np.flatnonzero(np.asarray(is_open(open_directions(left)[0])))).size:
        direction = np.abs(np.asarray(open_directions(left)[1]))[loose[0]]
        del kept[int(np.argmax(direction > IN_DIRECTION * direction.max()))]
        rows = [k for k in range(found.jacobian.shape[0]) if k >= n_rows or k in kept]
        left = found._replace(jacobian=found.jacobian[np.array(rows, int)][:, np.array(kept, int)])
        left = left._replace(unit=found.unit[np.array(kept, int)])
    chosen = [name for k, name in enumerate(names) if k not in kept]
    return f"[{', '.join(map(repr, chosen[:WORST]))}{', …' if len(chosen) > WORST else ''}]"


def _unknown_names(system: AcausalSystem, drifting: Drifting) -> list[str]:
    every = [*system.states, *system.carried]
    events = resting_events(system.plan, drifting.discrete, drifting.states)
    sampled = [] if events is None else [system.every_discrete[k] for k in events.unknown.tolist()]
    return [every[k] for k in unknowns(system.plan, drifting.states)] + sampled


def _row_names(system: AcausalSystem, drifting: Drifting) -> list[str]:
    plan = system.plan
    rows = [f"der({n})" for n in system.states] + [f"the equation that determines {n}" for n in system.carried]
    rows = [rows[k] for k in unknowns(plan, drifting.states)]
    rows += [f"the constraint {plan.describe(int(e))}" for e in plan.selection.constraints]
    if plan.held is not None:
        rows += [f"the branch {plan.held.table.text[k]}" for k in plan.held.table.owner.tolist()]
    return rows + [f"the change of {name}" for name in _written_names(system, drifting)]


def _written_names(system: AcausalSystem, drifting: Drifting) -> list[str]:
    """The variables that clocks write, one for each row of ticks."""
    plan = system.plan
    events = resting_events(plan, drifting.discrete, drifting.states)
    if events is None or plan.events is None:
        return []
    table = plan.events.table
    states = [system.states[plan.events.state[k]] if plan.events.state[k] >= 0 else "" for k in events.ticking]
    values = [int(k) for k in table.discrete[events.ticking]]
    return [state or system.every_discrete[k] for state, k in zip(states, values, strict=True)]
