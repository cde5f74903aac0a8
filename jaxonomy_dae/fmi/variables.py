"""The variables of an FMU: what an importer sees of a system, and where it stands in the C code."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..base.errors import ModelError, nearest
from ..compile.model.array_names import inner_name
from ..run.system.system import AcausalSystem
from .arrays import as_arrays, entries_together
from .content import Content
from .dependencies import dependencies
from .description import Structure, Variable, structured, unit_of_rate
from .manifest import Formulation, manifest
from .model_c import CVariable
from .open_blocks import given_quantities, residual_equations


class Variables(Content):
    """The variables of an FMU of a version of FMI, and where they stand. Version 2 has neither arrays nor event
    indicators among them."""

    def __init__(
        self, system: AcausalSystem, outputs: Sequence[str] | None, parameters: Sequence[str] | str,
        functions: Sequence[str], version: int = 3, arrays: bool = False,
    ):  # fmt: skip
        self._arrays = arrays
        super().__init__(system, outputs, functions)
        self._version = version
        self.parameter_names, self.weights = self._parameters(parameters)
        if arrays:
            self.parameter_names = entries_together(self.parameter_names)
        self._traced = self.programs.traced
        self._depend = self._dependencies()
        every = self._variables(self.wanted)
        self.variables, self._new = as_arrays(every) if arrays else (every, np.arange(len(every)))

    def _outputs(self, outputs: Sequence[str] | None) -> list[str]:
        names = super()._outputs(outputs)
        return entries_together(names) if self._arrays else names

    # --- names ------------------------------------------------------------------------------------------------------

    def _parameters(self, parameters: Sequence[str] | str) -> tuple[list[str], list[int]]:
        """The names of parameters, and the places of weights, that can be set."""
        system, table = self.system, self.system.parameters.table
        discrete = set(system.every_discrete)
        settable = [n for k, n in enumerate(table.names) if k not in table.expressions and n not in discrete]
        if isinstance(parameters, str) and parameters == "all":
            return settable, list(range(len(self.programs.networks)))
        if isinstance(parameters, str):
            raise ModelError(f'parameters is a list of names, or "all"; write parameters=[{parameters!r}]')
        names: list[str] = []
        networks: set[str] = set()
        for name in parameters:
            if name in system.neural:
                networks.add(name)
                continue
            found = table.one_by_one(name)
            for one in found:
                if one in discrete:
                    raise ModelError(f"parameters: '{one}' is a discrete variable, which events assign")
                if one not in table.names:
                    raise ModelError(
                        f"'{one}' is neither a parameter nor a network: " + nearest(one, [*table.names, *system.neural])
                    )
                table.settable(one)
            names += found
        kept = [
            k for k, w in enumerate(self.programs.networks) if any(_belongs(w.name, network) for network in networks)
        ]
        return list(dict.fromkeys(names)), kept

    # --- what depends on what ---------------------------------------------------------------------------------------

    def _dependencies(self) -> Any:
        """For each unknown, the numbers of the layout that it depends on: shape (unknowns, layout)."""
        n, parts = self.layout.size, []

        def columns(name: str, count: int) -> Any:
            if not count or name == "z":
                return None
            begin = self.layout[name]
            return sp.csr_array((np.ones(count, bool), (np.arange(count), begin + np.arange(count))), shape=(count, n))

        p = self.programs
        counts = {"t": 1, "x": p.nx, "z": p.nz, "q": p.nq, "p": len(p.p), "u": len(self.plan.inputs.names)}
        given = [columns(name, count) for name, count in counts.items()]
        given += [columns(f"w{k}", w.value.size) for k, w in enumerate(p.weights)]
        for name in ("field", "outputs", "guards", *(["opened"] if p.n_opened else [])):
            parts += dependencies(self._traced[name], given, n)
        return sp.csr_array(sp.vstack(parts, format="csr"))

    def _places(self, unknown: int) -> list[int]:
        """The places of the variables that an unknown depends on."""
        row = self._depend[[unknown]]
        found = self.place_of_column[row.indices[row.data.astype(bool)]]
        return sorted({int(self._new[k]) for k in found if k >= 0})

    @property
    def _tunable(self) -> np.ndarray:
        """True for numbers of the layout that field, outputs, guards or events read."""
        used = np.zeros(self.layout.size, bool)
        used[self._depend.indices[self._depend.data.astype(bool)]] = True
        if self.plan.events is not None:
            n = self.layout.size
            begin, count = self.layout.places["p"]
            own = sp.csr_array((np.ones(count, bool), (np.arange(count), begin + np.arange(count))), shape=(count, n))
            given: list[Any] = [None] * len(self._traced["event"].jaxpr.invars)
            given[4] = own
            for found in dependencies(self._traced["event"], given, n):
                used[found.indices[found.data.astype(bool)]] = True
        return used

    # --- variables --------------------------------------------------------------------------------------------------

    def _variables(self, wanted: Sequence[str]) -> list[Variable]:
        system, plan, p, at = self.system, self.plan, self.programs, self.layout
        flat = plan.flat.variables
        table = system.parameters.table
        is_output = set(wanted)
        out: list[Variable] = []
        columns = np.full(at.size, -1)
        sizes = np.asarray(system.state_sizes, float)

        def add(variable: Variable, begin: int | None = None) -> int:
            out.append(variable)
            if begin is not None:
                columns[begin : begin + variable.c.size] = len(out) - 1
            return len(out) - 1

        def c(name: str, kind: str, settable: str, place: int, **more: Any) -> CVariable:
            given = {"size": 1, "step": 1, "start": -1, "known": False, "low": -math.inf, "high": math.inf} | more
            return CVariable(kind=kind, settable=settable, place=place, name=name, **given)

        add(
            Variable("time", "independent", "continuous", c("time", "STORED", "NEVER", at["t"], known=True), unit="s"),
            at["t"],
        )
        self.state_places, self.slope_places = [], []
        jumps = plan.events is not None or bool(plan.n_projected)
        for k, name in enumerate(system.states):
            unit = self._unit(name)
            begins = name in p.starts
            place = at["x"] + k
            own = c(
                structured(name), "STORED", "ALWAYS", place, known=True,
                start=at["s"] + p.starts.index(name) if begins else -1,
            )  # fmt: skip
            variable = Variable(
                own.name, "output" if name in is_output else "local", "continuous", own, unit=unit,
                initial="exact" if begins else "calculated", nominal=float(sizes[k]), reinit=jumps,
                start=np.array(self.start_of(name)) if begins else None,
            )  # fmt: skip
            self.state_places.append(add(variable, place))
        for k, name in enumerate(system.states):
            own = c(self.slope_names[k], "UNKNOWN", "NEVER", k)
            variable = Variable(
                own.name, "local", "continuous", own, initial="calculated", derivative=self.state_places[k],
                unit=unit_of_rate(self._unit(name)),
            )  # fmt: skip
            self.slope_places.append(add(variable))
        for k, name in enumerate(plan.inputs.names):
            v = plan.variable_index[name]
            low, high = (float(b) for b in flat.bounds[v])
            default = plan.inputs.defaults[k]
            own = c(structured(name), "STORED", "ALWAYS", at["u"] + k, known=True, low=low, high=high)
            start = np.array(0.0 if default is None else float(default))
            add(Variable(own.name, "input", "continuous", own, start=start, unit=self._unit(name)), at["u"] + k)
        self.output_places = []
        for k, name in enumerate(self.outputs):
            own = c(structured(name), "UNKNOWN", "NEVER", p.nx + k)
            variable = Variable(own.name, "output", "continuous", own, initial="calculated", unit=self._unit(name))
            self.output_places.append(add(variable))
        self.discrete_places = []
        for k, name in enumerate(self.discretes):
            own = c(structured(name), "STORED", "NEVER", at["q"] + k)
            causality = "output" if name in is_output else "local"
            unit = table.units[table.index(name)]
            variable = Variable(own.name, causality, "discrete", own, initial="calculated", unit=unit)
            self.discrete_places.append((add(variable), causality == "output"))
        tunable = self._tunable
        for name in self.parameter_names:
            k = table.index(name)
            low, high = (float(b) for b in table.bounds[k])
            place = at["p"] + k
            free = bool(tunable[place])
            own = c(structured(name), "STORED", "ALWAYS" if free else "BEFORE", place, known=True, low=low, high=high)
            variability = "tunable" if free else "fixed"
            start = np.array(float(p.p[k]))
            add(Variable(own.name, "parameter", variability, own, "exact", start, table.units[k]), place)
        for k in self.weights:
            for name, value, place in self._settable_parts(p.weights[k].name, p.weights[k].value, at[f"w{k}"]):
                own = c(structured(name), "STORED", "ALWAYS", place, known=True, size=value.size)
                add(Variable(own.name, "parameter", "tunable", own, "exact", value, shape=value.shape), place)
        self.guard_places, self.indicator_places = [], []
        names = () if plan.events is None else plan.events.names[plan.events.n_clocks :]
        for k, text in enumerate(names):
            own = c(self.guard_names[k], "UNKNOWN", "NEVER", p.nx + p.ny + k)
            told = f"Falls through zero where the condition of an event becomes true: {text}"
            self.guard_places.append(
                add(Variable(own.name, "output", "continuous", own, initial="calculated", description=told))
            )
        for k, text in enumerate(names if self._version == 3 else ()):
            own = c(f"events.indicator[{k + 1}]", "INDICATOR", "NEVER", k)
            told = f"The guard, moved by its rounding: {text}"
            self.indicator_places.append(
                add(Variable(own.name, "local", "continuous", own, initial="calculated", description=told))
            )
        self.algebraic_places, self.opened_places = [], []
        if p.n_opened:
            begin = at[f"w{len(p.networks)}"]
            for k, (quantity, value) in enumerate(zip(given_quantities(plan), p.weights[-1].value, strict=True)):
                own = c(f"dae.algebraic[{k + 1}]", "STORED", "ALWAYS", begin + k, known=True)
                told = f"{plan.quantity_name[quantity]}, as users of FMI-LS-DAE give it"
                start = np.array(float(value))
                variable = Variable(own.name, "local", "continuous", own, "approx", start, description=told)
                self.algebraic_places.append(add(variable, begin + k))
            for k, name in enumerate(self.opened_names):
                own = c(name, "UNKNOWN", "NEVER", p.nx + p.ny + p.ng + k)
                variable = Variable(own.name, "local", "continuous", own, initial="calculated")
                if k < p.nx:
                    variable = dataclasses.replace(variable, derivative=self.state_places[k])
                else:
                    told = f"What is left of {plan.describe(int(residual_equations(plan)[k - p.nx]))}"
                    variable = dataclasses.replace(variable, description=told)
                self.opened_places.append(add(variable))
        self.place_of_column = columns
        return out

    def _settable_parts(self, name: str, value: np.ndarray, place: int) -> list[tuple[str, np.ndarray, int]]:
        """The variables that make up an array: (name, value, place). One, or one for each of its entries."""
        if self._version == 3 or not value.shape:
            return [(name, value, place)] if value.size else []
        return [
            (f"{name}[{','.join(map(str, index))}]", value[index], place + k)
            for k, index in enumerate(np.ndindex(value.shape))
        ]

    def _unit(self, name: str) -> str:
        order, inner = inner_name(name)
        flat = self.plan.flat.variables
        if inner not in self.plan.variable_index:
            return ""
        unit = flat.unit[self.plan.variable_index[inner]]
        for _ in range(order):
            unit = unit_of_rate(unit)
        return unit

    # --- the description and the tables of the C code ---------------------------------------------------------------

    @property
    def needs_steps(self) -> bool:
        """Whether integrators must tell of completed steps."""
        return bool(self.plan.n_projected or self.programs.nz or self.programs.ng or self.programs.nc)

    def manifest(self) -> str:
        """The manifest of FMI-LS-DAE: residuals of one equation and of its derivatives stand together."""
        p, extended = self.programs, self.plan.extended
        first, opened = p.nx + p.ny + p.ng, [int(self._new[place]) for place in self.opened_places]
        slopes = {place: self._places(first + k) for k, place in enumerate(opened[: p.nx])}
        groups: dict[int, list[Formulation]] = {}
        highest = np.zeros(int(extended.base.max(initial=0)) + 1, int)
        np.maximum.at(highest, extended.base, extended.level)
        for k, equation in enumerate(residual_equations(self.plan)):
            base, level = int(extended.base[equation]), int(extended.level[equation])
            own = self._places(first + p.nx + k)
            found = Formulation(opened[p.nx + k], int(highest[base]) - level + 1, own)
            groups.setdefault(base, []).append(found)
        ordered = [sorted(group, key=lambda f: -f.index) for group in groups.values()]
        return manifest([int(self._new[place]) for place in self.algebraic_places], slopes, ordered)

    def structure(self) -> Structure:
        nx, ny = self.programs.nx, self.programs.ny
        names = set(self.output_states)

        def of(places: Sequence[int], begin: int) -> dict[int, Sequence[int] | None]:
            """What variables depend on that are the unknowns from `begin` on; an array on what its entries do."""
            found: dict[int, set[int]] = {}
            for k, place in enumerate(places):
                found.setdefault(int(self._new[place]), set()).update(self._places(begin + k))
            return {place: sorted(own) for place, own in found.items()}

        own = [
            int(self._new[s]) for s, name in zip(self.state_places, self.system.states, strict=True) if name in names
        ]
        outputs: dict[int, Sequence[int] | None] = {place: [place] for place in own}
        outputs |= of(self.output_places, nx)
        outputs |= {int(self._new[place]): None for place, is_output in self.discrete_places if is_output}
        outputs |= of(self.guard_places, nx + ny)
        moving = {int(self._new[place]) for place in (*self.state_places, *self.slope_places)}
        calculated = [
            k for k, v in enumerate(self.variables)
            if v.initial == "calculated" and (v.causality == "output" or k in moving)
        ]  # fmt: skip
        return Structure(outputs, of(self.slope_places, 0), of(self.indicator_places, nx + ny), calculated)


def _belongs(weight: str, network: str) -> bool:
    return weight == network or weight.startswith((f"{network}.", f"{network}["))
