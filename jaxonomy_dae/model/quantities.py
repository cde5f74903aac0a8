"""Which quantity each variable is, what quantities are called, and the model that is left in them."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Int

from .extended import Extended, Quantities
from .tables import ZERO, AliasTable, EquationGroup, FlatModel, provenance_of

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
    unnamed = np.ones(quantities.n, bool)
    unnamed[named] = False
    for k in np.flatnonzero(unnamed).tolist():
        names[k] = f"der({names[k - 1]})"
    return names


@dataclasses.dataclass(frozen=True)
class ReducedModel:
    """A flattened model with the equations that are left of it, and the quantities that they are left in."""

    flat: FlatModel
    alias: AliasTable
    groups: tuple[EquationGroup, ...]  # the equations that are left, as they are to be differentiated
    extended: Extended  # with their derivatives
    variables: QuantityMap

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """A user's name for every quantity."""
        return tuple(name_quantities(self.flat, self.variables, self.extended.quantities))

    def text(self, equation: int) -> str:
        """The text of an equation as written."""
        return str(provenance_of(self.groups, equation))
