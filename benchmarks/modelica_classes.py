"""The classes of a Modelica library that have connectors: opened, translated, compiled in a plant of boundaries.

    python -m benchmarks.modelica_classes --library FOLDER [--packages Modelica.Electrical …] [--sample SEED]
        [--classes N] [--out FILE] [--page FILE]

`--library` holds the folder Modelica (a checkout of modelica/ModelicaStandardLibrary, tag v4.1.0; not part of this
project). Each class is opened by the front end and becomes a component, each port of which meets a boundary whose flow
is its potential, each input a constant; a class whose surroundings decide its clock gets one of 1 s. The plant is
compiled, which refuses one whose equations are not as many as its unknowns. Parameters without a value are numbers from
1 to 2, all different: with equal ones, coils have no leakage. Classes that are partial, and those without connectors,
are counted apart. `GIVEN` holds what some classes do not have by themselves. `--sample` puts the classes in a random
order in which any number of the first ones has each package in proportion; of `--classes` so chosen, those that take
long to open come last.

Classes run in a process that is replaced when one of them takes too long. Lines of JSON go to `--out`, from where a
second call goes on; the table by sub-library and the reasons go to `--page`.
"""

import argparse
import collections
import json
import multiprocessing
import random
import re
import resource
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import scipy.stats

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.library.signal import Constant
from jaxonomy_dae.modelica import Library
from jaxonomy_dae.modelica.library import component_of
from jaxonomy_dae.modelica.open_class import OpenClass, is_frame
from jaxonomy_dae.modelica.packing import components_in
from jaxonomy_dae.modelica.port_domains import domain_of
from jaxonomy_dae.modelica.sources import Sources

STAGES = ("found", "opened", "translated", "compiled")
SECONDS = 30  # of processor time, for each class after the first
MEMORY = 6 << 30  # bytes of memory
WATER = "redeclare package Medium = Modelica.Media.Water.ConstantPropertyLiquidWater"
STAR = 'terminalConnection = "Y"'
GIVEN = {  # modifications of classes whose names begin so: the first that fits
    "Modelica.Fluid.Vessels.": f"{WATER}, nPorts = 1, use_portsData = false",
    "Modelica.Fluid.Sources.": f"{WATER}, nPorts = 1",
    "Modelica.Fluid.": WATER,
    "Modelica.Mechanics.MultiBody.World": "enableAnimation = false",
    "Modelica.Blocks.Sources.CombiTimeTable": "table = [0, 1; 1, 2]",
    "Modelica.Blocks.Sources.TimeTable": "table = [0, 1; 1, 2]",
    "Modelica.Blocks.Sources.IntegerTable": "table = [0, 1; 1, 2]",
    "Modelica.Blocks.Sources.BooleanTable": "table = {0.5}",
    "Modelica.Blocks.Tables.CombiTable2D": "table = [0, 0, 1; 0, 1, 2; 1, 2, 4]",
    "Modelica.Blocks.Tables.": "table = [0, 1; 1, 2]",
    "Modelica.Electrical.Analog.Sources.Table": "table = [0, 1; 1, 2]",
    "Modelica.Electrical.Machines.Utilities.TerminalBox": STAR,
    "Modelica.Electrical.Machines.Utilities.MultiTerminalBox": STAR,
    "Modelica.Magnetic.QuasiStatic.FundamentalWave.Utilities.TerminalBox": STAR,
    "Modelica.Magnetic.QuasiStatic.FundamentalWave.Utilities.MultiTerminalBox": STAR,
    "Modelica.Electrical.Machines.Thermal.SynchronousMachines.ThermalAmbientSM": "useDamperCage = true",
    "Modelica.Magnetic.FundamentalWave.BasicMachines.SynchronousMachines.SM_": "useDamperCage = true",
    "Modelica.Thermal.HeatTransfer.Sensors.ConditionalFixedHeatFlowSensor": "useFixedTemperature = true",
    "Modelica.Blocks.Math.MinMax": "nu = 2",
    "Modelica.Blocks.MathBoolean.": "nu = 2",
    "Modelica.Blocks.MathInteger.": "nu = 2",
}
# Classes that the front end flattens as texts of their own. After a text, it reads the library anew for a class.
AS_TEXT = (
    "Modelica.Mechanics.MultiBody.",
    "Modelica.Fluid.",
    "Modelica.Electrical.QuasiStatic.",
    "Modelica.Magnetic.Quasi",
)
_HEAD = """# Classes of the Modelica library

Classes of the Modelica Standard Library 4.1.0 that have connectors, as components with open ports
([how](../how-to/modelica.md#take-components-of-a-library)). A class is *opened* if the front end flattens it with
open connectors, *translated* if its equations become those of a component, and *compiled* if a plant of the component
and its boundaries compiles: it then has as many equations as unknowns. Parameters without a value are numbers from 1
to 2, all different.

`python -m benchmarks.modelica_classes` makes this page from a checkout of the library. Its random order has each
package in proportion, however many classes are tried.
"""
_DECIDES = re.compile(r"gives no value to '(\w+)', which decides")  # what the front end says


class Boundaries(Component):
    """A port for each port of a class; the flow into each is its potential, and each stream leaves it with the value 1.

    A tree of frames that begins in none of the class's ports begins here, in a frame that stands still. Upon the other
    frames act a force and a torque that grow with their place and their rotation.
    """

    def __init__(self, ev: EqnEnv, name: str, of: OpenClass):
        super().__init__(ev, name)
        first = True
        for k, port in enumerate(of.ports):
            domain = domain_of(port)
            mine = self.port(f"p{k}", domain)
            across, through = ([self[f"p{k}.{n}"] for n, _ in side] for side in (domain.across, domain.through))
            streams = [self[f"p{k}.{n}"] for n, _ in domain.streams]
            self.add_equations(*(Eq(h, 1) for h in streams))
            reached = {b for _, b in of.branches} | set(of.roots)
            if not port.orientation:
                self.add_equations(*(Eq(f, p) for f, p in zip(through, across, strict=True)))
            elif not is_frame(port.orientation):
                free = [p for (n, _), p in zip(domain.across, across, strict=True) if n not in port.orientation]
                self.add_equations(*(Eq(f, p) for f, p in zip(through, free, strict=True)))
                if port.name not in reached:
                    self.declare_root(mine)
                    self.add_equations(*(Eq(self[f"p{k}.{n}"], 0) for n in port.orientation))
            elif port.name in reached:
                self.add_equations(
                    *(Eq(f, p) for f, p in zip(through[:3], across[:3], strict=True)),
                    *(Eq(t, self[f"p{k}.R.T[{i}]"]) for t, i in zip(through[3:], ("2,3", "3,1", "1,2"), strict=True)),
                )
            else:
                still = [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]
                self.declare_root(mine)
                across[:3] = [*across[:3]] if first else [*through[:3]]
                first = False
                self.add_equations(*(Eq(p, x) for p, x in zip(across, still, strict=True)))


def main() -> int:
    asked = _arguments()
    names = [n for p in asked.packages for n in components_in(Sources([asked.library]), p)]
    all_of_them = len(names)
    if asked.sample is not None:
        names = _drawn(names, asked.sample)
    names = sorted(names[: asked.classes], key=lambda n: n.startswith((*GIVEN, *AS_TEXT)))
    done = {r["class"]: r for r in _read(asked.out)}
    left = [n for n in names if n not in done]
    start = time.monotonic()
    while left and time.monotonic() - start < asked.minutes * 60:
        until = asked.minutes * 60 - (time.monotonic() - start)
        for row in _by_a_process(left, asked, until):
            done[row["class"]] = row
            with open(asked.out, "a", encoding="utf-8") as out:
                out.write(json.dumps(row) + "\n")
        left = [n for n in left if n not in done]
    page = _page([done[n] for n in names if n in done], len(left), all_of_them, asked.sample)
    print(page)
    if asked.page:
        Path(asked.page).write_text(page, encoding="utf-8")
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.modelica_classes")
    parser.add_argument("--library", required=True)
    parser.add_argument("--packages", nargs="+", default=["Modelica"], help="packages or classes")
    parser.add_argument("--sample", type=int, metavar="SEED", help="take the classes in a random order")
    parser.add_argument("--classes", type=int, help="take so many of them")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin no class after this time")
    parser.add_argument("--out", default="modelica_classes.jsonl")
    parser.add_argument("--page", help="a file for the tables, in Markdown")
    return parser.parse_args()


def _drawn(names: Sequence[str], seed: int) -> list[str]:
    """Classes in a random order; the places of each package are spread evenly."""
    draw = random.Random(seed)
    groups: dict[str, list[str]] = collections.defaultdict(list)
    for name in names:
        groups[_package(name)].append(name)
    places = {}
    for group in groups.values():
        draw.shuffle(group)
        places |= {name: (k + draw.random()) / len(group) for k, name in enumerate(group)}
    return sorted(names, key=lambda n: places[n])


def _package(name: str) -> str:
    return ".".join(name.split(".")[1:3])


def _read(file: str) -> list[dict]:
    try:
        with open(file, encoding="utf-8") as lines:
            return [json.loads(line) for line in lines]
    except FileNotFoundError:
        return []


def _by_a_process(names: Sequence[str], asked: argparse.Namespace, seconds: float):
    """The rows of classes, until one of them ends the process or the time is over."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_rows, args=(there, names, asked.library), daemon=True)
    child.start()
    there.close()
    start, left = time.monotonic(), list(names)
    try:
        while left:
            yield here.recv()
            left.pop(0)
            if time.monotonic() - start > seconds:
                break
    except EOFError:
        child.join()
        yield {"class": left[0], "reached": "nothing", "error": "late", "why": f"it ended with {child.exitcode}"}
    child.kill()
    child.join()


def _rows(there: Any, names: Sequence[str], root: str) -> None:
    sys.setrecursionlimit(20_000)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    library = Library(root)
    first = True
    for name in names:
        used = int(time.process_time())
        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (used + SECONDS * (3 if first else 1), hard))
        there.send(row_of(library, name))
        first = False
    there.close()


def row_of(library: Library, name: str) -> dict:
    """What becomes of a class: how far it comes, its counts, and the error that ends it."""
    row: dict = {"class": name, "reached": "nothing"}
    start = time.process_time()
    try:
        for stage in _stages(library, name, row):
            row["reached"] = stage
    except Exception as error:
        row |= {"error": type(error).__name__, "why": " ".join(str(error).split())[:400]}
    row["seconds"] = round(time.process_time() - start, 2)
    return row


def _stages(library: Library, name: str, row: dict):
    yield "found"
    found = _opened(library, name, [next((text for prefix, text in GIVEN.items() if name.startswith(prefix)), "")])
    row["connectors"] = len(found.ports) + len(found.inputs) + len(found.outputs)
    yield "opened"
    component_of(found)(EqnEnv(), "x", **_values(found))
    yield "translated"
    row |= _compiled(found)
    yield "compiled"


def _opened(library: Library, name: str, given: list[str], clock: float | None = None) -> OpenClass:
    """A class with what is given, and with 1 for parameters that decide its equations and for a clock."""
    try:
        return library.opened(name, ", ".join(filter(None, given)), clock=clock)
    except ModelError as error:
        if clock is None and "surroundings decide when its clock ticks" in str(error):
            return _opened(library, name, given, 1.0)
        unknown = _DECIDES.search(str(error))
        value = f"{unknown[1]} = 1" if unknown else ""
        if not value or value in given:
            raise
    return _opened(library, name, [*given, value], clock)


def _values(of: OpenClass) -> dict[str, Any]:
    """Values of the parameters that have none in the class."""
    return {name: 1.0 + k / len(of.required) for k, name in enumerate(of.required)}


def _compiled(of: OpenClass) -> dict:
    """The sizes of the compiled plant of one component and its boundaries."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    x = component_of(of)(ev, "x", **_values(of))
    diagram.add(x)
    if of.ports:
        rim = Boundaries(ev, "rim", of)
        diagram.add(rim)
        for k, port in enumerate(of.ports):
            diagram.connect(x, port.name, rim, f"p{k}")
    for k, name in enumerate(of.inputs):
        value = Constant(ev, f"u{k}", 0.5)
        diagram.add(value)
        diagram.connect(value, "y", x, name)
    system = AcausalCompiler(ev, diagram)()
    return {"states": len(system.states)}


def _page(rows: list[dict], left: int, all_of_them: int, seed: int | None) -> str:
    partial = [r for r in rows if "is partial" in r.get("why", "")]
    bare = [r for r in rows if r.get("connectors") == 0]
    rows = [r for r in rows if r not in partial and r not in bare]
    of: dict[str, list[dict]] = collections.defaultdict(list)
    for row in rows:
        of[_package(row["class"])].append(row)
    lines = [
        _HEAD,
        f"{len(rows) + len(partial) + len(bare)} classes of {all_of_them}"
        + (f", drawn with the seed {seed}" if seed is not None else "")
        + f". Partial: {len(partial)}; without connectors: {len(bare)}; both are left out below.",
        "",
        _share(rows, left),
        "",
        "| package | classes | opened | translated | compiled |",
        "|---|---|---|---|---|",
    ]
    for name, group in [*sorted(of.items()), ("**all**", rows)]:
        counts = [
            sum(r["reached"] in STAGES and STAGES.index(r["reached"]) >= STAGES.index(s) for r in group)
            for s in ("opened", "translated", "compiled")
        ]
        lines.append(f"| {name} | {len(group)} | " + " | ".join(map(str, counts)) + " |")
    reasons = collections.Counter((r["reached"], r["error"]) for r in rows if "error" in r)
    lines += ["", "| classes | reached | error |", "|---|---|---|"]
    lines += [f"| {n} | {s} | {e} |" for (s, e), n in reasons.most_common()]
    return "\n".join(lines) + "\n"


def _share(rows: list[dict], left: int) -> str:
    """The share of classes that compile, with its interval of Wilson; `left` of the sample have not been tried."""
    compiled = sum(r["reached"] == "compiled" for r in rows)
    if not rows:
        return ""
    interval = scipy.stats.binomtest(compiled, len(rows)).proportion_ci(method="wilson")
    low, high = (100 * x for x in interval)
    share = 100 * compiled / len(rows)
    whole = "the whole library" if not left else "those that do not take long to open"
    untried = (
        f" {left} classes of the sample have not been tried, all that take long to open among them." if left else ""
    )
    return (
        f"{compiled} of {len(rows)} compile, {share:.0f} %: of {whole}, between {low:.0f} % and {high:.0f} % with a "
        f"confidence of 95 %.{untried}"
    )


if __name__ == "__main__":
    sys.exit(main())
