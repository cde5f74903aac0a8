"""Runs a Modelica model: `python -m jaxonomy_dae.modelica model.bmo --csv out.csv --plot out.svg body.x body.v`; or
packs a library: `python -m jaxonomy_dae.modelica pack analog.zip Modelica.Electrical.Analog --root libraries`."""

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ..base.errors import JaxonomyDaeError
from ..run.simulation.simulate import simulate
from ..run.simulation.solution import Solution
from ..run.system.acausal_compiler import AcausalCompiler
from ..run.system.system import AcausalSystem
from ..write.diagram import AcausalDiagram
from ..write.environment import EqnEnv
from . import packing
from .flat_component import FlatComponent
from .flat_model import FlatModel
from .load import load

POINTS = 500  # saved times, where the text does not say how far apart they are
MOST_POINTS = 100_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Reads, compiles and runs a file, or packs a library; returns 1 if that fails, with the reason on the standard
    error."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["pack"]:
        return packing.main(given[1:])
    asked = _parser().parse_args(given)
    # This process is the command's own. The package itself never sets it.
    jax.config.update("jax_enable_x64", True)
    try:
        flat = load(Path(asked.file), asked.model, asked.root)
        system = _compiled(flat, asked.names)
        if asked.report:
            print(system.report)
        solution = _run(flat, system, asked.stop_time, asked.tolerance)
        names = [f"{flat.name}.{name}" for name in asked.names] or list(system.states)
        ends = {name: float(solution[name][-1]) for name in names}
        if asked.csv:
            _write_csv(Path(asked.csv), solution, names, flat.name)
        if asked.plot:
            np.ravel(solution.plot(*names))[0].figure.savefig(asked.plot)
    except (JaxonomyDaeError, OSError) as error:
        print(f"{asked.file}: {error}", file=sys.stderr)
        return 1
    print(f"{flat.name}: {len(system.states)} states, t = {float(solution.ts[-1]):g} s")
    for name, value in list(ends.items())[:20]:
        print(f"  {name.removeprefix(flat.name + '.')} = {value:.10g}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m jaxonomy_dae.modelica", description="Runs a Modelica model.")
    parser.add_argument(
        "file",
        help="a flat model, as OpenModelica writes it with --baseModelica, or Modelica source",
    )
    parser.add_argument("names", nargs="*", help="variables to print, write and plot; the states if left out")
    parser.add_argument("--model", help="the model of Modelica source to run, such as Package.Model")
    parser.add_argument("--root", action="append", default=[], help="a library's folder, for source; may be repeated")
    parser.add_argument("--stop-time", type=float, help="end of the run (second); the text's own if left out")
    parser.add_argument("--tolerance", type=float, help="relative tolerance; the text's own if left out")
    parser.add_argument("--csv", help="a file for the trajectories")
    parser.add_argument("--plot", help="a file for a figure, such as out.svg")
    parser.add_argument("--report", action="store_true", help="print what the compiler did")
    return parser


def _compiled(flat: FlatModel, names: Sequence[str]) -> AcausalSystem:
    ev, diagram = EqnEnv(), AcausalDiagram()
    discrete = [d.name for d in flat.model.declarations if d.name in names and d.type in ("Boolean", "Integer")]
    diagram.add(FlatComponent(ev, flat.name, flat, outputs=discrete))
    return AcausalCompiler(ev, diagram, prefer_states=[f"{flat.name}.{v}" for v in flat.preferred_states])()


def _run(flat: FlatModel, system: AcausalSystem, stop: float | None, tolerance: float | None) -> Solution:
    said = flat.experiment
    begin, end = said.get("StartTime", 0.0), said.get("StopTime", 1.0) if stop is None else stop
    count = round((end - begin) / said["Interval"]) if said.get("Interval") else POINTS
    ts = np.linspace(begin, end, min(max(count, 1), MOST_POINTS) + 1)
    rtol = tolerance or min(said.get("Tolerance", 1e-6), 1e-6)
    return simulate(system, end, t0=begin, ts=jnp.asarray(ts), rtol=rtol)


def _write_csv(path: Path, solution: Solution, names: Sequence[str], model: str) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["time", *(name.removeprefix(f"{model}.") for name in names)])
        columns = [np.asarray(solution.ts), *(np.asarray(solution[name]) for name in names)]
        rows.writerows(zip(*(c.tolist() for c in columns), strict=True))


if __name__ == "__main__":
    sys.exit(main())
