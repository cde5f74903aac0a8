"""Which quantity each variable is, what quantities are called, and the model that is left in them."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, overload

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


class QuantityNames(Sequence[str]):
    """A user's name for every quantity: of a variable that equals it, best not of a port; a quantity that equals no
    variable is the derivative of one."""

    def __init__(self, flat: FlatModel, variables: QuantityMap, quantities: Quantities):
        self._flat, self._variables, self._quantities = flat, variables, quantities

    @functools.cached_property
    def _best(self) -> np.ndarray:
        """The variable that names each quantity, −1 for derivatives of others."""
        order, table, variables = self._quantities.order, self._flat.variables, self._variables
        # A multiple of a quantity does not name it: its values would be read with another sign or in another unit.
        v = np.flatnonzero((variables.quantity >= 0) & (variables.factor == 1))
        q = variables.quantity[v]
        is_root = (order[q] == 0) & (self._quantities.variable[self._quantities.owner[q]] == v)
        # Internal names are nobody's, and a name of a port says less than that of the part's own variable.
        sorting = np.lexsort((v, ~is_root, table.is_port[v], table.is_internal[v], q))
        named, first = np.unique(q[sorting], return_index=True)
        best = np.full(self._quantities.n, -1)
        best[named] = v[sorting[first]]
        return best

    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    @overload
    def __getitem__(self, index: Any) -> str: ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        index = range(len(self))[index]
        v = int(self._best[index])
        return self._flat.variables.names[v] if v >= 0 else f"der({self[index - 1]})"

    def __len__(self):
        return self._quantities.n


@dataclasses.dataclass(frozen=True)
class ReducedModel:
    """A flattened model with the equations that are left of it, and the quantities that they are left in."""

    flat: FlatModel
    alias: AliasTable
    groups: tuple[EquationGroup, ...]  # the equations that are left, as they are to be differentiated
    extended: Extended  # with their derivatives
    variables: QuantityMap

    @functools.cached_property
    def names(self) -> "QuantityNames":
        """A user's name for every quantity."""
        return QuantityNames(self.flat, self.variables, self.extended.quantities)

    def text(self, equation: int) -> str:
        """The text of an equation as written."""
        return str(provenance_of(self.groups, equation))
