"""The incidence of equations, and their entries as flat arrays with numeric coefficients where these are numbers."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..structure.incidence import Incidence, compress
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
    used[used] = unknown[variable[used]]
    entries = Entries(row, variable, order, coefficient, int(equation_offsets(groups)[-1]))
    return entries.take(used)


def slots_of(groups: Sequence[EquationGroup]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(equation, variable, order) of all slots, row by row."""
    none, first = [np.zeros(0, np.int64)], equation_offsets(groups)
    row = [np.repeat(k + np.arange(len(g)), g.variable.shape[1]) for k, g in zip(first[:-1], groups, strict=True)]
    return (
        np.concatenate(none + row),
        np.concatenate(none + [group.variable.ravel() for group in groups]),
        np.concatenate(none + [group.order.ravel() for group in groups]),
    )


def incidence(groups: tuple[EquationGroup, ...], column: np.ndarray, n_columns: int) -> Incidence:
    """The incidence of all equations; column[v] is the unknown's number of variable v, or −1 if v is known."""
    row, variable, order = slots_of(groups)
    used = variable != ZERO
    used[used] = column[variable[used]] >= 0
    n_rows = int(equation_offsets(groups)[-1])
    pointer, variable, order = compress(row[used], column[variable[used]], order[used], n_rows)
    return Incidence(pointer, variable, order, n_columns)
