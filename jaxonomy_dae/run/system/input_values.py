"""Inputs at a time: the values of all quantities that inputs drive."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...base.errors import ModelError
from ...compile.lowering.gather import SCALARS, entries, take
from ...compile.lowering.plan import SystemPlan
from ...host.staging import is_traced
from .inputs import Entry, value_at


def check_given(plan: SystemPlan, inputs: Mapping[str, Any]) -> None:
    """Checks that every input has a value or a default.

    **Raises:**

    - `ModelError` that names the first one that has neither.
    """
    table = plan.inputs
    given = np.zeros(len(table.names), bool)
    for name in inputs:
        given[plan.input_places(name)] = True
    for k in np.flatnonzero(~given).tolist():
        if table.defaults[k] is None:
            missing = table.names[k]
            raise ModelError(
                f"input '{missing}' was not given, and has no default: pass inputs={{'{missing}': 1.0}}, (times, "
                "values) or a function of time, or connect a signal to it"
            )


def by_entry(plan: SystemPlan, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """The inputs that `read_inputs` returned, with an entry for each input of an array."""
    found = {}
    for name, source in inputs.items():
        places = plan.input_places(name)
        if places is None or not places.ndim:
            found[name] = source
        else:
            found |= {plan.inputs.names[place]: Entry(source, k) for k, place in enumerate(places.ravel().tolist())}
    return found


def input_values(plan: SystemPlan, given: Mapping[str, Any] | None, t: Any, dtype: Any) -> Any:
    """The values of all input quantities at time t: a tuple of scalars, or an array of shape (n,) if there are many.

    `given` is what `read_inputs` returned. Derivatives are those of functions of time, by jvp.
    """
    table = plan.inputs
    n = len(table.owner)
    position = np.zeros(len(table.names), np.int64)
    without = np.ones(len(table.names), bool)
    parts: list[tuple[np.ndarray, Any]] = []  # quantities, and their value or an array of their values

    def put(source: Any, inputs: np.ndarray):
        """One value for all of these inputs, or an array with one for each."""
        position[inputs] = np.arange(len(inputs))
        mine = np.flatnonzero(np.isin(table.owner, inputs))
        for order in np.unique(table.order[mine]).tolist():
            chosen = mine[table.order[mine] == order]
            value = _derivative(lambda s: _typed(value_at(source, s), dtype), order)(t)
            if jnp.ndim(value):
                value = take(jnp.ravel(value), position[table.owner[chosen]])
            parts.append((chosen, value))

    for name, source in (given or {}).items():
        places = plan.input_places(name)
        if places is not None:
            put(source, places.ravel())
            without[places] = False
    # Inputs of one default are put at once: an operation for each would be as many as there are inputs.
    for default in dict.fromkeys(table.defaults[k] for k in np.flatnonzero(without).tolist()):
        put(default, np.array([k for k in np.flatnonzero(without).tolist() if table.defaults[k] == default]))
    if n > SCALARS:
        arrays = [jnp.broadcast_to(value, chosen.shape) for chosen, value in parts]
        return take(jnp.concatenate(arrays), np.argsort(np.concatenate([chosen for chosen, _ in parts])))
    values: dict[int, Any] = {}
    for chosen, value in parts:
        values |= zip(chosen.tolist(), entries(value) if jnp.ndim(value) else [value] * len(chosen), strict=True)
    return tuple(values[q] for q in range(n))


def _typed(value: Any, dtype: Any) -> Any:
    """The value as an array of this type. While a program is traced, JAX would convert a number by another program."""
    return jnp.asarray(value, dtype) if is_traced(value) else np.asarray(value, dtype)


def _derivative(function: Callable, order: int) -> Callable:
    if not order:
        return function
    below = _derivative(function, order - 1)
    return lambda s: jax.jvp(below, (s,), (jnp.ones_like(s),))[1]
