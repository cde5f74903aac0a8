"""The C files of one model: its sizes, its tables, and its equations."""

import dataclasses
from collections.abc import Sequence
from importlib.resources import files

import numpy as np

from ..base.tolerances import BAND, EPS, RESOLUTION
from ..solve.events.side import ABOVE, RESTS
from .c_types import number
from .emit_c import CFunction, Source
from .programs import RUN, Programs

# States may be off their constraints by this part of a run's tolerance before they are moved onto them, which restarts
# an importer's integrator. A hundredth stays far below the errors of steps.
DRIFT = 0.01

# In Co-Simulation the absolute tolerance is this part of the tolerance, times a state's typical size: the ratio of the
# defaults of `simulate`. Guards are looked at so many times in a step, as often as there.
ABSOLUTE = 0.01
LOOKS = 6


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the numbers of an instance stand in its array, by name: (first place, count)."""

    places: dict[str, tuple[int, int]]

    @classmethod
    def of(cls, programs: Programs) -> "Layout":
        counts = {
            "t": 1, "x": programs.nx, "z": programs.nz, "q": programs.nq, "p": len(programs.p),
            "u": len(programs.plan.inputs.names), "s": len(programs.starts),
            **{f"w{k}": w.value.size for k, w in enumerate(programs.weights)},
            "guards": 2 * programs.ng, "clocks": 2 * programs.nc, "run": RUN,
        }  # fmt: skip
        places, begin = {}, 0
        for name, count in counts.items():
            places[name] = begin, count
            begin += max(count, 1)  # all begin elsewhere: functions are told that their arguments do not overlap
        return cls(places)

    def __getitem__(self, name: str) -> int:
        """The first place of some numbers."""
        return self.places[name][0]

    @property
    def size(self) -> int:
        return sum(max(count, 1) for _, count in self.places.values())


@dataclasses.dataclass(frozen=True)
class CVariable:
    """A variable as the C code sees it; see `instance.c`."""

    kind: str
    settable: str
    place: int
    size: int
    step: int
    start: int
    known: bool
    low: float
    high: float
    name: str


def text(value: str) -> str:
    """A string constant."""
    out = "".join(
        c if 32 <= ord(c) < 127 and c not in '"\\?' else "".join(f"\\{byte:03o}" for byte in c.encode()) for c in value
    )
    return f'"{out}"'


def _table(declaration: str, entries: Sequence[str]) -> str:
    """A constant array; C has no empty ones."""
    lines = [", ".join(entries[k : k + 8]) for k in range(0, len(entries), 8)] or ["0"]
    return f"static const {declaration}[] = {{\n  " + ",\n  ".join(lines) + "\n};\n"


# The sizes of a model and the switches of its functions, for `run.c`.
HAS = ("forward", "reverse", "event", "step", "opened")
OF_TEXTS = {"unknowns": "field", "rows": "start", "carried": "event", "events": "event"}  # what has these messages


def sizes_of(programs: Programs, layout: Layout, names: dict[str, Sequence[str]], work: int) -> dict[str, int]:
    """The numbers of `model.h` by name."""
    return {
        "NX": programs.nx, "NZ": programs.nz, "NY": programs.ny, "NG": programs.ng, "NC": programs.nc,
        "N_UNKNOWNS": programs.n_unknowns,
        "ND": layout.size, "N_ROWS": len(names["rows"]), "N_EVENTS": len(names["events"]), "WORK": work,
        **{f"HAS_{name.upper()}": int(name in programs.names) for name in HAS},
        "LOOKS": LOOKS, "ENDED_AT": 2, "STUCK_AT": 3, "AT_T": layout["t"], "AT_X": layout["x"], "AT_Z": layout["z"],
        "AT_GUARDS": layout["guards"], "AT_CLOCKS": layout["clocks"], "AT_RUN": layout["run"],
    }  # fmt: skip


def header(sizes: dict[str, int], tolerance: float) -> str:
    """`model.h`."""
    reals = {
        "TOLERANCE": tolerance, "DRIFT": DRIFT, "RESOLUTION": RESOLUTION * EPS, "BAND": BAND * EPS, "ABOVE": ABOVE,
        "RESTS": RESTS, "ABSOLUTE": ABSOLUTE,
    }  # fmt: skip
    return (
        "/* The sizes of the model. */\n#ifndef MODEL_H\n#define MODEL_H\n\n"
        + "".join(f"#define {name} {value}\n" for name, value in sizes.items())
        + "".join(f"#define {name} {number(value, np.float64)}\n" for name, value in reals.items())
        + "\n#endif\n"
    )


def model_files(
    programs: Programs, defaults: np.ndarray, nominals: np.ndarray, names: dict[str, Sequence[str]], tolerance: float
) -> tuple[dict[str, str], dict[str, int]]:  # fmt: skip
    """Returns (the C files by name, the sizes of the model). `defaults` are the numbers of a new instance; `names` has
    texts for messages: `unknowns`, `rows` of the start, `carried` variables, `events`.

    **Raises:**

    - `ModelError` for what C code cannot compute.
    """
    source = Source()
    functions = {name: source.function(program, f"p_{name}") for name, program in programs.traced.items()}
    layout = Layout.of(programs)
    sizes = sizes_of(programs, layout, names, max(f.work for f in functions.values()))
    body = "\n".join(
        [
            "/* The equations of the model, and its texts. */\n",
            source.text,
            *(_wrapper(programs, layout, name, function) for name, function in functions.items()),
            _table("double DEFAULTS", [number(v, np.float64) for v in defaults]),
            _table("double NOMINALS", [number(v, np.float64) for v in nominals]),
            *(table_of_texts(name.upper(), t) for name, t in names.items() if OF_TEXTS[name] in programs.names),
        ]
    )
    return {"model.h": header(sizes, tolerance), "model.c": body} | {name: fixed(name) for name in RUN_FILES}, sizes


def fixed(name: str) -> str:
    """A C file that is the same for all models."""
    return files("jaxonomy_dae.fmi").joinpath("c", name).read_text()


def table_of_variables(variables: Sequence[CVariable]) -> str:
    """`variables.c`: what an importer sees."""
    rows = [
        f"{{{v.kind}, {v.settable}, {v.place}, {v.size}, {v.step}, {v.start}, {int(v.known)}, "
        f"{number(v.low, np.float64)}, {number(v.high, np.float64)}, {text(v.name)}}}"
        for v in variables
    ]
    return f"#define N_VARIABLES {len(variables)}\n\n" + _table("Variable VARIABLES", rows)


def table_of_texts(name: str, texts: Sequence[str]) -> str:
    """A constant array of strings."""
    return _table(f"char *const {name}", [text(t) for t in texts])


RUN_FILES = ("run.h", "run.c")


def _wrapper(programs: Programs, layout: Layout, name: str, function: CFunction) -> str:
    """A function of the array of all numbers that calls a program."""
    weights = [f"w{k}" for k in range(len(programs.weights))]

    def numbers(array: str, names: Sequence[str]) -> list[str]:
        """Arguments from an array: scalars by value."""
        out = []
        for n in names:
            scalar = n == "t" or (n.startswith("w") and not programs.weights[int(n[1:])].value.shape)
            out.append(f"{array}[{layout[n]}]" if scalar else f"{array} + {layout[n]}")
        return out

    def results(array: str, names: Sequence[str]) -> list[str]:
        return [f"{array} + {layout[n]}" for n in names]

    point = numbers("d", ["t", "x", "z", "q", "p", "u"])
    moving = ["t", "x", "p", "u", *weights]
    memory = [*numbers("d", ["guards", "clocks", "run"]), "resolution", "tolerance"]
    own = numbers("d", weights)
    head = {
        "forward": "const double *d, const double *along, double *out",
        "reverse": "const double *d, const double *weight, double *out",
        "start": "double *d, double resolution, unsigned char *fine, double *residual, double *limit",
        "event": "const double *d, double resolution, double tolerance, double *next, unsigned char *fired, "
        "unsigned char *fine",
        "step": "const double *d, double h, double *x, double *error, double *dense",
        "accept": "const double *d, double resolution, double tolerance, double step, double *next, "
        "unsigned char *wants",
    }.get(name, "const double *d, double *out")
    given: dict[str, list[str]] = {
        "forward": [*numbers("d", ["z", "q", *moving]), *numbers("along", moving), "out"],
        "reverse": [*numbers("d", ["z", "q"]), "weight", *numbers("d", moving), *results("out", moving)],
        "start": [
            *numbers("d", ["t", "p", "u", "s"]), "resolution", *own,
            *results("d", ["x", "z", "q", "guards", "clocks", "run"]), "fine", "residual", "limit",
        ],
        "event": [*point, *memory, *own, *results("next", ["x", "z", "q", "guards", "clocks", "run"]), "fired", "fine"],
        "step": [*point, "h", *own, "x", "error", "dense"],
        "accept": [*point, *memory, "step", *own, *results("next", ["z", "guards", "run"]), "wants"],
    }  # fmt: skip
    arguments = given.get(name, [*point, *own, "out"])
    # The arrays at places of one array do not overlap, as `restrict` asks.
    return f"static void {function.name}_of({head}, char *w) {{\n  {function.name}({', '.join(arguments)}, w);\n}}\n"
