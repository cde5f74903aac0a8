"""The incidence of equations, and their entries as flat arrays with numeric coefficients where these are numbers."""

import dataclasses

import numpy as np

from ..structure.incidence import Incidence, compress
from .group import Columns
from .tables import ZERO, EquationGroup


@dataclasses.dataclass(frozen=True)
class Entries(Columns):
    """The entries (equation, variable, order) of all groups; `coefficient` is NaN unless it is a number."""

    row: np.ndarray
    variable: np.ndarray
    order: np.ndarray
    coefficient: np.ndarray
    n_rows: int


def entries_of(groups: tuple[EquationGroup, ...], unknown: np.ndarray) -> Entries:
    rows, variables, orders, coefficients = [], [], [], []
    first = 0
    for group in groups:
        n, k = group.variable.shape
        used = group.variable != ZERO
        used &= unknown[group.variable]
        rows.append(np.broadcast_to(np.arange(first, first + n)[:, None], (n, k))[used])
        variables.append(group.variable[used])
        orders.append(group.order[used])
        coefficients.append((group.template.numbers(group.coefficient) * group.factor)[used])
        first += n
    row, variable, order = (np.concatenate(a) if a else np.zeros(0, np.int64) for a in (rows, variables, orders))
    return Entries(row, variable, order, np.concatenate(coefficients) if coefficients else np.zeros(0), first)


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
