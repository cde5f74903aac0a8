"""Linear DAEs E·y' + A·y = f(t) of any index, by elimination in extended precision.

The derivative array stacks the equations and their derivatives (Campbell 1985). Eliminating the highest derivatives
first, with complete pivoting, leaves equations in (y', y) and then in y alone: the hidden constraints. Unknowns without
a pivot in the last are free: they are the degrees of freedom.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

LARGE = np.longdouble
TINY = 1e-13  # a pivot that is zero, compared with the largest entry of its row


class NoUniqueSolution(ArithmeticError):
    """The equations contradict each other, or leave something undetermined that is not a derivative."""


@dataclasses.dataclass(frozen=True)
class Flow:
    """All consistent points at a time: y = y0 + P·x and y' = d0 + Q·x for any values x of the `free` unknowns.
    `dy_known` says which rows of y' are determined."""

    free: list[int]
    y0: np.ndarray
    P: np.ndarray
    d0: np.ndarray
    Q: np.ndarray
    dy_known: np.ndarray


def _reduce(m: np.ndarray, columns: Sequence[int], size: np.ndarray) -> list[tuple[int, int]]:
    """Gauss–Jordan elimination in place with complete pivoting among `columns`; returns the pivots (row, column). Rows
    are compared after division by `size`."""
    pivots: list[tuple[int, int]] = []
    open_rows = np.ones(len(m), bool)
    open_columns = list(columns)
    while open_columns and open_rows.any():
        rows = np.flatnonzero(open_rows)
        block = np.abs(m[np.ix_(rows, open_columns)]) / size[rows, None]
        r, c = np.unravel_index(int(np.argmax(block)), block.shape)
        if block[r, c] <= TINY:
            break
        row, column = int(rows[r]), open_columns[int(c)]
        m[row] /= m[row, column]
        factors = m[:, column].copy()
        factors[row] = 0
        touched = np.flatnonzero(factors)
        m[touched] -= np.outer(factors[touched], m[row])
        m[touched, column] = 0
        open_rows[row] = False
        open_columns.pop(int(c))
        pivots.append((row, column))
    return pivots


def _without(rows: int, pivots: list[tuple[int, int]]) -> np.ndarray:
    return np.setdiff1d(np.arange(rows), [r for r, _ in pivots])


def flow(e: np.ndarray, a: np.ndarray, forcing: np.ndarray, bound_first: Sequence[int] = (), order: int = 3) -> Flow:
    """The consistent points of E·y' + A·y = f at a time where f has the derivatives `forcing[0]`, …, `forcing[order]`.

    `order` is at least the index. Unknowns in `bound_first` are not free if others can be.
    """
    n, m = a.shape[1], len(a)
    scale = np.maximum(np.max(np.abs(e), axis=1), np.max(np.abs(a), axis=1)).astype(LARGE)
    scale[scale == 0] = 1  # 0 = f, at a node to which nothing is connected but a source
    e, a = e.astype(LARGE) / scale[:, None], a.astype(LARGE) / scale[:, None]
    last = order * n
    table = np.zeros((m * (order + 1), last + 2 * n + 1), LARGE)  # columns: y^(order+1), …, y', y, 1
    for k in range(order + 1):
        rows = slice(k * m, (k + 1) * m)
        for matrix, q in ((e, k + 1), (a, k)):
            start = (order + 1 - q) * n
            table[rows, start : start + n] += matrix
        table[rows, -1] = np.asarray(forcing[k], LARGE) / scale
    used = _reduce(table, range(last), np.ones(len(table)))
    table = table[_without(len(table), used)]
    slopes = _reduce(table, range(last, last + n), np.ones(len(table)))
    hidden = table[_without(len(table), slopes)][:, last + n :]
    first = _reduce(hidden, bound_first, np.ones(len(hidden)))
    left = _without(len(hidden), first)
    rest = hidden[left]
    second = _reduce(rest, [k for k in range(n) if k not in set(bound_first)], np.ones(len(rest)))
    hidden[left] = rest
    for r, c in second:  # the rows reduced first still hold these unknowns
        for row, _ in first:
            hidden[row] -= hidden[row, c] * hidden[left[r]]
    pivots = [*first, *((int(left[r]), c) for r, c in second)]
    level = max(1.0, float(np.max(np.abs(table[:, -1]), initial=0)))
    over = _without(len(hidden), pivots)
    if np.max(np.abs(hidden[over, -1]), initial=0) > 1e-9 * level:
        raise NoUniqueSolution("the equations contradict each other")
    bound = {c for _, c in pivots}
    free = [k for k in range(n) if k not in bound]
    y0, p = np.zeros(n, LARGE), np.zeros((n, len(free)), LARGE)
    p[free] = np.eye(len(free))
    for r, c in pivots:
        y0[c], p[c] = hidden[r, -1], -hidden[r, free]
    d0, q, known = np.zeros(n, LARGE), np.zeros((n, len(free)), LARGE), np.zeros(n, bool)
    open_slopes = np.ones(n, bool)
    open_slopes[[c - last for _, c in slopes]] = False
    for r, c in slopes:
        row = table[r, last + n : -1]
        known[c - last] = np.max(np.abs(table[r, last : last + n][open_slopes]), initial=0) <= TINY
        d0[c - last], q[c - last] = table[r, -1] - row @ y0, -row @ p
    if not known[free].all():
        raise NoUniqueSolution("something is left undetermined")
    return Flow(free, y0, p, d0, q, known)
