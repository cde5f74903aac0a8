"""`steady_state`: where all derivatives vanish."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..diagnosis.wording import some
from ..errors import ModelError, SteadyStateError, nearest
from ..initialization.check import check
from ..initialization.initialize import find_initial
from ..programs.staging import is_staged
from ..solvers.rows import not_a_number
from ..system.inputs import read_inputs
from ..system.system import AcausalSystem
from .equilibrium import Equilibrium, compiled_search, find_equilibrium, is_open, open_directions, unknowns
from .operating_point import OperatingPoint

WORST = 4  # equations, or directions, that an error names
IN_DIRECTION = 0.1  # of its largest entry: what else belongs to a direction that nothing determines


def steady_state(
    system: AcausalSystem,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | None = None,
    initial: Mapping[str, Any] | None = None,
    drifting: Sequence[str] = (),
    throw: bool | None = None,
) -> OperatingPoint:
    """The equilibrium of a system: the point at which the derivatives of all states vanish and every equation holds,
    hidden constraints included.

    Starts declared as fixed do not bind it. The algebra is dense: meant for up to some thousand states.

    **Arguments:**

    - `system`: a compiled system.
    - `t`: the time, a scalar; equations and inputs that depend on time are frozen at it.
    - `inputs`: as in `simulate`.
    - `initial`: where the search starts, values by variables' names; otherwise at the initial point. Where there are
        several equilibria, it chooses.
    - `drifting`: states whose derivatives need not vanish, such as the angle of a shaft that turns at a steady speed:
        they keep their values at the start.
    - `throw`: whether to raise if there is no such point; otherwise its values are not-a-number, and so are their
        derivatives. None: outside jit, grad and vmap. Inside, True puts callbacks to the host into the program, which
        JAX's persistent compilation cache then does not keep.

    **Returns:**

    An `OperatingPoint`: `point["motor.rotor.w"]`. It is differentiable with respect to parameters, networks and inputs,
    by the implicit function theorem, to second order; the search itself is not differentiated. It works inside `jit`,
    `grad` and `vmap`.

    **Raises:**

    - `ModelError` for an unknown name, and a name in `drifting` that is not a state.
    - `SteadyStateError` if no equilibrium was found, with the derivatives that do not vanish; and if it is singular,
        with the states that nothing determines. Inside jit, these are Equinox run-time errors.
    - `InitializationError` if there is no consistent initial point to start from.
    """
    check_system(system)
    places = _places(system, drifting)
    found, t, inputs = equilibrium_from(system, t, inputs, initial, places, throw)
    return point_of(system, found, t, inputs, drifting=tuple(drifting), singular_is_error=True, throw=throw)


def equilibrium_from(
    system: AcausalSystem, t: Any, inputs: Any, initial: Any, drifting: tuple[int, ...], throw: bool | None
) -> tuple[Equilibrium, Any, dict[str, Any]]:
    """The search from the initial point; the time and the inputs as arrays and as they were read."""
    dtype = system.parameters.values.dtype
    initial = system.plan.one_by_one(initial)
    begin = find_initial(system, t, inputs, initial)
    if throw is not False:
        begin = check(system, begin, t, inputs, initial, throw=throw)
    inputs, t = read_inputs(system.plan, dtype, inputs), jnp.asarray(t, dtype)
    given = (system, t, begin.x, inputs)
    if not is_staged(given):
        found = compiled_search(*given, drifting)
        # An input's function may close over a traced value, which shows in the outcome only.
        if not is_staged(found):
            return found, t, inputs
    return find_equilibrium(*given, drifting), t, inputs


def point_of(
    system: AcausalSystem, found: Equilibrium, t: Any, inputs: Any, *, drifting: tuple[str, ...],
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
    return OperatingPoint(x, system, t, inputs, jax.lax.stop_gradient(jnp.max(relative, initial=0.0)))


def is_traced(tree: Any) -> bool:
    """True if a leaf is a tracer, whose value cannot be read."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def check_system(system: Any):
    """Raises a `ModelError` for what is not one compiled system."""
    if not isinstance(system, AcausalSystem):
        raise ModelError(f"an AcausalSystem is needed (call the AcausalCompiler); got {type(system).__name__}")
    if system.parameters.batch:
        raise ModelError(
            f"the system is a batch of shape {system.parameters.batch}: take each with "
            "equinox.filter_vmap(lambda s: steady_state(s, ...))(system)"
        )


def _places(system: AcausalSystem, drifting: Sequence[str]) -> tuple[int, ...]:
    """The places of drifting states in the state array."""
    if isinstance(drifting, str):
        raise ModelError(f"drifting is a list of names; write drifting=[{drifting!r}]")
    states = system.plan.states.tolist()
    places = []
    for name in drifting:
        quantity = int(system.plan.resolve([name])[0][0])
        if quantity not in states:
            raise ModelError(f"drifting: '{name}' is not a state: " + nearest(name, system.states))
        places.append(states.index(quantity))
    return tuple(sorted(set(places)))


# --- what is said when there is none -------------------------------------------------------------------------------


def _not_found(system: AcausalSystem, found: Equilibrium, drifting: tuple[str, ...]) -> str:
    residual, limit = np.abs(np.asarray(found.residual)), np.asarray(found.limit)
    excess = residual / np.where(limit > 0, limit, np.finfo(limit.dtype).tiny)
    excess = np.where(np.isfinite(excess), excess, np.inf)
    rows = _row_names(system, drifting)
    worst = [k for k in np.argsort(-excess, kind="stable")[:WORST].tolist() if excess[k] > 1]
    left = "; ".join(f"{rows[k]} = {float(found.residual[k]):.3g}" for k in worst)
    text = f"no equilibrium was found; where the search ended, these are not zero: {left}."
    loose = _undetermined(system, found, drifting)
    if loose:
        return (
            f"{text} Nothing there depends on {_directions(loose)}: if that may drift, as the angle of a shaft that "
            f"turns, say drifting={_first_names(loose)}"
        )
    return f"{text} If there is one, start the search nearer to it: initial={{'{system.states[0]}': ...}}"


def _singular(system: AcausalSystem, found: Equilibrium, drifting: tuple[str, ...]) -> str:
    loose = _undetermined(system, found, drifting)
    return (
        f"the equilibrium is singular: nothing determines {_directions(loose)}. To keep the value at the start, say "
        f"drifting={_first_names(loose)}; or add what holds it, such as a spring or a load"
    )


def _directions(loose: list[list[str]]) -> str:
    texts = [f"'{names[0]}'" if len(names) == 1 else f"a common change of {some(names)}" for names in loose[:WORST]]
    return " and ".join(texts) + (" and others" if len(loose) > WORST else "")


def _first_names(loose: list[list[str]]) -> str:
    return f"[{', '.join(repr(names[0]) for names in loose[:WORST])}{', …' if len(loose) > WORST else ''}]"


def _undetermined(system: AcausalSystem, found: Equilibrium, drifting: tuple[str, ...]) -> list[list[str]]:
    """The states in each direction that nothing determines."""
    if not found.jacobian.shape[1] or not bool(jnp.all(jnp.isfinite(found.jacobian))):
        return []
    values, directions = open_directions(found)
    names = np.array([*system.states, *system.carried])[unknowns(system.plan, _places(system, drifting))]
    loose = []
    for direction in np.abs(np.asarray(directions)[np.asarray(is_open(values))]):
        inside = names[direction > IN_DIRECTION * direction.max()].tolist()
        loose.append(inside)
    return [names for k, names in enumerate(loose) if names not in loose[:k]]


def _row_names(system: AcausalSystem, drifting: tuple[str, ...]) -> list[str]:
    plan = system.plan
    rows = [f"der({n})" for n in system.states] + [f"the equation that determines {n}" for n in system.carried]
    rows = [rows[k] for k in unknowns(plan, _places(system, drifting))]
    return rows + [f"the constraint {plan.describe(int(e))}" for e in plan.selection.constraints]
