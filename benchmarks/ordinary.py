"""What ordinary models cost, beside an older tree: a pendulum, a motor, a house, a ladder of diodes, a bank of bridges.

    python -m benchmarks.ordinary [--beside ../older] [--models pendulum,motor] [--repeat 3]

Of each, at default arguments: seconds of tracing and of XLA, lines of StableHLO, and a run, for the values at one saved
time, and with the gradient of their sum by all parameters. The trees take turns, each model in a process of its own; of
all turns the least is shown. Seconds are of the processor, all threads together: other work beside matters little.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from sympy import Eq, sin

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as signal
import jaxonomy_dae.library.thermal as thermal
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.write import Thermal

from .switching import bank, ladder

HERE = Path(__file__).resolve().parent.parent
RUNS = 10  # together: the clock of the processor is coarse
STATES = 20  # of a model, at most, in the sum


class Pendulum(Component):
    """A point mass on a rod, in Cartesian coordinates: of index 3."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        length, d = self.parameter("L", 1.0), self.parameter("d", 0.1)
        x, y = self.variable("x", start=1.0, fixed=True), self.variable("y", start=0.0)
        u, v = self.variable("u"), self.variable("v", start=0.0, fixed=True)
        force = self.variable("force")
        self.add_equations(
            Eq(der(x), u),
            Eq(der(y), v),
            Eq(der(u), -force * x - d * u),
            Eq(der(v), -force * y - d * v - 9.81),
            Eq(x**2 + y**2, length**2),
        )


class Weather(Component):
    """Days of an outdoor temperature."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        heat = self.port("heat", Thermal)
        omega = self.parameter("omega", 2 * jnp.pi / 86400)
        self.add_equations(Eq(heat.T, 273.0 + 5.0 * sin(omega * ev.t)))


def pendulum() -> AcausalCompiler:
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Pendulum(ev, "pendulum"))
    return AcausalCompiler(ev, diagram)


def motor() -> AcausalCompiler:
    """A motor behind a shaft that gives way, at a constant voltage."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = el.VoltageSource(ev, "source", V=12.0), el.Ground(ev, "ground")
    drive = el.DCMotor(ev, "motor", d=1e-4, initial_current=0.0, initial_angle=0.0, initial_speed=0.0)
    shaft = rot.SpringDamper(ev, "shaft", 20.0, 0.01)
    load = rot.Inertia(ev, "load", 2e-3, initial_angle=0.0, initial_speed=0.0)
    bearing, frame = rot.Damper(ev, "bearing", 1e-3), rot.FixedAngle(ev, "frame")
    diagram.connect(source.p, drive.p)
    diagram.connect(source.n, drive.n, ground.p)
    diagram.connect(drive.flange, shaft.flange_a)
    diagram.connect(shaft.flange_b, load.flange_a)
    diagram.connect(load.flange_b, bearing.flange_a)
    diagram.connect(bearing.flange_b, frame.flange)
    return AcausalCompiler(ev, diagram)


def house(**limits: float) -> AcausalCompiler:
    """Two days of a house with walls in layers, heated by a PI controller."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    weather, room = Weather(ev, "weather"), thermal.HeatCapacitor(ev, "room", 4e6, initial_temperature=288.0)
    R, C, T = [1e-3, 1e-2, 1.4e-3], [2.7e7, 4e5, 1.6e7], [275.0, 280.0, 285.0]  # of brick, insulation, an inner leaf
    wall = thermal.Wall(ev, "wall", R=R, C=C, initial_temperature=T)
    windows, heater = thermal.ThermalConductor(ev, "windows", 130.0), thermal.HeatFlowSource(ev, "heater")
    sensor, aim = thermal.TemperatureSensor(ev, "sensor"), signal.Constant(ev, "aim", 294.0)
    control = signal.PI(ev, "control", k=1500.0, Ti=10800.0, **limits)
    diagram.connect(weather.heat, wall.port_a, windows.port_a)
    diagram.connect(room.heat, wall.port_b, windows.port_b, heater.heat, sensor.heat)
    diagram.add(aim, control)
    diagram.connect(aim.y, control.setpoint)
    diagram.connect(sensor.T, control.measured)
    diagram.connect(control.y, heater.Q_flow)
    return AcausalCompiler(ev, diagram)


MODELS: dict[str, tuple[Callable[[], AcausalCompiler], float, dict[str, Any]]] = {
    "pendulum": (pendulum, 10.0, {}),
    "motor": (motor, 1.0, {}),
    "house": (house, 172800.0, {}),
    "house, limited": (lambda: house(low=0.0, high=6000.0), 172800.0, {}),
    "ladder of 100 diodes": (lambda: ladder(100, True), 10.0, {}),
    "bank of 10 bridges": (lambda: bank(10, True), 0.04, dict(max_events=400)),
}


def spent(function: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of the processor, and what comes out."""
    begin = time.process_time()
    out = function()
    return time.process_time() - begin, out


def measured(name: str, kinds: tuple[str, ...]) -> dict[str, float]:
    """What one model costs with the package that is imported."""
    make, t1, options = MODELS[name]
    found = {}
    found["build"], system = spent(lambda: make()())

    def end(system):
        solution = simulate(system, t1, ts=jnp.array([t1]), max_steps=100_000, throw=False, **options)
        return sum(jnp.sum(solution[n]) for n in system.states[:STATES])

    functions = {"value": end, "gradient": eqx.filter_value_and_grad(end)}
    for kind in kinds:
        function = functions[kind]
        found[f"{kind} trace"], lowered = spent(lambda f=function: eqx.filter_jit(f).lower(system))
        found[f"{kind} lines"] = lowered.as_text().count("\n")
        found[f"{kind} XLA"], compiled = spent(lowered.compile)
        jax.block_until_ready(eqx.filter(compiled(system), eqx.is_array))
        rounds = []
        for _ in range(5):
            seconds, _ = spent(lambda c=compiled: [jax.block_until_ready(c(system)) for _ in range(RUNS)])
            rounds.append(seconds / RUNS)
        found[f"{kind} run"] = min(rounds)
    return found


def turn(tree: Path, name: str, values: bool) -> dict[str, float]:
    """What one model costs with the package in `tree`."""
    environment = os.environ | {"PYTHONPATH": f"{tree}{os.pathsep}{HERE}"}
    command = [sys.executable, "-m", "benchmarks.ordinary", "--one", name, *(["--values"] if values else [])]
    # From outside of both trees: the directory in which Python starts comes before what PYTHONPATH names.
    done = subprocess.run(command, env=environment, cwd=os.sep, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{name}, {tree}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--beside", type=Path, help="the root of an older tree")
    parser.add_argument("--models", default=";".join(MODELS), help="names, between semicolons; all by default")
    parser.add_argument("--repeat", type=int, default=3, help="turns of each tree")
    parser.add_argument("--values", action="store_true", help="leave gradients out")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    kinds = ("value",) if given.values else ("value", "gradient")
    if given.one:
        print(json.dumps(measured(given.one, kinds)))
        return
    trees = {"now": HERE} if given.beside is None else {"before": given.beside.resolve(), "now": HERE}
    head = "".join(f"{c:>9}" for c in ("trace s", "XLA s", "lines", "run ms"))
    print(f"{'':<22}{'':<8}{'build s':>8}{'value':>10}{'with gradient':>39}\n{'':<38}{head}   {head}", flush=True)
    for name in given.models.split(";"):
        turns: dict[str, list[dict[str, float]]] = {which: [] for which in trees}
        for _ in range(given.repeat):
            for which, tree in trees.items():
                turns[which].append(turn(tree, name, given.values))
        for which, found in turns.items():
            least = {key: min(one[key] for one in found) for key in found[0]}
            cells = [
                f"{least[f'{kind} trace']:9.2f}{least[f'{kind} XLA']:9.2f}{least[f'{kind} lines']:9.0f}"
                f"{1e3 * least[f'{kind} run']:9.3f}"
                for kind in kinds
            ]
            print(f"{name:<22}{which:<8}{least['build']:8.2f}" + "   ".join(cells), flush=True)


if __name__ == "__main__":
    main()
