"""A compiled system as an FMU: a zip file with a description, C sources, and a binary."""

import hashlib
import io
import math
import os
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

from ..base.errors import ModelError
from ..run.system.system import AcausalSystem
from .compilers import FOLDERS_OF_FMI_2, TARGETS, compiler_for, shared_library, this_platform
from .description import model_description
from .description_2 import model_description_2
from .manifest import PATH as MANIFEST
from .model_c import fixed, model_files, table_of_variables
from .programs import NAMES, check_exportable
from .variables import Variables

KINDS = ("model_exchange", "co_simulation")
CO_SIMULATION_UPTO = 300  # states: a step factorizes a dense matrix, 27 million multiplications at this size


def export_fmu(
    system: AcausalSystem,
    path: str | os.PathLike[str],
    *,
    outputs: Sequence[str] | None = None,
    parameters: Sequence[str] | str = "all",
    fmi: int = 3,
    arrays: bool = False,
    dae: bool = False,
    kinds: Sequence[str] | None = None,
    platforms: Sequence[str] | str | None = None,
    stop_time: float = 1.0,
    tolerance: float = 1e-6,
    overwrite: bool = False,
) -> Path:
    """Writes a system as a Functional Mock-up Unit: FMI 3.0 or 2.0, Model Exchange and Co-Simulation, with C
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
    - `fmi`: the version of FMI, 3 or 2. Version 2 has no adjoint derivatives; arrays are scalars there.
    - `arrays`: whether variables of arrays of components are arrays of FMI 3, `cell.c.v`, as in solutions, where they
        stand together; otherwise each entry, `cell[0].c.v`, is a scalar. Dependencies are those of whole arrays then.
    - `dae`: experimental; adds the equations without the solution of their blocks, for users of the layered standard
        FMI-LS-DAE (a draft): unknowns `dae.algebraic[1]`, … that they give, `dae.slope[1]`, …, and what equations
        leave, `dae.residual[1]`, …, hidden constraints included, each with its derivatives and index. FMI 3.
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

    - `ModelError` for a name or a version that does not exist, a file that exists, a batch of systems, single
        precision, an input that the model differentiates, and a function with operations that cannot be written in C,
        with its line.
    - `MissingPackage` for a binary of another machine's platform, without Zig.

    Source: Functional Mock-up Interface 3.0 and 2.0 (Modelica Association, 2022 and 2014, fmi-standard.org).
    """
    target = Path(path)
    if target.suffix != ".fmu":
        raise ModelError(f"the file of an FMU ends in .fmu; got '{target}'")
    if target.exists() and not overwrite:
        raise ModelError(f"'{target}' exists: give another name, or overwrite=True")
    if not target.parent.is_dir():
        raise ModelError(f"there is no folder '{target.parent}'")
    if fmi not in (2, 3):
        raise ModelError(f"fmi is the version of FMI, 3 or 2; got {fmi!r}")
    if arrays and fmi != 3:
        raise ModelError("arrays: FMI 2 has none: leave out fmi=2, or arrays=True")
    if dae and fmi != 3:
        raise ModelError("dae: the layered standard FMI-LS-DAE is one of FMI 3: leave out fmi=2, or dae=True")
    if isinstance(kinds, str):
        raise ModelError(f"kinds is a list of names; write kinds=[{kinds!r}]")
    if not 0 < tolerance < 1:
        raise ModelError(f"tolerance is a number between 0 and 1, as 1e-6; got {tolerance!r}")
    if not 0 < stop_time < math.inf:
        raise ModelError(f"stop_time is a positive number of seconds; got {stop_time!r}")
    known = TARGETS if fmi == 3 else FOLDERS_OF_FMI_2
    chosen = list(known) if platforms == "all" else [platforms] if isinstance(platforms, str) else platforms
    commands = {}
    for name in [this_platform()] if chosen is None else chosen:
        command = compiler_for(name)
        if command is not None:
            commands[name] = command
        elif chosen is not None:
            raise ModelError(f"there is no C compiler for {name} on this machine: install one, or give platforms=()")
    files, description, identifier, extra = fmu_files(
        system, target.stem, outputs=outputs, parameters=parameters, fmi=fmi, arrays=arrays, dae=dae, kinds=kinds,
        stop_time=stop_time, tolerance=tolerance,
    )  # fmt: skip
    contents = {"modelDescription.xml": description.encode()}
    contents |= {"sources/buildDescription.xml": _build(identifier)} if fmi == 3 else {}
    contents |= {name: text.encode() for name, text in extra.items()}
    contents |= {f"sources/{name}": text.encode() for name, text in files.items()}
    for name, command in commands.items():
        ending = TARGETS.get(name, ("", ".so"))[1]
        library = shared_library(command, name, files, _source(fmi))
        folder = name if fmi == 3 else FOLDERS_OF_FMI_2.get(name, name)
        contents[f"binaries/{folder}/{identifier}{ending}"] = library
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


def _source(version: int) -> str:
    """The C file that is compiled."""
    return f"fmi{version}.c"


def _build(identifier: str) -> bytes:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{identifier}">\n'
        '    <SourceFileSet language="C99" compilerOptions="-ffp-contract=off">\n'
        f'      <SourceFile name="{_source(3)}"/>\n    </SourceFileSet>\n'
        '    <Library name="m"/>\n  </BuildConfiguration>\n</fmiBuildDescription>\n'
    ).encode()


def fmu_files(
    system: AcausalSystem, stem: str, *, outputs: Sequence[str] | None = None, parameters: Sequence[str] | str = "all",
    fmi: int = 3, arrays: bool = False, dae: bool = False, kinds: Sequence[str] | None = None, stop_time: float = 1.0,
    tolerance: float = 1e-6,
) -> tuple[dict[str, str], str, str, dict[str, str]]:  # fmt: skip
    """The C files by name, `modelDescription.xml`, the identifier of the model, and other files by their paths."""
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
    if fmi == 2:
        names.remove("reverse")
    if dae:
        names.append("opened")
    model = Variables(system, outputs, parameters, names, fmi, arrays)
    identifier = re.sub(r"\W", "_", stem, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"m_{identifier}"

    structure, name = model.structure(), system.plan.flat.name or stem

    def description(token: str) -> str:
        if fmi == 2:
            return model_description_2(
                name, identifier, token, model.variables, structure, model.programs.ng, model.needs_steps,
                co_simulation, [_source(2)], stop_time, tolerance,
            )  # fmt: skip
        return model_description(
            name, identifier, token, model.variables, structure, model.needs_steps, co_simulation, stop_time, tolerance
        )

    files, _ = model_files(model.programs, model.defaults(), model.nominals, model.texts(), tolerance)
    files |= {name: fixed(name) for name in (_source(fmi), f"fmi{fmi}_types.h", "instance.c")}
    files["variables.c"] = table_of_variables([v.c for v in model.variables])
    content = description("") + "".join(text for _, text in sorted(files.items()))
    digest = hashlib.sha256(content.encode()).hexdigest()
    token = f"{{{digest[:8]}-{digest[8:12]}-{digest[12:16]}-{digest[16:20]}-{digest[20:32]}}}"
    extra = {MANIFEST: model.manifest()} if dae else {}
    return {**files, "token.h": f'#define TOKEN "{token}"\n'}, description(token), identifier, extra
