"""How a compiled system evaluates its events and the constraints that come and go with modes."""

import dataclasses
import graphlib
from collections.abc import Callable, Sequence

import numpy as np

from ...base.errors import ModelError
from ...solve.events.facts import EventFacts
from ...write.events import EventFlag
from ..model.events import EventTable, HeldTable
from ..model.extended import Extended
from ..model.quantities import QuantityMap
from ..model.starts import Formulas
from ..model.tables import ZERO, FlatModel
from .gather import NOTHING, Gather
from .program import Program
from .schedule import AnyStep, Step


@dataclasses.dataclass(frozen=True)
class EventPlan:
    """The events of a system.

    Sampled events come first; `guard` reads the values of the others, which fall through zero. The
    rows of `state`, `factor` and `value` belong to the actions of `table`.
    """

    table: EventTable
    guards: Program
    guard: Gather
    values: Program
    value: Gather  # for actions that write a number, the constant zero
    state: np.ndarray  # where in the state array an action writes, or −1
    factor: np.ndarray  # of the variable that it writes, in units of the state
    discrete: np.ndarray  # the parameters that are discrete variables, hidden ones last
    n_declared: int  # how many of them were declared; the others are relations
    n_visible: int  # how many of these are shown
    dependents: tuple[Formulas, ...]  # the parameters that follow them
    facts: EventFacts

    @property
    def n_clocks(self) -> int:
        """How many events are sampled."""
        return self.table.n_clocks

    @property
    def names(self) -> tuple[str, ...]:
        """The text that the user wrote, for every event."""
        return self.table.text

    @property
    def are_listed(self) -> bool:
        """True if any of them is listed."""
        return bool(self.table.are(EventFlag.LISTED)[self.n_clocks :].any() or self.table.ends.any())

    def __len__(self) -> int:
        return len(self.table)


def plan_events(
    flat: FlatModel,
    variables: QuantityMap,
    states: np.ndarray,
    names: Sequence[str],
    extended: Extended,
    steps: Sequence[AnyStep],
    program: Callable[[np.ndarray], Program],
) -> EventPlan | None:
    """Plans the events of a model; `steps` determine its quantities, and `program` makes the program that computes
    chosen ones. None if it has no events.

    **Raises:**

    - `ModelError` if sampled events need each other's results; for a `reinit` of what is not a state.
    """
    table = flat.events
    if not len(table):
        return None
    table = _in_order(table, _reads(flat, variables, steps, extended.quantities.n))
    guards, guard = read_variables(variables, table.guard[table.n_clocks :], program)
    values, value = read_variables(variables, table.value, program)
    position = {int(q): k for k, q in enumerate(states)}
    place, factor = np.full(len(table.state), -1, np.int64), np.ones(len(table.state))
    begun: dict[tuple[int, int], int] = {}  # the variable that each event starts anew at a place in the state
    for row, (v, event) in enumerate(zip(table.state.tolist(), table.event.tolist(), strict=True)):
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
        # Two variables may be aliases of one state. Which value counted would be decided by the order of the actions.
        other = begun.setdefault((event, position[quantity]), v)
        if other != v:
            raise ModelError(
                f"{table.text[event]}: '{flat.variables.names[other]}' and '{flat.variables.names[v]}' are one state, "
                "which is given two values by one event: reinit one"
            )
    choices, choice_guards = _choices(table, flat.held)
    return EventPlan(
        table=table,
        guards=guards,
        guard=guard,
        values=values,
        value=value,
        state=place,
        factor=factor,
        discrete=flat.parameters.discrete,
        n_declared=len(flat.parameters.discrete) - flat.parameters.n_relations,
        n_visible=flat.parameters.n_shown,
        dependents=flat.parameters.follow_events,
        facts=EventFacts(
            flags=tuple(event.flags for event in table.events),
            n_clocks=table.n_clocks,
            ends=tuple(table.ends.tolist()),
            opposite=_opposite(table),
            choices=choices,
            choice_guards=choice_guards,
            only_kinks=bool(table.are(EventFlag.KINK).all()) and _only_as_written(flat.parameters.discrete, extended),
            contested=_contested(table, place, len(flat.parameters.discrete)),
        ),
    )


def _choices(table: EventTable, held: HeldTable) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns (the discrete values that `complementary` chooses, the guards that choose them). Contacts between states
    are left out: they close by impulses, and do not make equations singular."""
    chooses = table.are(EventFlag.REVOCABLE) & ~table.are(EventFlag.RELATION | EventFlag.REPEATED)
    chooses[table.event[np.isin(table.discrete, held.closed[held.closed >= 0])]] = False
    rows = chooses[table.event] & (table.discrete >= 0) & (table.event >= table.n_clocks)
    guards = table.event[rows] - table.n_clocks
    return tuple(np.unique(table.discrete[rows]).tolist()), tuple(np.unique(guards).tolist())


def _opposite(table: EventTable) -> tuple[int, ...]:
    """For each guard of a relation, the number of the guard that sets the same discrete value the other way; −1 for
    other guards."""
    opposite = [-1] * (len(table) - table.n_clocks)
    other: dict[int, int] = {}
    for guard, event in enumerate(table.events[table.n_clocks :]):
        for write in event.writes if EventFlag.RELATION in event.flags else ():
            if write.discrete in other:
                opposite[guard], opposite[other[write.discrete]] = other[write.discrete], guard
            other[write.discrete] = guard
    return tuple(opposite)


def _contested(table: EventTable, state: np.ndarray, n_discrete: int) -> tuple[tuple[int, int], ...]:
    """(event, place) for what several events write, if not all of them the same number. Events that choose a mode or
    turn a relation exclude each other, and contacts strike as one."""
    # Events that cannot happen at one instant, or are meant to, cannot contest what they write.
    exclusive = table.are(EventFlag.RELATION | EventFlag.REVOCABLE | EventFlag.STRIKE)
    writers: dict[int, list[int]] = {}
    for row, event in enumerate(table.event.tolist()):
        place = int(state[row]) if state[row] >= 0 else int(table.discrete[row]) - n_discrete
        if not exclusive[event]:
            writers.setdefault(place, []).append(row)
    out = []
    for place, rows in writers.items():
        same = (table.value[rows] < 0).all() and len(set(table.constant[rows].tolist())) == 1
        out += [] if same or len(rows) < 2 else [(int(table.event[row]), place) for row in rows]
    return tuple(out)


def _only_as_written(parameters: np.ndarray, extended: Extended) -> bool:
    """True if parameters stand in no equation that is differentiated: where |x| only bends, its derivative jumps."""
    return not any(group.level and np.isin(group.parameter, parameters).any() for group in extended.groups)


def _reads(flat: FlatModel, variables: QuantityMap, steps: Sequence[AnyStep], n: int) -> list[set[int]]:
    """The discrete variables that each event reads as they are at its instant, through equations too. Those of
    relations are left out: they have one event that sets them either way."""
    table = flat.events
    out: list[set[int]] = [set() for _ in table.events]
    if not (table.discrete >= 0).any():  # there is nothing to read
        return out
    place = {int(p): k for k, p in enumerate(flat.parameters.discrete)}
    behind = Behind(steps, n)
    for event, value in zip(table.event.tolist(), table.value.tolist(), strict=True):
        is_relation = event >= table.n_clocks and EventFlag.RELATION in table.events[event].flags
        if value >= 0 and not is_relation:
            out[event] |= {place[p] for p in behind.parameters(int(variables.quantity[value])) if p in place}
    return out


class Behind:
    """What the steps read to determine each quantity; a quantity is looked into when it is first asked for."""

    def __init__(self, steps: Sequence[AnyStep], n: int):
        # Each event walks through what it reads alone. When every event looked at all others, the time grew with their
        # square: 1.2 s for 4,000 bouncing balls, 4.6 s for 8,000.
        self._steps, self._step, self._row = steps, np.full(n, -1), np.zeros(n, np.int64)
        for k, step in enumerate(steps):
            for unknown in step.unknown:
                self._step[unknown], self._row[unknown] = k, np.arange(len(unknown))

    def parameters(self, quantity: int) -> set[int]:
        """The parameters of all equations that determine a quantity, states apart."""
        found: set[int] = set()
        waiting, seen = [quantity] if quantity >= 0 else [], {quantity, ZERO}
        done: set[tuple[int, int]] = set()
        while waiting:
            q = waiting.pop()
            k = int(self._step[q])
            # Of blocks that are written out only the instance that is asked for is followed. A whole system couples all
            # it has.
            row = int(self._row[q]) if k >= 0 and isinstance(self._steps[k], Step) else -1
            if k < 0 or (k, row) in done:
                continue
            done.add((k, row))
            for equation in self._steps[k].equations:
                rows = slice(None) if row < 0 else row
                found.update(equation.parameter[rows].ravel().tolist())
                more = set(equation.outside[rows].ravel().tolist()) - seen
                seen |= more
                waiting.extend(more)
        return found


def _in_order(table: EventTable, reads: list[set[int]]) -> EventTable:
    """The events in the order in which they happen at one instant: those that write what others read come first,
    sampled ones before conditions."""
    writers: dict[int, list[int]] = {}
    for e, written in zip(table.event.tolist(), table.discrete.tolist(), strict=True):
        writers.setdefault(written, []).append(e)
    n = table.n_clocks

    def sorted_by_reads(events: range) -> list[int]:
        sorter: graphlib.TopologicalSorter[int] = graphlib.TopologicalSorter({e: () for e in events})
        readers = [e for e in events if reads[e]]
        for e in readers:
            # What an event reads and writes itself, as a counter does, orders nothing.
            sorter.add(e, *sorted({k for read in reads[e] for k in writers.get(read, ()) if k != e and k in events}))
        return list(sorter.static_order())

    try:
        clocks = sorted_by_reads(range(n))
    except graphlib.CycleError as error:
        names = ", ".join(f"'{table.text[e]}'" for e in dict.fromkeys(error.args[1]))
        raise ModelError(
            f"the sampled events {names} need each other's results at the same instant, directly or through "
            "equations: let one of them read the value before, pre(…)"
        ) from None
    conditions = range(n, len(table))
    try:
        order = sorted_by_reads(conditions)
    except graphlib.CycleError:  # conditions that need each other's results need not become true at one instant
        order = list(conditions)
    return table.take([*clocks, *order])


def read_variables(
    variables: QuantityMap, chosen: np.ndarray, program: Callable[[np.ndarray], Program]
) -> tuple[Program, Gather]:
    """The program that computes variables, and where it has them; −1 stands for zero."""
    quantity = np.where(chosen < 0, ZERO, variables.quantity[chosen])
    made = program(quantity)
    if not len(chosen):
        return made, NOTHING
    return made, made.layout.gather(quantity, np.where(chosen < 0, 1.0, variables.factor[chosen]))


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
