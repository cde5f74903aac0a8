"""The incidence of equations, and their entries as flat arrays with numeric coefficients where these are numbers."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...graph.structure.incidence import Incidence, compress
from .group import Columns
from .tables import ZERO, EquationGroup, equation_offsets


@dataclasses.dataclass(frozen=True)
class Entries(Columns):
    """The entries (equation, variable, order) of all groups; `coefficient` is NaN unless it is a number."""

    row: np.ndarray
    variable: np.ndarray
    order: np.ndarray
    coefficient: np.ndarray
    n_rows: int


def entries_of(groups: tuple[EquationGroup, ...], unknown: np.ndarray) -> Entries:
    row, variable, order = slots_of(groups)
    numbers = [group.template.numbers(group.coefficient) * group.factor for group in groups]
    coefficient = np.concatenate([np.zeros(0), *(number.ravel() for number in numbers)])
    used = variable != ZERO
    # ZERO is −1 and would read the last entry.
    used[used] = unknown[variable[used]]
    entries = Entries(row, variable, order, coefficient, int(equation_offsets(groups)[-1]))
    return entries.take(used)


def slots_of(groups: Sequence[EquationGroup]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(equation, variable, order) of all slots, row by row: 32-bit integers, as there are more slots than anything
    else."""
    first = equation_offsets(groups).astype(np.int32)
    row = [np.repeat(np.arange(a, b), g.variable.shape[1]) for a, b, g in zip(first, first[1:], groups, strict=False)]
    none, variable, order = [np.zeros(0, np.int32)], [g.variable for g in groups], [g.order for g in groups]
    row, variable, order = (
        np.concatenate(none + [np.ravel(part).astype(np.int32, copy=False) for part in parts])
        for parts in (row, variable, order)
    )
    return row, variable, order


def incidence(groups: tuple[EquationGroup, ...], column: np.ndarray, n_columns: int) -> Incidence:
    """The incidence of all equations; column[v] is the unknown's number of variable v, or −1 if v is known."""
    row, variable, order = slots_of(groups)
    used = variable != ZERO
    used[used] = column[variable[used]] >= 0
    n_rows = int(equation_offsets(groups)[-1])
    pointer, variable, order = compress(row[used], column[variable[used]], order[used], n_rows)
    return Incidence(pointer, variable, order, n_columns)
