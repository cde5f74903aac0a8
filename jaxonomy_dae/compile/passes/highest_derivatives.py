"""The system Jacobian of index reduction: the partial derivatives of equations by their highest derivatives, as numbers
at random points and as numbers that the equations were written with."""

from collections.abc import Callable, Hashable
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ...base.tolerances import KNOWN
from ...graph.structure.pantelides import Offsets
from ..model.group import Point, QuantityGroup
from ..model.natural_sizes import natural_sizes
from ..model.tables import ZERO, EquationGroup, equation_offsets
from .combine_equations import quantity_label, somewhere, tried
from .combined_errors import CombinedGroup
from .elimination import Row
from .null_vectors import BlockMatrix

HIGHER = 8  # orders of derivatives that share one typical size


class _Place(NamedTuple):
    """The slots of one group that hold highest derivatives of a block's columns; arrays of one length
    but for `instances`."""

    group: int
    instances: np.ndarray  # of the group that are in the block
    instance: np.ndarray  # in the group
    own: np.ndarray  # among `instances`
    slot: np.ndarray
    row: np.ndarray  # in the block
    column: np.ndarray  # in the block


class HighestDerivatives:
    """∂F_e/∂(highest derivative of a column), for the equations and offsets of one round of index reduction.

    **Arguments:**

    - `groups`: the equations.
    - `column`: of every variable, the number of the unknown that it is, (variables,); −1 for others.
    - `values`: of the parameters.
    """

    def __init__(self, groups: tuple[EquationGroup, ...], offsets: Offsets, column: np.ndarray, values: np.ndarray):
        self.groups = groups
        self.offsets = offsets
        self.column = column
        self.values = values
        self.first = equation_offsets(groups)
        self._partials: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        self._where = np.full(len(offsets.variable), -1)  # the columns of a block, while it is looked at

    def with_values(self, values: np.ndarray) -> "HighestDerivatives":
        """The same at other values of the parameters."""
        return HighestDerivatives(self.groups, self.offsets, self.column, values)

    def place(self, e: int) -> tuple[int, int]:
        """(group, row) of an equation."""
        g = int(np.searchsorted(self.first, e, side="right") - 1)
        return g, e - int(self.first[g])

    def partials(self, g: int, trial: int) -> tuple[np.ndarray, np.ndarray]:
        """The partial derivatives of all equations of group g at a trial's sample point, factors included, and bounds
        of their errors: shape (n, slots) each."""
        if (g, trial) not in self._partials:
            group = self.groups[g]
            point = np.where(group.variable == ZERO, 0.0, tried(group.variable, group.order, trial))
            slots = point.shape[1]
            # Nothing is known of a function's derivatives, and its weights may be trained: numbers without pattern
            # stand for them, so that they cancel with nothing but themselves.
            if group.template.opaque is not None:  # any function
                slopes = [np.ones(len(group)), *(somewhere(group.variable[:, 0], k, trial) for k in range(1, slots))]
                values = np.stack(slopes, axis=-1) * group.factor
                found = values, KNOWN * np.abs(values)
            else:
                at = Point.of(point.ravel(), self.values, 0.37 + 0.1 * trial)
                own = group.reading(np.arange(point.size).reshape(point.shape))
                values, errors = own.partials_with_errors(at, KNOWN * np.abs(at.values))
                # Numbers of a combination are known to the errors of its terms.
                errors = np.maximum(errors, group.error) if isinstance(group, CombinedGroup) else errors
                found = values, errors
            self._partials[g, trial] = found
        return self._partials[g, trial]

    def _chosen(self, equations: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """The equations of a block by groups: (group, positions in the block, instances in the group)."""
        group_of_each = np.searchsorted(self.first, equations, side="right") - 1
        found = [(g, np.flatnonzero(group_of_each == g)) for g in np.unique(group_of_each).tolist()]
        return [(g, positions, equations[positions] - self.first[g]) for g, positions in found]

    def _places(self, equations: np.ndarray, columns: np.ndarray) -> list[_Place]:
        """The slots of equations that hold highest derivatives of these columns, by groups."""
        self._where[columns] = np.arange(len(columns))
        found = []
        for g, positions, instances in self._chosen(equations):
            variable = self.groups[g].variable[instances]
            column = np.where(variable == ZERO, -1, self.column[variable])
            order = self.groups[g].order[instances] + self.offsets.equation[equations[positions], None]
            is_highest = (column >= 0) & (self._where[column] >= 0) & (self.offsets.variable[column] == order)
            i, slot = np.nonzero(is_highest)
            found.append(_Place(g, instances, instances[i], i, slot, positions[i], self._where[column[i, slot]]))
        self._where[columns] = -1
        return found

    def at(self, equations: np.ndarray, columns: np.ndarray, trial: int) -> BlockMatrix:
        """The block at a trial's random point."""
        found = []
        for place in self._places(equations, columns):
            partials, errors = self.partials(place.group, trial)
            there = place.instance, place.slot
            found.append((place.row, place.column, partials[there], errors[there]))
        return BlockMatrix.of((len(equations), len(columns)), found)

    def at_natural_size(self, equations: np.ndarray, columns: np.ndarray, trial: int) -> BlockMatrix:
        """The block at a random point where all terms of the equations are alike. Elsewhere, an entry that depends on
        the point may look constant, because one of its terms is too small to be seen."""
        groups, pairs, size = self._at_natural_sizes(equations)
        if any(group.template.opaque is not None for group in groups):
            return self.at(equations, columns, trial)
        at = Point.of(size * somewhere(pairs[:, 0], pairs[:, 1], trial), self.values, 0.37 + 0.1 * trial)
        found = []
        for group, place in zip(groups, self._places(equations, columns), strict=True):
            partials, errors = group.partials_with_errors(at, KNOWN * np.abs(at.values))
            there = place.own, place.slot
            found.append((place.row, place.column, partials[there], errors[there]))
        return BlockMatrix.of((len(equations), len(columns)), found)

    def natural(self, equations: np.ndarray) -> dict[Hashable, float]:
        """Sizes of the quantities of equations, by their labels; those of the lower derivatives for higher ones."""
        _, pairs, size = self._at_natural_sizes(equations)
        found: dict[Hashable, float] = {}
        for (v, q), s in sorted(zip(map(tuple, pairs.tolist()), size.tolist(), strict=True), reverse=True):
            found |= {quantity_label(v, k): s for k in range(q, q + HIGHER)}
        return found

    def _at_natural_sizes(self, equations: np.ndarray) -> tuple[list[QuantityGroup], np.ndarray, np.ndarray]:
        """Regroups `equations`, in the order of `_chosen`. Returns (groups, quantities as (variable, order) of shape
        (q, 2), sizes of shape (q,)); the sizes balance the terms of each equation."""
        number: dict[tuple[int, int], int] = {}
        groups, count = [], 0
        for g, _, instances in self._chosen(equations):
            group = self.groups[g].take(instances.tolist())
            pairs = zip(group.variable.ravel().tolist(), group.order.ravel().tolist(), strict=True)
            found = [ZERO if v == ZERO else number.setdefault((v, q), len(number)) for v, q in pairs]
            quantity = np.array(found, np.int64).reshape(group.variable.shape)
            groups.append(group.reading(quantity, count + np.arange(len(group))))
            count += len(group)
        # By terms as well as by entries: an entry that is a sum hides that one of its terms is lost.
        size, _ = natural_sizes(groups, count, np.zeros(len(number)), self.values, by_terms=True)
        return groups, np.array(list(number), np.int64).reshape(-1, 2), np.abs(size)

    def rows(
        self, equations: np.ndarray, columns: np.ndarray, as_number: Callable[[float], Fraction | None]
    ) -> list[Row] | None:
        """The rows of the block, if all its entries are numbers that `as_number` has something for."""
        rows: list[Row] = [{} for _ in equations]
        for place in self._places(equations, columns):
            group = self.groups[place.group]
            numbers = group.template.numbers(group.coefficient[place.instances]) * group.factor[place.instances]
            values = numbers[place.own, place.slot]
            # One entry that is no number makes the whole block one of functions.
            if np.isnan(values).any():
                return None
            for i, j, value in zip(
                place.row.tolist(), place.column.tolist(), map(as_number, values.tolist()), strict=True
            ):
                if value is None:
                    return None
                rows[i][j] = rows[i][j] + value if j in rows[i] else value
        return [{j: value for j, value in row.items() if value} for row in rows]

    def is_constant(self, equations: np.ndarray, columns: np.ndarray) -> bool:
        """True if no entry of the block depends on the point."""
        return all(
            self.groups[place.group].template.coefficient_is_constant(slot)
            for place in self._places(equations, columns)
            for slot in np.unique(place.slot).tolist()
        )
