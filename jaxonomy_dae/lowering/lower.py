"""Lowering: the compiler's tables become the static plan of an `AcausalSystem`."""

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..compiler.extend import Extended, ExtendedGroup
from ..compiler.order_blocks import Blocks
from ..compiler.select_states import StateSelection
from ..compiler.tables import ZERO, AliasTable, EquationGroup, FlatModel, RowInjection
from ..compiler.templates import OpaqueFunction
from ..errors import ModelError, nearest
from ..solvers.sparse import SparsePattern
from . import pattern
from .evaluate import check_solvable
from .gather import Gather
from .program import Layout, Program, plan
from .schedule import TORN, AnyStep, SparseStep, build_schedule


@dataclasses.dataclass(frozen=True)
class ConstraintGroup:
    """Residuals of one template to project onto, read from a program's results."""

    group: ExtendedGroup
    slots: tuple[Gather, ...]


@dataclasses.dataclass(frozen=True)
class PlannedRow:
    """A correction added to finished rows of the right-hand side."""

    opaque: OpaqueFunction
    rows: tuple[int, ...]
    inputs: tuple[Gather, ...]
    sign: tuple[int, ...]
    quantities: np.ndarray  # of the inputs


@dataclasses.dataclass(frozen=True)
class InputTable:
    """Which inputs the model has; quantities are listed as (input, order)."""

    names: list[str]
    defaults: list[float | None]
    quantities: list[tuple[int, int]]


@dataclasses.dataclass(frozen=True)
class SystemPlan:
    """All that is static about a compiled system; compared and hashed by its digest."""

    digest: str
    flat: FlatModel
    alias: AliasTable
    groups: tuple[EquationGroup, ...]
    extended: Extended
    selection: StateSelection
    steps: tuple[AnyStep, ...]
    blocks: Blocks
    mode: str

    variable_index: dict[str, int]
    quantity_name: list[str]
    states: np.ndarray  # quantities in the state array …
    carried: np.ndarray  # … followed by the tearing variables of nonlinear blocks
    nominal: np.ndarray  # of the state array
    inputs: InputTable
    derivative: Program
    next_derivative: Gather
    carried_rates: Gather | None  # where the model itself has the derivatives of all `carried`
    everything: Program
    carried_residuals: Program
    constraint_program: Program
    constraints: tuple[ConstraintGroup, ...]
    constraint_pattern: tuple[frozenset[int], ...] | None
    rows: tuple[PlannedRow, ...]
    network_names: tuple[str, ...]
    functions: tuple[Any, ...]

    def __eq__(self, other):
        return isinstance(other, SystemPlan) and self.digest == other.digest and self.functions == other.functions

    def __hash__(self):
        return hash(self.digest)

    @property
    def n_state(self) -> int:
        return len(self.states) + len(self.carried)

    @property
    def n_constraints(self) -> int:
        return len(self.selection.constraints)

    @functools.cached_property
    def jacobian_pattern(self) -> SparsePattern | None:
        """Where ∂(vector field)/∂(state) can be nonzero at a consistent state, shape (n_state, n_state); None if it has
        too many places to list."""
        return pattern.field_pattern(self)

    @functools.cached_property
    def dae_pattern(self) -> SparsePattern | None:
        """Where the Jacobian of [f(t, x, z); g(t, x, z)] with respect to the state array [x, z] can be nonzero: the
        states' derivatives with z read from the array, not refined, then the residuals of the nonlinear blocks. Sorted
        by row, each place once; None if there are too many to list."""
        return pattern.dae_pattern(self)

    @functools.cached_property
    def carried_pattern(self) -> SparsePattern | None:
        """Where ∂g/∂z can be nonzero, if there are so many algebraic unknowns z that it matters."""
        if len(self.carried) <= TORN or self.dae_pattern is None:
            return None
        n, found = len(self.states), self.dae_pattern
        inside = (found.rows >= n) & (found.cols >= n)
        return SparsePattern(found.rows[inside] - n, found.cols[inside] - n, len(self.carried))

    def quantity_of(self, variable: int) -> tuple[int, int]:
        """(quantity, sign) of a variable; quantity ZERO if it is identically zero."""
        root = int(self.alias.root[variable])
        if root == ZERO:
            return ZERO, 0
        quantities = self.extended.quantities
        return int(quantities.first[quantities.column[root]] + self.alias.order[variable]), int(
            self.alias.sign[variable]
        )

    @property
    def visible_variables(self) -> list[str]:
        """The names a user may read: all but those made for corrected derivatives."""
        return [n for n in self.flat.variables.names if ":" not in n]

    def resolve(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """(quantities, signs) of variables by name; `"der(name)"` is accepted where the model has that derivative."""
        quantity, sign = [], []
        for name in names:
            order, inner = 0, name
            while inner.startswith("der(") and inner.endswith(")"):
                order, inner = order + 1, inner[4:-1]
            if inner not in self.variable_index:
                raise ModelError(f"'{name}' is no variable: " + nearest(inner, self.visible_variables))
            q, s = self.quantity_of(self.variable_index[inner])
            if q != ZERO and order:
                quantities = self.extended.quantities
                if quantities.order[q] + order > quantities.highest[quantities.owner[q]]:
                    raise ModelError(f"'{name}' occurs nowhere in the model: only '{inner}' does")
            quantity.append(q if q == ZERO else q + order)
            sign.append(s)
        return np.array(quantity, np.int64), np.array(sign, np.int64)


def _needed(steps: Sequence[AnyStep], targets: np.ndarray, n: int) -> tuple[AnyStep, ...]:
    """The steps on which the target quantities depend, in order."""
    wanted = np.zeros(n, bool)
    wanted[targets[targets != ZERO]] = True
    kept = []
    for step in reversed(steps):
        if any(wanted[q].any() for q in step.unknown):
            kept.append(step)
            needs = step.needs()
            wanted[needs[needs != ZERO]] = True
    return tuple(reversed(kept))


def lower(
    flat: FlatModel,
    alias: AliasTable,
    groups: tuple[EquationGroup, ...],
    extended: Extended,
    selection: StateSelection,
    blocks: Blocks,
    mode: str,
    quantity_name: list[str],
    state_order: np.ndarray,
) -> SystemPlan:
    """Builds the plan; `state_order` lists the selected states as they will lie in the state array."""
    quantities = extended.quantities
    n = quantities.n
    steps = build_schedule(extended, blocks)
    for step in steps:
        if isinstance(step, SparseStep):
            check_solvable(step.n)
    carried = [quantities for step in steps for quantities in step.guessed]
    carried = np.concatenate(carried) if carried else np.zeros(0, np.int64)
    input_quantities = np.arange(quantities.n_unknown, n)

    def program(chosen: Sequence[AnyStep]) -> Program:
        return plan(chosen, state_order, input_quantities, n, carried)

    nonlinear = [s for s in steps if s.carried]
    residual_needs = np.concatenate([np.zeros(0, np.int64), *(s.needs() for s in nonlinear)])
    upstream = _needed(steps, residual_needs, n)
    keep = {id(s) for s in (*upstream, *nonlinear)}
    for_residuals = [s for s in steps if id(s) in keep]
    carried_residuals = program(for_residuals)

    constraint_groups, constraint_slots, constraint_pattern = _constraints(extended, selection, state_order)
    constraint_program = program(_needed(steps, constraint_slots, n))
    planned_constraints = tuple(
        ConstraintGroup(
            g,
            tuple(constraint_program.layout.gather(g.quantity[:, k], g.sign[:, k]) for k in range(g.quantity.shape[1])),
        )
        for g in constraint_groups
    )

    everything = program(steps)
    row_inputs = _row_input_quantities(flat, alias, extended)
    following = state_order + 1
    rates = carried + 1 if _rates_hold(flat, alias, extended, for_residuals, carried) else carried[:0]
    derivative = program(_needed(steps, np.concatenate([following, rates, *(q for q, _ in row_inputs)]), n))
    rows = tuple(
        _plan_row(row, inputs, flat, alias, extended, state_order, derivative.layout)
        for row, inputs in zip(flat.rows, row_inputs, strict=True)
    )

    columns = quantities.owner[input_quantities]
    roots = quantities.variable[columns]
    input_roots = list(dict.fromkeys(roots.tolist()))
    variables = flat.variables
    for v in np.flatnonzero(variables.is_input).tolist():
        if v not in input_roots:
            input_roots.append(v)  # declared but unused: still a name `simulate` accepts
    inputs = InputTable(
        [variables.names[v] for v in input_roots],
        [variables.default[v] for v in input_roots],
        [(input_roots.index(int(v)), int(o)) for v, o in zip(roots, quantities.order[input_quantities], strict=True)],
    )
    in_state = np.concatenate([state_order, carried])
    opaque = {g.template.opaque.index: g.template.opaque for g in extended.groups if g.template.opaque is not None}
    opaque |= {r.opaque.index: r.opaque for r in flat.rows}
    functions = tuple(opaque[k].function if k in opaque else None for k in range(len(flat.networks)))
    return SystemPlan(
        _digest(flat, mode, selection, state_order, extended),
        flat,
        alias,
        groups,
        extended,
        selection,
        steps,
        blocks,
        mode,
        {name: k for k, name in enumerate(variables.names)},
        quantity_name,
        state_order,
        carried,
        quantity_scale(flat, alias, extended)[in_state],
        inputs,
        derivative,
        derivative.layout.gather(following) if len(following) else Gather(*(np.zeros(0, np.int64),) * 3),
        derivative.layout.gather(rates) if len(rates) else None,
        everything,
        carried_residuals,
        constraint_program,
        planned_constraints,
        constraint_pattern,
        rows,
        tuple(flat.networks),
        functions,
    )


def _rates_hold(
    flat: FlatModel, alias: AliasTable, extended: Extended, residuals: Sequence[AnyStep], carried: np.ndarray
) -> bool:
    """Whether the derivatives of all carried unknowns are quantities of the model, untouched by row injection."""
    quantities = extended.quantities
    if not len(carried) or not (quantities.order[carried] < quantities.highest[quantities.owner[carried]]).all():
        return False
    read = np.concatenate([step.needs() for step in residuals])
    targets = [v for row in flat.rows for v in row.targets]
    injected = quantities.first[quantities.column[alias.root[targets]]] + alias.order[targets] if targets else []
    return not np.isin(injected, read).any()


def quantity_scale(flat: FlatModel, alias: AliasTable, extended: Extended) -> np.ndarray:
    """The nominal value of every quantity: the largest that a variable which equals it declares, else 1."""
    quantities = extended.quantities
    scale = np.zeros(quantities.n)
    known = alias.root != ZERO
    known[known] = quantities.column[alias.root[known]] >= 0
    v = np.flatnonzero(known)
    q = quantities.first[quantities.column[alias.root[v]]] + alias.order[v]
    inside = alias.order[v] <= quantities.highest[quantities.column[alias.root[v]]]
    np.maximum.at(scale, q[inside], flat.variables.nominal[v[inside]])
    return np.where(scale == 0, 1.0, scale)


def _constraints(extended: Extended, selection: StateSelection, states: np.ndarray):
    """The constraint equations by group, the quantities they read, and which states each depends on (if on states
    alone)."""
    wanted = np.zeros(extended.n_equations, bool)
    wanted[selection.constraints] = True
    position = {int(q): k for k, q in enumerate(states)}
    groups, slots = [], []
    pattern: list[frozenset[int]] | None = []
    for group in extended.groups:
        rows = np.flatnonzero(wanted[group.equation])
        if not len(rows):
            continue
        taken = ExtendedGroup(
            group.template,
            group.equation[rows],
            group.base[rows],
            group.level,
            group.quantity[rows],
            group.sign[rows],
            group.parameter[rows],
            group.coefficient[rows],
        )
        groups.append(taken)
        slots.append(taken.quantity.ravel())
        for row in taken.quantity.tolist():
            used = [q for q in row if q != ZERO and q < extended.quantities.n_unknown]
            if pattern is not None and all(q in position for q in used):
                pattern.append(frozenset(position[q] for q in used))
            else:
                pattern = None
    joined = np.concatenate(slots) if slots else np.zeros(0, np.int64)
    return groups, joined, None if pattern is None else tuple(pattern)


def _row_input_quantities(flat: FlatModel, alias: AliasTable, extended: Extended):
    quantities = extended.quantities
    out = []
    for row in flat.rows:
        v = np.array(row.inputs, np.int64)
        root = alias.root[v]
        column = np.where(root == ZERO, 0, quantities.column[root])
        out.append((np.where(root == ZERO, ZERO, quantities.first[column] + alias.order[v]), alias.sign[v]))
    return out


def _plan_row(row: RowInjection, inputs, flat, alias, extended, states, layout: Layout) -> PlannedRow:
    quantities = extended.quantities
    position = {int(q): k for k, q in enumerate(states)}
    rows, signs = [], []
    for v in row.targets:
        q = int(quantities.first[quantities.column[alias.root[v]]] + alias.order[v])
        rows.append(position[q])
        signs.append(int(alias.sign[v]))
    gathers = tuple(layout.gather(np.array([q]), np.array([s])) for q, s in zip(*inputs, strict=True))
    return PlannedRow(row.opaque, tuple(rows), gathers, tuple(signs), inputs[0])


def _digest(flat: FlatModel, mode: str, selection: StateSelection, states: np.ndarray, extended: Extended) -> str:
    """A digest of all that determines the plan."""
    hasher = hashlib.sha256()

    def feed(*parts: Any):
        for part in parts:
            hasher.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
            hasher.update(b"|")

    v = flat.variables
    starts = [None if s is None else (s.template.key, s.parameters) for s in v.start]
    feed(mode, v.names, v.is_input, v.fixed, v.nominal, v.default, starts, flat.parameters.names)
    for g in flat.groups:
        feed(g.template.key, g.variable, g.order, g.sign, g.parameter, g.coefficient)
    for name in flat.networks:
        feed(name)
    for row in flat.rows:
        feed(row.opaque.index, row.targets, row.inputs, sorted(row.opaque.time_positions))
    feed(states, selection.constraints, selection.dummies, extended.base, extended.level)
    return hasher.hexdigest()
