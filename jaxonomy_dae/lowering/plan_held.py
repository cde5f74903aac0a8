"""How a compiled system evaluates the constraints that come and go with modes."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..model.events import HeldTable
from ..model.quantities import QuantityMap
from .gather import Gather
from .plan_events import read_variables
from .program import Program


@dataclasses.dataclass(frozen=True)
class HeldPlan:
    """The branches of `either` that are differentiated, as `table` lists them."""

    table: HeldTable
    active_program: Program
    active: Gather
    level_program: Program
    level: Gather
    force_program: Program
    force: Gather
    last: np.ndarray  # (held,): the level of each that jumps


def plan_held(table: HeldTable, variables: QuantityMap, program: Callable[[np.ndarray], Program]) -> HeldPlan | None:
    """Plans the constraints of a model; `program` makes the program that computes chosen quantities. None if it has
    none."""
    if not len(table):
        return None

    last = np.searchsorted(table.owner, np.arange(len(table)), side="right") - 1
    active, level, force = (read_variables(variables, v, program) for v in (table.active, table.level, table.force))
    return HeldPlan(table, *active, *level, *force, last)
