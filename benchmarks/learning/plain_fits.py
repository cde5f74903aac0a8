"""Plain `problem.fit()` of raw `equinox.nn.MLP`s: how far the learned law is from the true one, what the fit says of
that, and whether it calls itself reliable.

    python benchmarks/learning/plain_fits.py [drag,stribeck,valve,diode,gap,two] [8x1:tanh] [noise seeds] [weight seeds]
        [seconds] [factor of the noise]

Truths are integrated by SciPy, in SI units: inputs may be pascals. Errors are root mean squares over the range that the
run explored, relative to the law's size; "stated" is the same of the standard deviation of the band.
"""

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy
from scipy.integrate import solve_ivp

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der, learning

SAMPLES = 200


class Plant(NamedTuple):
    """States with starts, their derivatives by `(module, states, laws, time)`, the inputs of each law, the states that
    are measured with their noise, and the true laws by name. `module`: NumPy or SymPy."""

    starts: dict[str, float]
    slopes: Callable
    inputs: Callable
    measured: dict[str, float]
    laws: dict[str, Callable]


def _stribeck(v):
    return (1 + 0.5 * np.exp(-((v / 0.2) ** 2))) * np.tanh(v / 0.05) + 0.3 * v


PLANTS = {
    "drag": Plant(
        {"a": 0.5, "w": 0.0}, lambda m, s, f, t: [s["w"], -9.81 * m.sin(s["a"]) - f["law"]],
        lambda s: {"law": s["w"]}, {"a": 1e-3}, {"law": lambda w: 0.3 * w * abs(w)},
    ),
    "stribeck": Plant(
        {"x": 0.0, "v": 0.0}, lambda m, s, f, t: [s["v"], 2.0 * m.sin(1.7 * t) + m.sin(4.1 * t) - f["law"]],
        lambda s: {"law": s["v"]}, {"x": 1e-3}, {"law": _stribeck},
    ),
    "valve": Plant(
        {"h": 3.0}, lambda m, s, f, t: [(4e-3 * (1 + m.sin(0.9 * t)) - f["law"]) / 5e-3],
        lambda s: {"law": 9810 * s["h"]}, {"h": 1e-3}, {"law": lambda p: 3e-5 * np.sqrt(np.maximum(p, 0.0))},
    ),
    "diode": Plant(
        {"v": 0.0}, lambda m, s, f, t: [((1.5 * m.sin(2.0 * t) - s["v"]) / 100 - f["law"]) / 2e-3],
        lambda s: {"law": s["v"]}, {"v": 1e-3}, {"law": lambda v: 1e-6 * (np.exp(v / 0.06) - 1)},
    ),
    "gap": Plant(
        {"x": 0.0, "v": 0.0},
        lambda m, s, f, t: [s["v"], 3.0 * m.sin(1.3 * t) + 2.0 * m.sin(3.1 * t) - 0.5 * s["v"] - f["law"]],
        lambda s: {"law": s["x"]}, {"x": 1e-3}, {"law": lambda x: 8.0 * (x - np.clip(x, -0.3, 0.3))},
    ),
    "two": Plant(
        {"x": 1.0, "v": 0.0}, lambda m, s, f, t: [s["v"], m.sin(2.1 * t) - f["spring"] - f["friction"]],
        lambda s: {"spring": s["x"], "friction": s["v"]}, {"x": 1e-3, "v": 2e-3},
        {"spring": lambda x: 2 * x + 1.5 * x**3, "friction": lambda v: 0.3 * v + 0.4 * v * abs(v)},
    ),
}  # fmt: skip


class Learned(Component):
    """A plant with a network in place of each law."""

    def __init__(self, ev, plant, nets):
        super().__init__(ev, "c")
        s = {name: self.variable(name, start=start, fixed=True) for name, start in plant.starts.items()}
        laws = {}
        for name, given in plant.inputs(s).items():
            u = self.variable(f"{name}_input")
            self.add_equations(Eq(u, given))
            (laws[name],) = self.learned(name, nets[name], inputs=[u])
        slopes = plant.slopes(sympy, s, laws, self.ev.t)
        self.add_equations(*(Eq(der(x), slope) for x, slope in zip(s.values(), slopes, strict=True)))


def truth(plant, seconds):
    """(times, states by name) of the true plant."""

    def field(t, values):
        s = dict(zip(plant.starts, values, strict=True))
        return plant.slopes(np, s, {name: plant.laws[name](u) for name, u in plant.inputs(s).items()}, t)

    ts = np.linspace(seconds / SAMPLES, seconds, SAMPLES)
    start = list(plant.starts.values())
    run = solve_ivp(field, (0, seconds), start, "LSODA", ts, rtol=1e-10, atol=1e-12, max_step=0.01)
    return ts, dict(zip(plant.starts, run.y, strict=True))


def compared(fit, plant, states):
    """(error of each law, its stated deviation, the share of the range inside the band). Of two laws whose sum acts,
    the data leave open a constant, which the error does not count."""
    found = {}
    for law, u in plant.inputs(states).items():
        grid = np.linspace(u.min(), u.max(), 60)
        right, band = plant.laws[law](grid), fit.band(f"c.{law}", grid)
        unit = np.sqrt(np.mean(right**2))
        off = band.mean - right
        off = off - np.mean(off) if len(plant.laws) > 1 else off
        error, stated = (np.sqrt(np.mean(e**2)) / unit for e in (off, band.spread))
        found[law] = error, stated, np.mean((band.low <= right) & (right <= band.high))
    return found


def main(names, shapes, noises, seeds, seconds, factor):
    for name in names:
        plant = PLANTS[name]
        ts, states = truth(plant, seconds)
        for shape in shapes:
            size, activation = shape.split(":")
            width, depth = map(int, size.split("x"))

            def nets(seed, plant=plant, width=width, depth=depth, activation=activation):
                keys = jax.random.split(jax.random.key(seed), len(plant.laws))
                act = getattr(jnp, activation, None) or getattr(jax.nn, activation)
                return {n: eqx.nn.MLP(1, 1, width, depth, act, key=k) for n, k in zip(plant.laws, keys, strict=True)}

            ev, diagram = EqnEnv(), AcausalDiagram()
            diagram.add(Learned(ev, plant, nets(0)))
            system, problem, rows = AcausalCompiler(ev, diagram)(), None, []
            for noise in range(noises):
                rng = np.random.default_rng(noise)
                sigma = {f"c.{x}": factor * level for x, level in plant.measured.items()}
                data = {x: states[x[2:]] + level * rng.standard_normal(SAMPLES) for x, level in sigma.items()}
                data = learning.Experiment(ts, data, sigma=sigma)
                problem = problem or learning.Problem(system, data)
                for seed in range(seeds):
                    start, drawn = time.process_time(), {f"c.{n}": net for n, net in nets(seed).items()}
                    there = eqx.tree_at(lambda s: s.neural, system, drawn)
                    fit = problem.beginning_at(there).fit(data, warn=False)
                    for law, (error, stated, covered) in compared(fit, plant, states).items():
                        rows.append((error, stated, covered, fit.ok))
                        print(
                            f"{name} {shape} noise {noise} weights {seed} {law}: {100 * error:.2f} %, stated "
                            f"{100 * stated:.2f} %, covered {100 * covered:.0f} %, χ² {fit.chi2:.0f} of "
                            f"{fit.freedom:.0f}, {fit.minimum.evaluations} evaluations, "
                            f"{time.process_time() - start:.1f} s, ok {fit.ok} {'; '.join(fit.reasons)[:60]}",
                            flush=True,
                        )
            error, stated, covered, ok = (np.array(column) for column in zip(*rows, strict=True))
            off = np.sum((error > 0.01 * factor) & ok)
            print(
                f"| {name} | {shape} | {seconds:g} s, {factor:g} | {len(rows)} | {100 * np.median(error):.2f} | "
                f"{100 * error.max():.2f} | {100 * np.median(stated):.2f} | {100 * covered.mean():.0f} | {ok.sum()} | "
                f"{off} |",
                flush=True,
            )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    given = [*sys.argv[1:], *[None] * 6][:6]
    main(
        (given[0] or ",".join(PLANTS)).split(","), (given[1] or "8x1:tanh").split(","), int(given[2] or 2),
        int(given[3] or 2), float(given[4] or 6.0), float(given[5] or 1.0),
    )  # fmt: skip
