"""The extended system: every equation with its derivatives, in quantities.

After index reduction the model is: equation i differentiated 0, …, cᵢ times, in the quantities vⱼ, dvⱼ/dt, …, up to
order dⱼ. A quantity is one integer; so is an extended equation. Known inputs have quantities too, after all unknown
ones.
"""

import dataclasses

import numpy as np

from .reduce_index import Offsets
from .structure import compress
from .tables import ZERO, EquationGroup
from .templates import AnyTemplate


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
        """How many quantities are no inputs."""
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
class ExtendedGroup:
    """Instances of one template at one level of differentiation; slots are quantities (ZERO: constant zero)."""

    template: AnyTemplate
    equation: np.ndarray  # extended equation numbers (n,)
    base: np.ndarray  # the equation as written that each comes from (n,)
    level: int
    quantity: np.ndarray  # (n, slots)
    sign: np.ndarray
    parameter: np.ndarray
    coefficient: np.ndarray

    def __len__(self):
        return len(self.equation)


@dataclasses.dataclass(frozen=True)
class Extended:
    """The extended system."""

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
            used[used] = wanted[column[used]]
            rows.append(row[used])
            columns.append(column[used])
        row, column = (np.concatenate(a) if a else np.zeros(0, np.int64) for a in (rows, columns))
        pointer, column, _ = compress(row, column, np.zeros_like(row), self.n_equations)
        return pointer, column


def extend(
    groups: tuple[EquationGroup, ...],
    offsets: Offsets,
    column: np.ndarray,
    is_input: np.ndarray,
    least: np.ndarray,
    n_unknown: int,
) -> Extended:
    """Builds the extended system; column[v] numbers root variables, unknowns first, then inputs, least[v] is the lowest
    order that root variable v must have."""
    n_columns = int(column.max(initial=-1)) + 1
    variable = np.full(n_columns, -1, np.int64)
    present = np.flatnonzero(column >= 0)
    variable[column[present]] = present
    highest = np.zeros(n_columns, np.int64)
    highest[:n_unknown] = offsets.variable
    highest[n_unknown:] = least[variable[n_unknown:]]
    first_equation = 0
    for group in groups:
        c = offsets.equation[first_equation : first_equation + len(group)]
        first_equation += len(group)
        known = (group.variable != ZERO) & is_input[group.variable]
        reached = (group.order + c[:, None])[known]
        np.maximum.at(highest, column[group.variable[known]], reached)
    first = np.concatenate([[0], np.cumsum(highest + 1)]).astype(np.int64)
    quantities = Quantities(column, variable, n_unknown, highest, first)

    c = offsets.equation
    first_extended = np.concatenate([[0], np.cumsum(c + 1)]).astype(np.int64)
    n_extended = int(first_extended[-1])
    base = np.repeat(np.arange(len(c)), c + 1)
    level = np.arange(n_extended) - first_extended[base]
    out = []
    first_equation = 0
    for group in groups:
        rows = np.arange(len(group))
        counts = c[first_equation : first_equation + len(group)]
        template, k = group.template, 0
        while len(rows):
            slot_base = np.array([b for b, _ in template.slots], np.int64)
            slot_q = np.array([q for _, q in template.slots], np.int64)
            v = group.variable[np.ix_(rows, slot_base)] if len(slot_base) else np.zeros((len(rows), 0), np.int64)
            o = group.order[np.ix_(rows, slot_base)] + slot_q if len(slot_base) else v
            s = group.sign[np.ix_(rows, slot_base)] if len(slot_base) else v
            zero = v == ZERO
            quantity = np.where(zero, ZERO, first[column[v]] + o)
            out.append(
                ExtendedGroup(
                    template,
                    first_extended[first_equation + rows] + k,
                    first_equation + rows,
                    k,
                    quantity,
                    np.where(zero, 0, s),
                    group.parameter[rows],
                    group.coefficient[rows],
                )
            )
            k += 1
            rows = rows[counts[rows] >= k]
            if len(rows):
                template = template.derivative
        first_equation += len(group)
    return Extended(tuple(out), n_extended, quantities, base, level)
