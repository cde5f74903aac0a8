"""Alias elimination.

Given linear equations a = 0, a = c·b and a = c·dᵏb/dtᵏ with numbers c, replaces the variable a everywhere. What
remains is a smaller model in root variables; every eliminated variable stays observable through the `AliasTable`.
Replacing a velocity by the derivative of its position lowers the index by the number of equations that only name a
derivative.

Most of them say that two variables are equal, or opposite, or that one is zero: those are joined at once, as the
connected components of a graph. The others follow one by one.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from ...base.tolerances import EPS, NOISE
from ..model.entries import slots_of
from ..model.group import Columns
from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenances
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel, VariableTable

# Factors of aliases lie within so many decades of one: single precision has 38.
DECADES = 30.0
COMPARED = 4  # terms of an equation that are compared with each other: sorting all terms of a large model takes longer
SWEEPS = 8  # after which equations of any length are looked at one by one


@dataclasses.dataclass(frozen=True)
class _Terms(Columns):
    """Linear equations, term by term in the order of the equations: coefficient·(variable)^(order)."""

    row: np.ndarray
    variable: np.ndarray
    order: np.ndarray
    coefficient: np.ndarray
    noise: np.ndarray  # what rounding may have added to or taken from the coefficient


@dataclasses.dataclass
class _Classes:
    """Each variable as factor·(root)^(order); root ZERO if it is identically zero."""

    root: np.ndarray
    order: np.ndarray
    factor: np.ndarray
    products: np.ndarray  # how many factors other than ±1 were multiplied
    decades: np.ndarray  # (n, 2): of the smallest and largest factors of a root's members
    merit: np.ndarray  # the variable of larger merit stays
    is_input: np.ndarray

    @classmethod
    def alone(cls, v: VariableTable, differentiated: np.ndarray) -> "_Classes":
        """Every variable as its own root."""
        n = len(v)
        # The better root: an input, then what is differentiated, fixed, started, no port variable; then the first.
        # Inputs come before all others because they are known: nothing may replace them.
        better = np.lexsort((-np.arange(n), ~v.is_port, v.start.is_given, v.fixed, differentiated, v.is_input))
        merit, zeros = np.empty(n, np.int32), np.zeros(n, np.int32)
        merit[better] = own = np.arange(n, dtype=np.int32)
        return cls(own, zeros, np.ones(n), zeros.copy(), np.zeros((n, 2)), merit, v.is_input)

    def link(self, old: np.ndarray, root: np.ndarray, order: np.ndarray, factor: np.ndarray, products: np.ndarray):
        """Makes former roots factor·(root)^(order), and all variables that had them, too."""
        n = len(self.root)
        # Links are composed by arrays over all variables at once. Walking from link to link takes as many steps as a
        # chain has.
        to = np.arange(n + 1, dtype=np.int32)  # the last place is ZERO's
        more, times, count = np.zeros(n + 1, np.int32), np.ones(n + 1), np.zeros(n + 1, np.int32)
        to[old], more[old], times[old], count[old] = root, order, factor, products
        to[n] = ZERO
        own = self.root
        self.root = to[own]
        self.order = self.order + more[own]
        self.factor = self.factor * times[own]
        self.products = self.products + count[own]


def eliminate_aliases(model: FlatModel) -> tuple[tuple[EquationGroup, ...], AliasTable]:
    """Returns the remaining equations, in root variables, and the alias of every variable.

    Redundant rows (0 = 0) remain as equations without variables; the structural check names them.
    """
    n = len(model.variables)
    differentiated = np.zeros(n, bool)
    for group in model.groups:
        differentiated[group.variable[group.order > 0]] = True
    classes = _Classes.alone(model.variables, differentiated)
    linear = [g for g in model.groups if isinstance(g.template, LinearTemplate)]
    others = [g for g in model.groups if not isinstance(g.template, LinearTemplate)]
    terms, n_rows = _terms_of(linear)
    rest = np.ones(n_rows, bool)
    replaced = np.full(n_rows, ZERO)  # by each equation that is used
    sweep = 0
    while True:
        terms = _canonical(terms.take(rest[terms.row]), classes)
        # Joining equal variables shortens other rows: 0 = a − b + c with a = b is 0 = c. So it is repeated until
        # nothing joins, before multiples are looked at.
        found = _join(terms, n_rows, classes)
        if (found == ZERO).all():
            count, _ = _starts(terms, n_rows)
            # Rows of more terms may turn short inside `_follow`, since it puts found links in. But to go through all
            # terms in Python at each sweep would take quadratic time on chains.
            short = terms if sweep >= SWEEPS else terms.take(count[terms.row] <= 2)
            # Equal variables are joined before multiples of each other, so that the order of equations does not decide
            # whether a velocity is named by its position or a position by its acceleration (v = x' and v' = −k·x).
            found = _follow(short, n_rows, classes, multiples=False)
            if (found == ZERO).all():
                found = _follow(short, n_rows, classes, multiples=True)
            sweep += 1
        used = np.flatnonzero(found != ZERO)
        if not len(used):
            break
        replaced[used] = found[used]
        rest[used] = False
    is_zero = classes.root == ZERO
    # Provenances of removed equations are kept: an error about an alias names the connection that made it.
    used = np.flatnonzero(~rest)
    provenance = Provenances.joined([g.provenance for g in linear])
    table = AliasTable(
        classes.root.astype(np.int64),
        np.where(is_zero, 0, classes.order.astype(np.int64)),
        np.where(is_zero, 0.0, classes.factor),
        provenance.take(used),
        replaced[used],
    )
    groups = _linear_groups(terms, np.flatnonzero(rest), provenance)
    return (*groups, *(_substitute(g, table) for g in others)), table


def _terms_of(groups: Sequence[EquationGroup]) -> tuple[_Terms, int]:
    """The terms of all rows, and how many rows there are."""
    coefficient = np.concatenate([np.zeros(0), *(g.coefficient.ravel() for g in groups)])
    return _Terms(*slots_of(groups), coefficient, NOISE * EPS * np.abs(coefficient)), sum(map(len, groups))


def _canonical(terms: _Terms, classes: _Classes) -> _Terms:
    """The rows in roots, terms of equal quantity merged; what rounding leaves of terms that cancel is nothing. Terms
    stay in the order they were written in."""
    is_there = np.append(classes.root, ZERO)[terms.variable] != ZERO
    terms = terms.take(is_there)
    v, row = terms.variable, terms.row
    coefficient = classes.factor[v] * terms.coefficient
    # What is left of terms that cancel is judged by their roundings: 0.1·a + 0.2·b − 0.3·c where a = b = c leaves
    # 5e-17·a, which would seem to determine a. A factor that is a product of n numbers adds n roundings.
    noise = np.abs(classes.factor)[v] * terms.noise
    noise += EPS * classes.products[v] * np.abs(coefficient)
    root, order = classes.root[v], terms.order + classes.order[v]
    kept = np.ones(len(row), bool)
    some = np.flatnonzero(_may_repeat(row, root, order)[row])
    if len(some):
        by = some[np.lexsort((order[some], root[some], row[some]))]
        new = np.ones(len(by), bool)
        new[1:] = (np.diff(row[by]) != 0) | (np.diff(root[by]) != 0) | (np.diff(order[by]) != 0)
        first = np.flatnonzero(new)
        sums = np.add.reduceat(coefficient[by], first), np.add.reduceat(noise[by], first)
        kept[some], kept[by[first]] = False, True
        coefficient[by[first]], noise[by[first]] = sums
    kept &= np.abs(coefficient) > noise
    return _Terms(row, root, order, coefficient, noise).take(kept)


def _may_repeat(row: np.ndarray, root: np.ndarray, order: np.ndarray) -> np.ndarray:
    """False for equations that certainly have no quantity twice, by their numbers."""
    count = np.bincount(row)
    start = np.cumsum(count) - count
    repeats = count > COMPARED
    for length in range(2, COMPARED + 1):
        members = np.flatnonzero(count == length)
        for i, j in itertools.combinations(range(length), 2):
            a, b = start[members] + i, start[members] + j
            repeats[members] |= (root[a] == root[b]) & (order[a] == order[b])
    return repeats


def _starts(terms: _Terms, n_rows: int) -> tuple[np.ndarray, np.ndarray]:
    """For each row, the number of its terms and the place of the first one."""
    count = np.bincount(terms.row, minlength=n_rows)
    return count, np.cumsum(count) - count


def _join(terms: _Terms, n_rows: int, classes: _Classes) -> np.ndarray:
    """Uses all rows a = 0 and a = ±b at once; returns the variable that each row replaces, or −1."""
    found = np.full(n_rows, ZERO)
    count, start = _starts(terms, n_rows)
    n = len(classes.root)  # in the graph, ZERO is the last node
    v = np.append(terms.variable, n)
    single = np.flatnonzero(count == 1)
    # A derivative that is zero leaves its variable constant, not zero.
    single = single[(terms.order[start[single]] == 0) & ~classes.is_input[v[start[single]]]]
    pair = np.flatnonzero(count == 2)
    a, b = start[pair], start[pair] + 1
    equal = (terms.order[a] == 0) & (terms.order[b] == 0)
    pair = pair[equal & (np.abs(terms.coefficient[a]) == np.abs(terms.coefficient[b]))]
    a, b = start[pair], start[pair] + 1
    row = np.concatenate([single, pair])
    if not len(row):
        return found
    left = np.concatenate([v[start[single]], v[a]])
    right = np.concatenate([np.full(len(single), n), v[b]])
    sign = np.concatenate([np.ones(len(single)), np.sign(-terms.coefficient[b] / terms.coefficient[a])])
    # The graph has the variables that occur in these rows alone: sweeps after the first join few of a large model.
    nodes, ends = np.unique(np.concatenate([left, right]), return_inverse=True)
    left, right = np.sort(ends.reshape(2, -1), axis=0)
    edge, first = np.unique(left * len(nodes) + right, return_index=True)  # of rows that say the same, the first
    # Of a loop, the equation that was written last is left over: it repeats the others, or contradicts them.
    # (Older versions of SciPy span trees of graphs with 32-bit indices only.)
    places = left[first].astype(np.int32), right[first].astype(np.int32)
    # Numbers of rows plus one, because SciPy takes a weight of zero for no edge.
    graph = sp.csr_array((row[first] + 1.0, places), shape=(len(nodes),) * 2)
    tree = sp.coo_array(minimum_spanning_tree(graph))
    n_parts, part = connected_components(tree, directed=False)
    # Zero counts as one of them: an input that would be zero is a contradiction to be named, not an alias.
    is_fixed = np.append(classes.is_input, True)[nodes]  # a part may have one of those: it is the root
    too_many = np.bincount(part, is_fixed, n_parts) > 1
    merit = np.append(classes.merit, n)[nodes]
    by = np.lexsort((merit, part))
    top = by[np.flatnonzero(np.append(np.diff(part[by]) != 0, True))]  # of each part
    # Beyond all nodes, one that reaches every root: one search visits the trees of all parts.
    every = len(nodes)
    i, j = np.append(tree.coords[0], top), np.append(tree.coords[1], np.full(n_parts, every))
    _, before = breadth_first_order(sp.csr_array((np.ones(len(i)), (i, j)), shape=(every + 1,) * 2), every, False)
    before = before[:every]
    # A part with two known quantities has an equation that determines nothing. `_follow` joins what it can of it and
    # leaves that equation for the structural check to name.
    child = np.flatnonzero((before != every) & ~too_many[part])
    if not len(child):
        return found
    lower, upper = np.minimum(child, before[child]), np.maximum(child, before[child])
    chosen = first[np.searchsorted(edge, lower * len(nodes) + upper)]
    up, total = np.arange(every), np.ones(every)
    up[child], total[child] = before[child], sign[chosen]
    # Each round doubles the length of what is followed: a chain of a million equal variables takes twenty.
    while not np.array_equal(up[up], up):
        total, up = total * total[up], up[up]
    names = np.append(np.arange(n), ZERO)[nodes]
    old, root = names[child], names[up[child]]
    found[row[chosen]] = old
    kept = root != ZERO
    np.minimum.at(classes.decades[:, 0], root[kept], classes.decades[old[kept], 0])
    np.maximum.at(classes.decades[:, 1], root[kept], classes.decades[old[kept], 1])
    none = np.zeros(len(child), np.int64)
    classes.link(old, root, none, total[child], none)
    return found


def _follow(terms: _Terms, n_rows: int, classes: _Classes, multiples: bool) -> np.ndarray:
    """Uses rows a = c·dᵏb/dtᵏ one after the other, without `multiples` those with c = ±1; returns the variable that
    each row replaces, or −1."""
    found = np.full(n_rows, ZERO)
    links: dict[int, tuple[int, int, float, int]] = {}

    # Union–find with path compression (Tarjan 1975): links form chains, and rows ask for their ends again and again.
    def find(v: int) -> tuple[int, int, float, int]:
        order, factor, products, path = 0, 1.0, 0, []
        while v in links:
            path.append(v)
            v = links[v][0]
        for w in reversed(path):
            _, o, f, p = links[w]
            order, factor, products = order + o, factor * f, products + p
            links[w] = v, order, factor, products
        return v, order, factor, products

    rows: dict[int, list[tuple[int, int, float, float]]] = {}
    columns = (terms.row, terms.variable, terms.order, terms.coefficient, terms.noise)
    for row, *term in zip(*(c.tolist() for c in columns), strict=True):
        rows.setdefault(row, []).append(tuple(term))
    for row, members in rows.items():
        merged: dict[tuple[int, int], float] = {}
        noise: dict[tuple[int, int], float] = {}
        for v, order, c, error in members:
            root, more, factor, products = find(v)
            if root != ZERO:
                key, c = (root, order + more), factor * c
                merged[key] = merged.get(key, 0.0) + c
                noise[key] = noise.get(key, 0.0) + abs(factor) * error + EPS * products * abs(c)
        left = [(*key, c) for key, c in merged.items() if abs(c) > noise[key]]
        usable = len(left) == 1 or (len(left) == 2 and (multiples or abs(left[0][2]) == abs(left[1][2])))
        link = _as_link(left, classes) if usable else None
        if link is not None:
            found[row], links[link[0]] = link[0], link[1]
    if links:
        old = np.array(list(links))
        root, order, factor, products = zip(*map(find, links), strict=True)
        classes.link(old, np.array(root), np.array(order), np.array(factor), np.array(products))
    return found


def _as_link(row: list[tuple[int, int, float]], classes: _Classes) -> tuple[int, tuple[int, int, float, int]] | None:
    """The variable that a row of one or two terms replaces, and by what; None if it replaces none."""
    if len(row) == 1:
        v, order, _ = row[0]
        return None if order or classes.is_input[v] else (v, (ZERO, 0, 1.0, 0))
    (a, p, ca), (b, q, cb) = row
    # a' = c·a is a differential equation, not an alias.
    if a == b:
        return None
    if (p == q == 0 and classes.merit[a] > classes.merit[b]) or p > 0:
        a, p, ca, b, q, cb = b, q, cb, a, p, ca
    # Equal derivatives leave a constant between their variables. And an input cannot be replaced.
    if p > 0 or classes.is_input[a]:
        return None
    factor = -cb / ca
    # A quotient of coefficients may underflow or overflow. The equation then stays as it is.
    if not 0 < abs(factor) < np.inf:
        return None
    # It is the members' factors that must not overflow, not the factor of this link: along a chain of ratios they
    # multiply.
    smallest, largest = classes.decades[a] + np.log10(abs(factor))
    smallest, largest = min(classes.decades[b, 0], smallest), max(classes.decades[b, 1], largest)
    if max(-smallest, largest) > DECADES:
        return None
    classes.decades[b] = smallest, largest
    return a, (b, q, factor, int(abs(factor) != 1.0))


def _substitute(group: EquationGroup, table: AliasTable) -> EquationGroup:
    root, order, factor = np.append(table.root, ZERO), np.append(table.order, 0), np.append(table.factor, 0.0)
    variable = root[group.variable]  # at ZERO, which is −1, the last entry
    order = np.where(variable == ZERO, 0, group.order + order[group.variable])
    return dataclasses.replace(group, variable=variable, order=order, factor=factor[group.variable])


def _linear_groups(terms: _Terms, rows: np.ndarray, provenance: Provenances) -> list[EquationGroup]:
    """The rows by their length, in the order of the first of each."""
    count, start = _starts(terms, int(rows[-1]) + 1 if len(rows) else 0)
    groups = []
    for length in dict.fromkeys(count[rows].tolist()):
        members = rows[count[rows] == length]
        at = start[members][:, None] + np.arange(length)
        says, template = provenance.take(members), LinearTemplate(length)
        group = EquationGroup.of(template, terms.variable[at], terms.order[at], says, coefficient=terms.coefficient[at])
        groups.append(group)
    return groups
