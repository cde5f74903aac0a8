"""An FMU as a component: its equations are calls of its binary, through FMPy."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import sympy

from ..base.errors import ModelError, nearest
from ..write.component import Component
from ..write.environment import EqnEnv
from ..write.events import assign, reinit, terminate
from ..write.symbols import der
from .calls import Calls, Sign
from .described import Described


class FmuComponent(Component):
    """A Functional Mock-up Unit for Model Exchange, FMI 3.0 or 2.0, as a component.

    Its states, outputs, inputs and parameters are this component's; names that are no identifiers have underscores in
    place of other letters (`names`). The field and the outputs are calls of the binary. Derivatives by states and
    inputs are the FMU's own directional derivatives where it has them, and central differences otherwise: `derivatives`
    says which. Those by parameters and those of event indicators are central differences. So forward and reverse mode
    work; second derivatives are refused. Calls go to the host; members of a batch have instances of their own.

    Events happen where an indicator changes its sign, and at the times that the FMU names. Its discrete variables are
    hidden in it: the discrete variable `events_memory` is the number of their history. A gradient through an event
    needs that no discrete variable depends on states or inputs; this is checked where it is taken.

    **Arguments:**

    - `path`: the file.
    - `outputs`: the names of outputs to read; None: all scalar ones. Integers and booleans are read as numbers.
    - `parameters`: the names of the FMU's parameters that are parameters here; None: all scalar real ones. Others keep
        the values that they start with.

    **Raises:**

    - `ModelError` for a file that does not exist, another version of FMI or platform, an FMU without Model Exchange or
        with arrays of states, and an unknown name.
    - `MissingPackage` without FMPy, which names the extra.
    """

    names: dict[str, str]
    derivatives: str

    def __init__(
        self, ev: EqnEnv, name: str, path: Any, *, outputs: Sequence[str] | None = None,
        parameters: Sequence[str] | None = None,
    ):  # fmt: skip
        super().__init__(ev, name)
        fmu = Described(Path(path), f"{name}: ")
        outputs = fmu.outputs if outputs is None else list(outputs)
        parameters = fmu.parameters if parameters is None else list(parameters)
        for wanted, known, what in ((outputs, fmu.outputs, "output"), (parameters, fmu.parameters, "parameter")):
            for one in wanted:
                if one not in known:
                    raise ModelError(f"{name}: '{one}' is not a scalar {what} of the FMU: " + nearest(one, known))
        shown = [n for n in outputs if n not in fmu.states]
        calls = Calls(fmu, shown, parameters)
        self.derivatives = "directional derivatives" if fmu.directional else "central differences"
        self.names = {}

        def own(of_fmu: str) -> str:
            short = re.sub(r"\W+", "_", of_fmu).strip("_")
            short = f"_{short}" if short[:1].isdigit() else short
            if short in self.names.values():
                raise ModelError(f"{name}: two variables of the FMU would have the name '{short}'")
            self.names[of_fmu] = short
            return short

        values = calls.parameter_values
        p = [
            self.parameter(own(n), float(v), unit=fmu.unit(n), bounds=fmu.bounds(n))
            for n, v in zip(parameters, values, strict=True)
        ]
        held_by = [*fmu.inputs, *parameters]  # what the states at the start may depend on
        x = [
            self.variable(own(n), unit=fmu.unit(n), nominal=fmu.nominal(n), start=float(v), fixed=not held_by)
            for n, v in zip(fmu.states, calls.starts_of(values), strict=True)
        ]
        u = [self.input(own(n), default=fmu.start(n)) for n in fmu.inputs]
        # Functions read variables; these have the values of parameters.
        held = [self.variable(f"{self.names[n]}_value") for n in parameters]
        self.add_equations(*(sympy.Eq(v, s, evaluate=False) for v, s in zip(held, p, strict=True)))
        point = [ev.t, *x, *u, *held]
        if calls.has_events:
            memory = self.discrete("events_memory", unit="1")
            kept = self.variable("events_memory_value", unit="1")
            self.add_equations(sympy.Eq(kept, memory, evaluate=False))
            point = [*point, kept]
        found = self._function("fmu", calls.function, point, calls.n_unknowns)
        self.add_equations(*(sympy.Eq(der(v), f, evaluate=False) for v, f in zip(x, found, strict=False)))
        for one, value in zip(shown, found[len(x) :], strict=True):
            self.output(own(one), value, unit=fmu.unit(one))
        if held_by and x:
            starts = self._function("starts", calls.start, [ev.t, *u, *held], len(x))
            self.initially(*(sympy.Eq(v, s, evaluate=False) for v, s in zip(x, starts, strict=True)))
        if calls.has_events:
            self._declare_events(calls, memory, point, x)

    def _function(self, name: str, function: Any, inputs: Sequence[Any], n: int) -> Sequence[Any]:
        return self.function(name, function, inputs=inputs) if n else ()

    def _declare_events(self, calls: Calls, memory: Any, point: Sequence[Any], x: Sequence[Any]) -> None:
        """Events where an indicator changes its sign in either direction, at the time that the FMU named last, and at
        the start, where it names the first."""
        due, waits = self.discrete("events_due", unit="s"), self.discrete("events_wait", unit="1")
        ended = self.discrete("events_end", unit="1")
        known_due = self.variable("events_due_value", unit="s")
        self.add_equations(sympy.Eq(known_due, due, evaluate=False))
        targets = [memory, due, waits, ended]

        def actions(name: str, sign: Sign) -> Sequence[Any]:
            after = self.function(name, calls.event(sign), inputs=[*point, known_due])
            return [
                *(reinit(v, new) for v, new in zip(x, after, strict=False)),
                *(assign(q, new) for q, new in zip(targets, after[len(x) :], strict=True)),
            ]

        in_time = actions("event", None)
        self.when(memory < 0.5, *in_time, at_start=True)
        self.when(self.ev.t >= due, *in_time, on=sympy.Eq(waits, 1))
        for k, z in enumerate(self._function("indicators", calls.indicators, point, calls.n_indicators)):
            self.when(z <= 0, *actions(f"event_{k}_falls", (k, False)))
            self.when(z > 0, *actions(f"event_{k}_rises", (k, True)))
        self.when(ended > 0.5, terminate("the FMU ended the run"), at_start=True)
