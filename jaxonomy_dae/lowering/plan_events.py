"""How a compiled system evaluates its events: programs for conditions and for what events write."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..errors import ModelError
from ..model.quantities import QuantityMap
from ..model.tables import ZERO, DependentParameters, EventTable, FlatModel
from .gather import Gather
from .program import Program


@dataclasses.dataclass(frozen=True)
class EventPlan:
    """The events of a system.

    Sampled events come first, `n_clocks` of them; `guard` reads the values of the others, which fall through zero. The
    rows of `state`, `factor` and `value` belong to the actions of `table`.
    """

    table: EventTable
    n_clocks: int
    guards: Program
    guard: Gather
    values: Program
    value: Gather  # for actions that write a number, the constant zero
    state: np.ndarray  # where in the state array an action writes, or −1
    factor: np.ndarray  # of the variable that it writes, in units of the state
    discrete: np.ndarray  # the parameters that are discrete variables
    dependents: tuple[DependentParameters, ...]  # the parameters that follow them

    @property
    def names(self) -> tuple[str, ...]:
        """What the user wrote, for every event."""
        return self.table.text

    def __len__(self) -> int:
        return len(self.table)


def plan_events(
    flat: FlatModel,
    variables: QuantityMap,
    states: np.ndarray,
    names: Sequence[str],
    program: Callable[[np.ndarray], Program],
) -> EventPlan | None:
    """Plans the events of a model; `program` makes the program that computes given quantities. None if it has none.

    **Raises:**

    - `ModelError` for a `reinit` of what is not a state.
    """
    table = flat.events
    if not len(table):
        return None
    n_clocks = len(table.clocks)
    guards, guard = _read(variables, table.guard[n_clocks:], program)
    values, value = _read(variables, table.value, program)
    position = {int(q): k for k, q in enumerate(states)}
    place, factor = np.full(len(table.state), -1, np.int64), np.ones(len(table.state))
    for row, v in enumerate(table.state.tolist()):
        if v < 0:
            continue
        quantity, scale = variables[v]
        if quantity == ZERO or quantity not in position:
            shown = ", ".join(repr(names[q]) for q in states[:12])
            raise ModelError(
                f"{table.text[table.event[row]]}: '{flat.variables.names[v]}' cannot start anew, because it is not a "
                f"state: the equations determine it at every instant. The states are {shown or 'none'}"
            )
        place[row], factor[row] = position[quantity], scale
        for other in range(row):
            if table.event[other] == table.event[row] and place[other] == place[row]:
                raise ModelError(
                    f"{table.text[table.event[row]]}: '{flat.variables.names[table.state[other]]}' and "
                    f"'{flat.variables.names[v]}' are one state, which is given two values by one event: reinit one"
                )
    return EventPlan(
        table, n_clocks, guards, guard, values, value, place, factor, flat.parameters.discrete, _following(flat)
    )  # fmt: skip


def _read(
    variables: QuantityMap, chosen: np.ndarray, program: Callable[[np.ndarray], Program]
) -> tuple[Program, Gather]:
    """The program that computes variables, and where it has them; −1 stands for zero."""
    quantity = np.where(chosen < 0, ZERO, variables.quantity[chosen])
    made = program(quantity)
    if not len(chosen):
        return made, Gather(*(np.zeros(0, np.int64),) * 3)
    return made, made.layout.gather(quantity, np.where(chosen < 0, 1.0, variables.factor[chosen]))


def _following(flat: FlatModel) -> tuple[DependentParameters, ...]:
    """The parameters that are expressions in discrete variables, directly or through others."""
    moved = np.zeros(len(flat.parameters), bool)
    moved[flat.parameters.discrete] = True
    found = []
    for group in flat.parameters.dependents:
        rows = moved[group.parameter].any(axis=1) & ~moved[group.target]
        if rows.any():
            moved[group.target[rows]] = True
            found.append(DependentParameters(group.template, group.target[rows], group.parameter[rows]))
    return tuple(found)
