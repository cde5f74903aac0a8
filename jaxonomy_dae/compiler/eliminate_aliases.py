"""Alias elimination.

Given linear equations a = 0, a = c·b and a = c·dᵏb/dtᵏ with numbers c, replaces the variable a everywhere. What
remains is a smaller model in root variables; every eliminated variable stays observable through the `AliasTable`.
Replacing a velocity by the derivative of its position lowers the index by the number of equations that only name a
derivative.
"""

import dataclasses

import numpy as np

from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel

# (variable, order, coefficient, what rounding may have added to or taken from the coefficient)
Row = list[tuple[int, int, float, float]]
ROUNDING = 1e-15  # of a coefficient as it was written
EPS = 2.0**-52
DECADES = 30.0  # that factors span at most: single precision has 38


class _Classes:
    """Union–find over variables with a factor and a derivative offset to the root."""

    def __init__(self, model: FlatModel, differentiated: np.ndarray):
        n = len(model.variables)
        self.parent = list(range(n))
        self.order = [0] * n
        self.factor = [1.0] * n
        self.products = [0] * n  # how many factors other than ±1 were multiplied
        self.decades = [(0.0, 0.0)] * n  # of the smallest and largest factors of a root's members
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

    def find(self, v: int) -> tuple[int, int, float, int]:
        """(root, order, factor, products) of a variable; root ZERO if it is identically zero."""
        path = []
        while v != ZERO and self.parent[v] != v:
            path.append(v)
            v = self.parent[v]
        order, factor, products = 0, 1.0, 0
        for w in reversed(path):
            order += self.order[w]
            factor *= self.factor[w]
            products += self.products[w]
            self.parent[w], self.order[w], self.factor[w], self.products[w] = v, order, factor, products
        return v, order, factor, products

    def canonical(self, row: Row) -> Row:
        """The row in roots, terms of equal quantity merged; what rounding leaves of terms that cancel is nothing."""
        merged: dict[tuple[int, int], float] = {}
        noise: dict[tuple[int, int], float] = {}
        for v, order, c, error in row:
            root, more, factor, products = self.find(v)
            if root != ZERO:
                key, c = (root, order + more), factor * c
                merged[key] = merged.get(key, 0.0) + c
                noise[key] = noise.get(key, 0.0) + abs(factor) * error + EPS * products * abs(c)
        return [(v, order, c, noise[v, order]) for (v, order), c in merged.items() if abs(c) > noise[v, order]]

    def absorb(self, row: Row) -> int | None:
        """Uses a canonical row of one or two terms as an alias, if it is one; returns the variable it replaces."""
        if len(row) == 1:
            v, order, _, _ = row[0]
            if order == 0 and not self.is_input[v]:
                self.parent[v] = ZERO
                return v
            return None
        (a, p, ca, _), (b, q, cb, _) = row
        if a == b:
            return None
        if (p == q == 0 and self.merit[a] > self.merit[b]) or p > 0:
            a, p, ca, b, q, cb = b, q, cb, a, p, ca
        if p > 0 or self.is_input[a]:
            return None
        factor = -cb / ca
        if not 0 < abs(factor) < np.inf:
            return None
        moved = np.log10(abs(factor))
        smallest = min(self.decades[b][0], self.decades[a][0] + moved)
        largest = max(self.decades[b][1], self.decades[a][1] + moved)
        if max(-smallest, largest) > DECADES:
            return None
        self.decades[b] = smallest, largest
        self.parent[a], self.order[a], self.factor[a], self.products[a] = b, q, factor, int(abs(factor) != 1.0)
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
            rows.append(([(*term, ROUNDING * abs(term[2])) for term in zip(v, o, c, strict=True)], provenance))

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
    factor = np.empty(n)
    for v in range(n):
        root[v], order[v], factor[v], _ = classes.find(v)
    factor[root == ZERO] = 0.0
    order[root == ZERO] = 0
    table = AliasTable(root, order, factor, eliminated)
    return (*_linear_groups(pending), *(_substitute(g, table) for g in others)), table


def _substitute(group: EquationGroup, table: AliasTable) -> EquationGroup:
    variable = table.root[group.variable]
    factor = table.factor[group.variable]
    order = np.where(variable == ZERO, 0, group.order + table.order[group.variable])
    return dataclasses.replace(group, variable=variable, order=order, factor=factor)


def _linear_groups(rows: list[tuple[Row, Provenance]]) -> list[EquationGroup]:
    by_length: dict[int, list[tuple[Row, Provenance]]] = {}
    for row, provenance in rows:
        by_length.setdefault(len(row), []).append((row, provenance))
    groups = []
    for length, members in by_length.items():
        shape = (len(members), length)
        variable = np.array([[v for v, *_ in r] for r, _ in members], np.int64).reshape(shape)
        order = np.array([[o for _, o, *_ in r] for r, _ in members], np.int64).reshape(shape)
        coefficient = np.array([[c for _, _, c, _ in r] for r, _ in members], float).reshape(shape)
        groups.append(
            EquationGroup(
                LinearTemplate(length),
                variable,
                order,
                np.ones(shape),
                np.zeros((shape[0], 0), np.int64),
                coefficient,
                [provenance for _, provenance in members],
            )
        )
    return groups
