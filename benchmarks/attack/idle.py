"""Derivatives of models whose parts rest, move and switch side by side, by all adjoints, against closed forms.

Where a part rests, its error is zero and says nothing about steps; what moves beside it decides about them. Parts:
oscillators x'' = −ω²·x − d·x' + F and lags y' = −k·(y − c), at rest or not, pushed at an instant or not; ramps;
sawteeth and balls, which events reset. They do not act on each other, so the derivative of a weighted sum of their ends
is known part by part.
"""

import math
import time
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, assign, der, pre, reinit, simulate
from jaxonomy_dae.solvers import DAETerm, solve_dae

from .judge import CHEAP
from .outcome import Outcome

RTOL, ATOL = 1e-9, 1e-11
ALLOWED = 1e-6  # of a derivative's scale, for each radian that an oscillator turns, and for one at least
WAYS = ("default", "forward", "checkpoint", "solve_dae")
VALUES = 6  # sets of numbers for each program
T1 = 1.0


def _turned(w: float, d: float, t: float) -> tuple[float, float, float]:
    """Of x'' = −w²·x − d·x' + F from zero: ∂x(t)/∂x(0), ∂x(t)/∂x'(0), ∂x(t)/∂F."""
    beta = d / 2
    damped = math.sqrt(w**2 - beta**2)
    decay, c, s = math.exp(-beta * t), math.cos(damped * t), math.sin(damped * t)
    by_x = decay * (c + beta / damped * s)
    return by_x, decay * s / damped, (1 - by_x) / w**2


class Oscillator(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        w, d, push = self.parameter("w", 20.0), self.parameter("d", 0.0), self.parameter("F", 0.0)
        x = self.variable("x", start=self.parameter("x0", 0.0), fixed=True)
        v = self.variable("v", start=self.parameter("v0", 0.0), fixed=True)
        self.add_equations(Eq(der(x), v), Eq(der(v), -(w**2) * x - d * v + push))

    @staticmethod
    def draw(rng):
        """Its numbers, its end, and its derivatives: (value, scale) by parameter."""
        w = float(10 ** rng.uniform(0, 2.2))
        d = 2 * w * float(rng.choice([0.0, 0.0, 0.01, 0.3]))
        rest = rng.random() < 0.7
        x0, v0, force = (0.0, 0.0, 0.0) if rest else (float(rng.normal()), w * float(rng.normal()), 0.0)
        by = _turned(w, d, T1)
        end = x0 * by[0] + v0 * by[1]
        turns = max(1.0, w * T1)
        slopes = {"x0": (by[0], turns), "v0": (by[1], turns / w), "F": (by[2], turns / w**2)}
        return {"w": w, "d": d, "x0": x0, "v0": v0, "F": force}, end, slopes, "x"


class Pushed(Component):
    """An oscillator that is pushed from an instant on, by a force that may be zero."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        w, force, at = self.parameter("w", 20.0), self.parameter("F", 0.0), self.parameter("at", 0.5)
        x, v = self.variable("x", start=0.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        on = self.discrete("on", start=0)
        self.add_equations(Eq(der(x), v), Eq(der(v), -(w**2) * x + on * force))
        self.when(ev.t >= at, assign(on, 1))

    @staticmethod
    def draw(rng):
        w, at = float(10 ** rng.uniform(0, 2)), float(rng.uniform(0.2, 0.7))
        force = 0.0 if rng.random() < 0.6 else float(rng.normal())
        by = (1 - math.cos(w * (T1 - at))) / w**2
        return {"w": w, "F": force, "at": at}, force * by, {"F": (by, max(1.0, w * T1) / w**2)}, "x"


class Lag(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        k, c = self.parameter("k", 1.0), self.parameter("c", 0.0)
        y = self.variable("y", start=self.parameter("y0", 0.0), fixed=True)
        self.add_equations(Eq(der(y), -k * (y - c)))

    @staticmethod
    def draw(rng):
        k = float(10 ** rng.uniform(-1, 3))
        c = float(rng.choice([0.0, 1.0, -30.0]))
        y0 = c if rng.random() < 0.7 else c + float(rng.normal())
        left = math.exp(-k * T1)
        return {"k": k, "c": c, "y0": y0}, c + (y0 - c) * left, {"y0": (left, 1.0), "c": (1 - left, 1.0)}, "y"


class Ramp(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        s = self.variable("s", start=self.parameter("s0", 0.0), fixed=True)
        self.add_equations(Eq(der(s), self.parameter("r", 1.0)))

    @staticmethod
    def draw(rng):
        s0, r = float(rng.normal()), float(rng.normal())
        return {"s0": s0, "r": r}, s0 + r * T1, {"s0": (1.0, 1.0), "r": (T1, 1.0)}, "s"


class Sawtooth(Component):
    """A clock that is reset, and counts how often."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        s, n = self.variable("s", start=self.parameter("s0", 0.0), fixed=True), self.discrete("n", start=0)
        self.add_equations(Eq(der(s), self.parameter("r", 1.0)))
        self.when(s >= 1, reinit(s, pre(s) - 1), assign(n, pre(n) + 1))

    @staticmethod
    def draw(rng):
        s0, r = float(rng.uniform(0, 0.5)), float(rng.uniform(0.7, 6))
        return {"s0": s0, "r": r}, (s0 + r * T1) % 1.0, {"s0": (1.0, 1.0), "r": (T1, 1.0)}, "s"


class Ball(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        e, g = self.parameter("e", 0.8), self.parameter("g", 9.81)
        h = self.variable("h", start=self.parameter("h0", 1.0), fixed=True)
        v = self.variable("v", start=0.0, fixed=True)
        self.add_equations(Eq(der(h), v), Eq(der(v), -g))
        self.when(h <= 0, reinit(v, -e * pre(v)), reinit(h, 0))

    @staticmethod
    def draw(rng):
        """It has bounced once at the end: h = up·s − g·s²/2 with up = e·√(2·g·h0), s = T1 − √(2·h0/g)."""
        e, g, fall = float(rng.uniform(0.7, 0.95)), 9.81, float(rng.uniform(0.45, 0.7))
        h0 = g * fall**2 / 2
        s, up = T1 - fall, e * g * fall
        by_fall = e * g * s - up + g * s
        slopes = {"e": (g * fall * s, 10.0), "h0": (by_fall / (g * fall), 10.0)}
        return {"e": e, "g": g, "h0": h0}, up * s - g * s**2 / 2, slopes, "h"


IDLE, MOVING, SWITCHING = (Oscillator, Lag), (Ramp, Lag, Oscillator), (Sawtooth, Ball, Pushed)


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """One program, and one outcome for each set of numbers."""
    rng = np.random.default_rng([seed, 18])
    way = WAYS[seed % len(WAYS)]
    kinds = [IDLE[int(rng.integers(2))] for _ in range(int(rng.integers(1, 3)))]
    kinds += [MOVING[int(rng.integers(3))] for _ in range(int(rng.integers(0, 2)))]
    if way != "solve_dae":
        kinds += [SWITCHING[int(rng.integers(3))] for _ in range(int(rng.integers(0, 3)))]
    ev = EqnEnv()
    parts = [kind(ev, f"p{k}") for k, kind in enumerate(kinds)]
    diagram = AcausalDiagram()
    diagram.add(*(parts[k] for k in rng.permutation(len(parts))))
    system = AcausalCompiler(ev, diagram)()
    program: Any = None
    outcomes = []
    for _ in range(VALUES):
        start = time.process_time()
        drawn = [kind.draw(rng) for kind in kinds]
        weights = {f"p{k}.{d[3]}": float(rng.uniform(0.5, 2)) for k, d in enumerate(drawn)}
        numbers = {f"p{k}.{n}": v for k, d in enumerate(drawn) for n, v in d[0].items()}
        by = {f"p{k}.{n}": w for (k, d), w in zip(enumerate(drawn), weights.values(), strict=True) for n in d[2]}
        slopes = {f"p{k}.{n}": s for k, d in enumerate(drawn) for n, s in d[2].items()}
        given = {n: jnp.asarray(numbers[n]) for n in slopes}
        others = {n: jnp.asarray(v) for n, v in numbers.items() if n not in slopes}
        args = given, others, {n: jnp.asarray(w) for n, w in weights.items()}
        if program is None:
            program = jax.jit(_gradient(system, way)).lower(*args).compile(compiler_options=CHEAP)
        value, found = program(*args)
        true = sum(w * d[1] for w, d in zip(weights.values(), drawn, strict=True))
        size = sum(w * max(abs(d[1]), 1.0) for w, d in zip(weights.values(), drawn, strict=True))
        errors = {"the sum": (float(value), true, ALLOWED * 100 * size)}
        for name, (slope, scale) in slopes.items():
            errors[f"by {name}"] = (float(found[name]), by[name] * slope, ALLOWED * by[name] * scale)
        off = {n: abs(f - t) / a if math.isfinite(f) else math.inf for n, (f, t, a) in errors.items()}
        worst = max(off, key=off.__getitem__)
        f, t, a = errors[worst]
        text = f"{worst}: {f!r}, true {t!r}, allowed {a:.1e}; {numbers}"
        outcomes.append(Outcome("right" if off[worst] <= 1 else "wrong", off[worst], text, time.process_time() - start))
    return f"{way}: {', '.join(kind.__name__ for kind in kinds)}", outcomes


def _gradient(system, way: str):
    """(value, derivatives by name) of a weighted sum of ends."""

    def end(given, others, weights):
        whole = system.with_parameters({**given, **others})
        if way == "solve_dae":
            x = whole.initialize()
            term = DAETerm(lambda t, y, s: s.vector_field(t, y), mass=np.ones(len(system.states)))
            y = solve_dae(term, T1, x, args=whole, rtol=RTOL, atol=ATOL, adjoint=diffrax.ForwardMode()).ys[-1]
            return sum(w * whole.observe(n, T1, y) for n, w in weights.items())
        adjoint = {
            "default": None,
            "forward": diffrax.ForwardMode(),
            "checkpoint": diffrax.RecursiveCheckpointAdjoint(),
        }
        solution = simulate(whole, T1, rtol=RTOL, atol=ATOL, adjoint=adjoint[way])
        return sum(w * solution[n][-1] for n, w in weights.items())

    if way in ("default", "checkpoint"):
        return jax.value_and_grad(end)

    def forward(given, others, weights):
        slopes = {}
        for name in given:
            tangent = {n: jnp.asarray(float(n == name)) for n in given}
            slopes[name] = tangent
        stacked = jax.tree.map(lambda *rows: jnp.stack(rows), *slopes.values())
        by = jax.vmap(lambda t: jax.jvp(lambda g: end(g, others, weights), (given,), (t,))[1])(stacked)
        return end(given, others, weights), dict(zip(slopes, by, strict=True))

    return forward
