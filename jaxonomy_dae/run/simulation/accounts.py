"""What components declare of energy and power, evaluated at states.

Each term is an expression in quantities of the model. A derivative that the model itself does not have, such as the
speed of the end of a massless spring, is taken along the vector field.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import Args, Numeric, State, Time, Times
from ...base.errors import ModelError, nearest
from ...compile.lowering.plan import SystemPlan
from ...compile.model.opaque import Networks
from ...compile.model.tables import ZERO, AccountGroup
from ...host.cache import compiled
from ...host.rows import at_times
from ...host.staging import is_staged
from ..system.system import AcausalSystem


def chosen_terms(plan: SystemPlan, kind: str, component: str | None) -> np.ndarray:
    """The numbers of the declared terms of one kind that belong to a component, or to what it contains."""
    accounts, names = plan.flat.accounts, plan.flat.components
    if not accounts:
        raise ModelError(
            "no component of this model declares energies or powers: use self.declare_energy(...), "
            "self.declare_dissipation(...) and self.declare_supply(...) in its __init__"
        )
    kinds = np.repeat([a.kind for a in accounts], [len(a) for a in accounts])
    owners = np.concatenate([a.component for a in accounts])
    inside = np.ones(len(names), bool)
    if component is not None:
        inside = np.array([n == component or n.startswith((f"{component}.", f"{component}[")) for n in names])
        if not inside.any():
            raise ModelError(f"'{component}' is not a component: " + nearest(component, names))
    return np.flatnonzero((kinds == kind) & inside[owners])


def account_values(
    system: AcausalSystem, ts: Times, states: State, inputs: Args, discrete: Array | None = None
) -> Numeric:
    """The values of all terms at all times, shape (n, terms); `discrete` holds the discrete values, if there are."""
    given = (system.without_stiffness, ts, states, inputs, discrete)
    return _terms(*given) if is_staged(given) else _compiled(*given)


def _terms(system: AcausalSystem, ts: Times, states: State, inputs: Args, discrete: Array | None) -> Numeric:
    def one(t, x, q):
        return _at_one_time(system if q is None else system.holding(q), t, x, inputs)

    return at_times(one, ts, states, discrete, width=system.plan.extended.quantities.n)


_compiled = compiled(_terms)


def _at_one_time(system: AcausalSystem, t: Time, x: State, inputs: Args) -> Numeric:
    plan = system.plan
    slots = [_slots(plan, group) for group in plan.flat.accounts]
    # What no term reads may be without a value here, and a last place holds what is identically zero.
    used = np.unique(np.concatenate([quantity[quantity != ZERO] for quantity, _, _ in slots]))

    def quantities(t, x):
        return jnp.append(system.at(t, inputs).quantities(x, used, np.ones(len(used))), 0.0)

    # Derivatives along the field cost a second evaluation of everything, so they are taken only where a term needs one.
    if any(missing.any() for _, _, missing in slots):
        along = (jnp.ones_like(t), system.at(t, inputs).vector_field(x))
        values, slopes = jax.jvp(quantities, (t, x), along)
    else:
        values = slopes = quantities(t, x)
    array = system.numbers
    networks = Networks(tuple(system.neural[n] for n in plan.network_names))
    parts = []
    for group, (quantity, factor, missing) in zip(plan.flat.accounts, slots, strict=True):
        place = np.where(quantity == ZERO, len(used), np.searchsorted(used, quantity))
        read = jnp.where(missing, slopes[place], values[place]) * jnp.asarray(factor, values.dtype)
        value = group.template.residual(list(read.T), *group.numbers(array), t, networks)
        parts.append(jnp.broadcast_to(jnp.asarray(value, values.dtype), (len(group),)))
    return jnp.concatenate(parts)


def _slots(plan: SystemPlan, group: AccountGroup) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (quantities, factors, flags), each of shape (n, slots); a flag is set where a derivative beyond those in
    the table must be taken. The quantity of a slot that is identically zero is `ZERO`."""
    table = plan.extended.quantities
    quantity = np.full(group.variable.shape, ZERO, np.int64)
    factor, missing = np.zeros(group.variable.shape), np.zeros(group.variable.shape, bool)
    for place, variable in np.ndenumerate(group.variable):
        q, scale = plan.quantity_of(int(variable))
        if q == ZERO:
            continue
        order = int(group.order[place])
        short = int(table.order[q]) + order - int(table.highest[table.owner[q]])
        if short > 1:
            raise ModelError(_too_high(plan, group, int(variable), order))
        quantity[place], factor[place], missing[place] = q + order - max(short, 0), scale, short > 0
    return quantity, factor, missing


def _too_high(plan: SystemPlan, group: AccountGroup, variable: int, order: int) -> str:
    name = "der(" * order + plan.flat.variables.names[variable] + ")" * order
    owner = plan.flat.components[int(group.component[0])]
    return (
        f"component '{owner}' declares {group.kind} in {name}, but the model has neither that derivative nor the one "
        "below it: declare it in variables of the component"
    )


def silent_components(plan: SystemPlan) -> Sequence[str]:
    """Components with ports that declare no energy or power, and contain none that does."""
    names, ports = plan.flat.components, plan.flat.ports
    declared = {names[int(k)] for group in plan.flat.accounts for k in group.component}
    has_port = [names[int(k)] for k in dict.fromkeys(ports.owner.tolist())]
    return [n for n in has_port if not any(d == n or d.startswith(f"{n}.") for d in declared)]
