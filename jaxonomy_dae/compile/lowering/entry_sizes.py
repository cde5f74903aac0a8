"""The sizes of the Jacobian's entries, for the choice of pivots when a model is compiled."""

import numpy as np

from ..model.declared import quantity_scale, start_guess
from ..model.group import Point
from ..model.opaque import Networks
from ..model.quantities import ReducedModel


class EntrySizes:
    """|∂(residual)/∂(slot)| of every equation, with the parameters of the model as compiled.

    What depends on variables is looked at near the declared starts: at two points, so that what happens to vanish at
    one does not count as zero. What is not finite there counts as the largest entry of its equation.
    """

    def __init__(self, model: ReducedModel):
        self.extended = model.extended
        declared = model.flat.declares
        self._changed = model.flat.parameters.changed_by_events
        guess, _ = start_guess(model, declared.values)
        networks = Networks(tuple(declared.networks.values()))
        points = (guess, guess + quantity_scale(model))
        self.points = [Point.of(values, declared.values, 0.0, networks) for values in points]
        self._groups: dict[int, np.ndarray] = {}

    def of(self, group: int, slot: int) -> np.ndarray:
        """Sizes over the instances of a group of equations."""
        if group not in self._groups:
            self._groups[group] = self._evaluated(group)
        return self._groups[group][:, slot]

    def is_number(self, group: int, slot: int) -> bool:
        """True if the entry depends on nothing, parameters included."""
        return self.extended.groups[group].template.coefficient_is_number(slot)

    def may_vanish(self, group: int, slot: int, rows: np.ndarray) -> bool:
        """True if the entry may be zero in one of these instances, whose equation cannot be solved for the slot then.

        Parameters do not vanish while a model runs, except for those that events change: where a pump is switched off,
        dp = on·head(m_flow) does not determine the head.
        """
        chosen = self.extended.groups[group]
        if not chosen.template.coefficient_never_vanishes(slot):
            return True
        readers = chosen.template.readers_of_partials()[1]
        read = [k for k, positions in enumerate(readers) if slot in positions]
        return bool(self._changed[chosen.parameter[np.ix_(rows, np.array(read, np.int64))]].any())

    def _evaluated(self, group: int) -> np.ndarray:
        chosen = self.extended.groups[group]
        # Networks are not called while a model is compiled: their sizes count as one.
        if chosen.template.opaque is not None:
            return np.ones(chosen.quantity.shape)
        # `fmax` takes the number where one of the points gives none.
        size = np.fmax(*(np.abs(chosen.partials(point)) for point in self.points))
        largest = np.where(np.isfinite(size), size, 0.0).max(axis=1, keepdims=True, initial=0.0)
        return np.where(np.isfinite(size), size, np.where(largest > 0, largest, 1.0))
