"""The pattern of the system's Jacobian: which entries of the state array each result can depend on.

Dependencies are propagated through the steps in the order of their evaluation. Every quantity has a row, the set of
entries of the state array it depends on; the unknowns of a block share one, the union of the rows the block reads. All
of a step's blocks are treated at once, so the work grows with the entries of the rows, not with the square of the
model.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...graph.structure.integers import distinct
from ...solve.linear.sparse import SparsePattern
from .schedule import AnyStep, SparseStep

LIMIT = 30_000_000  # entries of rows, above which the pattern counts as dense


class Scheduled(NamedTuple):
    """The part of a plan that its pattern follows from; the plan keeps the pattern, and imports this module."""

    n_quantities: int
    states: np.ndarray
    carried: np.ndarray
    steps: Sequence[AnyStep]
    corrected: Sequence[tuple[Sequence[int], np.ndarray]]  # finished rows, and the quantities that a correction reads

    @property
    def n_state(self) -> int:
        return len(self.states) + len(self.carried)


class TooDense(Exception):
    """The rows have more entries than is worth keeping."""


@dataclasses.dataclass(frozen=True)
class ColumnSets:
    """Sets of columns: row r is columns[pointer[r]:pointer[r + 1]]."""

    pointer: np.ndarray
    columns: np.ndarray

    def of(self, rows: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """The lengths of some rows, and their columns one row after the other; at most so many."""
        start = self.pointer[rows]
        length = self.pointer[rows + 1] - start
        # Before the columns are gathered: rows that are dense would take the memory that the limit is there to save.
        if int(length.sum()) > most:
            raise TooDense
        first = np.cumsum(length) - length
        return length, self.columns[np.repeat(start - first, length) + np.arange(int(length.sum()))]


class Dependencies:
    """The rows of all quantities computed so far. `refined` tells whether the tearing variables of nonlinear blocks are
    solved for (and depend on what their block reads) or read from the state array."""

    def __init__(self, plan: Scheduled, refined: bool):
        n = plan.n_quantities
        self.width = plan.n_state
        self.refined = refined
        self.place = np.zeros(n, np.int64)
        self.place[plan.carried] = len(plan.states) + np.arange(len(plan.carried))
        self.segment = np.full(n + 1, -1, np.int64)  # the last entry is the constant zero
        self.row = np.zeros(n + 1, np.int64)
        self.segments: list[ColumnSets] = []
        self.entries = 0
        self.residuals: list[ColumnSets] = []  # of nonlinear blocks, in the order of the algebraic unknowns
        # Segment 0, where row k is the set of k alone: what is read from the state array refers to it.
        single = ColumnSets(np.arange(self.width + 1), np.arange(self.width, dtype=np.int32))
        self._store(single, [plan.states])

    def _store(self, rows: ColumnSets, quantities: Sequence[np.ndarray]):
        self.entries += len(rows.columns)
        if self.entries > LIMIT:
            raise TooDense
        self.segments.append(rows)
        for quantity in quantities:
            self.segment[quantity] = len(self.segments) - 1
            self.row[quantity] = np.arange(len(quantity))

    def union(self, owner: np.ndarray, quantity: np.ndarray, n: int, own: Sequence[np.ndarray] = ()) -> ColumnSets:
        """n rows: row owner[k] contains the row of quantity[k]; `own` lists further columns, one for each row."""
        segment = self.segment[quantity]
        owners, columns = [], []
        for s in np.unique(segment[segment >= 0]).tolist():
            here = np.flatnonzero(segment == s)
            rows = self.segments[s]
            length, found = rows.of(self.row[quantity[here]], LIMIT - self.entries)
            columns.append(found)
            owners.append(np.repeat(owner[here], length))
        for column in own:
            columns.append(np.asarray(column, np.int32))
            owners.append(np.arange(n))
        if not columns:
            return ColumnSets(np.zeros(n + 1, np.int64), np.zeros(0, np.int32))
        # As single integers, which are sorted faster than pairs.
        key = distinct(np.concatenate(owners) * np.int64(self.width) + np.concatenate(columns))
        counts = np.bincount(key // self.width, minlength=n)
        return ColumnSets(np.concatenate([[0], np.cumsum(counts)]), (key % self.width).astype(np.int32))

    def of(self, quantity: np.ndarray) -> ColumnSets:
        """The rows of quantities."""
        return self.union(np.arange(len(quantity)), quantity, len(quantity))

    def add(self, step: AnyStep):
        """The rows of what a step computes."""
        if isinstance(step, SparseStep):
            return self._add_sparse(step)
        n = step.n
        sources = np.concatenate([e.outside.T for e in step.equations])
        quantity = sources.ravel()
        owner = np.tile(np.arange(n), len(sources))
        if not step.carried or self.refined:
            self._store(self.union(owner, quantity, n), step.unknown)
            return
        guessed = step.torn
        places = [self.place[quantities] for quantities in guessed]
        # The derivatives of what a block computes follow from those of its guesses, so both depend on the places of all
        # its guesses.
        rows = self.union(owner, quantity, n, places)
        self._store(rows, step.unknown)
        self.residuals.extend([rows] * len(guessed))
        for quantities, place in zip(guessed, places, strict=True):
            self.segment[quantities], self.row[quantities] = 0, place

    def _add_sparse(self, step: SparseStep):
        quantity = np.concatenate([e.quantity.T.ravel() for e in step.equations])
        if not step.carried or self.refined:
            pairs = zip(step.equations, step.equation_block, strict=True)
            owners = [np.tile(block, len(e.local)) for e, block in pairs]
            own = np.zeros(len(self.segment), bool)
            own[step.unknown[0]] = True
            outside = ~own[quantity]
            rows = self.union(np.concatenate(owners)[outside], quantity[outside], int(step.block.max()) + 1)
            self._store(rows, [])
            self.segment[step.unknown[0]], self.row[step.unknown[0]] = len(self.segments) - 1, step.block
            return
        self.segment[step.unknown[0]], self.row[step.unknown[0]] = 0, self.place[step.unknown[0]]
        first, owners = 0, []
        for equation in step.equations:
            n = len(equation.equation)
            owners.append(np.tile(first + np.arange(n), len(equation.local)))
            first += n
        self.residuals.append(self.union(np.concatenate(owners), quantity, step.n))


def entries(rows: Sequence[ColumnSets]) -> tuple[np.ndarray, np.ndarray]:
    """(rows, columns) of all entries, the rows numbered through."""
    first, out = 0, []
    for part in rows:
        n = len(part.pointer) - 1
        out.append((first + np.repeat(np.arange(n), np.diff(part.pointer)), part.columns))
        first += n
    if not out:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate([r for r, _ in out]), np.concatenate([c for _, c in out]).astype(np.int64)


def unique_entries(rows: np.ndarray, columns: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The places, each once, by row."""
    key = distinct(rows.astype(np.int64) * width + columns)
    return key // max(1, width), key % max(1, width)


def field_pattern(plan: Scheduled) -> SparsePattern | None:
    """The pattern of the vector field's Jacobian, shape (n_state, n_state), at a consistent state; None if dense."""
    try:
        dependencies = Dependencies(plan, refined=True)
        slopes = field_rows(dependencies, plan)
        rows, columns = entries([slopes])
        more = rate_entries(dependencies, slopes, plan.carried, len(plan.states))
    except TooDense:
        return None
    rows, columns = np.concatenate([rows, len(plan.states) + more[0]]), np.concatenate([columns, more[1]])
    return SparsePattern(rows, columns, plan.n_state)


def dae_pattern(plan: Scheduled) -> SparsePattern | None:
    """The pattern of the Jacobian of [f(t, x, z); g(t, x, z)] with respect to the state array [x, z]: the states'
    derivatives with z as it stands in the array, then the residuals of nonlinear blocks. None if dense."""
    try:
        dependencies = Dependencies(plan, refined=False)
        slopes = field_rows(dependencies, plan)
    except TooDense:
        return None
    return SparsePattern(*entries([slopes, *dependencies.residuals]), plan.n_state)


def field_rows(dependencies: Dependencies, plan: Scheduled) -> ColumnSets:
    """The rows of the states' derivatives."""
    for step in plan.steps:
        dependencies.add(step)
    rows = dependencies.of(plan.states + 1)
    if not plan.corrected:
        return rows
    places, columns = entries([rows])
    for corrected, quantities in plan.corrected:
        read = distinct(dependencies.of(quantities).columns)
        places = np.concatenate([places, np.repeat(np.array(corrected, np.int64), len(read))])
        columns = np.concatenate([columns, np.tile(read, len(corrected))])
    places, columns = unique_entries(places, columns, dependencies.width)
    counts = np.bincount(places, minlength=len(plan.states))
    return ColumnSets(np.concatenate([[0], np.cumsum(counts)]), columns.astype(np.int32))


def rate_entries(
    dependencies: Dependencies, slopes: ColumnSets, carried: np.ndarray, n_states: int
) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the derivatives of the algebraic unknowns: dz/dt = −(∂g/∂z)⁻¹(∂g/∂t + ∂g/∂x·dx/dt) depends on the
    states its block reads, and on what their derivatives depend on."""
    direct = entries([dependencies.of(carried)])
    inside = direct[1] < n_states
    length, through = slopes.of(direct[1][inside], LIMIT)
    rows = np.concatenate([direct[0], np.repeat(direct[0][inside], length)])
    columns = np.concatenate([direct[1], through])
    return unique_entries(rows, columns, dependencies.width)
