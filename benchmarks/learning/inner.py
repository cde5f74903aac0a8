"""Closed forms of a slider's friction, found in the place of a network, over seeds of the noise.

    python benchmarks/learning/inner.py [stribeck,drag] [first seed] [last seed]

- `stribeck`: tanh(v/0.05)·(0.4 + 0.5·exp(−(v/v_s)²)) + 0.3 v, with v_s = 0.25 unknown.
- `drag`: 0.3 v + 0.4 v|v|, among the powers up to four.

Positions are measured 120 times in 6 s, with noise of 1 mm. SciPy integrates the truth.
"""

import sys
import time

import jax
import numpy as np
import scipy.integrate

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der
from jaxonomy_dae.learning import Experiment, Odd, Problem, powers, terms

FALLING = "tanh(v/0.05)*exp(-(v/v_s)**2)"
CASES = {
    "stribeck": (
        lambda v: np.tanh(v / 0.05) * (0.4 + 0.5 * np.exp(-((v / 0.25) ** 2))) + 0.3 * v,
        lambda: terms("v", "tanh(v/0.05)", FALLING, "v*Abs(v)"), {"v", "tanh(v/0.05)", FALLING},
    ),
    "drag": (lambda v: 0.3 * v + 0.4 * v * abs(v), lambda: powers(4), {"v", "v*|v|"}),
}  # fmt: skip


class Slider(Component):
    """x' = v, v' = u − 2x − f(v), with a learned friction f."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, v = self.variable("x", start=0.5, fixed=True), self.variable("v", start=0.0, fixed=True)
        u = self.input("u", default=0.0)
        (f,) = self.learned("f", Odd(key=jax.random.key(0), inputs=0.3, outputs=1.0), inputs=[v])
        self.add_equations(Eq(der(x), v), Eq(der(v), u - 2 * x - f))


def force(t):
    return 1.6 * np.sin(1.7 * t) + 0.5 * np.sin(4.1 * t)


def main(name, seeds):
    friction, library, right = CASES[name]
    ts, tu = np.linspace(0, 6, 121)[1:], np.linspace(0, 6, 601)
    run = scipy.integrate.solve_ivp(
        lambda t, s: [s[1], force(t) - 2 * s[0] - friction(s[1])], (0, 6), [0.5, 0.0], "LSODA", ts, rtol=1e-9,
        atol=1e-11,
    )  # fmt: skip
    diagram, problem, count = AcausalDiagram(), None, 0
    ev = EqnEnv()
    diagram.add(Slider(ev, "s"))
    system = AcausalCompiler(ev, diagram)()
    for seed in seeds:
        start = time.process_time()
        noise = 1e-3 * np.random.default_rng(seed).standard_normal(len(ts))
        data = Experiment(ts, {"s.x": run.y[0] + noise}, sigma=1e-3, inputs={"s.u": (tu, force(tu), "cubic")})
        problem = problem or Problem(system, data)
        found = problem.fit(data, warn=False).discover("s.f", library())
        true = [c for c in found.candidates if set(c.terms) == right]
        others = [c.bic - true[0].bic for c in found.candidates if c is not true[0]] if true else [np.nan]
        is_right = bool(true) and found.chosen is true[0]
        count += is_right
        row = found.chosen.coefficients(0.95)
        values = ", ".join(f"{key} {row[key].low:.3g} to {row[key].high:.3g}" for key in (r.name for r in row))
        print(
            f"{name} seed {seed}: {'right' if is_right else 'WRONG'} {found.chosen.terms}, next {min(others):+.2f}, "
            f"lack of fit {found.lack_of_fit:.2g}, {values}, {time.process_time() - start:.1f} CPU s",
            flush=True,
        )
    print(f"{name}: right form in {count} of {len(seeds)}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    given = [*sys.argv[1:], *[None] * 3][:3]
    for case in (given[0] or ",".join(CASES)).split(","):
        main(case, range(int(given[1] or 0), int(given[2] or 19) + 1))
