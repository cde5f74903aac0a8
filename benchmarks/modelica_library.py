"""The examples of the Modelica Standard Library, read, compiled, run, compared and differentiated.

    python -m benchmarks.modelica_library --texts FOLDER --references FOLDER [--library FOLDER] [--only TEXT]
        [--out FILE] [--resume]

`--texts` holds Base Modelica files `Modelica.*.bmo` (OpenModelica/BaseModelicaLibraryTesting.jl on GitHub, branch
gh-pages, folders `results/main/Modelica/4.1.0/files/*`), in one folder or below it. `--references` is a checkout of
modelica/MAP-LIB_ReferenceResults, branch v4.1.0. `--library` is a checkout of modelica/ModelicaStandardLibrary, tag
v4.1.0: functions that a text calls but does not hold are read from it. None of them is part of this project.

Each file runs in a process of its own, with limits of time and memory. A run agrees if each reference signal (those of
`comparisonSignals.txt`, or all) is within 0.2 % of its range, where values may also be those within 0.2 % of the run's
time before or after. A gradient is that of the sum of squares of the signals at the end, by two parameters, in reverse
mode beside central differences. Lines of JSON go to `--out`, each with the commit on which it was made, and a table by
sub-library, with a row for each text, to the standard output.
"""

import argparse
import collections
import json
import multiprocessing
import os
import re
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, EqnEnv, StructuralError, simulate
from jaxonomy_dae.modelica import FlatComponent, load

SECONDS, MEMORY = 120, 4 << 30  # of one file's process: time of the processor, bytes of memory beside XLA's code
AGREES = 0.002  # of a signal's range, and of the run's time
POINTS = 1000  # the most saved times
STEPS_OF_A_RUN = 2**17  # at most: processor time is what limits a run
STEPS = (1e-5, 1e-3, 1e-2)  # of a parameter, for differences: of longer steps, the runs' own errors count less
CLOSE = 1e-3  # relative error of a gradient that counts as right
SAID = 120  # letters of a message in the list of texts


def main() -> int:
    asked = _arguments()
    files = sorted(Path(asked.texts).rglob("Modelica.*.bmo"), key=lambda f: f.stat().st_size)
    files = [f for f in files if asked.only in f.name]
    done = {r["model"]: r for r in _read(asked.out)} if asked.resume else {}
    commit = asked.commit or _commit()
    for k, file in enumerate(files):
        if file.stem in done:
            continue
        row = _in_a_process(file, asked) | {"commit": commit}
        done[file.stem] = row
        with open(asked.out, "a", encoding="utf-8") as out:
            out.write(json.dumps(row) + "\n")
        print(f"{k + 1}/{len(files)} {file.stem}: {_short(row)}", file=sys.stderr, flush=True)
    page = _page([done[f.stem] for f in files], len(files))
    print(page)
    if asked.page:
        Path(asked.page).write_text(page, encoding="utf-8")
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.modelica_library")
    parser.add_argument("--texts", required=True)
    parser.add_argument("--references", required=True)
    parser.add_argument("--library", help="sources of the functions that texts do not hold")
    parser.add_argument("--only", default="", help="files whose name contains this")
    parser.add_argument("--out", default="modelica_library.jsonl")
    parser.add_argument("--resume", action="store_true", help="leave out what is in --out already")
    parser.add_argument("--page", help="a file for the tables, in Markdown")
    parser.add_argument("--no-gradients", action="store_true")
    parser.add_argument("--commit", default="", help="of this tree, where it is not a checkout")
    parser.add_argument("--seconds", type=int, default=SECONDS, help="of processor time, for each file")
    return parser.parse_args()


def _commit() -> str:
    asked = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True).stdout.strip()


def _in_a_process(file: Path, asked: argparse.Namespace) -> dict:
    """The row of one file, from a copy of this process, which has imported everything already."""
    here, there = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=_with_limits, args=(there, file, asked))
    child.start()
    there.close()
    row: dict = {"model": file.stem, "reached": "nothing", "seconds": asked.seconds}
    try:
        while True:  # a row after each stage: the last one stands, also if the process is killed thereafter
            row = here.recv()
    except EOFError:
        child.join()
    if child.exitcode in (-9, -24):
        row |= {"error": "late", "kind": "late", "seconds": asked.seconds}
    elif child.exitcode:
        row |= {"error": f"the process ended with {child.exitcode}", "kind": "process"}
    return row


def _with_limits(there: Any, file: Path, asked: argparse.Namespace) -> None:
    used = int(time.process_time())
    resource.setrlimit(resource.RLIMIT_CPU, (used + asked.seconds, used + asked.seconds + 5))
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    roots = [asked.library] if asked.library else []
    for row in _rows(file, Path(asked.references), not asked.no_gradients, roots):
        there.send(row)


def _rows(file: Path, references: Path, gradients: bool, roots: Sequence[str] = ()):
    """The row of one file, in this process, after each stage and at the end."""
    sys.setrecursionlimit(20_000)
    warnings.simplefilter("ignore")
    row: dict = {"model": file.stem, "reached": "nothing", "seconds": 0.0}
    start = time.process_time()
    try:
        for stage in _stages(file, references, gradients, row, roots):
            row["reached"] = stage
            row[f"until_{stage}"] = row["seconds"] = round(time.process_time() - start, 2)
            yield row
    except MemoryError:
        row |= {"error": "memory", "kind": "memory"}
    except Exception as error:
        said = str(error).replace(str(file), file.name)  # rows say nothing of this machine
        row |= {"error": said[:600], "kind": type(error).__name__}
    row["seconds"] = round(time.process_time() - start, 2)
    yield row


def _stages(file: Path, references: Path, gradients: bool, row: dict, roots: Sequence[str]):
    """Reads, translates, compiles, runs, compares and differentiates; yields the name of each stage after it."""
    jax.config.update("jax_enable_x64", True)
    row["plain"] = not SPECIAL.search(file.read_text(encoding="utf-8"))
    flat = load(file, roots=roots)
    yield "read"
    names, data = _reference(file.stem, references)
    changing = {d.name for d in flat.model.declarations if not d.prefixes & {"parameter", "constant"}}
    outputs = [n for n in names if n in changing]
    component = FlatComponent(EqnEnv(), "m", flat, outputs)
    yield "translated"
    component, system = _compiled(component, outputs)
    row["equations"], row["states"] = system.plan.flat.n_equations, len(system.states)
    yield "compiled"
    said = flat.experiment
    begin, end = said.get("StartTime", 0.0), said.get("StopTime", 1.0)
    end = end if end > begin else begin + 1.0  # of a model that is only initialized
    ts = np.unique(data[:, 0]) if len(data) else np.linspace(begin, end, 201)
    ts = ts[(ts >= begin) & (ts <= end)]
    ts = jnp.asarray(ts[:: -(-len(ts) // POINTS)])
    rtol = min(said.get("Tolerance", 1e-6), 1e-6)
    solution = simulate(system, end, t0=begin, ts=ts, rtol=rtol, max_steps=STEPS_OF_A_RUN)
    row["steps"] = int(solution.stats["num_steps"])
    yield "run"
    if not len(data):
        row["kind"] = "no reference"
        return
    ours = _signals(solution, system, names[1:])
    columns = zip(names[1:], ours, data.T[1:], strict=True)
    errors = sorted(((_deviation(np.asarray(ts), o, data[:, 0], r), name) for name, o, r in columns), reverse=True)
    row["worst"] = errors[:3]
    if errors[0][0] > AGREES:
        row |= {"error": f"{errors[0][1]} by {errors[0][0]:.3g} of its range", "kind": "deviates"}
        return
    yield "agrees"
    if gradients:
        signals = [f"m.{n}" for n in names if f"m.{n}" in system.variables]
        fixed = [f"m.{n}" for n, v in component.variables.items() if v.fixed and f"m.{n}" in system.states]
        row |= _gradient(system, signals, fixed, begin, end, rtol)
        if row["kind"] == "gradient":
            del row["kind"]
            yield "gradient"


def _compiled(component: FlatComponent, outputs: list[str]) -> tuple[FlatComponent, AcausalSystem]:
    """The model. Parameters of zero for which an equation determines nothing are written as numbers."""
    numbers: list[str] = []
    preferred = [f"m.{v}" for v in component.flat.preferred_states]
    while True:
        diagram = AcausalDiagram()
        diagram.add(component)
        try:
            return component, AcausalCompiler(component.ev, diagram, prefer_states=preferred)()
        except StructuralError as error:
            zeros = re.findall(r"m\.(\S+) = 0[,:]", str(error)) if "determines nothing for" in str(error) else []
            if not set(zeros) - set(numbers):
                raise
            numbers += zeros
            component = FlatComponent(EqnEnv(), "m", component.flat, outputs, numbers)


def _reference(stem: str, references: Path):
    """(names of the signals, trajectories with the time in the first column)."""
    folder = references.joinpath(*stem.split("."))
    file = folder / f"{folder.name}.csv"
    if not file.exists():
        return [], np.zeros((0, 1))
    with file.open(encoding="utf-8") as text:
        names = [n.strip().strip('"') for n in re.split(r",(?=(?:[^\"]*\"[^\"]*\")*[^\"]*$)", text.readline().strip())]
    data = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
    listed = folder / "comparisonSignals.txt"
    wanted = {s.strip() for s in listed.read_text(encoding="utf-8").splitlines()} if listed.exists() else set(names)
    places = [0] + [k for k, n in enumerate(names) if n in wanted and n.lower() != "time"]
    return [names[k] for k in places], data[:, places]


def _signals(solution, system, names: list[str]) -> list[np.ndarray]:
    """The trajectories of signals, read at once; a parameter is constant."""
    varying = [f"m.{n}" for n in names if f"m.{n}" in solution]
    found = dict(zip(varying, np.asarray(solution[varying], float).T, strict=True)) if varying else {}
    n = len(solution.ts)
    return [found[m] if (m := f"m.{name}") in found else np.full(n, float(system.parameters[m])) for name in names]


def _deviation(ts, ours, times, theirs) -> float:
    """The largest deviation from the tube about a reference, relative to the reference's range. An event at the end
    may be part of a run or not: the value before it counts as well."""
    if not np.isfinite(ours).all():
        return float("inf")
    size = max(float(np.ptp(theirs)), 1e-3 * float(np.abs(theirs).max()), 1e-12)
    away = np.abs(ours - np.interp(ts, times, theirs))
    span = AGREES * (times[-1] - times[0])
    for i in np.flatnonzero(away > AGREES * size):
        near = theirs[(times >= ts[i] - span) & (times <= ts[i] + span)]
        values = ours[-2:] if i == len(ts) - 1 and ts[i] - ts[i - 1] <= 1.01 * span else ours[i : i + 1]
        away[i] = min(max(float(near.min()) - v, v - float(near.max()), 0.0) for v in values)
    return float(away.max()) / size


def _gradient(system, names: list[str], fixed: list[str], begin: float, end: float, rtol: float) -> dict:
    """The relative error, "gradient", of the derivatives of the sum of squares of the signals at the end, by up to two
    parameters or fixed starts: reverse mode against central differences, by longer steps where those of short ones are
    far. "by" says what they are taken by, "kind" whether they are right: zeros on both sides are not counted so."""
    values = system.parameters
    computed = {int(k) for group in values.table.dependents for k in group.target}
    settable = [n for k, n in enumerate(values.names) if k not in computed and not n.startswith("m.:")]
    by = [n for n in settable if float(values[n])][:2]
    starts = fixed[: 2 - len(by)]
    if not (by or starts) or not names:
        return {"kind": "nothing to differentiate by"}
    tight = min(rtol, 1e-9)
    point = simulate(system, end, t0=begin, ts=jnp.array([begin]))

    @jax.jit
    def loss(p):
        changed = system.with_parameters(dict(zip(by, p[: len(by)], strict=True)))
        initial = dict(zip(starts, p[len(by) :], strict=True)) or None
        last = simulate(
            changed, end, t0=begin, ts=jnp.array([end]), rtol=tight, atol=tight * 1e-2, initial=initial
        )  # fmt: skip
        return sum(jnp.sum(last[n] ** 2) for n in names)

    at = jnp.array([*(float(values[n]) for n in by), *(float(point[n][0]) for n in starts)])
    found = jax.jit(jax.grad(loss))(at)
    worst, moves = 0.0, False
    for k in range(len(at)):
        size, error = abs(float(at[k])) or 1.0, np.inf
        for step in STEPS:
            h = step * size
            slope = (loss(at.at[k].add(h)) - loss(at.at[k].add(-h))) / (2 * h)
            moves = moves or float(slope) != 0
            scale = max(abs(float(slope)), 1e-3 * abs(float(loss(at))) / size)
            error = min(error, abs(float(found[k] - slope)) / max(scale, 1e-300))
            if error <= CLOSE:
                break
        worst = max(worst, error)
    kind = "gradient off" if not worst <= CLOSE else "gradient" if moves else "gradient of zero"
    return {"gradient": worst, "by": "parameters" if by else "starts", "kind": kind}


def _read(file: str) -> list[dict]:
    if not os.path.exists(file):
        return []
    with open(file, encoding="utf-8") as lines:
        return [json.loads(line) for line in lines]


def _short(row: dict) -> str:
    return f"{row.get('reached', 'nothing')} in {row['seconds']} s. {row.get('error', '')[:150]}"


STAGES = ("read", "translated", "compiled", "run", "agrees", "gradient")
KINDS = {  # why a text does not reach the last stage: what a stage found, or the class of the error that ended it
    "ModelError": "a construct that is not read, or what the text asks for is refused by name (ModelError)",
    "StructuralError": "the compiler calls it singular (StructuralError)",
    "InitializationError": "no consistent start is found (InitializationError)",
    "SimulationError": "the run stops before its end (SimulationError)",
    "late": "takes more processor time than it is given",
    "memory": "takes more memory than it is given",
    "process": "the process was ended",
    "no reference": "runs, but there is no reference result of moderate size",
    "deviates": "deviates from the reference",
    "not asked": "agrees; it was not differentiated",
    "nothing to differentiate by": "agrees, but has nothing to differentiate by: the text has numbers for parameters",
    "gradient of zero": "agrees, and the derivatives that were tried are zero on both sides",
    "gradient off": "the gradient is not that of differences",
}
EXPLAINED = {
    "Electrical.Machines.Examples.SynchronousMachines.SMPM_NoLoad": "an angle that turns from π to -π, saved on "
    "one side of the turn or on the other",
    "Electrical.Analog.Examples.OpAmps.SignalGenerator": "three starts satisfy its equations; the run begins at the "
    "unstable one, where the oscillator rests",
    "Mechanics.Translational.Examples.HeatLosses": "a mass that hits a stop is set to rest by `reinit`. "
    "The reference keeps the speeds of its neighbours relative to it, as its states, so that they stop, too; here they "
    "keep their own: that the text prefers relative speeds as states counts where it differentiates them, and it does "
    "not",
}
EXPLAINED_GRADIENTS = {
    "Blocks.Examples.SlewRateLimiter": "the differences step across a kink of width 2e-7",
    "Blocks.Examples.TotalHarmonicDistortion": "ours is not-a-number: the run ends where means are zero, of which "
    "equations take the square root",
    "Electrical.Analog.Examples.DifferenceAmplifier": "no number on either side: with the starts given by name and at "
    "1e-9 the run is refused inside jit",
    "Electrical.Analog.Examples.IdealTriacCircuit": "a kink: the start of the pulse counts only before the first "
    "sample, which lies there. Ours is the derivative to the right, 0; differences average it with that to the left",
    "Electrical.Analog.Examples.NandGate": "the second derivative is by the start of an Integer",
    "Magnetic.FluxTubes.Examples.MovingCoilActuator.ArmatureStroke": "ours is not-a-number where differences have "
    "0.0010 and 0.0002: an armature starts at rest on a stop; not explained further",
    "Mechanics.Rotational.Examples.Backlash": "the laws of its contacts bend inside noEvent, where no step ends: at a "
    "tolerance of 1e-8 ours is off by 14 %, at 1e-10 by 0.8 % and at 1e-12 by 0.2 %",
    "Mechanics.Rotational.Examples.OneWayClutch": "one of the two is by the start of an Integer",
    "Mechanics.MultiBody.Examples.Elementary.InitSpringConstant": "nothing moves, so that the signals, and "
    "with them both derivatives, are zero but for rounding",
    "Mechanics.Rotational.Examples.ElasticBearing": "ours is wrong, by 2 %. A spring of the shaft could swing and does "
    "not, so that the steps become too long for its swing: they bound the error of the run, and a change of the start, "
    "which would excite it, is followed with these steps. Differences excite it, and their runs take shorter ones",
}
SPECIAL = re.compile(  # texts without it are counted apart
    r"^\s*(pure |impure )?function\s|^\s*algorithm\b|\brecord\b|\bexternal\b|ExternalCombi|"
    r"^\s*(parameter |constant |final |input |output )*String\b|\bdelay\(",
    re.M,
)
HEAD = """# The Modelica library

The examples of the Modelica Standard Library 4.1.0, as [Base Modelica](../how-to/modelica.md) that OpenModelica has
written, were read, compiled, run, compared with the published reference results, and differentiated. A run *agrees* if
each reference signal is within 0.2 % of its range, where values may also be those within 0.2 % of the run's time before
or after. A *gradient* is right if that of the sum of squares of the signals at the end, by two parameters or starts, in
reverse mode, is within 0.1 % of central differences. Functions that a text lacks are read from the sources of
the library.

`python -m benchmarks.modelica_library` makes this page from a folder of texts and one of references. Neither is part of
this project.
"""


def _page(rows: list[dict], files: int) -> str:
    """The tables: by sub-library, the reasons of failures, and runs that deviate."""
    of: dict[str, list[dict]] = collections.defaultdict(list)
    for row in rows:
        of[".".join(row["model"].split(".")[1:3])].append(row)
    head = ("sub-library", "tried", *STAGES)
    commits = ", ".join(f"`{c}`" for c in sorted({r.get("commit", "") for r in rows} - {""}))
    right = [r for r in rows if r.get("reached") == "gradient"]
    zero, off, nothing = (
        sum(r.get("kind") == kind for r in rows)
        for kind in ("gradient of zero", "gradient off", "nothing to differentiate by")
    )
    lines = [
        HEAD,
        f"{len(rows)} of {files} texts were run on commit {commits or 'unknown'}. Of the gradients that were tried, "
        f"{sum(r['by'] == 'parameters' for r in right)} by parameters and {sum(r['by'] == 'starts' for r in right)} by "
        f"starts are right, {off} are not, and {zero} are zero on both sides; {nothing} texts have nothing to "
        "differentiate by.",
        "",
    ]
    lines += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, group in [*sorted(of.items()), ("**all**", rows)]:
        counts = [sum(STAGES.index(r["reached"]) >= k for r in group if r.get("reached") in STAGES) for k in range(6)]
        lines.append(f"| {name} | {len(group)} | " + " | ".join(map(str, counts)) + " |")
    seconds = sorted(r["until_run"] for r in rows if "until_run" in r)
    if seconds:
        lines += [
            "",
            f"Median of the first run, compilation included: {seconds[len(seconds) // 2]:.1f} processor seconds.",
        ]
    reasons = collections.Counter(_kind(r) for r in rows if _kind(r))
    plain = [r for r in rows if r.get("plain")]
    run, agree = (sum(f"until_{stage}" in r for r in plain) for stage in ("run", "agrees"))
    lines += [
        "",
        f"{len(plain)} of the texts tried have no functions, algorithms, records, external code, tables, strings or "
        f"delays: of these, {run} run and {agree} agree.",
    ]
    lines += ["", "## Why the others do not", "", "| files | reason |", "|---|---|"]
    lines += [f"| {n} | {KINDS.get(kind, kind)} |" for kind, n in reasons.most_common()]
    lines += ["", "## Deviations", ""]
    far = [
        (r["worst"][0], r["model"].removeprefix("Modelica."))
        for r in rows
        if r.get("worst") and r["worst"][0][0] > AGREES
    ]
    lines += [
        f"- `{m}`: `{n}` by {e:.2g} of its range; {EXPLAINED.get(m, 'not looked into')}." for (e, n), m in far
    ] or ["None."]
    off = [r["model"].removeprefix("Modelica.") for r in rows if r.get("gradient", 0.0) and r["gradient"] > CLOSE]
    lines += ["", "## Gradients that are not those of differences", ""]
    lines += [f"- `{m}`: {EXPLAINED_GRADIENTS.get(m, 'not looked into')}." for m in off] or ["None."]
    lines += ["", "## Text by text", "", "| text | reaches | because |", "|---|---|---|"]
    for r in rows:
        said = r.get("error", "").split("\n")[0].replace("|", "\\|")[:SAID]
        why = f"{_kind(r)}: {said}" if said and said != _kind(r) else _kind(r)
        lines.append(f"| {r['model'].removeprefix('Modelica.')} | {r['reached']} | {why} |")
    return "\n".join(lines) + "\n"


def _kind(row: dict) -> str:
    """Why a text did not reach the last stage; "" if it did."""
    return row.get("kind", "not asked" if row["reached"] == "agrees" else "")


if __name__ == "__main__":
    sys.exit(main())
