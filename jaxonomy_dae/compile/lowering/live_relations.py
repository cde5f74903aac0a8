"""Relations that are no events after all: those that nonlinear equations need as they are.

A relation that is an event keeps its value until a step ends where it turns; a stage of that step that lies beyond goes
on with the branch before. Where this branch stands in nonlinear equations that determine what the relation compares, it
may have no solution there: of k·q·|q| = Δp, the branch k·q² = Δp has none for Δp < 0. Such relations are looked at
whenever the equations are. Where the branches are linear they have solutions, and relations stay events.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ...graph.expressions.node import FALSE, Node, leaf, number, postorder
from ...graph.expressions.substitute import rebuilt
from ...graph.structure.matching import maximum_matching
from ...write.events import LIVE, EventFlag
from ..model.events import EventTable
from ..model.quantities import QuantityMap
from ..model.symbolic import SymbolicTemplate, parameter_label, slot_label, template_of
from ..model.tables import ZERO, FlatModel
from ..model.template import AbstractTemplate
from .schedule import AnyStep, Step, StepEquation


def without_live_relations(
    flat: FlatModel, variables: QuantityMap, steps: Sequence[AnyStep]
) -> tuple[FlatModel, tuple[str, ...]]:
    """Returns (the model without the events of relations that nonlinear equations need as they are, notes about
    them)."""
    table = flat.events
    relation = table.are(EventFlag.RELATION)
    if not relation.any():
        return flat, ()
    rows = relation[table.event] & (table.discrete >= 0)
    live = np.zeros(len(flat.parameters), bool)
    compared = _compared(table, flat.parameters.discrete[table.discrete], rows, variables, steps)
    for step in steps:
        if step.carried:
            live[_needed_as_they_are(step, *compared)] = True
    if not live.any():
        return flat, ()
    assigned = np.where(table.discrete >= 0, flat.parameters.discrete[table.discrete], -1)
    gone = np.zeros(len(table), bool)
    count = -1
    while gone.sum() > count:  # an event may write two, as those of a whole part do
        count = gone.sum()
        gone[table.event[live[assigned] & (assigned >= 0)]] = True
        live[assigned[gone[table.event] & (assigned >= 0)]] = True
    turned = [table.events[e] for e in np.flatnonzero(gone & relation).tolist()]
    notes = tuple(
        f"{owner}: '{condition}' is no event: nonlinear equations that it stands in determine what it compares"
        for owner, condition in dict.fromkeys((event.owner, event.condition) for event in turned)
    )
    return dataclasses.replace(flat, events=table.take(np.flatnonzero(~gone).tolist())), notes


def _compared(
    table: EventTable, parameter: np.ndarray, rows: np.ndarray, variables: QuantityMap, steps: Sequence[AnyStep]
) -> tuple[np.ndarray, np.ndarray]:
    """(parameter, quantity) of each relation and of all that it compares."""
    rows = rows & (table.guard[table.event] >= 0)
    guard = variables.quantity[table.guard[table.event[rows]]]
    own = parameter[rows][guard != ZERO]
    guard = guard[guard != ZERO]
    # The guard of x > y is a variable of its own, x − y: what its equation reads is compared. That of x > 0 is x
    # itself, and no equation is looked for.
    parameters, quantities = [own], [guard]
    for step in steps:
        if not isinstance(step, Step) or len(step.unknown) != 1:
            continue
        (unknown,) = step.unknown
        here = np.isin(unknown, guard)
        if not here.any():
            continue
        place = np.full(max(int(guard.max()), int(unknown.max())) + 1, -1, np.int64)
        place[unknown] = np.arange(step.n)
        found = place[guard]
        for quantity in step.equations[0].quantity.T:
            parameters.append(own[found >= 0])
            quantities.append(quantity[found[found >= 0]])
    parameters, quantities = np.concatenate(parameters), np.concatenate(quantities)
    return parameters[quantities != ZERO], quantities[quantities != ZERO]


def _needed_as_they_are(step: AnyStep, parameters: np.ndarray, quantities: np.ndarray) -> np.ndarray:
    """The relations that a nonlinear step's equations need as they are."""
    relations = np.unique(parameters)
    if not any(np.isin(e.parameter, relations).any() for e in step.equations):
        return np.zeros(0, np.int64)
    pairs = {*zip(parameters.tolist(), quantities.tolist(), strict=True)}
    found: set[int] = set()
    for equation in _in_nonlinear_blocks(step, relations):
        for column in equation.parameter.T:
            for row in np.flatnonzero(np.isin(column, relations)).tolist():
                p = int(column[row])
                if p not in found and any((p, q) in pairs for q in step.own(equation, row)):
                    found.add(p)
    return np.array(sorted(found), np.int64)


def _in_nonlinear_blocks(step: AnyStep, relations: np.ndarray) -> list[StepEquation]:
    """The equations of a step that stand in nonlinear blocks once relations are known."""
    known = []
    for equation in step.equations:
        columns = tuple(np.flatnonzero(np.isin(equation.parameter, relations).any(axis=0)).tolist())
        known.append(_with_known(equation.template, columns))
    # With its relations known an equation reads less: a block of the plan may fall apart into smaller ones, of which
    # some are linear.
    both = list(zip(step.equations, known, strict=True))
    blocks = _blocks(both, len(step.unknown)) if isinstance(step, Step) else None
    if blocks is None:
        affine = all(t.is_affine_in(np.flatnonzero(place).tolist()) for e, t in both for place in step.places(e))
        return [] if affine else list(step.equations)
    block_of, determined = blocks
    nonlinear = set()
    for k, (equation, template) in enumerate(both):
        inside = [slot for slot, u in enumerate(equation.local) if u in determined[block_of[k]]]
        if not template.is_affine_in(inside):
            nonlinear.add(block_of[k])
    return [equation for k, equation in enumerate(step.equations) if block_of[k] in nonlinear]


def _blocks(
    equations: list[tuple[StepEquation, AbstractTemplate]], count: int
) -> tuple[list[int], dict[int, set[int]]] | None:
    """(the number of the block of each equation, the local unknowns that each block determines): the strong components
    of what the equations read. None if they cannot be matched with their unknowns."""
    read = []
    for equation, template in equations:
        read.append(sorted({u for slot, u in enumerate(equation.local) if u >= 0 and _reads(template, slot)}))
    pointer = np.cumsum([0, *map(len, read)])
    matched = maximum_matching(pointer, np.concatenate(read).astype(np.int64), count)
    if (matched < 0).any():
        return None
    owner = {int(u): k for k, u in enumerate(matched)}
    heads = [owner[u] for reads in read for u in reads]
    tails = np.repeat(np.arange(len(read)), np.diff(pointer))
    graph = csr_array((np.ones(len(heads)), (tails, heads)), shape=(len(read), len(read)))
    block_of = connected_components(graph, directed=True, connection="strong")[1].tolist()
    determined: dict[int, set[int]] = {}
    for block, u in zip(block_of, matched.tolist(), strict=True):
        determined.setdefault(block, set()).add(u)
    return block_of, determined


def _reads(template: AbstractTemplate, slot: int) -> bool:
    return not isinstance(template, SymbolicTemplate) or slot_label(template.slots[slot]) in template.graph.leaves


def _with_known(template: AbstractTemplate, columns: tuple[int, ...]) -> AbstractTemplate:
    """The template where relations are not to be found out; these parameters say what they are."""
    if not columns or not isinstance(template, SymbolicTemplate):
        return template
    relations = {leaf(parameter_label(k)) for k in columns}
    known: dict[Node, Node] = {}
    # Between events a relation is 1 or 0: the branch in which it is as its sides say is left out.
    for n in postorder([template.graph]):
        asks = n.operation == "equal" and not relations.isdisjoint(n.arguments)
        if asks and any(number(a) == LIVE for a in n.arguments):
            known[n] = FALSE
        else:
            known[n] = rebuilt(n, [known[a] for a in n.arguments]) if n.arguments else n
    return template_of(known[template.graph], template.slots, template.n_parameters, template.n_coefficients)
