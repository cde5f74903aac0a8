"""The report of a compilation, in user names."""

import functools

import numpy as np

from ...compile.diagnosis.wording import counted
from ...compile.lowering.plan import SystemPlan
from ...compile.model.entries import incidence
from ...compile.model.events import EventTable
from ...compile.model.starts import Start
from ...compile.model.symbolic import SymbolicTemplate, number_label, parameter_label
from ...compile.model.tables import FlatModel, provenance_of
from ...graph.structure.pantelides import Offsets, reduce_index
from ...write.events import EventFlag
from .passes import simultaneous_blocks
from .sections import Sections, folded, some
from .solver_choice import solver_choice


class SystemReport(Sections):
    """A report of the compiler; `print(report)` shows it.

    Attributes count and name: `n_equations`, `n_unknowns`, `n_aliases`, `index` (structural, of the model as written),
    `differentiated` (pairs of an equation's text and how often), `states`, `algebraics`, `carried`, `constraints`,
    `blocks` (of more than one equation, or nonlinear), `notes`. Of a model with events also `discretes` (with their
    starts), `events` of conditions, `relations` that are events, `left_alone` (those that are not), `clocks`, `modes`
    (equations that change with discrete variables) and `index_changes` (the constraints that come and go with them, and
    the index while they hold).

    `values` are those of all parameters, on which starts and periods depend; None where they are not known, inside jit
    and in a batch.
    """

    def __init__(self, plan: SystemPlan, values: np.ndarray | None = None):
        self._plan = plan
        flat = plan.flat
        self._values = values
        self.n_equations = flat.n_equations
        self.n_unknowns = len(flat.variables) - int(flat.variables.is_input.sum())
        self.n_aliases = len(plan.model.alias.eliminated)
        self.state_selection = plan.mode
        self.notes = list(plan.selection.notes)

    @functools.cached_property
    def _offsets(self) -> Offsets:
        """Index reduction of the model as written, before alias elimination: the numbers the literature gives."""
        flat = self._plan.flat
        column = np.full(len(flat.variables), -1, np.int64)
        unknown = np.flatnonzero(~flat.variables.is_input)
        column[unknown] = np.arange(len(unknown))
        return reduce_index(incidence(flat.groups, column, len(unknown)))

    @property
    def index(self) -> int:
        """The structural index; where highest derivatives cancel, that of the equations in which they do not."""
        extended = self._plan.extended
        counts = np.bincount(extended.base, minlength=1) - 1
        quantities = extended.quantities
        algebraic = (quantities.highest[: quantities.n_unknown_columns] == 0).any()
        # Where highest derivatives cancel, equations were combined, and differentiated more often than the structure of
        # those that were written asks for.
        return max(self._offsets.structural_index, int(counts.max(initial=0)) + int(algebraic))

    @property
    def degrees_of_freedom(self) -> int:
        """The number of initial values that can be chosen."""
        extended = self._plan.extended
        quantities = extended.quantities
        return int(quantities.highest[: quantities.n_unknown_columns].sum() - extended.level.astype(bool).sum())

    @property
    def differentiated(self) -> list[tuple[str, int]]:
        """(equation, number of differentiations) where that is not zero."""
        counts = self._offsets.equation
        groups = self._plan.flat.groups
        return [(str(provenance_of(groups, int(e))), int(counts[e])) for e in np.flatnonzero(counts)]

    @property
    def states(self) -> list[str]:
        """The differential states."""
        return [self._plan.quantity_name[q] for q in self._plan.states]

    @property
    def carried(self) -> list[str]:
        """Tearing variables of nonlinear blocks, kept in the state array."""
        return [self._plan.quantity_name[q] for q in self._plan.carried]

    @property
    def algebraics(self) -> list[str]:
        """The unknowns that are solved for, without derivatives."""
        plan = self._plan
        named: dict[int, str] = {}
        for name in plan.visible_variables:
            named.setdefault(plan.variable_map[plan.variable_index[name]][0], name)
        names = [(plan.quantity_name[q], named.get(q)) for q in plan.blocks.unknowns.tolist()]
        return [other if name.startswith("der(") else name for name, other in names if other is not None]

    @property
    def constraints(self) -> list[str]:
        """The hidden constraints the state is projected onto."""
        plan = self._plan
        return [plan.describe(int(e)) for e in plan.selection.constraints]

    @property
    def blocks(self) -> list[str]:
        """The simultaneous blocks, alike ones counted together."""
        kinds = {True: "linear", False: "nonlinear"}
        return [
            f"{times}{kinds[step.linear]} block of {len(names)}: {some(names)}; {how}"
            for step, times, names, how in simultaneous_blocks(self._plan)
        ]

    @property
    def discretes(self) -> list[str]:
        """The discrete variables and their starts."""
        flat, values = self._plan.flat, self._values
        names = [(p, flat.parameters.names[p]) for p in _declared(flat)] if len(flat.events) else []
        return [name if values is None else f"{name} = {values[p]:g}" for p, name in names]

    @property
    def events(self) -> list[str]:
        """The events of conditions, and what they do. Relations in equations are listed apart."""
        flat, table = self._plan.flat, self._plan.flat.events
        return [f"{table.text[e]}: {_actions(flat, e)}" for e in _listed(table) if e >= table.n_clocks]

    @property
    def relations(self) -> list[str]:
        """The relations in equations, and the jumps of sources, at which steps end. `smooth(...)` leaves one alone."""
        table = self._plan.flat.events
        found = [event for event in table.events if EventFlag.RELATION in event.flags]
        return list(dict.fromkeys(f"{event.owner}: {event.condition}" for event in found))

    @property
    def left_alone(self) -> list[str]:
        """The parts of equations whose relations are no events: they are smooth there, or said to be."""
        return list(self._plan.flat.events.left_alone)

    @property
    def clocks(self) -> list[str]:
        """The sampled events, their periods and offsets, and what they do."""
        flat, table = self._plan.flat, self._plan.flat.events
        out = []
        for e in _listed(table):
            clock = table.events[e].clock
            if clock is None:
                continue
            when = ""
            if self._values is not None:
                period, offset = (_number(part, self._values) for part in clock)
                when = f", every {period:g} s from {offset:g} s"
            out.append(f"{table.text[e]}{when}: {_actions(flat, e)}")
        return out

    @property
    def modes(self) -> list[str]:
        """The equations with two branches, of which a discrete variable chooses one."""
        flat = self._plan.flat
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

    @property
    def index_changes(self) -> list[str]:
        """The constraints that come and go with modes, and the index of each while it holds."""
        held = self._plan.flat.held
        index = np.bincount(held.owner, minlength=len(held)) + 1
        return [f"{text}: index {k} while it does" for text, k in zip(held.text, index.tolist(), strict=True)]

    def _contents(self) -> tuple[list[str], list[tuple[str, list[str]]]]:
        plan = self._plan
        flat, groups = plan.flat, plan.model.groups
        n_remaining, n_shapes = sum(map(len, groups)), len({g.template.key for g in groups})
        counts = [
            counted(self.n_equations, "equation"),
            counted(self.n_unknowns, "unknown"),
            counted(flat.parameters.n_declared, "parameter"),
            *([counted(len(plan.inputs.names), "input")] if plan.inputs.names else []),
            *([counted(len(plan.network_names), "network")] if plan.network_names else []),
        ]
        head = [
            ", ".join(counts),
            f"{self.n_aliases} alias{'' if self.n_aliases == 1 else 'es'} eliminated, "
            f"{counted(n_remaining, 'equation')} of {counted(n_shapes, 'shape')} "
            f"remain{'s' if n_remaining == 1 else ''}",
            f"structural index {self.index}, {counted(self.degrees_of_freedom, 'degree')} of freedom",
        ]
        head.append(f"state selection {self.state_selection}")
        head.append("simulate(solver=None) takes {}: {}".format(*solver_choice(plan)[:2]))
        discretes, events, clocks = self.discretes, self.events, self.clocks
        sections = [
            ("differentiated", [f"{n}× {text}" for text, n in self.differentiated]),
            (counted(len(self.states), "state"), [some(folded(self.states))]),
            ("algebraic unknowns in the state array", [some(folded(self.carried))]),
            (counted(len(self.algebraics), "algebraic variable"), [some(folded(self.algebraics))]),
            (counted(len(discretes), "discrete variable"), [some(discretes)]),
            (counted(len(events), "event"), events),
            (counted(len(clocks), "clock"), clocks),
            ("relations at which steps end", self.relations),
            ("relations at which they do not", self.left_alone),
            ("equations that change with a mode", self.modes),
            ("constraints that come and go", self.index_changes),
            ("hidden constraints, projected onto", self.constraints),
            ("simultaneous blocks", self.blocks),
            ("notes", self.notes),
        ]
        kept = [(title, [e for e in entries if e]) for title, entries in sections]
        return head, [(title, entries) for title, entries in kept if entries]


def _declared(flat: FlatModel) -> list[int]:
    """The parameters that are discrete variables, hidden ones left out."""
    return flat.parameters.discrete[: flat.parameters.n_shown].tolist()


def _listed(table: EventTable) -> list[int]:
    """The events that users wrote."""
    return np.flatnonzero(table.are(EventFlag.LISTED)).tolist()


def _actions(flat: FlatModel, event: int) -> str:
    """The actions of an event, in the words in which they are declared; values that are not numbers are left out, and
    so are hidden variables."""
    table = flat.events
    out = []
    for write in table.events[event].writes:
        value = "…" if write.value >= 0 else f"{write.constant:g}"
        if write.state >= 0:
            out.append(f"reinit({flat.variables.names[write.state]}, {value})")
        elif write.discrete < len(_declared(flat)):
            name = flat.parameters.names[flat.parameters.discrete[write.discrete]]
            out.append(f"assign({name}, {value})")
    message = table.events[event].message
    return ", ".join([*out, *([f"terminate({message!r})"] if message is not None else [])])


def _number(start: Start | None, values: np.ndarray) -> float:
    return float("inf") if start is None else start.value(values)
