"""A model after alias elimination, the resolution of cancellations and index reduction."""

import dataclasses
import functools

from .extended import Extended
from .quantities import QuantityMap, name_quantities
from .tables import AliasTable, EquationGroup, FlatModel, provenance_of


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
