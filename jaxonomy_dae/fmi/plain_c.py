"""A compiled system as plain C99: a header, a source, a program that runs it, and its CMake file."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from ..base.errors import ModelError
from ..run.system.system import AcausalSystem
from .c_types import number
from .content import Content
from .export import CO_SIMULATION_UPTO
from .model_c import fixed, model_files, table_of_texts
from .model_c import text as c_text
from .programs import check_exportable

FUNCTIONS = ("derivatives", "events", "run")
KEYWORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while"
).split()
_ALWAYS = ("field", "outputs", "guards", "start")
_EVENTS = ("event", "accept")
_PROGRAMS = {"derivatives": ("forward", "reverse"), "events": _EVENTS, "run": (*_EVENTS, "step")}
# Names of `run.h` in the header, where they have the name of the model before them.
_OWN = re.compile(r"\b(State|Model|ROOM|N_UNKNOWNS|NX|NY|NG|ND|WORK)\b")


def write_c(
    system: AcausalSystem,
    path: str | os.PathLike[str],
    *,
    outputs: Sequence[str] | None = None,
    functions: Sequence[str] | None = None,
    stop_time: float = 1.0,
    tolerance: float = 1e-6,
    overwrite: bool = False,
) -> Path:
    """Writes a system as C99 for those who write their own integrator, or want one: into the folder `path`, named as
    the folder is, `plant.h`, `plant.c`, `main.c` and `CMakeLists.txt`.

    The code computes what an FMU of the system computes (`export_fmu`). It allocates nothing, has no variables of its
    own, and needs no libraries but those of C, `math.h` and `string.h`. The header says how to call it.

    **Arguments:**

    - `path`: a folder, which is made; its name is that of the functions in C.
    - `outputs`: the variables to read beside states and discrete ones. None: all of them.
    - `functions`: what there is beside the field, outputs, guards and the consistent start: `"derivatives"`, forward
        and reverse; `"events"`; `"run"`, events and steps of Rodas5P with error control. None: all, but `"run"` for up
        to 300 states only, for a step factorizes a dense matrix.
    - `stop_time` (second), `tolerance`: the defaults of `main.c`, which prints a run as a table.
    - `overwrite`: whether files that exist are replaced.

    **Returns:**

    The folder.

    **Raises:**

    - `ModelError` for a name that does not exist or is none in C, a file that exists, a batch of systems, single
        precision, an input that the model differentiates, and a function with operations that cannot be written in C,
        with its line.
    """
    folder = Path(path)
    stem = folder.name
    if not (stem.isascii() and stem.isidentifier()) or stem in KEYWORDS:
        raise ModelError(f"'{stem}' is not a name of C, and functions begin with the folder's: give another folder")
    names = ("plant.h", "plant.c", "main.c", "CMakeLists.txt")
    paths = {name: folder / name.replace("plant", stem) for name in names}
    found = next((p for p in paths.values() if p.exists()), None)
    if found is not None and not overwrite:
        raise ModelError(f"'{found}' exists: give another folder, or overwrite=True")
    if not folder.parent.is_dir():
        raise ModelError(f"there is no folder '{folder.parent}'")
    contents = _files(system, stem, outputs, functions, stop_time, tolerance)
    folder.mkdir(exist_ok=True)
    for name, own in paths.items():
        own.write_text(contents[name])
    return folder


def _files(
    system: AcausalSystem, stem: str, outputs: Sequence[str] | None, functions: Sequence[str] | None, stop_time: float,
    tolerance: float,
) -> dict[str, str]:  # fmt: skip
    """The texts of the files by name."""
    check_exportable(system)
    system = system.merged().without_stiffness
    small = len(system.states) <= CO_SIMULATION_UPTO
    if functions is None:
        functions = [name for name in FUNCTIONS if name != "run" or small]
    for name in functions:
        if name not in FUNCTIONS:
            raise ModelError(f"functions: '{name}' is not known; there are {', '.join(FUNCTIONS)}")
    if "run" in functions and not small:
        raise ModelError(
            f"functions: a run factorizes dense matrices of up to {CO_SIMULATION_UPTO} states, and this model has "
            f"{len(system.states)}: leave 'run' out"
        )
    programs = tuple(dict.fromkeys(n for name in functions for n in _PROGRAMS[name]))
    content = Content(system, outputs, (*_ALWAYS, *programs))
    files, sizes = model_files(content.programs, content.defaults(), content.nominals, content.texts(), tolerance)
    runs = "run" in functions

    def of_model(text: str) -> str:
        return re.sub(r"\bplant(?=\b|_)", stem, re.sub(r"\bPLANT(?=\b|_)", stem.upper(), text))

    return {
        "plant.h": of_model(_header(content, sizes, functions)),
        "plant.c": of_model(_source(content, files)),
        "main.c": of_model(
            fixed("plain_main.c")
            .replace("STOP_TIME", number(stop_time, "float64"))
            .replace("#if PLANT_RUNS", f"#if {int(runs)}")
        ),
        "CMakeLists.txt": of_model(fixed("plain_cmake.txt")),
    }


def _header(content: Content, sizes: dict[str, int], functions: Sequence[str]) -> str:
    layout, programs = content.layout, content.programs
    numbers = {name: sizes[name] for name in ("NX", "NY", "NG", "N_UNKNOWNS", "ND", "WORK")}
    numbers |= {"NQ": len(content.discretes), "NU": len(content.plan.inputs.names), "NP": len(programs.p)}
    places = {f"AT_{name.upper()}": place for name, (place, _) in layout.places.items() if name in "txqpu"}
    struct = fixed("run.h")
    struct = struct[struct.index("#define ROOM") : struct.rindex("#endif")]
    own = {"State": "plant_state", "Model": "plant"}
    struct = _OWN.sub(lambda found: own.get(found[0], f"PLANT_{found[0]}"), struct)
    parts = ["plain.h"]
    parts += ["plain_derivatives.h"] if "derivatives" in functions else []
    parts += ["plain_event.h"] if {"events", "run"} & set(functions) else []
    parts += ["plain_step.h"] if "run" in functions else []
    return "\n".join(
        [
            f"/* {content.plan.flat.name or 'plant'}: a model in C99.".replace("*/", "* /")
            + "\n\n   States, inputs, parameters and all other numbers stand in `s.d` of a `plant`. */",
            "#ifndef PLANT_H\n#define PLANT_H\n\n#include <stdint.h>\n",
            "/* How many states, outputs, guards, discrete variables, inputs, parameters, numbers; bytes of room. */",
            *(f"#define PLANT_{name} {value}" for name, value in numbers.items()),
            "\n/* Where they begin in `s.d`: time, states, discrete variables, parameters, inputs. */",
            *(f"#define PLANT_{name} {value}" for name, value in places.items()),
            "",
            struct + "".join(fixed(name) for name in parts),
            "#endif\n",
        ]
    )


def _source(content: Content, files: dict[str, str]) -> str:
    layout, programs = content.layout, content.programs
    names = {
        "time": layout["t"],
        **{name: layout["x"] + k for k, name in enumerate(content.system.states)},
        **{name: layout["q"] + k for k, name in enumerate(content.discretes)},
        **{name: layout["p"] + k for k, name in enumerate(content.system.parameters.table.names)},
        **{name: layout["u"] + k for k, name in enumerate(content.plan.inputs.names)},
        **{f"start({name})": layout["s"] + k for k, name in enumerate(programs.starts)},
        **{w.name: layout[f"w{k}"] for k, w in enumerate(programs.weights)},
    }
    rows = ",\n  ".join(f"{{{c_text(name)}, {place}}}" for name, place in names.items())
    texts = content.texts()
    n_clocks = len(texts["events"]) - programs.ng
    tables = {
        "states": content.system.states, "outputs": content.outputs, "discretes": content.discretes,
        "guards": texts["events"][n_clocks:],
    }  # fmt: skip
    return "\n".join(
        [
            '#include "plant.h"\n\ntypedef plant_state State;\ntypedef plant Model;\n'
            "\n#define ROOM(n) PLANT_ROOM(n)\n#define NOMINALS plant_nominals\n",
            files["model.h"],
            files["model.c"].replace("static const double NOMINALS", "const double NOMINALS"),
            files["run.c"],
            f"#define N_PLACES {len(names)}\n\nstatic const struct {{ const char *name; int place; }} PLACES[] = {{"
            f"\n  {rows}\n}};\n",
            *(table_of_texts(f"plant_{name}", t).removeprefix("static ") for name, t in tables.items()),
            fixed("plain.c"),
        ]
    )
