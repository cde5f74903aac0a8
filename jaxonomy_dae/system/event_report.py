"""What the report of a compilation says of events, a line for each."""

import numpy as np

from ..model.symbolic import SymbolicTemplate, number_label, parameter_label
from ..model.tables import EventTable, FlatModel, Start


def discrete_starts(flat: FlatModel, values: np.ndarray) -> list[str]:
    """The discrete variables and their starts; `values` are those of all parameters."""
    if not len(flat.events):
        return []
    return [f"{flat.parameters.names[p]} = {values[p]:g}" for p in _declared(flat)]


def condition_events(flat: FlatModel) -> list[str]:
    """The events of conditions: what the user wrote, and what each of them does."""
    return [f"{flat.events.text[e]}: {_actions(flat, e)}" for e in _noted(flat.events) if e >= len(flat.events.clocks)]


def relation_events(flat: FlatModel) -> list[str]:
    """The relations in equations whose changes are events."""
    table = flat.events
    found = (text.partition(": when(") for text, is_one in zip(table.text, table.relation, strict=True) if is_one)
    return list(dict.fromkeys(f"{where}: {condition[:-1]}" for where, _, condition in found))


def clock_events(flat: FlatModel, values: np.ndarray) -> list[str]:
    """The sampled events, with their periods and offsets."""
    out = []
    for e in _noted(flat.events):
        if e < len(flat.events.clocks):
            period, offset = (_number(part, values) for part in flat.events.clocks[e])
            out.append(f"{flat.events.text[e]}, every {period:g} s from {offset:g} s: {_actions(flat, e)}")
    return out


def mode_equations(flat: FlatModel) -> list[str]:
    """The equations that are one or another while a relation in discrete variables holds or does not."""
    discrete = np.array(_declared(flat), np.int64)
    out = []
    for group in flat.groups:
        if not isinstance(group.template, SymbolicTemplate) or group.template.graph.operation != "select":
            continue
        labels = [parameter_label(k) for k in range(group.template.n_parameters)]
        condition = group.template.graph.arguments[0]
        if condition.leaves <= {*labels, *map(number_label, range(group.template.n_coefficients))}:
            read = [k for k, label in enumerate(labels) if label in condition.leaves]
            rows = np.flatnonzero(np.isin(group.parameter[:, read], discrete).any(axis=1))
            out += [str(group.provenance[row]) for row in rows.tolist()]
    return out


def _declared(flat: FlatModel) -> list[int]:
    """The parameters that are discrete variables, relations left out."""
    table = flat.parameters
    return table.discrete[: len(table.discrete) - table.n_relations].tolist()


def _noted(table: EventTable) -> list[int]:
    """The events that users wrote."""
    return [e for e, noted in enumerate(table.noted) if noted]


def _actions(flat: FlatModel, event: int) -> str:
    """The actions of an event, in the words in which they are declared; values that are not numbers are left out, and
    so are hidden variables."""
    table = flat.events
    out = []
    for row in np.flatnonzero(table.event == event).tolist():
        value = "…" if table.value[row] >= 0 else f"{table.constant[row]:g}"
        if table.state[row] >= 0:
            out.append(f"reinit({flat.variables.names[table.state[row]]}, {value})")
        elif table.discrete[row] < len(_declared(flat)):
            name = flat.parameters.names[flat.parameters.discrete[table.discrete[row]]]
            out.append(f"assign({name}, {value})")
    message = table.message[event]
    return ", ".join([*out, *([f"terminate({message!r})"] if message is not None else [])])


def _number(start: Start | None, values: np.ndarray) -> float:
    if start is None:
        return float("inf")
    return float(start.template.residual([], [*values[list(start.parameters)]], [], 0.0, None, backend="numpy"))
