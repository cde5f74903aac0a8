"""How often 95 % intervals cover the truth: a battery, two tanks and a motor, each from 200 synthetic records with
noise of unknown level and unknown starts. The truth is integrated by SciPy.

    python benchmarks/learning/coverage.py [records] [battery,tanks,motor]
"""

import sys
import time

import jax
import numpy as np
import scipy.integrate
from sympy import sqrt

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.write import POSITIVE, Component, Eq, der


class Battery(Component):
    """v = ocv(s) − R0 i − w,  Q s' = −i/3600,  C1 w' = i − w/R1."""

    truth = {"R0": 0.02, "R1": 0.015, "C1": 2000.0, "Q": 2.5}
    starts = {"s": (0.8, 0.7), "w": (0.0, 0.005)}  # true, guess
    sigma = {"v": 2e-3}
    span, samples, levels = 1200.0, 240, 5.0

    def __init__(self, ev, name="m"):
        super().__init__(ev, name)
        r0, r1, c1, q = (self.parameter(k, 1.3 * v, bounds=POSITIVE) for k, v in self.truth.items())
        i, v = self.input("u"), self.variable("v")
        s, w = (self.variable(k, start=v, fixed=True) for k, (v, _) in self.starts.items())
        ocv = 3.2 + 0.9 * s + 0.2 * s**2
        self.add_equations(Eq(3600 * q * der(s), -i), Eq(c1 * der(w), i - w / r1), Eq(v, ocv - r0 * i - w))

    @staticmethod
    def field(x, u, p):
        return [-u / 3600 / p["Q"], (u - x[1] / p["R1"]) / p["C1"]]

    @staticmethod
    def measured(x, u, p):
        return {"v": 3.2 + 0.9 * x[0] + 0.2 * x[0] ** 2 - p["R0"] * u - x[1]}


class Tanks(Component):
    """h1' = p u − a1 √h1,  h2' = a1 √h1 − a2 √h2; the lower level is measured."""

    truth = {"p": 0.05, "a1": 0.06, "a2": 0.05}
    starts = {"h1": (4.0, 5.0), "h2": (6.0, 5.5)}
    sigma = {"h2": 0.03}
    span, samples, levels = 1600.0, 200, 2.0

    def __init__(self, ev, name="m"):
        super().__init__(ev, name)
        p, a1, a2 = (self.parameter(k, 1.2 * v, bounds=POSITIVE) for k, v in self.truth.items())
        u = self.input("u")
        h1, h2 = (self.variable(k, start=v, fixed=True) for k, (v, _) in self.starts.items())
        flow = self.variable("flow")
        self.add_equations(Eq(flow, a1 * sqrt(h1)), Eq(der(h1), p * (u + 3) - flow), Eq(der(h2), flow - a2 * sqrt(h2)))

    @staticmethod
    def field(x, u, p):
        flow = p["a1"] * np.sqrt(x[0])
        return [p["p"] * (u + 3) - flow, flow - p["a2"] * np.sqrt(x[1])]

    @staticmethod
    def measured(x, u, p):
        return {"h2": x[1]}


class Motor(Component):
    """L i' = u − R i − k ω,  J ω' = k i − b ω; both are measured."""

    truth = {"R": 1.2, "L": 0.02, "k": 0.1, "J": 2e-3, "b": 1e-3}
    starts = {"i": (0.5, 0.0), "w": (10.0, 0.0)}
    sigma = {"i": 0.1, "w": 0.5}
    span, samples, levels = 2.0, 200, 6.0

    def __init__(self, ev, name="m"):
        super().__init__(ev, name)
        r, inductance, k, j, b = (self.parameter(n, 1.3 * v, bounds=POSITIVE) for n, v in self.truth.items())
        u = self.input("u")
        i, w = (self.variable(n, start=v, fixed=True) for n, (v, _) in self.starts.items())
        self.add_equations(Eq(inductance * der(i), u - r * i - k * w), Eq(j * der(w), k * i - b * w))

    @staticmethod
    def field(x, u, p):
        return [(u - p["R"] * x[0] - p["k"] * x[1]) / p["L"], (p["k"] * x[0] - p["b"] * x[1]) / p["J"]]

    @staticmethod
    def measured(x, u, p):
        return {"i": x[0], "w": x[1]}


def record(kind):
    """Times, the held input (times, values), and what would be measured without noise."""
    grid = np.linspace(0, kind.span, 21)
    u = kind.levels * np.random.default_rng(7).choice([-0.6, 0.0, 1.0], 21)
    times = np.linspace(0, kind.span, kind.samples + 1)[1:]
    place = np.minimum(np.searchsorted(grid, times, side="right") - 1, 20)
    x, out = np.array([v for v, _ in kind.starts.values()]), []
    for k in range(20):
        inside = times[(times > grid[k]) & (times <= grid[k + 1])]
        run = scipy.integrate.solve_ivp(
            lambda t, x, k=k: kind.field(x, u[k], kind.truth), (grid[k], grid[k + 1]), x, "DOP853", rtol=1e-11,
            atol=1e-13, dense_output=True,
        )  # fmt: skip
        out.append(run.sol(inside))
        x = run.y[:, -1]
    # A sample at a jump has the new input.
    return times, (grid, u), kind.measured(np.concatenate(out, axis=1), u[place], kind.truth)


def cover(kind, count):
    """Which intervals cover the truth, by name, and how long the fits took."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(kind(ev))
    system = AcausalCompiler(ev, diagram)()
    times, samples, exact = record(kind)
    initial = {f"m.{k}": learning.Unknown(guess) for k, (_, guess) in kind.starts.items()}

    def data(seed):
        rng = np.random.default_rng(seed)
        noisy = {f"m.{n}": y + kind.sigma[n] * rng.standard_normal(len(y)) for n, y in exact.items()}
        return learning.Experiment(times, noisy, inputs={"m.u": (*samples, "held")}, initial=initial)

    problem = learning.Problem(system, data(0), train=[f"m.{k}" for k in kind.truth])
    start = time.perf_counter()
    problem.fit()
    first, start, cpu = time.perf_counter() - start, time.perf_counter(), time.process_time()
    truth = {f"m.{k}": v for k, v in kind.truth.items()}
    truth |= {f"m.{k}, experiment 0": v for k, (v, _) in kind.starts.items()}
    inside = []
    for seed in range(count):
        table = problem.fit(data(seed)).table()
        inside.append([table[name].low <= value <= table[name].high for name, value in truth.items()])
    each = (time.perf_counter() - start) / count, (time.process_time() - cpu) / count
    by_name = dict(zip(truth, np.mean(inside, axis=0).tolist(), strict=True))
    print(
        f"{kind.__name__}: {np.mean(inside):.3f} of {np.size(inside)}, {by_name}; first fit {first:.1f} s, then "
        f"{each[0]:.3f} s, {each[1]:.3f} s CPU", flush=True,
    )  # fmt: skip
    return inside


def main(count, kinds):
    found = [np.ravel(cover({"battery": Battery, "tanks": Tanks, "motor": Motor}[kind], count)) for kind in kinds]
    print(f"pooled {np.mean(np.concatenate(found)):.3f}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    chosen = sys.argv[2].split(",") if len(sys.argv) > 2 else ["battery", "tanks", "motor"]
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200, chosen)
