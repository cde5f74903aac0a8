"""Numbers at compile time: residuals and Jacobians of the extended system in NumPy, and a consistent point.

Only the choice of states needs numbers before the model runs. They are computed in float64 whatever the precision the
model will run in, from the same templates the lowered system uses.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from ..expressions.errors import KNOWN
from .extended import Extended, ExtendedGroup
from .opaque import OpaqueFunction
from .tables import ZERO


class Networks:
    """The weights of learned terms, and each network's value, computed once for equal arguments."""

    def __init__(self, weights: tuple[Any, ...]):
        self.weights = weights
        self._seen: dict[tuple, tuple[Any, Any]] = {}

    def evaluate(self, opaque: OpaqueFunction, order: int, t, inputs: list[list]) -> Any:
        """The outputs' `order`-th time derivative, shape (outputs,) or (outputs, instances)."""
        key = (opaque.index, order, id(t), *(id(x) for level in inputs for x in level))
        if key not in self._seen:
            value = opaque.derivatives(self.weights[opaque.index], order, t, inputs)
            self._seen[key] = (value, (t, inputs))  # the arguments are kept, so that their ids stay taken
        return self._seen[key][0]


def slot_values(group: ExtendedGroup, values: np.ndarray) -> list[np.ndarray]:
    """The values of each slot over the group's instances."""
    padded = np.append(values, 0.0)  # ZERO is −1: the last entry
    return list((group.factor * padded[group.quantity]).T)


def group_values(group: ExtendedGroup, values, parameters, t: float, networks: Networks, partials: bool):
    """The residuals (n,) of a group, or its partial derivatives (n, slots)."""
    slots = slot_values(group, values)
    p = list(parameters[group.parameter].T)
    c = list(group.coefficient.T)
    n = len(group)
    if partials:
        out = group.template.partial_values(slots, p, c, t, networks, backend="numpy")
        return np.stack([np.broadcast_to(np.asarray(x, float), (n,)) for x in out], axis=-1) * group.factor
    out = group.template.residual(slots, p, c, t, networks, backend="numpy")
    return np.broadcast_to(np.asarray(out, float), (n,))


def partials_along(group: ExtendedGroup, values, move, parameters, t: float, networks: Networks) -> np.ndarray:
    """The derivatives of a group's partial derivatives, (n, slots), where all quantities move by `move`: what moves so
    makes them the partial derivatives of the residual's time derivative."""
    template = group.template.derivative
    place = {slot: k for k, slot in enumerate(group.template.slots)}
    at, moved = slot_values(group, values), slot_values(group, move)
    p, c, n = list(parameters[group.parameter].T), list(group.coefficient.T), len(group)

    def partials(moved: Sequence[np.ndarray]) -> tuple:
        slots = [at[place[s]] if s in place else moved[place[s[0], s[1] - 1]] for s in template.slots]
        return template.partial_values(slots, p, c, t, networks, backend="numpy")

    still = partials([np.zeros(n)] * len(moved))  # what changes with time alone
    out = np.zeros((n, len(place)))
    for slot, moving, resting in zip(template.slots, partials(moved), still, strict=True):
        if slot in place:
            out[:, place[slot]] = np.asarray(moving, float) - np.asarray(resting, float)
    return out * group.factor


def partial_errors(group: ExtendedGroup, values, errors, parameters, t: float, networks: Networks) -> np.ndarray:
    """Bounds of the errors of a group's partial derivatives (n, slots), given those of all quantities."""
    slots = slot_values(group, values)
    of_slots = [np.abs(e) for e in slot_values(group, errors)]
    p, c, n = list(parameters[group.parameter].T), list(group.coefficient.T), len(group)
    out = group.template.partial_errors(slots, of_slots, p, c, t, networks)
    return np.stack([np.broadcast_to(np.asarray(e, float), (n,)) for e in out], axis=-1) * np.abs(group.factor)


def residual_and_jacobian(
    extended: Extended, values, parameters, t: float, networks: Networks
) -> tuple[Float[np.ndarray, " equations"], Any]:
    """All residuals, and the sparse Jacobian with respect to all quantities."""
    residual = np.empty(extended.n_equations)
    partials = []
    for group in extended.groups:
        residual[group.equation] = group_values(group, values, parameters, t, networks, partials=False)
        if group.quantity.shape[1]:
            partials.append((group, group_values(group, values, parameters, t, networks, partials=True)))
    return residual, _jacobian(extended, partials)


def _jacobian(extended: Extended, partials: Sequence[tuple[ExtendedGroup, np.ndarray]]) -> Any:
    """The sparse Jacobian of all equations, from the partial derivatives (n, slots) of groups that have slots."""
    shape = (extended.n_equations, extended.quantities.n)
    if not partials:
        return sp.csr_array(shape)
    used = [group.quantity != ZERO for group, _ in partials]
    rows = [np.broadcast_to(g.equation[:, None], u.shape)[u] for (g, _), u in zip(partials, used, strict=True)]
    columns = [g.quantity[u] for (g, _), u in zip(partials, used, strict=True)]
    entries = [partial[u] for (_, partial), u in zip(partials, used, strict=True)]
    data = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
    return sp.coo_array(data, shape=shape).tocsr()


def generic_jacobian(
    extended: Extended, size: np.ndarray, parameter_size: np.ndarray
) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """A sparse Jacobian with respect to all quantities at a generic point, for questions of rank: what depends there
    depends everywhere, or nearly so. Also bounds of the errors of its entries, the point and the parameters.

    It reads nothing but the structure: not the values of parameters, nor the weights of networks. Partial derivatives
    that are not real at the point, and those of networks, are generic numbers.

    **Arguments:**

    - `size`: of every quantity; the factor counts. `parameter_size`: of every parameter.
    """
    rng = np.random.default_rng(0)
    samples = [(size * generic(rng, size.shape), parameter_size * generic(rng, parameter_size.shape)) for _ in range(2)]
    partials, errors = [], []
    for group in extended.groups:
        n, k = group.quantity.shape
        if k == 0:
            continue
        if group.template.opaque is not None:
            partial = generic(rng, (n, k))
            error = KNOWN * partial
        else:
            (first, of_first), (second, of_second) = (
                (
                    group_values(group, point, parameters, 0.5, Networks(()), partials=True),
                    partial_errors(group, point, KNOWN * np.abs(point), parameters, 0.5, Networks(())),
                )
                for point, parameters in samples
            )
            # Zero on one branch is not zero on all; and what is not real at one point may be so at the other.
            other = (np.abs(first) <= of_first) | ~np.isfinite(first)
            partial, error = np.where(other, second, first), np.where(other, of_second, of_first)
            partial = np.where(np.isfinite(partial), partial, generic(rng, (n, k)))
            error = np.where(np.isfinite(error), error, KNOWN * np.abs(partial))
        partials.append((group, partial))
        errors.append((group, error))
    return _jacobian(extended, partials), _jacobian(extended, errors), *samples[0]


def generic(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers near 1 without pattern."""
    return rng.uniform(0.5, 1.5, shape)
