"""The events of all components, as one table."""

import graphlib
from typing import Any

import numpy as np

from ..errors import ModelError
from ..model.symbolic import canonical
from ..model.tables import NO_EVENTS, EventTable, Start
from ..modeling.events import Assign, Terminate, When
from ..modeling.symbols import DiscreteSymbol, VariableSymbol
from .number_model import ModelNumbers
from .read_equations import read_expression


def event_table(model: ModelNumbers) -> EventTable:
    """Events in the order in which they happen at one instant: sampled ones, those that write what others read first;
    then those of conditions, in the order of declaration.

    **Raises:**

    - `ModelError` if sampled events need each other's results.
    """
    found = [(k, when) for k, component in enumerate(model.components) for when in component.events]
    if not found:
        return NO_EVENTS
    sampled = [(k, when) for k, when in found if when.clock is not None]
    ordered = [sampled[i] for i in _order(model, sampled)] + [pair for pair in found if pair[1].clock is None]
    place = {int(p): i for i, p in enumerate(model.discrete)}
    rows: list[tuple[int, int, int, int, float]] = []
    for e, (k, when) in enumerate(ordered):
        for action, value in zip(when.actions, when.values, strict=True):
            if isinstance(action, Terminate):
                continue
            is_name = isinstance(value, str)
            target = action.target.path
            rows.append(
                (
                    e,
                    -1 if isinstance(action, Assign) else model.variable(k, target),
                    place[model.parameter(k, target)] if isinstance(action, Assign) else -1,
                    model.variable(k, value) if is_name else -1,
                    0.0 if is_name else float(value),  # type: ignore[arg-type]
                )
            )
    columns = list(zip(*rows, strict=True)) or [()] * 5
    event, state, discrete, value = (np.array(c, np.int64) for c in columns[:4])
    return EventTable(
        tuple(f"{model.paths[k]}: when({when.text})" for k, when in ordered),
        np.array([-1 if when.guard is None else model.variable(k, when.guard) for k, when in ordered], np.int64),
        tuple((_in_parameters(model, k, w.clock.period), _in_parameters(model, k, w.clock.offset)) for k, w in ordered
              if w.clock is not None),
        tuple(next((a.message for a in w.actions if isinstance(a, Terminate)), None) for _, w in ordered),
        tuple(when.noted for _, when in ordered),
        tuple(when.immediate for _, when in ordered),
        event,
        state,
        discrete,
        value,
        np.array(columns[4], float),
    )  # fmt: skip


def _in_parameters(model: ModelNumbers, component: int, expression: Any) -> Start:
    symbols: list[Any] = sorted(expression.free_symbols, key=lambda s: model.parameter(component, s.path))
    graph = read_expression(expression, model.paths[component])
    return Start(canonical(graph, (), symbols), tuple(model.parameter(component, s.path) for s in symbols))


def _order(model: ModelNumbers, sampled: list[tuple[int, When]]) -> list[int]:
    """Sampled events so that what is written at an instant is read after it."""
    writers: dict[int, list[int]] = {}
    for i, (k, when) in enumerate(sampled):
        for action in when.actions:
            if isinstance(action, Assign):
                writers.setdefault(model.parameter(k, action.target.path), []).append(i)
    sorter: graphlib.TopologicalSorter[int] = graphlib.TopologicalSorter({i: () for i in range(len(sampled))})
    for i, (k, when) in enumerate(sampled):
        read = {
            model.parameter(k, s.path)
            for action in when.actions
            if not isinstance(action, Terminate)
            for s in action.value.free_symbols
            if isinstance(s, DiscreteSymbol) and not isinstance(s, VariableSymbol)
        }
        for p in read:
            sorter.add(i, *(j for j in writers.get(p, ()) if j != i))
    try:
        return list(sorter.static_order())
    except graphlib.CycleError as error:
        names = [f"'{model.paths[sampled[i][0]]}: when({sampled[i][1].text})'" for i in dict.fromkeys(error.args[1])]
        raise ModelError(
            f"the sampled events {', '.join(names)} need each other's results at the same instant: let one of them "
            "read the value before, pre(…)"
        ) from None
