"""A compiled system as an FMU: a zip file with a description, C sources, and a binary."""

import hashlib
import io
import math
import os
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..base.errors import ModelError, nearest
from ..compile.model.array_names import inner_name
from ..run.system.system import AcausalSystem
from .compilers import TARGETS, compiler_for, shared_library, this_platform
from .content import Content
from .dependencies import dependencies
from .description import Structure, Variable, model_description, structured, unit_of_rate
from .model_c import CVariable, fixed, model_files, table_of_variables
from .programs import NAMES, check_exportable

SOURCE = "fmi3.c"
KINDS = ("model_exchange", "co_simulation")
CO_SIMULATION_UPTO = 300  # states: a step factorizes a dense matrix, 27 million multiplications at this size


def export_fmu(
    system: AcausalSystem,
    path: str | os.PathLike[str],
    *,
    outputs: Sequence[str] | None = None,
    parameters: Sequence[str] | str = "all",
    kinds: Sequence[str] | None = None,
    platforms: Sequence[str] | str | None = None,
    stop_time: float = 1.0,
    tolerance: float = 1e-6,
    overwrite: bool = False,
) -> Path:
    """Writes a system as a Functional Mock-up Unit: FMI 3.0, Model Exchange and Co-Simulation, with C
    sources.

    An importer (Simulink, OpenModelica, FMPy, …) integrates it without Python. It computes what `simulate` computes:
    the same equations, networks and functions, events by the same map, and consistent starts. Directional and adjoint
    derivatives are exact, through blocks of equations and by the weights of networks, too.

    **Arguments:**

    - `path`: the file, `"plant.fmu"`.
    - `outputs`: the variables that are outputs, continuous or discrete. None: all of them; choose some of a large
        model.
    - `parameters`: the parameters, arrays of parameters and networks that an importer may set. `"all"`: each of them.
        Others keep the values of `system`. Those that only the start reads are `fixed`, others are `tunable`.
    - `kinds`: `"model_exchange"` is always there. `"co_simulation"` adds a solver, Rodas5P, with error control by the
        importer's tolerance, events, and dense factorizations of up to 300 states. None: it is added if there are no
        more states.
    - `platforms`: for which platforms binaries are made, as `"x86_64-windows"`; `"all"` for all that are known. Those
        of other machines need the package `ziglang`. None: this machine's, if there is a compiler. `()`: sources only.
    - `stop_time` (second), `tolerance`: the default experiment. Where an importer gives no tolerance, states are moved
        onto their constraints when they are farther off than a hundredth of `tolerance`.
    - `overwrite`: whether a file that exists is replaced.

    **Returns:**

    The path. The same model gives the same bytes, on one machine and with one compiler.

    **Raises:**

    - `ModelError` for a name that does not exist, a file that exists, a batch of systems, single precision, an input
        that the model differentiates, and a function with operations that cannot be written in C, with its line.
    - `MissingPackage` for a binary of another machine's platform, without Zig.

    Source: Functional Mock-up Interface 3.0 (Modelica Association, 2022, fmi-standard.org).
    """
    target = Path(path)
    if target.suffix != ".fmu":
        raise ModelError(f"the file of an FMU ends in .fmu; got '{target}'")
    if target.exists() and not overwrite:
        raise ModelError(f"'{target}' exists: give another name, or overwrite=True")
    if not target.parent.is_dir():
        raise ModelError(f"there is no folder '{target.parent}'")
    chosen = list(TARGETS) if platforms == "all" else [platforms] if isinstance(platforms, str) else platforms
    commands = {}
    for name in [this_platform()] if chosen is None else chosen:
        command = compiler_for(name)
        if command is not None:
            commands[name] = command
        elif chosen is not None:
            raise ModelError(f"there is no C compiler for {name} on this machine: install one, or give platforms=()")
    files, description, identifier = fmu_files(
        system, target.stem, outputs=outputs, parameters=parameters, kinds=kinds, stop_time=stop_time,
        tolerance=tolerance,
    )  # fmt: skip
    contents = {"modelDescription.xml": description.encode(), "sources/buildDescription.xml": _build(identifier)}
    contents |= {f"sources/{name}": text.encode() for name, text in files.items()}
    for name, command in commands.items():
        ending = TARGETS.get(name, ("", ".so"))[1]
        library = shared_library(command, name, files, SOURCE)
        contents[f"binaries/{name}/{identifier}{ending}"] = library
    target.write_bytes(zipped(contents))
    return target


def zipped(contents: dict[str, bytes]) -> bytes:
    """A zip file without times, in the order of names."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        for name in sorted(contents):
            # The earliest time that a zip file can hold, so that the same model gives the same bytes.
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            file.writestr(entry, contents[name])
    return stream.getvalue()


def _build(identifier: str) -> bytes:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{identifier}">\n'
        '    <SourceFileSet language="C99" compilerOptions="-ffp-contract=off">\n'
        f'      <SourceFile name="{SOURCE}"/>\n    </SourceFileSet>\n'
        '    <Library name="m"/>\n  </BuildConfiguration>\n</fmiBuildDescription>\n'
    ).encode()


def fmu_files(
    system: AcausalSystem, stem: str, *, outputs: Sequence[str] | None = None, parameters: Sequence[str] | str = "all",
    kinds: Sequence[str] | None = None, stop_time: float = 1.0, tolerance: float = 1e-6,
) -> tuple[dict[str, str], str, str]:  # fmt: skip
    """The C files by name, `modelDescription.xml`, and the identifier of the model."""
    check_exportable(system)
    system = system.merged().without_stiffness
    if kinds is not None and (unknown := set(kinds) - set(KINDS)):
        raise ModelError(f"kinds: '{min(unknown)}' is not known; there are {', '.join(KINDS)}")
    small = len(system.states) <= CO_SIMULATION_UPTO
    co_simulation = small if kinds is None else "co_simulation" in kinds
    if co_simulation and not small:
        raise ModelError(
            f"kinds: Co-Simulation factorizes dense matrices of up to {CO_SIMULATION_UPTO} states, and this model has "
            f"{len(system.states)}: export it for Model Exchange, kinds=['model_exchange']"
        )
    names = [name for name in NAMES if name != "step" or co_simulation]
    model = _Variables(system, outputs, parameters, names)
    identifier = re.sub(r"\W", "_", stem, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"m_{identifier}"

    structure = model.structure()

    def description(token: str) -> str:
        return model_description(
            system.plan.flat.name or stem, identifier, token, model.variables, structure, model.needs_steps,
            co_simulation, stop_time, tolerance,
        )  # fmt: skip

    files, _ = model_files(model.programs, model.defaults(), model.nominals, model.texts(), tolerance)
    files |= {name: fixed(name) for name in (SOURCE, "fmi3_types.h")}
    files["variables.c"] = table_of_variables([v.c for v in model.variables])
    content = description("") + "".join(text for _, text in sorted(files.items()))
    digest = hashlib.sha256(content.encode()).hexdigest()
    token = f"{{{digest[:8]}-{digest[8:12]}-{digest[12:16]}-{digest[16:20]}-{digest[20:32]}}}"
    return {**files, "token.h": f'#define TOKEN "{token}"\n'}, description(token), identifier


class _Variables(Content):
    """The variables of an FMU, and where they stand."""

    def __init__(
        self, system: AcausalSystem, outputs: Sequence[str] | None, parameters: Sequence[str] | str,
        functions: Sequence[str],
    ):  # fmt: skip
        super().__init__(system, outputs, functions)
        self.parameter_names, self.weights = self._parameters(parameters)
        self._traced = self.programs.traced
        self._depend = self._dependencies()
        self.variables = self._variables(self.wanted)

    # --- names ------------------------------------------------------------------------------------------------------

    def _parameters(self, parameters: Sequence[str] | str) -> tuple[list[str], list[int]]:
        """The names of parameters, and the places of weights, that can be set."""
        system, table = self.system, self.system.parameters.table
        discrete = set(system.every_discrete)
        settable = [n for k, n in enumerate(table.names) if k not in table.expressions and n not in discrete]
        if isinstance(parameters, str) and parameters == "all":
            return settable, list(range(len(self.programs.weights)))
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
            k for k, w in enumerate(self.programs.weights) if any(_belongs(w.name, network) for network in networks)
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
        for name in ("field", "outputs", "guards"):
            parts += dependencies(self._traced[name], given, n)
        return sp.csr_array(sp.vstack(parts, format="csr"))

    def _places(self, unknown: int) -> list[int]:
        """The places of the variables that an unknown depends on."""
        row = self._depend[[unknown]]
        found = self.place_of_column[row.indices[row.data.astype(bool)]]
        return sorted({int(k) for k in found if k >= 0})

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
            given = {"size": 1, "start": -1, "known": False, "low": -math.inf, "high": math.inf} | more
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
            w = p.weights[k]
            own = c(structured(w.name), "STORED", "ALWAYS", at[f"w{k}"], known=True, size=w.value.size)
            if w.value.size:
                add(Variable(own.name, "parameter", "tunable", own, "exact", w.value), at[f"w{k}"])
        self.guard_places, self.indicator_places = [], []
        names = () if plan.events is None else plan.events.names[plan.events.n_clocks :]
        for k, text in enumerate(names):
            own = c(self.guard_names[k], "UNKNOWN", "NEVER", p.nx + p.ny + k)
            told = f"Falls through zero where the condition of an event becomes true: {text}"
            self.guard_places.append(
                add(Variable(own.name, "output", "continuous", own, initial="calculated", description=told))
            )
        for k, text in enumerate(names):
            own = c(f"events.indicator[{k + 1}]", "INDICATOR", "NEVER", k)
            told = f"The guard, moved by its rounding: {text}"
            self.indicator_places.append(
                add(Variable(own.name, "local", "continuous", own, initial="calculated", description=told))
            )
        self.place_of_column = columns
        return out

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

    def structure(self) -> Structure:
        nx, ny = self.programs.nx, self.programs.ny
        names = set(self.output_states)
        outputs: dict[int, Sequence[int] | None] = {
            place: [place] for place, name in zip(self.state_places, self.system.states, strict=True) if name in names
        }
        outputs |= {place: self._places(nx + k) for k, place in enumerate(self.output_places)}
        outputs |= {place: None for place, is_output in self.discrete_places if is_output}
        outputs |= {place: self._places(nx + ny + k) for k, place in enumerate(self.guard_places)}
        derivatives: dict[int, Sequence[int] | None] = {
            place: self._places(k) for k, place in enumerate(self.slope_places)
        }
        indicators: dict[int, Sequence[int] | None] = {
            place: self._places(nx + ny + k) for k, place in enumerate(self.indicator_places)
        }
        moving = {*self.state_places, *self.slope_places}
        calculated = [
            k for k, v in enumerate(self.variables)
            if v.initial == "calculated" and (v.causality == "output" or k in moving)
        ]  # fmt: skip
        return Structure(outputs, derivatives, indicators, calculated)


def _belongs(weight: str, network: str) -> bool:
    return weight == network or weight.startswith((f"{network}.", f"{network}["))
