"""How long programs of medium models take to compile: value alone, and value with gradient.

Models of 3 to 120 equations of different shapes: the published test set, a double pendulum of rigid arms, networks of
turbulent pipes, circuits. Every program ends at one saved time; the gradient is that of the sum of the states there, by
all parameters. Processor seconds are those of all threads.

    python -m benchmarks.compile_times [--models pendulums,pipes]
"""

import argparse
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from sympy import Eq, cos, sin

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, Component, EqnEnv, der, simulate, solvers
from jaxonomy_dae.run.system.solver_choice import implicit_choice

from .attack import circuits, pipes
from .testset import PROBLEMS

STATES = 20  # of a model, at most, in the sum


class Arm(Component):
    """A rigid arm between the points 0 and 1, its mass in the middle."""

    def __init__(self, ev, name, angle):
        super().__init__(ev, name)
        m, length, inertia = self.parameter("m", 1.0), self.parameter("L", 1.0), self.parameter("J", 0.08)
        phi, w = self.variable("phi", start=angle, fixed=True), self.variable("w", start=0.0, fixed=True)
        x, y, vx, vy, x0, y0, x1, y1, fx0, fy0, fx1, fy1 = (
            self.variable(n) for n in "x y vx vy x0 y0 x1 y1 fx0 fy0 fx1 fy1".split()
        )
        torque = (x0 - x) * fy0 - (y0 - y) * fx0 - (x1 - x) * fy1 + (y1 - y) * fx1
        self.add_equations(
            Eq(der(phi), w),
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(m * der(vx), fx0 - fx1),
            Eq(m * der(vy), fy0 - fy1 - 9.81 * m),
            Eq(inertia * der(w), torque - self.parameter("d", 0.05) * w),
            Eq(x0, x - length / 2 * sin(phi)),
            Eq(y0, y + length / 2 * cos(phi)),
            Eq(x1, x + length / 2 * sin(phi)),
            Eq(y1, y - length / 2 * cos(phi)),
        )


class Chain(Component):
    """Arms that hang from each other."""

    def __init__(self, ev, name, n):
        super().__init__(ev, name)
        arms = [self.add(Arm(ev, f"arm{k}", 1.0 / (k + 1))) for k in range(n)]
        self.add_equations(arms[0].x0, arms[0].y0, arms[-1].fx1, arms[-1].fy1)
        for a, b in zip(arms, arms[1:], strict=False):
            self.add_equations(Eq(a.x1, b.x0), Eq(a.y1, b.y0), Eq(a.fx1, b.fx0), Eq(a.fy1, b.fy0))


class Model(NamedTuple):
    """A compiled model, the end of its run, and whether an implicit method must be taken."""

    name: str
    system: AcausalSystem
    t1: float
    stiff: bool


def models(chosen: list[str]) -> Iterator[Model]:
    """The models of these kinds, or all."""

    def wanted(kind: str) -> bool:
        return not chosen or kind in chosen

    if wanted("pendulums"):
        for n in (1, 2):
            ev, diagram = EqnEnv(), AcausalDiagram()
            diagram.add(Chain(ev, "chain", n))
            yield Model(f"chain of {n}", AcausalCompiler(ev, diagram)(), 2.0, False)
    if wanted("testset"):
        for problem in PROBLEMS.values():
            yield Model(problem.name, problem.compile(), problem.t1, problem.stiff)
    for kind, make, seeds in (("pipes", pipes.make, (2, 4, 7)), ("circuits", circuits.make, (1, 5, 6))):
        for seed in seeds if wanted(kind) else ():
            case = make(seed)
            yield Model(f"{kind} {seed}", AcausalCompiler(case.ev, case.diagram)(), 1e-3, True)


def measure(function: Any, system: AcausalSystem) -> tuple[float, float, int]:
    """Processor seconds of tracing and of XLA, and the lines of the program."""
    begin = time.process_time()
    lowered = eqx.filter_jit(function).lower(system)
    traced = time.process_time()
    lines = lowered.as_text().count("\n")
    middle = time.process_time()
    lowered.compile()
    return traced - begin, time.process_time() - middle, lines


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--models", default="", help="pendulums, testset, pipes, circuits; all by default")
    chosen = [m for m in parser.parse_args().models.split(",") if m]
    jax.config.update("jax_enable_x64", True)
    print(f"{'':<20}{'':>10}{'':>9}{'value':>24}{'with gradient':>24}")
    columns = "".join(f"{c:>8}" for c in 2 * ("trace s", "XLA s", "lines"))
    print(f"{'model':<20}{'equations':>10}{'solver':>9}{columns}{'ratio':>7}", flush=True)
    for name, system, t1, stiff in models(chosen):
        if not len(system.parameters):
            continue  # nothing to differentiate by
        solver = implicit_choice(system.plan, "").solver if stiff or len(system.carried) else "Tsit5"

        def end(system, t1=t1, solver=solver):
            method = getattr(solvers, solver)()
            solution = simulate(system, t1, ts=jnp.array([t1]), solver=method, throw=False)
            return sum(jnp.sum(solution[n]) for n in system.states[:STATES])

        rows = [measure(f, system) for f in (end, eqx.filter_value_and_grad(end))]
        ratio = sum(rows[1][:2]) / sum(rows[0][:2])
        cells = "".join(f"{trace:>8.1f}{xla:>8.1f}{lines:>8}" for trace, xla, lines in rows)
        print(f"{name:<20}{system.plan.flat.n_equations:>10}{solver:>9}{cells}{ratio:>7.1f}", flush=True)


if __name__ == "__main__":
    main()
