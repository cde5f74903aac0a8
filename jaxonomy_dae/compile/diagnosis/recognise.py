"""Faults that have a name: circuits without ground, loops of ideal sources, two walls on one flange, …

Given the model as flattened and after alias elimination, returns what is certainly wrong with it, whatever the values
of its parameters. Each kind is a null vector of the equations that can be read off a graph:

- *known variables*: an equation with one unknown, not differentiated, determines it; whoever determines it again is one
  too many. Peeling off such equations takes time proportional to what is known;
- *loops*: equations a ± b = known tie two unknowns each; as many of them in a circle as unknowns are one too many, if
  the signs agree all the way round (a signed graph is balanced, Harary 1953);
- *cuts*: the connections of a part of the model say that its flows sum to zero; if every unknown flow has both its ends
  there, the sum is a statement about known flows alone;
- *floating networks*: if no equation changes when all across variables of a connected network are shifted by the same
  amount, nothing determines their level.

Models without such a fault pay for a few array operations.
"""

import collections
import dataclasses

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ..model.entries import Entries, entries_of
from ..model.linear_template import LinearTemplate
from ..model.tables import ZERO, AliasTable, EquationGroup, FlatModel
from .explain import Explainer
from .wording import listed, words

FINDINGS = 4  # of each kind


@dataclasses.dataclass(frozen=True)
class Findings:
    """Recognised faults.

    - `texts`: sentences that speak of ports.
    - `equations`: sets of equations that no sentence fits, with the fewer variables that they contain.
    - `more`: the number of equations too many that were found beside those.
    """

    texts: list[str]
    equations: list[tuple[np.ndarray, np.ndarray]]  # equations as written, and the fewer variables they contain
    more: int  # how many equations too many were found beside those


def recognise(flat: FlatModel, groups: tuple[EquationGroup, ...], alias: AliasTable) -> Findings:
    """Finds faults that are certain whatever the values are; `groups` and `alias` are those after alias elimination."""
    entries = entries_of(flat.groups, ~flat.variables.is_input)
    determined_by, twice = _known(entries, len(flat.variables))
    say = Explainer(flat, entries, determined_by)
    floating, afloat = _floating(flat, groups, alias)
    cycles = _loops(entries, determined_by)
    texts, equations = list(floating), []
    too_often: dict[tuple, list] = {}  # by kind and place: x and y of one joint are one fault
    for rows in [*([r] for r in sorted(twice)[:FINDINGS]), *cycles[:FINDINGS]]:
        rows, variables = say.behind(rows)
        kind = say.kind(rows, variables)
        if kind == "mixed":
            equations.append((rows, variables))
        # Where a network floats, its equations of flows depend on each other. That is the same fault, which has a
        # sentence.
        elif kind == "across" or not set(say.components(rows)) <= afloat:
            seen = too_often.setdefault((kind, *say.where(rows, variables)), [rows, variables, kind, []])
            seen[3].append(say.quantity(variables))
    # One sentence for a joint, with all quantities that it determines twice.
    for rows, variables, kind, quantities in too_often.values():
        texts.append(say.once_too_often(rows, variables, kind, list(dict.fromkeys(quantities))))
    if not texts:
        for rows in _cuts(flat, groups, alias, determined_by >= 0)[:FINDINGS]:
            sources = say.sources(rows, groups, alias)
            if sources:
                texts.append(sources)
    return Findings(list(dict.fromkeys(texts)), equations, max(len(twice) - FINDINGS, 0))


# --- known variables ---------------------------------------------------------------------------------------------


def _known(entries: Entries, n_variables: int) -> tuple[np.ndarray, list[int]]:
    """For each variable, the equation that determines it alone (−1: none); and the equations all of whose variables are
    known."""
    count = np.bincount(entries.row, minlength=entries.n_rows)
    # `bincount` adds weights as floating-point numbers, which are exact for integers up to 2⁵³.
    total = np.bincount(entries.row, np.arange(len(entries.row), dtype=float), entries.n_rows)
    determined_by = np.full(n_variables, -1, np.int64)
    twice = np.flatnonzero(count == 0).tolist()
    queue = collections.deque(np.flatnonzero(count == 1).tolist())
    if not queue:
        return determined_by, twice
    # Views, not lists: of a large model, few entries are looked at.
    by_variable = np.argsort(entries.variable, kind="stable").data
    start = np.append(0, np.cumsum(np.bincount(entries.variable, minlength=n_variables))).data
    row_of, variable_of, order_of = entries.row.data, entries.variable.data, entries.order.data
    # Once an equation has one unknown entry left, the sum of the numbers of its unknown entries is that entry: it need
    # not be searched for.
    left, last = count.data, np.rint(total).astype(np.int64).data  # the sum of the numbers of unknown entries
    while queue:
        row = queue.popleft()
        # An equation that is left with dx/dt determines x but for a constant.
        if left[row] != 1 or order_of[last[row]] != 0:
            continue
        variable = variable_of[last[row]]
        determined_by[variable] = row
        for k in by_variable[start[variable] : start[variable + 1]]:
            other = row_of[k]
            left[other] -= 1
            last[other] -= k
            if other != row and left[other] == 1:
                queue.append(other)
            elif other != row and left[other] == 0:
                twice.append(other)
    return determined_by, twice


# --- loops -------------------------------------------------------------------------------------------------------


def _loops(entries: Entries, determined_by: np.ndarray) -> list[list[int]]:
    """Circles of equations a ± b = known in which one follows from the others up to a constant."""
    open_ = entries.take(determined_by[entries.variable] < 0)
    count = np.bincount(open_.row, minlength=entries.n_rows)
    pairs = open_.take(count[open_.row] == 2)
    order = np.argsort(pairs.row, kind="stable")
    a, b = order[0::2], order[1::2]
    size = np.abs(pairs.coefficient)
    good = (
        (pairs.order[a] == 0) & (pairs.order[b] == 0) & (size[a] == size[b]) & (pairs.variable[a] != pairs.variable[b])
    )
    a, b = a[good], b[good]
    if not len(a):
        return []
    nodes, ends = np.unique(np.concatenate([pairs.variable[a], pairs.variable[b]]), return_inverse=True)
    n, m = len(nodes), len(a)
    u, v = ends[:m], ends[m:]
    opposite = pairs.coefficient[a] * pairs.coefficient[b] > 0  # a = −b + known
    # Two copies of every node, one for each sign: a part whose copies stay apart has signs that agree.
    copies = (np.concatenate([u, u + n]), np.concatenate([v + n * opposite, v + n * ~opposite]))
    _, label = connected_components(sp.coo_array((np.ones(2 * m), copies), shape=(2 * n, 2 * n)), directed=False)
    parts, part = connected_components(sp.coo_array((np.ones(m), (u, v)), shape=(n, n)), directed=False)
    balanced = np.zeros(parts, bool)
    balanced[part] = label[:n] != label[n:]
    # A tree has one edge less than nodes. Each further edge of a part closes a circle.
    surplus = np.bincount(part[u], minlength=parts) - np.bincount(part, minlength=parts) + 1
    found: list[list[int]] = []
    for p in np.flatnonzero(balanced & (surplus > 0)).tolist():
        inside = np.flatnonzero(part[u] == p)
        found.extend(_circles(u[inside].tolist(), v[inside].tolist(), pairs.row[a[inside]].tolist()))
        if len(found) >= FINDINGS:
            break
    return found


def _circles(u: list[int], v: list[int], rows: list[int]) -> list[list[int]]:
    """The first circles that edges close with those before them, each as the rows of a shortest way round."""
    parent: dict[int, int] = {}
    near: dict[int, list[tuple[int, int]]] = {}

    def find(x: int) -> int:
        while parent.setdefault(x, x) != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        return x

    found = []
    for a, b, row in zip(u, v, rows, strict=True):
        if find(a) == find(b):
            came: dict[int, tuple[int, int]] = {a: (a, -1)}
            queue = collections.deque([a])
            while b not in came:
                x = queue.popleft()
                for y, r in near.get(x, ()):
                    if y not in came:
                        came[y] = (x, r)
                        queue.append(y)
            path = [row]
            x = b
            while x != a:
                x, r = came[x]
                path.append(r)
            found.append(sorted(path))
            if len(found) == FINDINGS:
                break
            continue
        parent[find(b)] = find(a)
        near.setdefault(a, []).append((b, row))
        near.setdefault(b, []).append((a, row))
    return found


# --- cuts --------------------------------------------------------------------------------------------------------


def _cuts(flat: FlatModel, groups, alias: AliasTable, known: np.ndarray) -> list[np.ndarray]:
    """Sets of connections (equations after alias elimination) whose sum contains known flows alone."""
    is_known = np.zeros(len(flat.variables), bool)  # of roots
    plain = known & (alias.root != ZERO) & (alias.order == 0)
    is_known[alias.root[plain]] = True
    entries = entries_of(groups, ~flat.variables.is_input & ~is_known)
    connection = np.zeros(entries.n_rows, bool)
    first = 0
    for group in groups:
        if isinstance(group.template, LinearTemplate):
            unit = (np.abs(group.coefficient) == 1).all(axis=1) & (group.order == 0).all(axis=1)
            connection[first : first + len(group)] = unit & ~group.provenance.is_written
        first += len(group)
    inside = entries.take(connection[entries.row])
    rows, row = np.unique(inside.row, return_inverse=True)
    columns, column = np.unique(inside.variable, return_inverse=True)
    if not len(rows):
        return []
    n = len(rows)
    graph = sp.coo_array((np.ones(len(row)), (row, n + column)), shape=(n + len(columns),) * 2)
    parts, part = connected_components(graph, directed=False)
    closed = np.ones(parts, bool)
    sums = np.bincount(column, inside.coefficient, len(columns))
    closed[part[n:][sums != 0]] = False
    return [rows[part[:n] == p] for p in np.flatnonzero(closed)[:FINDINGS].tolist() if (part[:n] == p).any()]


# --- floating networks -------------------------------------------------------------------------------------------


def _floating(flat: FlatModel, groups, alias: AliasTable) -> tuple[list[str], set[str]]:
    """Networks whose across variables have no level: sentences, and the components concerned."""
    variables, ports = flat.variables, flat.ports
    texts, components = [], set()
    for k, (domain, name) in enumerate(variables.potentials):
        for island in _islands(flat, groups, alias, np.flatnonzero(variables.potential == k)):
            numbers = np.unique(variables.owner[island])
            owners = [flat.components[c] for c in numbers]
            loose = [ports.names[p] for p in np.unique(variables.port[island]) if ports.is_loose[p]]
            if len(owners) == 1 and len(loose) == len(island):
                whole = len(loose) == ports.count(int(numbers[0]))
                text = f"'{owners[0]}' is connected to nothing: connect {listed(loose)}"
                texts.append(text + (", or leave it out." if whole else "."))
            else:
                say = words(domain, [name])
                hint = f" ({listed(loose)} {'is' if len(loose) == 1 else 'are'} not connected)" if loose else ""
                texts.append(f"{say.floating.format(names=listed(owners))}. {say.mend}{hint}.")
            components.update(owners)
    return list(dict.fromkeys(texts)), components  # x and y of one frame float alike


def _islands(flat: FlatModel, groups, alias: AliasTable, members: np.ndarray) -> list[np.ndarray]:
    """The sets of across variables, all of one kind, that can be shifted together without any equation noticing."""
    n = len(flat.variables)
    shift, held = np.zeros(n), np.zeros(n, bool)
    plain = (alias.root[members] != ZERO) & (alias.order[members] == 0)
    root = alias.root[members]
    held[root[~plain & (root != ZERO)]] = True
    shift[root[plain]] = 1 / alias.factor[members[plain]]
    held[root[plain][shift[root[plain]] != 1 / alias.factor[members[plain]]]] = True
    held |= flat.variables.is_input
    rows, columns, first = [], [], 0
    moved = []  # whether an equation notices the shift
    for group in groups:
        weight = np.where(group.variable == ZERO, 0.0, shift[group.variable]) * group.factor
        i, k = np.nonzero(weight)
        rows.append(first + i)
        columns.append(group.variable[i, k])
        moved.append(~_invariant(group, weight))
        first += len(group)
    rows, columns = (np.concatenate(a) if a else np.zeros(0, np.int64) for a in (rows, columns))
    nodes = np.flatnonzero(shift)
    place = np.full(n, -1)
    place[nodes] = np.arange(len(nodes))
    total = first + len(nodes)
    graph = sp.coo_array((np.ones(len(rows)), (rows, first + place[columns])), shape=(total, total))
    parts, part = connected_components(graph, directed=False)
    fixed = np.zeros(parts, bool)
    if moved:
        fixed[part[:first][np.concatenate(moved)]] = True
    fixed[part[first:][held[nodes]]] = True
    afloat = np.unique(part[first:][~fixed[part[first:]]])
    if not len(afloat):
        return []
    part_of = np.full(len(members), -1)
    part_of[plain] = part[first + place[root[plain]]]
    found = [members[part_of == p] for p in afloat.tolist()]
    return sorted(found, key=lambda island: int(island[0]))


def _invariant(group: EquationGroup, weight: np.ndarray) -> np.ndarray:
    """True for instances whose residual stays the same when their slots move by weight·(a function of time), shape
    (instances,)."""
    out = ~(weight != 0).any(axis=1)
    rest = np.flatnonzero(~out)
    if not len(rest):
        return out
    unmoved = np.ones(len(rest), bool)
    for o in np.unique(group.order[rest]).tolist():  # a function of time and its derivatives move independently
        direction = np.where(group.order[rest] == o, weight[rest], 0.0)
        unmoved &= group.template.is_unmoved(direction, group.coefficient[rest])
    out[rest] = unmoved
    return out
