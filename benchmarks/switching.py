"""Many diodes in one circuit, each with events of its own: a ladder of diodes, and a bank of bridge rectifiers.

    python -m benchmarks.switching [sizes of the ladder] [--bridges sizes of the bank]

Beside each, the same circuit with resistors in place of the diodes. All are arrays of components: one program for any
size, and one run without an enumeration of modes. Compilation, first run (with XLA) and the best of three runs are
timed apart; a step is what the solver tries, those that end at an event included.
"""

import argparse
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxonomy_dae.library.electrical as el
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate


def ladder(n: int, switching: bool) -> AcausalCompiler:
    """1 V charges n capacitors, each through a resistor from the node before and a diode."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = el.VoltageSource(ev, "source", V=1.0), el.Ground(ev, "ground")
    series = diagram.add_array(ev, "r", el.Resistor, n, 0.5)
    tank = diagram.add_array(ev, "c", el.Capacitor, n, 1.0, initial_voltage=0.0)
    if switching:
        link = diagram.add_array(ev, "d", el.IdealDiode, n, Vknee=0.05, Goff=1e-6, Ron=0.5)
    else:
        link = diagram.add_array(ev, "d", el.Resistor, n, 0.5)
    diagram.connect(source.p, series[0].p)
    diagram.connect(series.n, link.p)
    diagram.connect(link.n, tank.p)
    diagram.connect(link[:-1].n, series[1:].p)
    diagram.connect(tank.n, ground.p)
    diagram.connect(source.n, ground.p)
    return AcausalCompiler(ev, diagram)


def bank(n: int, switching: bool) -> AcausalCompiler:
    """n bridges at one source of 10 V and 50 Hz, each with its own capacitor and load."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = el.SineVoltage(ev, "source", 10.0, 50.0), el.Ground(ev, "ground")
    series = diagram.add_array(ev, "line", el.Resistor, n, 0.1)
    if switching:
        d = [diagram.add_array(ev, f"d{k}", el.IdealDiode, n, Vknee=0.6, Goff=1e-6, Ron=0.05) for k in range(4)]
    else:  # of different sizes: a balanced bridge carries nothing
        d = [diagram.add_array(ev, f"d{k}", el.Resistor, n, 0.05 * (k + 1)) for k in range(4)]
    tank = diagram.add_array(ev, "c", el.Capacitor, n, np.linspace(1e-3, 2e-3, n), initial_voltage=0.0)
    load = diagram.add_array(ev, "r", el.Resistor, n, np.linspace(10.0, 50.0, n))
    diagram.connect(source.n, ground.p)
    diagram.connect(source.p, series.p)
    diagram.connect(series.n, d[0].p, d[1].n)
    diagram.connect(source.n, d[2].p)
    diagram.connect(source.n, d[3].n)
    diagram.connect(d[0].n, d[2].n, tank.p, load.p)
    diagram.connect(d[1].p, d[3].p, tank.n, load.n)
    return AcausalCompiler(ev, diagram)


def row(name: str, n: int, switching: bool, compiler: AcausalCompiler, end: float, most: int) -> None:
    """Compiles and runs a model, and prints what it took."""
    start = time.perf_counter()
    system = compiler()
    compiled = time.perf_counter() - start
    times = []
    for _ in range(4):
        start = time.perf_counter()
        solution = simulate(
            system, end, ts=jnp.array([end]), solver=diffrax.Tsit5(), max_events=most, max_steps=200_000,
            save_events=False,
        )  # fmt: skip
        jax.block_until_ready(solution.states)
        times.append(time.perf_counter() - start)
    steps, best = int(solution.stats["num_steps"]), min(times[1:])
    events = int(np.isfinite(np.asarray(solution.events.ts)).sum()) if switching else 0
    kind = "diodes" if switching else "resistors"
    print(
        f"{name:8s}{n:6d}  {kind:10s}{compiled:8.2f}s{times[0]:9.2f}s{best:10.4f}s{steps:8d}{events:8d}"
        f"{1e6 * best / steps:10.0f}",
        flush=True,
    )


def main():
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser()
    parser.add_argument("ladders", nargs="*", type=int, default=[10, 100, 1000])
    parser.add_argument("--bridges", nargs="*", type=int, default=[1, 10, 100])
    given = parser.parse_args()
    columns = "compile", "first", "steady", "steps", "events", "µs/step"
    widths = 9, 10, 10, 8, 8, 10
    print(f"{'size':>14s}{'':12s}", *(f"{c:>{w}s}" for c, w in zip(columns, widths, strict=True)), sep="")
    for build, name, sizes, end in ((ladder, "ladder", given.ladders, 10.0), (bank, "bank", given.bridges, 0.1)):
        for n in sizes:
            for switching in (True, False):
                row(name, n, switching, build(n, switching), end, 100 * n)


if __name__ == "__main__":
    main()
