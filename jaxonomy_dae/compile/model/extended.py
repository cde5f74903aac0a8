"""The extended system: every equation with its derivatives, in quantities.

After index reduction the model is: equation i differentiated 0, …, cᵢ times, in the quantities vⱼ, dvⱼ/dt, …, up to
order dⱼ. A quantity is one integer; so is an extended equation. Known inputs have quantities too, after all unknown
ones.
"""

import dataclasses

import numpy as np

from ...graph.structure.incidence import compress
from .group import QuantityGroup
from .tables import ZERO


@dataclasses.dataclass(frozen=True)
class Quantities:
    """Numbers of quantities: the k-th derivative of variable column j is first[j] + k."""

    column: np.ndarray  # of every root variable, −1 if it does not occur
    variable: np.ndarray  # of every column
    n_unknown_columns: int
    highest: np.ndarray  # d of every column, inputs included
    first: np.ndarray

    @property
    def n_unknown(self) -> int:
        """The number of quantities that are not inputs."""
        return int(self.first[self.n_unknown_columns])

    @property
    def n(self) -> int:
        return int(self.first[-1])

    @property
    def owner(self) -> np.ndarray:
        """The column of every quantity."""
        return np.repeat(np.arange(len(self.highest)), self.highest + 1)

    @property
    def order(self) -> np.ndarray:
        """The order of every quantity."""
        return np.arange(self.n) - self.first[self.owner]


@dataclasses.dataclass(frozen=True)
class ExtendedGroup(QuantityGroup):
    """Instances of one template at one level of differentiation."""

    base: np.ndarray  # the equation as written that each comes from (n,)
    level: int


@dataclasses.dataclass(frozen=True, eq=False)
class Extended:
    """The extended system; what is found for one is kept by it, so that it is equal to itself alone."""

    groups: tuple[ExtendedGroup, ...]
    n_equations: int
    quantities: Quantities
    base: np.ndarray  # of every extended equation, the equation as written
    level: np.ndarray  # and how often it is differentiated

    def incidence(self, wanted: np.ndarray):
        """(pointer, quantities) of every equation, among the quantities where `wanted` is true."""
        rows, columns = [], []
        for group in self.groups:
            n, k = group.quantity.shape
            row, column = np.repeat(group.equation, k), group.quantity.ravel()
            used = column != ZERO
            # ZERO is −1 and would read the last entry.
            used[used] = wanted[column[used]]
            rows.append(row[used])
            columns.append(column[used])
        row, column = (np.concatenate(a) if a else np.zeros(0, np.int64) for a in (rows, columns))
        pointer, column, _ = compress(row, column, np.zeros_like(row), self.n_equations)
        return pointer, column
