"""The incidence of a model's equations."""

import numpy as np

from ..structure.incidence import Incidence, compress
from .tables import ZERO, EquationGroup


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
