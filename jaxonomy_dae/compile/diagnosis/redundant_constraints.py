"""Constraints that depend on each other at a point: a loop of a mechanism that is closed twice, and the like.

Given a compiled model and a consistent point, returns which constraints depend on each other: where their Jacobian G
lacks rank. For every combination u of rows with uᵀG = 0 there are two cases, told apart by the second derivative along
the directions v that G leaves free (Gv = 0):

- *redundant*: the constraint uᵀg changes only in the third order along all of them, (uᵀ·∂G[v])·v' = 0. It follows from
  the others wherever the parts move, and the forces of these constraints are not determined;
- *singular*: it changes in the second order. The constraints depend on each other here, as where parts are in line, and
  not nearby.

Alias elimination has removed the equations of many joints. Which of these pass u on from one constraint to the next is
read off a graph: they are the edges of trees of equal variables, with what u demands at the nodes.
"""

import collections
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ...base.tolerances import HALF_OF_THE_DIGITS, KNOWN, NO_PART, UNCHANGED
from ...graph.judgement.rank import DECOMPOSED_UPTO, above_errors, rank_of
from ...graph.judgement.scaling import equilibrated
from ...solve.linear.sparse_least_squares import SparseLeastSquares
from ..model.constraint_jacobian import (
    ConstraintEntries,
    constraint_entries,
    gathered,
    independent_parts,
    values_and_errors,
)
from ..model.group import Point
from ..model.linear_template import LinearTemplate
from ..model.provenance import Provenance
from ..model.quantities import ReducedModel
from ..model.tables import ZERO, AliasTable, FlatModel, equation_offsets, provenance_of
from ..model.typical_sizes import typical_sizes
from .wording import listed, words

WHOLE = DECOMPOSED_UPTO  # constraints of a part in which those that depend on each other are not sought first
SAMPLES = 4  # random directions of a larger part that stand for all: what none of them sees has probability zero
NO_SHARE = 1e-4  # of the largest, in a random vector for which uᵀG is zero to some six digits: no part of any such u
MECHANICAL = ("Planar", "Translational", "Rotational")
SHOWN = 12  # names
YIELDS = "or replace one by a part that yields, such as a spring"


@dataclasses.dataclass(frozen=True)
class ModelAt:
    """A model, and the values of all its quantities at a point."""

    model: ReducedModel
    settled: np.ndarray  # quantities that equations determine without any state
    point: Point

    @functools.cached_property
    def error_sizes(self) -> np.ndarray:
        """The sizes to whose rounding all quantities are known."""
        return typical_sizes(self.model, self.point.parameters)


@dataclasses.dataclass(frozen=True)
class DependentConstraints:
    """A set of constraints that depend on each other: the components that write them, how many of them follow from the
    others, and whether they do so everywhere, or only at this point."""

    components: tuple[str, ...]
    count: int
    is_redundant: bool
    forces: str  # what they leave open

    def __str__(self):
        names = listed(self.components, SHOWN)
        if not self.is_redundant:
            return (
                f"at this point the constraints of {names} depend on each other, though not nearby (as where parts are "
                "in line): it does not determine how they go on. Start elsewhere, with `initial={...}` or other "
                "parameters."
            )
        follow = "one of them follows" if self.count == 1 else f"{self.count} of them follow"
        mechanical = self.forces == "forces"
        mend = f", {YIELDS}" if mechanical else ""
        return (
            f"the constraints of {names} depend on each other: {follow} from the others in every position, so nothing "
            f"determines how they share their {self.forces}. Take one of these components out{mend}."
        )


def dependent_constraints(at: ModelAt) -> list[DependentConstraints]:
    """The constraints that depend on each other at the point, redundant ones first."""
    entries, parts = _parts(at)
    found = []
    for rows, members in parts:
        found += _of_part(at, entries.take(members), rows)
    return sorted(found, key=lambda f: not f.is_redundant)


def _parts(at: ModelAt) -> tuple[ConstraintEntries, list[tuple[np.ndarray, np.ndarray]]]:
    quantities = at.model.extended.quantities
    entries = constraint_entries(at.model.groups, at.model.extended)
    entries = entries.take(~np.isin(entries.column, quantities.owner[at.settled]))
    n_rows = equation_offsets(at.model.groups)[-1]
    shape = (int(n_rows), quantities.n_unknown_columns)
    return entries, independent_parts(entries, np.unique(entries.row), shape)


def _of_part(at: ModelAt, entries: ConstraintEntries, rows: np.ndarray) -> list[DependentConstraints]:
    columns = np.unique(entries.column)
    quantities = at.model.extended.quantities
    c = np.bincount(at.model.extended.base) - 1
    if len(np.unique(c[rows])) > 1:
        return []  # constraints of several orders: their Jacobian is no derivative by one set of quantities
    # The quantities that constraints restrict: those below the highest derivative by as many orders as they are
    # differentiated.
    position = quantities.first[columns] + quantities.highest[columns] - c[rows[0]]
    sampled = None
    if len(rows) > WHOLE:
        rows, sampled = _sampled(at, entries, rows, columns)
        entries = entries.take(np.isin(entries.row, rows))
        if not len(rows):
            return []
    place = (np.searchsorted(rows, entries.row), np.searchsorted(columns, entries.column))

    def matrix_of(numbers: np.ndarray) -> sp.csr_array:
        return sp.csr_array((numbers, place), shape=(len(rows), len(columns)))

    where = at.model.groups, at.model.extended, entries
    matrix, bounds = map(matrix_of, _values_and_errors(at, entries))
    if not np.isfinite(matrix.data).all():
        return []
    if sampled is None or len(rows) <= DECOMPOSED_UPTO:
        rank = rank_of(matrix.toarray(), bounds.toarray())
        # A constant Jacobian has all digits of its entries. Any other one is taken at a point that is known to half of
        # the digits, and singular values of rows that depend on each other are no smaller.
        number = rank.number if entries.constant.all() else int((rank.s > HALF_OF_THE_DIGITS * rank.s[0]).sum())
        row_scale, column_scale, left, right = rank.r, rank.c, rank.u[:, number:], rank.vt[number:].T
        right = right if sampled is None else sampled.right / column_scale[:, None]
    else:
        row_scale, column_scale, left = sampled.row_scale, sampled.column_scale, sampled.left
        right = sampled.right / column_scale[:, None]
    matrix = above_errors(matrix, bounds)  # sin(1e-17) is zero
    if not left.shape[1]:
        return []
    changed = np.zeros((left.shape[1], right.shape[1], right.shape[1]))
    size = np.zeros_like(changed)
    for k in range(right.shape[1]):
        move = np.zeros(at.model.extended.quantities.n + 1)
        move[position] = column_scale * right[:, k]
        rates = gathered(*where, lambda group, move=move: group.partials_along(at.point, move))
        slope: Any = sp.diags_array(row_scale) @ matrix_of(rates) @ sp.diags_array(column_scale)
        if not np.isfinite(slope.data).all():
            return []
        changed[:, k] = left.T @ (slope @ right)
        size[:, k] = np.abs(left.T) @ (abs(slope) @ np.abs(right))
    kept, still = _unchanged(changed.reshape(len(changed), -1), float(size.max(initial=0.0)))
    found = []
    for basis, is_redundant in ((left @ still, True), (left @ kept, False)):
        for support in _connected(basis, matrix):
            count = int(np.linalg.matrix_rank(basis[support], tol=NO_PART))
            weight = row_scale[support, None] * basis[support]
            names, forces = _behind(at, rows[support], weight)
            if names:
                found.append(DependentConstraints(names, count, is_redundant, forces))
    return found


def _values_and_errors(at: ModelAt, entries: ConstraintEntries) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the Jacobian, and bounds of their errors."""
    known = KNOWN * (np.abs(at.point.values) + np.append(at.error_sizes, 0.0))
    return values_and_errors(at.model.groups, at.model.extended, entries, at.point, known)


class _Sampled(NamedTuple):
    """The scales of rows and columns of a Jacobian G, a basis of the combinations u with uᵀG = 0, shape (rows, k), and
    random directions v with Gv = 0, shape (columns, samples); u in scaled rows, v in the units of the columns."""

    row_scale: np.ndarray
    column_scale: np.ndarray
    left: np.ndarray
    right: np.ndarray


def _sampled(
    at: ModelAt, entries: ConstraintEntries, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, _Sampled]:
    """The constraints of a large part that some combination u with uᵀG = 0 contains, and these combinations. They are
    what least squares leave of random vectors. Vectors are added until one more of them tells nothing new."""
    place = (np.searchsorted(rows, entries.row), np.searchsorted(columns, entries.column))
    shape = len(rows), len(columns)
    values, errors = (sp.csr_array((v, place), shape=shape) for v in _values_and_errors(at, entries))
    jacobian = sp.csr_array(above_errors(values, errors))
    if not np.isfinite(jacobian.data).all():
        return rows[:0], _Sampled(*(np.zeros((0, 0)),) * 4)
    scaled, row_scale, unit = equilibrated(jacobian)
    rng = np.random.default_rng(0)

    def left_of(matrix: Any, count: int) -> np.ndarray:
        solver, left = SparseLeastSquares(matrix), rng.normal(size=(matrix.shape[0], count))
        for _ in range(2):  # the first time to some six digits
            left = left - np.stack([matrix @ solver.solve(u) for u in left.T], axis=1)
        return left

    left, count = left_of(scaled, SAMPLES), SAMPLES
    while (number := int((np.linalg.svd(left, compute_uv=False) > NO_SHARE).sum())) == count < shape[0]:
        count *= 2
        left = left_of(scaled, count)
    right = unit[:, None] * left_of(scaled.T, SAMPLES)
    kept = np.abs(left).max(axis=1) > NO_SHARE
    basis = np.linalg.svd(left[kept], full_matrices=False)[0][:, :number]
    return rows[kept], _Sampled(row_scale[kept], unit, basis, right)


def _unchanged(changed: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Combinations of rows: those that are not zero, and those that are; as columns."""
    u, s, _ = np.linalg.svd(changed)
    s = np.append(s, np.zeros(max(0, len(u) - len(s))))[: len(u)]
    zero = s <= UNCHANGED * size
    return u[:, ~zero], u[:, zero]


def _connected(basis: np.ndarray, matrix: Any) -> list[np.ndarray]:
    """The rows of a basis that are not zero, in sets that share no column of the matrix."""
    support = np.flatnonzero(np.abs(basis).max(axis=1, initial=0.0) > NO_PART)
    if not len(support):
        return []
    row, column = matrix[support].nonzero()
    n, m = len(support), matrix.shape[1]
    graph = sp.coo_array((np.ones(len(row)), (row, n + column)), shape=(n + m, n + m))
    _, label = connected_components(graph, directed=False)
    return [support[label[:n] == k] for k in dict.fromkeys(label[:n].tolist())]


# --- who wrote them ----------------------------------------------------------------------------------------------


def _behind(at: ModelAt, equations: np.ndarray, weight: np.ndarray) -> tuple[tuple[str, ...], str]:
    """The components that a combination of equations goes through, and what their ports call forces.

    `weight` has a column for each of the combinations.
    """
    flat = at.model.flat
    wanted: dict[tuple[str, str], list[np.ndarray]] = {}
    names: set[str] = set()
    for equation, w in zip(equations.tolist(), weight, strict=True):
        source = provenance_of(at.model.groups, equation)
        for one in source.sources or (source,):
            wanted.setdefault((one.component, one.statement), []).append(w)
            names.add(one.component)
    demand = _demands(at, wanted)
    # Many joints are in no constraint any more: alias elimination has removed their equations.
    names |= _ties(flat, at.model.alias, demand)
    ports = np.unique(flat.variables.port[list(demand)]) if demand else np.zeros(0, np.int64)
    domains = {flat.ports.domains[p] for p in ports.tolist() if p >= 0}
    mechanical = not domains or domains & {*MECHANICAL}
    forces = "forces" if mechanical else f"{words(sorted(domains)[0]).through}s"
    return _named(flat, names), forces


def _only_holds(flat: FlatModel, component: str) -> bool:
    return flat.ports.count(flat.components.index(component)) == 1


def _composites(components: list[str]) -> tuple[str, ...]:
    """Parts of one component under its name, as long as more than one name is left."""
    parents = collections.Counter(c.rpartition(".")[0] for c in components)
    found = dict.fromkeys(
        parent if parent and parents[parent] > 1 else c for c in components for parent in [c.rpartition(".")[0]]
    )
    return tuple(found) if len(found) > 1 else tuple(components)


def _demands(at: ModelAt, wanted: dict[tuple[str, str], list[np.ndarray]]) -> dict[int, np.ndarray]:
    """Σ weight·∂(equation)/∂(variable) of every variable as written, where it is not zero."""
    quantity, factor = at.model.variables.quantity, at.model.variables.factor
    padded = at.point.values
    values = np.where(quantity >= ZERO, padded[np.maximum(quantity, ZERO)], np.nan) * factor
    there = at.point.at(values)  # by variables, as equations are written
    out: dict[int, np.ndarray] = {}
    for group in at.model.flat.groups:
        for i, source in enumerate(group.provenance):
            for w in wanted.get((source.component, source.statement), ())[:1]:
                slopes = group.reading(group.variable).take([i]).partials(there)
                for v, slope in zip(group.variable[i].tolist(), slopes[0].tolist(), strict=True):
                    if v != ZERO:
                        out[v] = out.get(v, 0.0) + slope * w
    return {v: d for v, d in out.items() if np.isfinite(d).all() and np.abs(d).max() > 0}


def _ties(flat: FlatModel, alias: AliasTable, demand: dict[int, np.ndarray]) -> set[str]:
    """The components of equations a = ±b through which demands reach each other, or what holds."""
    trees = {int(alias.root[v]) for v in demand}
    edges: list[tuple[str, list[tuple[int, float]]]] = []  # the component, and the ends with their coefficients
    at: dict[int, list[int]] = {}
    for group in flat.groups:
        if not isinstance(group.template, LinearTemplate) and group.variable.shape[1] != 1:
            continue
        for i in np.flatnonzero(np.isin(alias.root[group.variable], list(trees)).all(axis=1)).tolist():
            variables, orders = group.variable[i].tolist(), group.order[i]
            if len(variables) > 2 or orders.any() or len({int(alias.root[v]) for v in variables}) > 1:
                continue
            linear = isinstance(group.template, LinearTemplate)
            slopes = (group.coefficient[i] if linear else np.ones(1)) * group.factor[i]
            for v in variables:
                at.setdefault(v, []).append(len(edges))
            edges.append((group.provenance[i].component, list(zip(variables, slopes.tolist(), strict=True))))
    left = {v: np.array(d) for v, d in demand.items()}
    scale = max(float(np.abs(d).max()) for d in demand.values()) if demand else 1.0
    open_ = {v: set(numbers) for v, numbers in at.items()}
    # From the leaves inwards: the one edge that is left at a leaf must carry all that is demanded there. Edges in
    # circles are never reached, because nothing says how they share it.
    queue = collections.deque(v for v, numbers in open_.items() if len(numbers) == 1)
    names = set()
    while queue:
        v = queue.popleft()
        if len(open_[v]) != 1:
            continue
        (number,) = open_[v]
        component, ends = edges[number]
        own = dict(ends)[v]
        passed = -left.pop(v, np.zeros(1)) / own
        if component and np.abs(passed).max() > NO_PART * scale:
            names.add(component)
        open_[v].clear()
        for other, slope in ends:
            if other != v:
                left[other] = left.get(other, 0.0) + passed * slope
                open_[other].discard(number)
                if len(open_[other]) == 1:
                    queue.append(other)
    return names


def behind(flat: FlatModel, alias: AliasTable, equations: Sequence[Provenance]) -> tuple[str, ...]:
    """The components that wrote these equations, and those through which they reach each other; what only holds is
    left out."""
    wanted = {(e.component, e.statement) for one in equations for e in one.sources or (one,)}
    random = np.random.default_rng(0)
    demand: dict[int, np.ndarray] = {}
    for group in flat.groups:
        for source, variables in zip(group.provenance, group.variable.tolist(), strict=True):
            if (source.component, source.statement) in wanted:
                # Equal demands of opposite signs would cancel where they meet in a tree, and hide the components
                # beyond.
                demand.update((v, random.uniform(0.5, 1.5, 1)) for v in variables if v != ZERO and v not in demand)
    names = {component for component, _ in wanted} | _ties(flat, alias, demand)
    return _named(flat, names)


def _named(flat: FlatModel, names: set[str]) -> tuple[str, ...]:
    """The components in the order of the model, without those that only hold others, and with the parts of one
    component under its name."""
    components = [c for c in flat.components if c in names]
    return _composites([c for c in components if not _only_holds(flat, c)] or components)


def no_freedom(at: ModelAt) -> list[tuple[str, ...]]:
    """Components of parts in which there are as many constraints as variables they restrict."""
    entries, parts = _parts(at)
    found = []
    for rows, members in parts:
        inside = entries.take(members)
        if len(rows) == len(np.unique(inside.column)) and not inside.constant.all():
            equations = [provenance_of(at.model.groups, r) for r in rows.tolist()]
            found.append(behind(at.model.flat, at.model.alias, equations))
    return found


def too_many(flat: FlatModel, alias: AliasTable, equations: Sequence[Provenance], variables: np.ndarray) -> str:
    """The sentence on mechanical constraints that are more than the positions they determine; "" if they are something
    else.

    `variables` are those that the equations determine, and their aliases.
    """
    port = flat.variables.port[variables]
    at_ports = variables[port >= 0]
    domains = {flat.ports.domains[p] for p in port[port >= 0].tolist()}
    names = behind(flat, alias, equations)
    if not len(at_ports) or not flat.variables.is_across[at_ports].all() or not domains <= {*MECHANICAL}:
        return ""
    if len(names) < 2:
        return ""
    return (
        f"the constraints of {listed(names, SHOWN)} determine the same positions more than once: they repeat each "
        "other, so that nothing determines how they share their forces, or contradict each other. Take one of these "
        f"components out, {YIELDS}."
    )
