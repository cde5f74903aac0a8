"""Which quantity each variable is, and what quantities are called."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from .extended import Extended, Quantities
from .tables import ZERO, AliasTable, FlatModel

ABSENT = -2  # the quantity of a variable that occurs in none of the remaining equations


@dataclasses.dataclass(frozen=True)
class QuantityMap:
    """Every variable of the model as factor·quantity; quantity ZERO (factor 0) if it is identically zero."""

    quantity: Int[np.ndarray, " variables"]
    factor: Float[np.ndarray, " variables"]

    def __getitem__(self, variable: int) -> tuple[int, float]:
        return int(self.quantity[variable]), float(self.factor[variable])


def map_quantities(alias: AliasTable, quantities: Quantities) -> QuantityMap:
    """Looks the alias of every variable up among the quantities."""
    column = np.where(alias.root == ZERO, -1, quantities.column[alias.root])
    reached = (column >= 0) & (alias.order <= np.append(quantities.highest, -1)[column])
    quantity = np.where(reached, quantities.first[column] + alias.order, ABSENT)
    return QuantityMap(np.where(alias.root == ZERO, ZERO, quantity), alias.factor)


def name_quantities(flat: FlatModel, variables: QuantityMap, quantities: Quantities) -> list[str]:
    """A user's name for every quantity: of a variable that equals it, best not of a port; a quantity that equals no
    variable is the derivative of one."""
    order, table = quantities.order, flat.variables
    v = np.flatnonzero((variables.quantity >= 0) & (variables.factor == 1))
    q = variables.quantity[v]
    is_root = (order[q] == 0) & (quantities.variable[quantities.owner[q]] == v)
    sorting = np.lexsort((v, ~is_root, table.is_port[v], table.is_internal[v], q))
    named, first = np.unique(q[sorting], return_index=True)
    names: list[str] = [""] * quantities.n
    for k, best in zip(named.tolist(), v[sorting[first]].tolist(), strict=True):
        names[k] = table.names[best]
    for k in np.setdiff1d(np.arange(quantities.n), named).tolist():
        names[k] = f"der({names[k - 1]})"
    return names


def declared_scale(flat: FlatModel, variables: QuantityMap, extended: Extended) -> np.ndarray:
    """The nominal value of every quantity: the largest that a variable which equals it declares, else 0."""
    scale = np.zeros(extended.quantities.n)
    v = np.flatnonzero(variables.quantity >= 0)
    np.maximum.at(scale, variables.quantity[v], flat.variables.nominal[v] / np.abs(variables.factor[v]))
    return scale


def quantity_scale(flat: FlatModel, variables: QuantityMap, extended: Extended) -> np.ndarray:
    """The nominal value of every quantity, 1 where none is declared."""
    scale = declared_scale(flat, variables, extended)
    return np.where(scale == 0, 1.0, scale)


def quantity_bounds(flat: FlatModel, variables: QuantityMap, extended: Extended) -> np.ndarray:
    """The bounds of every quantity, shape (quantities, 2): those of all variables that equal it."""
    n = extended.quantities.n
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    v = np.flatnonzero(variables.quantity >= 0)
    (a, b), q = (flat.variables.bounds[v] / variables.factor[v, None]).T, variables.quantity[v]
    np.maximum.at(low, q, np.minimum(a, b))
    np.minimum.at(high, q, np.maximum(a, b))
    return np.stack([low, high], axis=-1)


def leading_starts(flat: FlatModel, variables: QuantityMap) -> Int[np.ndarray, " variables"]:
    """The variables whose starts count, one for each quantity that has any.

    A fixed start goes before a guess. Of guesses it is the one that is larger at the declared values, and the positive
    one of two that differ in sign: zero is what is written where nothing is known, and a rule by place or by name would
    let these decide which branch a model starts on.
    """
    v = np.flatnonzero(flat.variables.start.is_given & (variables.quantity >= 0))
    value = flat.variables.start.values(flat.parameters.values)[v] / variables.factor[v]
    order = np.lexsort((-v, value, np.abs(value), flat.variables.fixed[v]))
    last = np.full(int(variables.quantity.max(initial=-1)) + 1, -1)
    last[variables.quantity[v[order]]] = v[order]
    return last[last >= 0]


def start_guess(flat: FlatModel, variables: QuantityMap, n: int) -> tuple[np.ndarray, dict[int, float]]:
    """The declared starts of all n quantities (zero where there is none), and those that are fixed."""
    guess = np.zeros(n)
    chosen = leading_starts(flat, variables)
    q, fixed = variables.quantity[chosen], flat.variables.fixed[chosen]
    value = flat.variables.start.values(flat.parameters.values)[chosen] / variables.factor[chosen]
    guess[q] = value
    return guess, dict(zip(q[fixed].tolist(), value[fixed].tolist(), strict=True))
