"""The events of all components, as one table."""

import dataclasses
from typing import Any

import numpy as np

from ..expressions.to_sympy import shortened
from ..model.symbolic import canonical
from ..model.tables import NO_EVENTS, EventTable, HeldTable, Start
from ..modeling.automatic_events import relations_left_alone
from ..modeling.events import Assign, Terminate, When
from .number_model import Instances, ModelNumbers
from .read_equations import read_expression


def event_table(model: ModelNumbers) -> EventTable:
    """The sampled events, then those of conditions, in the order of declaration."""
    found: list[tuple[int, int, Instances, int, When]] = []
    for i in model.instances:
        for n, when in enumerate(i.component.events):
            found.extend((k, n, i, row, when) for row, k in enumerate(i.number.tolist()))
    left_alone = _left_alone(model)
    if not found:
        return dataclasses.replace(NO_EVENTS, left_alone=left_alone)
    found.sort(key=lambda entry: (entry[4].clock is None, entry[0], entry[1]))
    place = {int(p): i for i, p in enumerate(model.discrete)}
    known: dict[tuple[int, str, bool], np.ndarray] = {}

    def variable(i: Instances, path: str, row: int) -> int:
        key = (id(i), path, True)
        if key not in known:
            known[key] = model.variable(i, path)
        return int(known[key][row])

    def parameter(i: Instances, path: str, row: int) -> int:
        key = (id(i), path, False)
        if key not in known:
            known[key] = model.parameter(i, path)
        return int(known[key][row])

    def in_parameters(i: Instances, row: int, expression: Any) -> Start:
        symbols: list[Any] = sorted(expression.free_symbols, key=lambda s: parameter(i, s.path, row))
        graph = read_expression(expression, model.paths[i.number[row]])
        return Start(canonical(graph, (), symbols), tuple(parameter(i, s.path, row) for s in symbols))

    rows: list[tuple[int, int, int, int, float]] = []
    for e, (_, _, i, row, when) in enumerate(found):
        for action, value in zip(when.actions, when.values, strict=True):
            if isinstance(action, Terminate):
                continue
            is_name = isinstance(value, str)
            target = action.target.path
            rows.append(
                (
                    e,
                    -1 if isinstance(action, Assign) else variable(i, target, row),
                    place[parameter(i, target, row)] if isinstance(action, Assign) else -1,
                    variable(i, value, row) if is_name else -1,
                    0.0 if is_name else float(value),  # type: ignore[arg-type]
                )
            )
    columns = list(zip(*rows, strict=True)) or [()] * 5
    event, state, discrete, value = (np.array(c, np.int64) for c in columns[:4])
    whens = [when for *_, when in found]
    return EventTable(
        tuple(f"{model.paths[k]}: when({when.text})" for k, *_, when in found),
        np.array([-1 if w.guard is None else variable(i, w.guard, row) for _, _, i, row, w in found], np.int64),
        tuple((None if w.clock.period is None else in_parameters(i, row, w.clock.period),
               in_parameters(i, row, w.clock.offset))
              for _, _, i, row, w in found if w.clock is not None),
        tuple(next((a.message for a in w.actions if isinstance(a, Terminate)), None) for w in whens),
        tuple(when.noted for when in whens),
        tuple(when.revocable for when in whens),
        tuple(when.relation for when in whens),
        tuple(when.kink for when in whens),
        tuple(when.strict for when in whens),
        tuple(when.strike for when in whens),
        tuple(when.immediate for when in whens),
        event,
        state,
        discrete,
        value,
        np.array(columns[4], float),
        left_alone,
    )  # fmt: skip


def _left_alone(model: ModelNumbers) -> tuple[str, ...]:
    """The parts of equations whose relations are no events."""
    found: list[tuple[int, str]] = []
    for i in model.instances:
        written = (i.component.as_written.get(e, e) for e in i.component.equations)
        texts = [shortened(part) for equation in written for part in relations_left_alone(equation)]
        found += [(k, text) for k in (i.number.tolist() if texts else ()) for text in texts]
    return tuple(f"{model.paths[k]}: {text}" for k, text in sorted(dict.fromkeys(found)))


def held_table(model: ModelNumbers) -> HeldTable:
    """The branches that are differentiated, in the order of declaration."""
    place = {int(p): k for k, p in enumerate(model.discrete)}
    found = sorted(
        (
            (k, n, row, i)
            for i in model.instances
            for n in range(len(i.component.held_branches))
            for row, k in enumerate(i.number.tolist())
        ),
        key=lambda entry: entry[:2],
    )
    text, active, impulse, force, closed, level, owner = [], [], [], [], [], [], []
    for number, (k, n, row, i) in enumerate(found):
        held = i.component.held_branches[n]
        text.append(f"{model.paths[k]}: {held.text}")
        active.append(model.variable(i, held.active)[row])
        impulse.append(place[int(model.parameter(i, held.impulse.path)[row])])
        force.append(-1 if held.force is None else model.variable(i, held.force)[row])
        closed.append(-1 if held.closed is None else place[int(model.parameter(i, held.closed.path)[row])])
        level += [model.variable(i, name)[row] for name in held.levels]
        owner += [number] * len(held.levels)
    columns = (active, impulse, force, closed, level, owner)
    return HeldTable(tuple(text), *(np.array(column, np.int64) for column in columns))
