"""The events of all components, as one table."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import sympy

from ...graph.expressions.to_sympy import shortened
from ...write.automatic_events import relations_left_alone
from ...write.events import Assign, Reinit, Terminate, When
from ..model.events import Event, EventTable, HeldTable, Write
from ..model.starts import Start
from ..model.symbolic import canonical
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
        return EventTable(left_alone=left_alone)
    # Sampled events come first: tables of events are cut at `n_clocks`.
    found.sort(key=lambda entry: (entry[4].clock is None, entry[0], entry[1]))
    place = {int(p): i for i, p in enumerate(model.discrete)}
    variables, parameters = functools.cache(model.variable), functools.cache(model.parameter)

    def variable(i: Instances, path: str, row: int) -> int:
        return int(variables(i, path)[row])

    def parameter(i: Instances, path: str, row: int) -> int:
        return int(parameters(i, path)[row])

    def write(i: Instances, row: int, action: Reinit | Assign, value: str | float) -> Write:
        target = action.target.path
        is_name = isinstance(value, str)
        return Write(
            state=-1 if isinstance(action, Assign) else variable(i, target, row),
            discrete=place[parameter(i, target, row)] if isinstance(action, Assign) else -1,
            value=variable(i, value, row) if is_name else -1,
            constant=0.0 if is_name else float(value),
        )

    def event(k: int, i: Instances, row: int, when: When) -> Event:
        clock = when.clock
        period = (
            None if clock is None or clock.period is None else in_parameters(model, parameter, i, row, clock.period)
        )
        return Event(
            owner=model.paths[k],
            condition=when.text,
            guard=-1 if when.guard is None else variable(i, when.guard, row),
            clock=None if clock is None else (period, in_parameters(model, parameter, i, row, clock.offset)),
            message=next((a.message for a in when.actions if isinstance(a, Terminate)), None),
            flags=when.flags,
            writes=tuple(
                write(i, row, action, value)
                for action, value in zip(when.actions, when.values, strict=True)
                if not isinstance(action, Terminate) and value is not None
            ),
        )

    return EventTable(tuple(event(k, i, row, when) for k, _, i, row, when in found), left_alone)


def in_parameters(
    model: ModelNumbers, parameter: Callable[[Instances, str, int], int], i: Instances, row: int, expression: sympy.Expr
) -> Start:
    """An expression in parameters of one instance; `parameter` numbers these."""
    # A set of symbols has another order in each process.
    symbols: list[Any] = sorted(expression.free_symbols, key=lambda s: parameter(i, s.path, row))
    graph = read_expression(expression, model.paths[i.number[row]])
    return Start(canonical(graph, (), symbols), tuple(parameter(i, s.path, row) for s in symbols))


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
    text, active, impulse, rate, force, closed, level, owner = [], [], [], [], [], [], [], []
    for number, (k, n, row, i) in enumerate(found):
        held = i.component.held_branches[n]
        text.append(f"{model.paths[k]}: {held.text}")
        active.append(model.variable(i, held.active)[row])
        impulse.append(place[int(model.parameter(i, held.impulse.path)[row])])
        rate.append(place[int(model.parameter(i, held.rate.path)[row])])
        force.append(-1 if held.force is None else model.variable(i, held.force)[row])
        closed.append(-1 if held.closed is None else place[int(model.parameter(i, held.closed.path)[row])])
        level += [model.variable(i, name)[row] for name in held.levels]
        owner += [number] * len(held.levels)
    columns = (active, impulse, rate, force, closed, level, owner)
    return HeldTable(tuple(text), *(np.array(column, np.int64) for column in columns))
