"""Incidence: which equation contains which variable, up to which derivative."""

import dataclasses

import numpy as np


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
    # Values are the last key of the sorting, so that the last one of equal places has the highest order.
    last = np.ones(len(rows), bool)
    last[:-1] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
    rows, columns, values = rows[last], columns[last], values[last]
    pointer = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n_rows))]).astype(np.int64)
    return pointer, columns, values
