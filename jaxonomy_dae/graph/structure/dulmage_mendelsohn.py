"""The over- and under-determined parts of an incidence."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from .incidence import Incidence


def dulmage_mendelsohn(pattern: Incidence, matched: np.ndarray):
    """The over- and under-determined parts of an incidence (Dulmage & Mendelsohn 1958), split where they fall apart.

    **Arguments:**

    - `matched`: the column of every equation in some maximum matching, −1 for none. The parts do not depend on it.

    **Returns:**

    Two lists of (equations, columns): parts with more equations than columns, and parts with fewer; in order.
    """
    n, m = pattern.n_equations, pattern.n_variables
    rows, columns = pattern.rows, pattern.variable
    owner = np.full(m, -1, np.int64)
    owner[matched[matched >= 0]] = np.flatnonzero(matched >= 0)
    # From an equation too many, along its variables to the equations that hold them.
    held = owner[columns] >= 0
    too_many = _reach(rows[held], owner[columns[held]], np.flatnonzero(matched < 0), n)
    unsettled = left_open(rows, columns, matched, m)
    in_over = too_many[rows]
    over_columns = np.zeros(m, bool)
    over_columns[columns[in_over]] = True
    in_under = unsettled[columns]
    under_rows = np.zeros(n, bool)
    under_rows[rows[in_under]] = True
    over = _components(rows[in_over], columns[in_over], too_many, over_columns)
    under = _components(rows[in_under], columns[in_under], under_rows, unsettled)
    return over, under


def left_open(rows: np.ndarray, columns: np.ndarray, matched: np.ndarray, m: int) -> np.ndarray:
    """True for the columns that equations do not determine, shape (m,), given the places of entries, and the column of
    every equation in some maximum matching, −1 for none."""
    # From a variable too many, along its equations to the variables these hold.
    holds, too_many = matched[rows] >= 0, np.ones(m, bool)
    too_many[matched[matched >= 0]] = False
    return _reach(columns[holds], matched[rows[holds]], np.flatnonzero(too_many), m)


def _reach(tail: np.ndarray, head: np.ndarray, start: np.ndarray, n: int) -> np.ndarray:
    """True for the nodes that can be reached from `start` along the arcs, shape (n,): a search from one node put before
    them all."""
    arcs = (np.concatenate([tail, np.full(len(start), n)]), np.concatenate([head, start]))
    graph = sp.coo_array((np.ones(len(arcs[0])), arcs), shape=(n + 1, n + 1)).tocsr()
    reached = sp.csgraph.breadth_first_order(graph, n, return_predecessors=False)
    out = np.zeros(n + 1, bool)
    out[reached] = True
    return out[:n]


def _components(rows, columns, has_row: np.ndarray, has_column: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The connected parts of a set of equations and columns, those of the first equations or columns first."""
    n, m = len(has_row), len(has_column)
    graph = sp.coo_array((np.ones(len(rows)), (rows, n + columns)), shape=(n + m, n + m))
    _, label = connected_components(graph, directed=False)
    # An equation without variables, or a variable without equations, has no entry and is still at fault: nodes are
    # chosen by what was reached, not by their arcs.
    used = np.flatnonzero(np.concatenate([has_row, has_column]))
    labels, first = np.unique(label[used], return_index=True)
    order = np.argsort(label[used], kind="stable")
    members = np.split(used[order], np.searchsorted(label[used][order], labels)[1:]) if len(used) else []
    return [
        (members[k][members[k] < n], members[k][members[k] >= n] - n) for k in np.argsort(first, kind="stable").tolist()
    ]
