"""The events of all components, as one table."""

from typing import Any

import numpy as np

from ..model.symbolic import canonical
from ..model.tables import NO_EVENTS, EventTable, Start
from ..modeling.events import Assign, Terminate
from .number_model import ModelNumbers
from .read_equations import read_expression


def event_table(model: ModelNumbers) -> EventTable:
    """The sampled events, then those of conditions, in the order of declaration."""
    found = [(k, when) for k, component in enumerate(model.components) for when in component.events]
    if not found:
        return NO_EVENTS
    sampled = [(k, when) for k, when in found if when.clock is not None]
    ordered = sampled + [pair for pair in found if pair[1].clock is None]
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
        tuple(when.revocable for _, when in ordered),
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
