"""Whether the default solver and adjoint are the best ones: nine models by all that the package offers.

    python -m benchmarks.defaults                               # all: long
    python -m benchmarks.defaults --models "motor,four-bar" --saved 200 --solvers "default,diffrax.Tsit5"

Pendulum, double and triple pendulum, four-bar, ladders of 100 and 1,000 cells, motor drive, transistor amplifier,
bridge rectifier; 3 and 200 saved times; a process for each of these. The programs are the value of a sum over the saved
states, and that with its gradient by all parameters. Columns: steps; correct digits of this sum, judged by the first
solver at tolerances of a hundredth; processor seconds of compilation; processor milliseconds of a call, the programs of
a model timed alternately; megabytes that the program holds. Adjoints are compared by the default solver, and the
default one by all solvers that are about as fast.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent.parent
SAVED = (3, 200)
RTOL, ATOL = 1e-6, 1e-8
SLOW = 1.5  # gradients by a solver that takes so many times as long as the fastest one before are left out
SPENT = 0.5  # processor seconds for repeated calls of each program
BATCH = 0.05  # processor seconds over which calls are averaged
FEW = 20  # parameters by which forward mode is tried


class Model(NamedTuple):
    """How to build a model, the end of its run, and further arguments of `simulate`."""

    build: Callable[[], Any]
    t1: float
    options: dict[str, Any] = {}


def models() -> dict[str, Model]:
    from benchmarks import first_models, ladder
    from benchmarks.testset import PROBLEMS
    from jaxonomy_dae import AcausalCompiler, EqnEnv
    from jaxonomy_dae.library.planar import MassiveLink, PlanarPendulum, Revolute, World

    def pendulum() -> Any:
        ev = EqnEnv()
        return first_models.compiler(ev, PlanarPendulum(ev, "pend", initial_theta=-1.2), connect=[])()

    def arms(n: int) -> Any:
        ev = EqnEnv()
        frame, parts, connect = World(ev, "world"), [], []
        parts.append(frame)
        frame = frame.frame
        for k in range(n):
            pin = Revolute(ev, f"pin{k}", initial_angle=0.5 if k == 0 else 0.2, initial_speed=0.0)
            arm = MassiveLink(ev, f"arm{k}", 1.0)
            connect += [(frame, pin.frame_a), (pin.frame_b, arm.frame_a)]
            parts += [pin, arm]
            frame = arm.frame_b
        return first_models.compiler(ev, *parts, connect=connect)()

    def of_first(name: str) -> Model:
        model = first_models.MODELS[name]
        return Model(lambda: model.build()(), model.t1, model.options)

    transistors = PROBLEMS["transamp"]
    return {
        "pendulum": Model(pendulum, 1.5),
        "double pendulum": Model(lambda: arms(2), 2.0),
        "triple pendulum": Model(lambda: arms(3), 2.0),
        "four-bar": of_first("four-bar"),
        "ladder 100": Model(lambda: AcausalCompiler(*ladder.array(100))(), ladder.END),
        "ladder 1000": Model(lambda: AcausalCompiler(*ladder.array(1000))(), ladder.END),
        "motor": of_first("motor drive"),
        "transistor amplifier": Model(transistors.compile, 0.05),
        "bridge rectifier": of_first("bridge rectifier"),
    }


def solvers() -> dict[str, Any]:
    import diffrax

    from jaxonomy_dae import solvers as own

    return {
        "default": None, "Tsit5": own.Tsit5(), "Rodas5P": own.Rodas5P(), "BDF": own.BDF(),
        "diffrax.Tsit5": diffrax.Tsit5(), "diffrax.Kvaerno5": diffrax.Kvaerno5(),
    }  # fmt: skip


def adjoints() -> dict[str, Any]:
    import diffrax

    from jaxonomy_dae.solvers import StoredAdjoint

    return {
        "default": None, "StoredAdjoint": StoredAdjoint(), "Recursive…": diffrax.RecursiveCheckpointAdjoint(),
        "ForwardMode": diffrax.ForwardMode(),
    }  # fmt: skip


def timed(program: Callable[..., Any], *arguments: Any) -> float:
    """Processor milliseconds of a call: the mean over `BATCH`, since the time of threads on other cores is added at
    their next tick."""
    import jax

    start, count = time.process_time(), 0
    while count == 0 or time.process_time() - start < BATCH:
        jax.block_until_ready(program(*arguments))
        count += 1
    return 1e3 * (time.process_time() - start) / count


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], dict[str, float]]:
    """(the program, what it costs): seconds of compilation, megabytes, milliseconds of the cheaper of two calls."""
    import jax

    start = time.process_time()
    program = jax.jit(function).lower(*arguments).compile()
    took, memory = time.process_time() - start, program.memory_analysis()
    assert memory is not None
    held = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 1e6
    timed(program, *arguments)
    return program, {"compile": took, "MB": held, "run": timed(program, *arguments)}


def of_model(name: str, saved: int, chosen: list[str], gradients: list[str], emit: Callable[[dict], None]) -> None:
    """Emits a row for each solver, and for each adjoint."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxonomy_dae import simulate

    model = models()[name]
    moving, fixed = eqx.partition(model.build(), eqx.is_inexact_array)
    ts = np.linspace(0.0, model.t1, saved + 1)[1:]

    def value(moving: Any, rtol: Any, solver: Any, adjoint: Any) -> tuple[Any, Any]:
        run = simulate(
            eqx.combine(moving, fixed), model.t1, ts=ts, rtol=rtol, atol=rtol * ATOL / RTOL, solver=solver,
            adjoint=adjoint, throw=False, **model.options,
        )  # fmt: skip
        return jnp.sum(run.states * jnp.cos(jnp.arange(run.states.shape[-1]))), run.stats["num_steps"]

    def by_forward(moving: Any, rtol: Any, solver: Any, adjoint: Any) -> Any:
        values = moving.parameters.values

        def of(values: Any) -> Any:
            out = value(eqx.tree_at(lambda s: s.parameters.values, moving, values), rtol, solver, adjoint)
            return out[0], out

        slope, out = jax.jacfwd(of, has_aux=True)(values)
        return out, slope

    def by_reverse(moving: Any, rtol: Any, solver: Any, adjoint: Any) -> Any:
        out, slope = jax.value_and_grad(value, has_aux=True)(moving, rtol, solver, adjoint)
        return out, slope.parameters.values

    found: list[tuple[dict[str, Any], Callable[..., Any]]] = []
    right, fastest = None, math.inf

    def tried(row: dict[str, Any], function: Callable[..., Any]) -> Callable[..., Any] | None:
        try:
            program, cost = compiled(function, moving, RTOL)
        except Exception as error:
            return emit(row | {"error": str(error).strip().splitlines()[0][:80]})
        row.update(cost)
        found.append((row, program))
        return program

    for label in chosen:
        solver = solvers()[label]
        row: dict[str, Any] = {"model": name, "saved": saved, "solver": label, "adjoint": ""}
        program = tried(row, lambda m, r, s=solver: value(m, r, s, None))
        if program is None:
            continue
        total, steps = program(moving, RTOL)
        right = float(program(moving, RTOL * 1e-2)[0]) if right is None else right
        off = abs(float(total) - right) / abs(right)
        digits = -math.log10(max(off, 1e-15)) if math.isfinite(off) else -math.inf
        row.update(steps=int(steps), digits=digits)
        if row["run"] > SLOW * fastest:
            continue
        fastest = min(fastest, row["run"])
        for by in gradients if label == "default" else gradients[:1]:
            if by == "ForwardMode" and moving.parameters.values.size > FEW:
                continue
            adjoint, way = adjoints()[by], by_forward if by == "ForwardMode" else by_reverse
            of_row = {"model": name, "saved": saved, "solver": label, "adjoint": by}
            tried(of_row, lambda m, r, s=solver, a=adjoint, w=way: w(m, r, s, a))
    begin = time.process_time()
    while time.process_time() - begin < SPENT * len(found):  # alternately, since the machine's speed changes
        for row, program in found:
            row["run"] = min(row["run"], timed(program, moving, RTOL))
    for row, _ in found:
        emit(row)


def line(row: dict[str, Any]) -> str:
    head = f"{row['model']:21}{row['saved']:5}  {row['solver']:17}{row['adjoint'] or 'value':15}"
    if "error" in row:
        return head + row["error"]
    middle = f"{row['steps']:6}{row['digits']:7.1f}" if "steps" in row else f"{'':13}"
    return head + middle + f"{row['compile']:10.1f}{row['run']:9.3f}{row['MB']:9.2f}"


def split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def main() -> None:
    names = ["default", "diffrax.Tsit5", "Tsit5", "Rodas5P", "BDF", "diffrax.Kvaerno5"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", default="")
    parser.add_argument("--saved", type=int, nargs="+", default=SAVED)
    parser.add_argument("--solvers", default=",".join(names))
    parser.add_argument("--adjoints", default="default,Recursive…,ForwardMode")
    parser.add_argument("--seconds", type=float, default=600.0, help="for one model and number of times")
    parser.add_argument("--one", action="store_true", help="measure in this process")
    asked = parser.parse_args()
    if asked.one:
        import jax

        jax.config.update("jax_enable_x64", True)
        for name in split(asked.models):
            for saved in asked.saved:
                of_model(
                    name, saved, split(asked.solvers), split(asked.adjoints), lambda r: print(json.dumps(r), flush=True)
                )
        return
    # XLA's own options, and nothing that was compiled before.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_FLAGS", "JAX_COMP", "JAX_PERS"))}
    environment |= {"PYTHONPATH": str(HERE), "JAX_PLATFORMS": "cpu"}
    columns = f"{'steps':>6}{'digits':>7}{'compile s':>10}{'run ms':>9}{'MB':>9}"
    print(f"{'model':21}{'saved':>5}  {'solver':17}{'adjoint':15}{columns}")
    for name in split(asked.models) or models():
        for saved in asked.saved:
            command = [sys.executable, "-m", "benchmarks.defaults", "--one", "--models", name, "--saved", str(saved)]
            command += ["--solvers", asked.solvers, "--adjoints", asked.adjoints]
            process = subprocess.Popen(command, cwd=HERE, env=environment, stdout=subprocess.PIPE, text=True)
            assert process.stdout is not None
            until = time.monotonic() + asked.seconds
            for text in process.stdout:
                print(line(json.loads(text)), flush=True)
                if time.monotonic() > until:
                    process.kill()
                    print(f"{name:21}{saved:5}  stopped after {asked.seconds:.0f} s")
                    break
            process.wait()


if __name__ == "__main__":
    main()
