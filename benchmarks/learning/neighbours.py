"""Faults that verdicts had, each with ten neighbours or more.

    python benchmarks/learning/neighbours.py [precise,start,restart,level,outliers,input]

- `precise`: a term that is missing shows below 1e-5 of the signal, at the default tolerance; and the right model.
- `start`: a number is determined or not wherever its search begins.
- `restart`: two tanks and a sine, whose plain search ends in a local minimum for some noise.
- `level`: noise stated too large or too small by a factor.
- `outliers`: some samples far away.
- `input`: the kinds of smooth inputs against SciPy's curves through the same samples.

References are the numbers that records were made with, SciPy and closed forms.
"""

import functools
import sys
import time

import coverage
import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from sympy import sin

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der, learning, simulate

TIMES = np.linspace(0.05, 10, 200)


class Spring(Component):
    """x'' = −k x − d x'."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        k, d = self.parameter("k", 3.5), self.parameter("d", 0.3)
        self.add_equations(Eq(der(x), v), Eq(der(v), -k * x - d * v))


class Lag(Component):
    """x' = −k x + c + u."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x, u = self.variable("x", start=1000.0, fixed=True), self.input("u", default=0.0)
        k, c = self.parameter("k", 1.0), self.parameter("c", 900.0)
        self.add_equations(Eq(der(x), -k * x + c + u))


class Sine(Component):
    """x = sin ω t, by x' = ω cos φ, φ' = ω."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x, phase = self.variable("x"), self.variable("phase", start=0.0, fixed=True)
        w = self.parameter("w2", 2.4)
        self.add_equations(Eq(der(phase), w**0.5), Eq(x, sin(phase)))


class Integral(Component):
    """x' = u."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x, u = self.variable("x", start=0.0, fixed=True), self.input("u", default=0.0)
        self.add_equations(Eq(der(x), u))


def compiled(component):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(component(ev))
    return AcausalCompiler(ev, diagram)()


@functools.cache
def swing(cube):
    return solve_ivp(
        lambda t, s: [s[1], -4 * s[0] - cube * s[0] ** 3 - 0.2 * s[1]], (0, 10), [1, 0], "DOP853", TIMES, rtol=1e-13,
        atol=1e-15,
    ).y[0]  # fmt: skip


def springs(cases):
    """(a case, the fit of its record), of one program: cases are (term, noise, stated noise, draw, outliers)."""
    system, problem = compiled(Spring), None
    for cube, noise, stated, seed, outliers in cases:
        rng = np.random.default_rng(seed)
        y = swing(cube) + noise * rng.standard_normal(200)
        for size in outliers:
            y[rng.integers(200)] += size * noise
        data = learning.Experiment(TIMES, {"c.x": y}, sigma=stated)
        problem = problem or learning.Problem(system, data, train=["c.k", "c.d"])
        yield (cube, noise, stated, seed, outliers), problem.fit(data, warn=False)


def precise():
    ratios = (30, 60, 100, 150)
    wrong = [(r * s, s, level, 1, ()) for s in (1e-6, 1e-7, 1e-5) for r in ratios for level in ("estimate", s)]
    right = [(0.0, s, level, seed, ()) for s in (1e-6, 1e-7, 1e-5) for level in ("estimate", s) for seed in range(4)]
    for case, fit in springs(wrong + right):
        yield case, fit.ok == (case[0] == 0), fit.reasons


def start():
    system = compiled(Lag)
    t = np.linspace(0.1, 20, 200)
    grid = np.linspace(0, 20, 401)
    for size, noise, is_determined in ((1000.2, 2.0, True), (9.5, 60.0, False)):
        said = []
        for begun in (0.0, 1e-3, 1.0, 10.0, 100.0, 500.0, 900.0, 1100.0, 3e3, 1e4, -500.0):
            y = size + (1000 - size) * np.exp(-t) + 50 * (np.sin(t) - np.cos(t) + np.exp(-t)) / 2
            y = y + noise * np.random.default_rng(3).standard_normal(200)
            data = learning.Experiment(t, {"c.x": y}, sigma=noise, inputs={"c.u": (grid, 50 * np.sin(grid), "spline")})
            problem = learning.Problem(system.with_parameters({"c.c": begun}), data, train=["c.k", "c.c"])
            fit = problem.fit(warn=False)
            row = fit.table()["c.c"]
            said.append((fit.ok, row.note))
            is_near = abs(row.value - size) < 4 * (row.high - row.low) / 3.92
            yield (size, begun), is_near and said[-1] == said[0] and (fit.ok or not is_determined), (*fit.reasons, row)


def restart():
    kind = coverage.Tanks
    times, samples, exact = coverage.record(kind)
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(kind(ev))
    system, problem = AcausalCompiler(ev, diagram)(), None
    initial = {f"m.{k}": learning.Unknown(guess) for k, (_, guess) in kind.starts.items()}
    for seed in range(30):
        noisy = exact["h2"] + kind.sigma["h2"] * np.random.default_rng(seed).standard_normal(len(times))
        data = learning.Experiment(times, {"m.h2": noisy}, inputs={"m.u": (*samples, "held")}, initial=initial)
        problem = problem or learning.Problem(system, data, train=[f"m.{k}" for k in kind.truth])
        fit = problem.fit(data, warn=False)
        level = fit.sigma["m.h2"] / kind.sigma["h2"]
        yield ("tanks", seed), 0.8 < level < 1.2, (level, fit.tried, *fit.reasons)
    system, problem = compiled(Sine), None
    for k in range(12):
        truth = 4.84 * (1 + 0.05 * (k - 6))
        y = np.sin(np.sqrt(truth) * TIMES) + 0.02 * np.random.default_rng(k).standard_normal(200)
        data = learning.Experiment(TIMES, {"c.x": y}, sigma="estimate")
        problem = problem or learning.Problem(system, data, train=["c.w2"])
        fit = problem.fit(data, warn=False)
        yield ("sine", truth), abs(fit.values["c.w2"] / truth - 1) < 0.01, (fit.values["c.w2"], fit.tried, *fit.reasons)


def level():
    for factor, word in ((2.0, "too large"), (1.6, "too large"), (0.5, "too small"), (0.7, "too small"), (1.0, None)):
        for case, fit in springs([(0.0, 0.01, 0.01 * factor, seed, ()) for seed in range(5)]):
            said = fit.ok if word is None else any(word in reason for reason in fit.reasons)
            yield (factor, *case), said, fit.reasons


def outliers():
    sizes = ((300.0, -300.0), (10.0,) * 8, (-10.0,) * 8, (20.0, -20.0, 15.0), (8.0,) * 10)
    for case, fit in springs(
        [(0.0, 0.01, s, seed, which) for which in sizes for s in (0.01, "estimate") for seed in (0, 1)]
    ):
        yield case, any("outlier" in reason for reason in fit.reasons), fit.reasons


def smooth_inputs():
    system = compiled(Integral)
    for k in range(10):
        t = np.sort(np.random.default_rng(k).uniform(0, 10, 30))
        t[0], t[-1] = 0.0, 10.0
        u = np.sin((1 + 0.3 * k) * t + k)
        exact = CubicSpline(t, u, bc_type="natural").integrate(0, 10)
        run = simulate(system, 10.0, inputs={"c.u": (t, u, "spline")}, rtol=1e-10, atol=1e-12)
        off = abs(float(run["c.x"][-1]) - float(exact))
        yield ("spline", k), off < 1e-8, (off,)


KINDS = {f.__name__: f for f in (precise, start, restart, level, outliers)} | {"input": smooth_inputs}


def main(names):
    jax.config.update("jax_enable_x64", True)
    for name in names:
        begun, count, right = time.process_time(), 0, 0
        for case, is_right, found in KINDS[name]():
            count, right = count + 1, right + bool(is_right)
            if not is_right:
                print(f"{name} {case}:", *found, sep="\n    ", flush=True)
        print(f"{name}: {right} of {count}, {time.process_time() - begun:.0f} CPU s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1].split(",") if len(sys.argv) > 1 else KINDS)
