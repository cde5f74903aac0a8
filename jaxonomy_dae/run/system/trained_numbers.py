"""The numbers of a system that are chosen by name to be trained: parameters, perhaps as free numbers, and networks."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...base.errors import ModelError, nearest
from ...host.staging import is_traced
from .bounds import constrained, unconstrained
from .parameters import Parameters


def parameters_among(parameters: Parameters, neural: Mapping[str, Any], names: Sequence[str]) -> tuple[str, ...]:
    """The names that are not of networks.

    **Raises:**

    - `ModelError` for a name that is neither a network nor a parameter.
    """
    chosen = tuple(n for n in dict.fromkeys(names) if n not in neural)
    for name in chosen:
        if name not in parameters:
            raise ModelError(
                f"'{name}' is neither a network nor a parameter: " + nearest(name, [*neural, *parameters.names])
            )
    return chosen


def free_numbers(parameters: Parameters, neural: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The free numbers of parameters and networks: see `AcausalSystem.unconstrain`."""
    table = parameters.table
    chosen = table.chosen(parameters_among(parameters, neural, names))
    out: dict[str, Any] = {n: eqx.filter(neural[n], eqx.is_inexact_array) for n in names if n in neural}
    for name, entries in chosen.items():
        z = out[name] = unconstrained(parameters[name], table.ends.take(entries))
        if not is_traced(z) and not np.isfinite(z).all():
            places = np.broadcast_to(entries, np.shape(z))[~np.isfinite(z)]
            one, interval = table.names[places[0]], table.intervals[places[0]]
            raise ModelError(
                f"parameter '{one}' lies on the end of its bounds {interval}, or outside, where no free number "
                "belongs to it: start inside, with system.with_parameters, or let learning.Problem or "
                "learning.minimize train it, which can leave an end and reach it"
            )
    return {name: out[name] for name in names}


def at_free_numbers(
    parameters: Parameters, neural: Mapping[str, Any], free: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The values of parameters, and the networks, that belong to free numbers: see `AcausalSystem.constrain`."""
    table, dtype = parameters.table, parameters.values.dtype
    chosen = table.chosen(parameters_among(parameters, neural, tuple(free)))
    values = {name: constrained(jnp.asarray(free[name], dtype), table.ends.take(k)) for name, k in chosen.items()}
    return values, {n: eqx.combine(free[n], neural[n]) for n in free if n in neural}


def is_trained(system: Any, parameters: bool, networks: set[str]) -> Any:
    """For each leaf of a system whether it is trained: the parameters set apart in `parameters.free`, and the weights
    of these networks."""
    wanted = jax.tree.map(lambda _: False, system)
    if parameters:
        wanted = eqx.tree_at(lambda s: s.parameters.free, wanted, True)
    if networks:
        flags = {
            n: jax.tree.map(eqx.is_inexact_array, w) if n in networks else wanted.neural[n]
            for n, w in system.neural.items()
        }
        wanted = eqx.tree_at(lambda s: s.neural, wanted, flags)
    return wanted
