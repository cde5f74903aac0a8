"""The parts of a system that are written in C: its programs, where their numbers stand, and the texts of messages."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..compile.lowering.plan import SystemPlan
from ..compile.model.array_names import inner_name
from ..run.start.rows import initial_rows
from ..run.system.system import AcausalSystem
from .description import structured
from .model_c import Layout
from .programs import Programs


class Content:
    """The programs of a system with these names. `outputs` are the variables to read; None: all of them. Those among
    them that are neither states nor discrete are the `outputs` of the programs."""

    def __init__(self, system: AcausalSystem, outputs: Sequence[str] | None, functions: Sequence[str]):
        self.system, self.plan = system, system.plan
        states = system.states
        flat = self.plan.flat.variables
        number = {n: self.plan.variable_index[n] for n in states if n in self.plan.variable_index}
        fixed = [n for n, v in number.items() if flat.fixed[v] and flat.start.is_number[v]]
        self.discretes = system.discretes
        self.wanted = self._outputs(outputs)
        self.output_states = [n for n in self.wanted if n in states]
        self.output_discretes = [n for n in self.wanted if n in self.discretes]
        own = {*states, *self.discretes, *system.inputs}
        self.outputs = [n for n in self.wanted if n not in own]
        self.programs = Programs(system, self.outputs, fixed, functions)
        self.layout = Layout.of(self.programs)
        own_names = set(map(structured, states))
        self.slope_names = [_name_of_slope(name, own_names) for name in states]
        n = self.programs.n_opened
        self.opened_names = [f"dae.slope[{k + 1}]" for k in range(len(states) * bool(n))]
        self.opened_names += [f"dae.residual[{k + 1}]" for k in range(n - len(self.opened_names))]
        self.guard_names = [f"events.guard[{k + 1}]" for k in range(self.programs.ng)]

    def _outputs(self, outputs: Sequence[str] | None) -> list[str]:
        system, plan = self.system, self.plan
        if outputs is None:
            inputs = set(system.inputs)
            return [*(n for n in system.variables if n not in inputs), *system.discretes]
        if isinstance(outputs, str):
            raise ModelError(f"outputs is a list of names; write outputs=[{outputs!r}]")
        names = list(dict.fromkeys(plan.entry_names(outputs)))
        for name in names:
            if name in system.inputs:
                raise ModelError(f"outputs: '{name}' is an input")
            if name not in system.discretes and name not in system.states:
                plan.resolve([name])
        return names

    def start_of(self, name: str) -> float:
        """The start of a state that has a number for it."""
        v = self.plan.variable_index[name]
        start = self.plan.flat.variables.start[v]
        assert start is not None
        return start.value(np.zeros(0))

    @property
    def nominals(self) -> np.ndarray:
        return np.asarray(self.system.state_sizes, float)[: self.programs.nx]

    def defaults(self) -> np.ndarray:
        """The numbers of a new instance, shape (layout,)."""
        out = np.zeros(self.layout.size)

        def put(name: str, values: Any) -> None:
            begin, count = self.layout.places[name]
            out[begin : begin + count] = np.ravel(values)

        put("p", self.programs.p)
        put("u", [0.0 if d is None else d for d in self.plan.inputs.defaults])
        put("s", [self.start_of(name) for name in self.programs.starts])
        for k, w in enumerate(self.programs.weights):
            put(f"w{k}", w.value)
        return out

    def texts(self) -> dict[str, Sequence[str]]:
        """The texts of messages."""
        plan = self.plan
        return {
            "unknowns": [*self.slope_names, *map(structured, self.outputs), *self.guard_names, *self.opened_names],
            "rows": _rows_of_start(plan, self.programs.starts),
            "carried": self.system.carried,
            "events": () if plan.events is None else plan.events.names,
        }


def _rows_of_start(plan: SystemPlan, starts: Sequence[str]) -> list[str]:
    """The texts of the equations that determine a start, in their order in `InitialPoint.residual`."""
    rows = initial_rows(plan, tuple(starts))
    names = [f"the start of {row.name}" for row in rows.kept]
    if rows.direct:
        return names
    equations = [plan.describe(int(e)) for planned in plan.constraints for e in planned.equation.equation]
    left = [equation for step in plan.steps if step.carried for equation in step.left]
    return [*equations, *(plan.describe(int(e)) for found in left for e in found.equation), *names]


def _name_of_slope(state: str, states: set[str]) -> str:
    """The name of a state's derivative: der(x), or der(x,1) where der(x) is a state itself."""
    order, inner = inner_name(state)
    name = structured("der(" * (order + 1) + inner + ")" * (order + 1))
    return f"{name[:-1]},1)" if name in states else name
