"""Incidence: which equation contains which variable, up to which derivative."""

import dataclasses

import numpy as np

from .tables import ZERO, EquationGroup


@dataclasses.dataclass(frozen=True)
class Incidence:
    """A signature matrix in compressed rows (Pryce 2001).

    Row i lists the variables of equation i and the highest order at which each occurs.
    """

    pointer: np.ndarray
    variable: np.ndarray
    order: np.ndarray
    n_variables: int

    @property
    def n_equations(self) -> int:
        return len(self.pointer) - 1

    @property
    def rows(self) -> np.ndarray:
        """The equation of every entry."""
        return np.repeat(np.arange(self.n_equations), np.diff(self.pointer))


def compress(rows, columns, values, n_rows: int):
    """Sorted unique (row, column) pairs with the maximum of their values, as (pointer, columns, values)."""
    rows, columns, values = (np.asarray(a, np.int64) for a in (rows, columns, values))
    sorting = np.lexsort((values, columns, rows))
    rows, columns, values = rows[sorting], columns[sorting], values[sorting]
    last = np.ones(len(rows), bool)
    last[:-1] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
    rows, columns, values = rows[last], columns[last], values[last]
    pointer = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n_rows))]).astype(np.int64)
    return pointer, columns, values


def incidence(groups: tuple[EquationGroup, ...], column: np.ndarray, n_columns: int) -> Incidence:
    """The incidence of all equations; column[v] is the unknown's number of variable v, or −1 if v is known."""
    rows, columns, orders = [], [], []
    first = 0
    for group in groups:
        n, k = group.variable.shape
        row = np.repeat(np.arange(first, first + n), k)
        variable = group.variable.ravel()
        used = variable != ZERO
        used[used] = column[variable[used]] >= 0
        rows.append(row[used])
        columns.append(column[variable[used]])
        orders.append(group.order.ravel()[used])
        first += n
    row, variable, order = (np.concatenate(a) if a else np.zeros(0, np.int64) for a in (rows, columns, orders))
    pointer, variable, order = compress(row, variable, order, first)
    return Incidence(pointer, variable, order, n_columns)
