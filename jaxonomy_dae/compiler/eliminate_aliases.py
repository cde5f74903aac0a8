"""Alias elimination.

Given linear equations a = 0, a = ±b and a = ±dᵏb/dtᵏ, replaces the variable a everywhere. What remains is a smaller
model in root variables; every eliminated variable stays observable through the `AliasTable`. Replacing a velocity by
the derivative of its position lowers the index by the number of equations that only name a derivative.
"""

import dataclasses

import numpy as np

from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel

Row = list[tuple[int, int, float]]  # (variable, order, coefficient)
ROUNDING = 1e-15  # of the sizes of the terms that are merged


class _Classes:
    """Union–find over variables with a sign and a derivative offset to the root."""

    def __init__(self, model: FlatModel, differentiated: np.ndarray):
        n = len(model.variables)
        self.parent = list(range(n))
        self.order = [0] * n
        self.sign = [1] * n
        v = model.variables
        has_start = np.array([s is not None for s in v.start], bool)
        # The better root: an input, then what is differentiated, fixed, started, no port variable; then the first.
        self.merit = list(
            zip(
                v.is_input.tolist(),
                differentiated.tolist(),
                v.fixed.tolist(),
                has_start.tolist(),
                (~v.is_port).tolist(),
                [-k for k in range(n)],
                strict=True,
            )
        )
        self.is_input = v.is_input.tolist()

    def find(self, v: int) -> tuple[int, int, int]:
        """(root, order, sign) of a variable; root ZERO if it is identically zero."""
        path = []
        while v != ZERO and self.parent[v] != v:
            path.append(v)
            v = self.parent[v]
        order, sign = 0, 1
        for w in reversed(path):
            order += self.order[w]
            sign *= self.sign[w]
            self.parent[w], self.order[w], self.sign[w] = v, order, sign
        return v, order, sign

    def canonical(self, row: Row) -> Row:
        """The row in roots, terms of equal quantity merged; what rounding leaves of terms that cancel is nothing."""
        merged: dict[tuple[int, int], float] = {}
        size: dict[tuple[int, int], float] = {}
        for v, order, c in row:
            root, more, sign = self.find(v)
            if root != ZERO:
                key = (root, order + more)
                merged[key] = merged.get(key, 0.0) + sign * c
                size[key] = size.get(key, 0.0) + abs(c)
        return [(v, order, c) for (v, order), c in merged.items() if abs(c) > ROUNDING * size[v, order]]

    def absorb(self, row: Row) -> int | None:
        """Uses a canonical row of one or two terms as an alias, if it is one; returns the variable it replaces."""
        if len(row) == 1:
            v, order, _ = row[0]
            if order == 0 and not self.is_input[v]:
                self.parent[v] = ZERO
                return v
            return None
        (a, p, ca), (b, q, cb) = row
        if abs(ca) != abs(cb) or a == b:
            return None
        sign = -1 if ca * cb > 0 else 1
        if p == q == 0 and self.merit[a] > self.merit[b]:
            a, p, b, q = b, q, a, p
        elif p > 0:
            a, p, b, q = b, q, a, p
        if p > 0 or self.is_input[a]:
            return None
        self.parent[a], self.order[a], self.sign[a] = b, q, sign
        return a


def eliminate_aliases(model: FlatModel) -> tuple[tuple[EquationGroup, ...], AliasTable]:
    """Returns the remaining equations, in root variables, and the alias of every variable.

    Redundant rows (0 = 0) remain as equations without variables; the structural check names them.
    """
    n = len(model.variables)
    differentiated = np.zeros(n, bool)
    for group in model.groups:
        differentiated[group.variable[group.order > 0]] = True
    classes = _Classes(model, differentiated)

    rows: list[tuple[Row, Provenance]] = []
    others: list[EquationGroup] = []
    for group in model.groups:
        if not isinstance(group.template, LinearTemplate):
            others.append(group)
            continue
        for v, o, c, provenance in zip(
            group.variable.tolist(), group.order.tolist(), group.coefficient.tolist(), group.provenance, strict=True
        ):
            rows.append((list(zip(v, o, c, strict=True)), provenance))

    eliminated: list[tuple[Provenance, int]] = []
    pending = rows
    changed = True
    while changed:
        # Short rows first, to a fixed point, then one sweep over the long ones: near-linear in all.
        changed = False
        kept = []
        for row, provenance in pending:
            row = classes.canonical(row)
            replaced = classes.absorb(row) if 1 <= len(row) <= 2 else None
            if replaced is not None:
                eliminated.append((provenance, replaced))
                changed = True
            else:
                kept.append((row, provenance))
        pending = kept

    root = np.empty(n, np.int64)
    order = np.empty(n, np.int64)
    sign = np.empty(n, np.int64)
    for v in range(n):
        root[v], order[v], sign[v] = classes.find(v)
    sign[root == ZERO] = 0
    order[root == ZERO] = 0
    table = AliasTable(root, order, sign, eliminated)
    return (*_linear_groups(pending), *(_substitute(g, table) for g in others)), table


def _substitute(group: EquationGroup, table: AliasTable) -> EquationGroup:
    variable = table.root[group.variable]
    sign = table.sign[group.variable]
    order = np.where(variable == ZERO, 0, group.order + table.order[group.variable])
    return dataclasses.replace(group, variable=variable, order=order, sign=sign)


def _linear_groups(rows: list[tuple[Row, Provenance]]) -> list[EquationGroup]:
    by_length: dict[int, list[tuple[Row, Provenance]]] = {}
    for row, provenance in rows:
        by_length.setdefault(len(row), []).append((row, provenance))
    groups = []
    for length, members in by_length.items():
        shape = (len(members), length)
        variable = np.array([[v for v, _, _ in r] for r, _ in members], np.int64).reshape(shape)
        order = np.array([[o for _, o, _ in r] for r, _ in members], np.int64).reshape(shape)
        coefficient = np.array([[c for _, _, c in r] for r, _ in members], float).reshape(shape)
        groups.append(
            EquationGroup(
                LinearTemplate(length),
                variable,
                order,
                np.ones(shape, np.int64),
                np.zeros((shape[0], 0), np.int64),
                coefficient,
                [provenance for _, provenance in members],
            )
        )
    return groups
