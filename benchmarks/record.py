"""Figures over versions: a few that everybody pays for, appended to `benchmarks/figures.jsonl`.

    python -m benchmarks.record                 # measures all, prints them and appends a line for each
    python -m benchmarks.record array_20000     # some of them
    python -m benchmarks.record --show          # a table of all that was recorded, a column for each commit

Each figure is measured in a process of its own. Times are processor seconds of all threads, so that other programs on
the machine matter less; ratios are of one process. A line has the version, commit, date and machine.
"""

import datetime
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

FILE = Path(__file__).with_name("figures.jsonl")
sys.path.append(str(FILE.parent))  # the scripts beside this one find each other there
MEMBERS = 1_000


def spent(function: Callable[[], Any], rounds: int = 1) -> float:
    """Processor seconds of a call, the mean of several: the time of threads on other cores is added up in ticks, so
    that the cheapest call may be one whose tick came later."""
    start = time.process_time()
    for _ in range(rounds):
        jax.block_until_ready(function())
    return (time.process_time() - start) / rounds


def array(n: int) -> dict[str, float]:
    """A ladder of n cells from two arrays: from building it to its first run, then other values and a second run."""
    from benchmarks.ladder import END, RTOL
    from benchmarks.ladder import array as model
    from jaxonomy_dae import AcausalCompiler, simulate

    kept: dict[str, Any] = {}

    def run(system: Any) -> Any:
        return simulate(system, t1=END, ts=jnp.array([END]), rtol=RTOL).states

    def first() -> Any:
        kept["system"] = AcausalCompiler(*model(n))()
        return run(kept["system"])

    def again() -> Any:
        return run(kept["system"].with_parameters({f"r[{n // 2}].R": 2.0}))

    return {f"array {n}, s": spent(first), f"array {n}, other values, s": spent(again, 2)}


def balls() -> dict[str, float]:
    """Bouncing balls in one batch: values and gradients over values, and what a gradient keeps for each."""
    from benchmarks.events import ball, height

    system, e = ball(True), jnp.linspace(0.75, 0.9, MEMBERS)
    given = jnp.stack([e, jnp.full_like(e, 9.81)], axis=1)
    values = jax.jit(jax.vmap(lambda p: height(system, p))).lower(given).compile()
    both = jax.jit(jax.vmap(jax.value_and_grad(lambda p: height(system, p)))).lower(given).compile()
    ratio = spent(lambda: both(given), 5) / spent(lambda: values(given), 5)
    memory = both.memory_analysis()
    assert memory is not None
    kept = memory.temp_size_in_bytes / MEMBERS / 1e3
    return {"balls, gradient over values": ratio, "balls, kB a member": kept}


def rollouts() -> dict[str, float]:
    """Rollouts of the tutorial's pendulum in reduced coordinates, over those by hand with stages written out."""
    from benchmarks import handwritten, pendulum
    from jaxonomy_dae import simulate

    ts, weights = jnp.array(handwritten.HORIZONS), handwritten.tutorial_weights()
    angles = jnp.linspace(-1.2, -0.6, 10 * MEMBERS)
    system = pendulum.build("row", "dummy_derivatives", pendulum.network_unrolled)

    def one(angle: Any, theta: Any) -> Any:
        released = pendulum.with_weights(system, theta).with_parameters({"pend.initial_theta": angle})
        solution = simulate(released, t1=1.5, ts=ts, rtol=handwritten.RTOL, atol=handwritten.ATOL)
        return solution["pend.vx"], solution["pend.x"]

    def by_hand(angles: Any, theta: Any) -> Any:
        solver = handwritten.UnrolledTsit5()
        return handwritten.rollouts(angles, theta, model="reduced", batching="vmap", solver=solver)

    ours = jax.jit(jax.vmap(one, in_axes=(0, None))).lower(angles, weights).compile()
    hand = jax.jit(by_hand).lower(angles, weights).compile()
    ratio = spent(lambda: ours(angles, weights), 6) / spent(lambda: hand(angles, weights), 6)
    return {"rollouts over by hand": ratio}


def lines() -> dict[str, float]:
    """Lines of StableHLO of the tutorial's loss, and with its gradient."""
    from benchmarks import handwritten, pendulum

    pendulum.TS = jnp.array(handwritten.HORIZONS)
    system, truth = pendulum.build("row", "dummy_derivatives"), handwritten.tutorial_truth()

    def loss(theta: Any) -> Any:
        return pendulum.tutorial_loss(pendulum.with_weights(system, theta), truth)

    def count(function: Any) -> float:
        return float(jax.jit(function).lower(handwritten.tutorial_weights()).as_text().count("\n"))

    return {"tutorial, lines": count(loss), "tutorial with gradient, lines": count(jax.value_and_grad(loss))}


FIGURES: dict[str, Callable[[], dict[str, float]]] = {
    "array_20000": lambda: array(20_000),
    "array_100000": lambda: array(100_000),
    "balls": balls,
    "rollouts": rollouts,
    "lines": lines,
}


def place() -> dict[str, str]:
    """What a line says beside its figure."""
    from jaxonomy_dae import __version__

    command = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, cwd=FILE.parent).stdout.strip()
    machine = f"{platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}"
    return {"version": __version__, "commit": commit, "date": f"{datetime.date.today()}", "machine": machine}


def record(names: list[str]) -> None:
    """Measures figures, prints them and appends them to the file."""
    beside = place()
    for name in names:
        command = [sys.executable, "-m", "benchmarks.record", "--one", name]
        done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=FILE.parent.parent)
        for figure, value in json.loads(done.stdout.splitlines()[-1]).items():
            print(f"{figure:40s}{value:10.3g}", flush=True)
            with FILE.open("a") as file:
                file.write(json.dumps({"figure": figure, "value": value, **beside}) + "\n")


def show() -> None:
    """The last value of each figure at each commit, in the order of the file."""
    rows = [json.loads(line) for line in FILE.read_text().splitlines()]
    heads = list(dict.fromkeys((row["date"], row["commit"]) for row in rows))
    last = {(row["figure"], row["date"], row["commit"]): row["value"] for row in rows}
    print("| figure | " + " | ".join(f"{commit}, {date}" for date, commit in heads) + " |")
    print("|---" * (len(heads) + 1) + "|")
    for figure in dict.fromkeys(row["figure"] for row in rows):
        values = (last.get((figure, *head)) for head in heads)
        print(f"| {figure} | " + " | ".join("" if v is None else f"{v:.4g}" for v in values) + " |")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    if "--one" in sys.argv:
        print(json.dumps(FIGURES[sys.argv[-1]]()))
    elif "--show" in sys.argv:
        show()
    else:
        record(sys.argv[1:] or list(FIGURES))
