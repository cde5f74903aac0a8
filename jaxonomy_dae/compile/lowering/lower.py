"""Lowering: the compiler's tables become the static plan of an `AcausalSystem`."""

import dataclasses
from collections.abc import Sequence

import lineax as lx
import numpy as np

from ...solve.linear.sparse import check_solvable
from ..model.declared import leading_starts, quantity_scale
from ..model.extended import Extended
from ..model.quantities import QuantityMap
from ..model.tables import ZERO, FlatModel, RowInjection
from ..passes.pipeline import CompiledModel
from ..passes.select_states import StateSelection
from .entry_sizes import EntrySizes
from .gather import NOTHING
from .live_relations import without_live_relations
from .plan import InputTable, PlannedRow, SystemPlan
from .plan_delays import plan_delays
from .plan_events import plan_events, plan_held
from .plan_waves import plan_waves
from .program import Layout, Program, plan, plan_equation
from .schedule import AnyStep, build_schedule, equation_of, needed


def lower(model: CompiledModel, linear_solver: lx.AbstractLinearSolver | None = None) -> SystemPlan:
    """Builds the plan; `linear_solver` is for blocks that stay whole."""
    reduced, selection = model.reduced, model.selection
    variable_map, extended = reduced.variables, reduced.extended
    state_order = selection.states  # as they lie in the state array
    quantities = extended.quantities
    n = quantities.n
    steps, carried = _schedule(model, linear_solver)
    # Which relations stay plain depends on the steps, and what is planned below reads the flat model that is left.
    flat, left_alone = without_live_relations(reduced.flat, variable_map, steps)
    reduced = dataclasses.replace(reduced, flat=flat)
    selection = dataclasses.replace(selection, notes=(*selection.notes, *left_alone))
    input_quantities = np.arange(quantities.n_unknown, n)

    def program(chosen: Sequence[AnyStep]) -> Program:
        return plan(chosen, state_order, input_quantities, n, carried, linear_solver)

    nonlinear = [s for s in steps if s.carried]
    residual_needs = np.concatenate([np.zeros(0, np.int64), *(s.needs() for s in nonlinear)])
    # Residuals of nonlinear blocks are evaluated in every iteration of Newton's method, and need a part of the steps.
    upstream = needed(steps, residual_needs, n)
    keep = {id(s) for s in (*upstream, *nonlinear)}
    for_residuals = [s for s in steps if id(s) in keep]
    carried_residuals = program(for_residuals)

    constraint_groups, constraint_slots, constraint_pattern = _constraints(extended, selection, state_order)
    constraint_program = program(needed(steps, constraint_slots, n))
    planned_constraints = tuple(plan_equation(group, constraint_program.layout) for group in constraint_groups)

    events = plan_events(
        flat,
        variable_map,
        state_order,
        reduced.names,
        extended,
        steps,
        lambda q: program(needed(steps, q, n)),
    )
    held = plan_held(flat.held, variable_map, lambda q: program(needed(steps, q, n)))
    delays = None
    if events is not None and len(flat.delays):
        delays = plan_delays(flat, events.table, variable_map, extended, steps, lambda q: program(needed(steps, q, n)))
        assert delays is not None
        events = dataclasses.replace(events, facts=dataclasses.replace(events.facts, delays=delays.facts))
    watched = [] if events is None else [variable_map.quantity[events.table.guard[events.n_clocks :]]]
    row_inputs = [_of(variable_map, row.inputs) for row in flat.rows]
    following = state_order + 1
    rates = carried + 1 if _rates_hold(flat, variable_map, extended, for_residuals, carried) else carried[:0]
    watched += [q for q, _ in row_inputs]
    derivative = program(needed(steps, np.concatenate([following, rates, *(q for q, _ in row_inputs)]), n))
    rows = tuple(
        _plan_row(row, inputs, variable_map, state_order, derivative.layout)
        for row, inputs in zip(flat.rows, row_inputs, strict=True)
    )

    in_state = np.concatenate([state_order, carried])
    waves = plan_waves(needed(steps, np.concatenate([following, rates, constraint_slots, *watched]), n))
    # Values and networks are no part of a plan: a plan with other numbers must be equal to this one, and share its
    # programs.
    structure = dataclasses.replace(reduced, flat=dataclasses.replace(flat, declared=None))
    return SystemPlan(
        model=structure,
        leading=leading_starts(reduced, flat.declares.values),
        selection=selection,
        steps=steps,
        blocks=model.blocks,
        mode=model.mode,
        states=state_order,
        carried=carried,
        nominal=quantity_scale(reduced)[in_state],
        inputs=_input_table(flat, extended, input_quantities),
        derivative=derivative,
        next_derivative=derivative.layout.gather(following) if len(following) else NOTHING,
        carried_rates=derivative.layout.gather(rates) if len(rates) else None,
        carried_residuals=carried_residuals,
        constraint_program=constraint_program,
        constraints=planned_constraints,
        constraint_pattern=constraint_pattern,
        rows=rows,
        network_names=flat.network_names,
        linear_solver=linear_solver,
        events=events,
        held=held,
        waves=waves,
        delays=delays,
    )


def _schedule(
    model: CompiledModel, linear_solver: lx.AbstractLinearSolver | None
) -> tuple[tuple[AnyStep, ...], np.ndarray]:
    """Returns (the steps in order, the unknowns whose values are carried along as guesses)."""
    steps = build_schedule(model.reduced.extended, model.blocks, EntrySizes(model.reduced))
    for step in steps:
        if step.whole and linear_solver is None:
            check_solvable(step.n)
    carried = [quantities for step in steps for quantities in step.guessed]
    return steps, np.concatenate(carried) if carried else np.zeros(0, np.int64)


def _input_table(flat: FlatModel, extended: Extended, input_quantities: np.ndarray) -> InputTable:
    """The inputs by name, and where the quantities that derive from them find theirs."""
    quantities, variables = extended.quantities, flat.variables
    roots = quantities.variable[quantities.owner[input_quantities]]
    # Inputs that are declared but unused follow: they are still names that `simulate` accepts.
    input_roots = list(dict.fromkeys([*roots.tolist(), *np.flatnonzero(variables.is_input).tolist()]))
    place = {v: k for k, v in enumerate(input_roots)}
    return InputTable(
        [variables.names[v] for v in input_roots],
        [variables.default[v] for v in input_roots],
        np.array(input_roots, np.int64),
        np.array([place[v] for v in roots.tolist()], np.int64),
        quantities.order[input_quantities],
    )


def _rates_hold(
    flat: FlatModel, variables: QuantityMap, extended: Extended, residuals: Sequence[AnyStep], carried: np.ndarray
) -> bool:
    """True if the derivatives of all carried unknowns are quantities of the model, untouched by row injection."""
    quantities = extended.quantities
    if not len(carried) or not (quantities.order[carried] < quantities.highest[quantities.owner[carried]]).all():
        return False
    read = np.concatenate([step.needs() for step in residuals])
    injected = variables.quantity[[v for row in flat.rows for v in row.targets]] if flat.rows else []
    return not np.isin(injected, read).any()


def _constraints(extended: Extended, selection: StateSelection, states: np.ndarray):
    """The constraint equations by group, the quantities they read, and which states each depends on (if on states
    alone)."""
    wanted = np.zeros(extended.n_equations, bool)
    wanted[selection.constraints] = True
    position = {int(q): k for k, q in enumerate(states)}
    settled = set(selection.settled.tolist())
    groups, slots = [], []
    pattern: list[frozenset[int]] | None = []
    for group in extended.groups:
        rows = np.flatnonzero(wanted[group.equation])
        if not len(rows):
            continue
        taken = equation_of(group, rows, {})
        groups.append(taken)
        slots.append(taken.quantity.ravel())
        for row in taken.quantity.tolist():
            used = [q for q in row if q != ZERO and q < extended.quantities.n_unknown and q not in settled]
            if pattern is not None and all(q in position for q in used):
                pattern.append(frozenset(position[q] for q in used))
            else:
                # A constraint that reads more than states needs the whole field's dependencies, so nothing is said of
                # any of them.
                pattern = None
    joined = np.concatenate(slots) if slots else np.zeros(0, np.int64)
    return groups, joined, None if pattern is None else tuple(pattern)


def _of(variables: QuantityMap, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """(quantities, factors) of the chosen variables."""
    v = np.array(chosen, np.int64)
    return variables.quantity[v], variables.factor[v]


def _plan_row(row: RowInjection, inputs, variables: QuantityMap, states, layout: Layout) -> PlannedRow:
    position = {int(q): k for k, q in enumerate(states)}
    targets, factors = _of(variables, row.targets)
    gathers = tuple(layout.gather(np.array([q]), np.array([s])) for q, s in zip(*inputs, strict=True))
    rows = tuple(position[q] for q in targets.tolist())
    return PlannedRow(row.opaque, rows, gathers, tuple(factors.tolist()), inputs[0])
