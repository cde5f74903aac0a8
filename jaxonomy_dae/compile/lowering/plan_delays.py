"""How a compiled system evaluates what is delayed, and when."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ...base.errors import ModelError
from ...solve.events.facts import DelayFacts
from ..model.delays import DelayTable
from ..model.events import EventTable
from ..model.extended import Extended
from ..model.quantities import QuantityMap
from ..model.tables import FlatModel
from .gather import Gather
from .plan_events import Behind, read_variables
from .program import Program
from .schedule import AnyStep


@dataclasses.dataclass(frozen=True)
class DelayPlan:
    """The delayed quantities of a system.

    - `table`: their table; `sources`, `source`: the program that computes what is delayed, and where it has it;
        `instants`, `instant`: the same for the times at which the past is read.
    - `parameters`: those by which equations read the past, shape (delays, 5), as `DelayTable.read`.
    """

    table: DelayTable
    sources: Program
    source: Gather
    instants: Program
    instant: Gather
    parameters: np.ndarray
    facts: DelayFacts

    def __len__(self):
        return len(self.table)


def plan_delays(
    flat: FlatModel, events: EventTable, variables: QuantityMap, extended: Extended, steps: Sequence[AnyStep],
    program: Callable[[np.ndarray], Program],
) -> DelayPlan | None:  # fmt: skip
    """Plans the delayed quantities of a model; `program` makes the program that computes chosen quantities. None if it
    has none.

    **Raises:**

    - `ModelError` for a delay that depends on what comes out of a delay at the same instant, and for equations that
        need the second derivative of what is delayed.
    """
    table = flat.delays
    if not len(table):
        return None
    parameters = flat.parameters.discrete[table.read]
    values = parameters[:, 2].tolist()
    for group in extended.groups:
        twice = np.flatnonzero(np.isin(parameters[:, 2], group.parameter))
        if group.level > 1 and len(twice):
            raise ModelError(
                f"'{table.text[twice[0]]}': the equations need its second derivative, because it drives a constraint "
                "on positions or the like, and a record of the past has rates only. Let it drive a force or a speed"
            )
    behind = Behind(steps, extended.quantities.n)
    read = [behind.parameters(int(variables.quantity[v])) for v in table.source]
    for name, v in zip(table.text, table.instant.tolist(), strict=True):
        inside = behind.parameters(int(variables.quantity[v]))
        others = [other for other, p in zip(table.text, values, strict=True) if p in inside]
        if others:
            raise ModelError(
                f"the delay of '{name}' depends on '{others[0]}' at the same instant, which is delayed itself: let it "
                "depend on states, inputs and time"
            )
    begins = table.read[:, 0].tolist()
    clocks = [int(events.event[events.discrete == place][0]) for place in begins]
    return DelayPlan(
        table,
        *read_variables(variables, table.source, program),
        *read_variables(variables, table.instant, program),
        parameters,
        DelayFacts(
            tuple(clocks), tuple(begins), table.constant, tuple(tuple(p in found for p in values) for found in read)
        ),
    )
