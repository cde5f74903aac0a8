"""Whether a verdict changes with what should not matter: units, starts of the search, offsets, tolerances.

    python benchmarks/learning/invariance.py [spring,room,drag,tanks,circuit]

Twenty problems: five plants, of the model itself and of one that differs from it, with noise of a known level and with
one that is estimated beside an unknown start. Each is fitted in seven units of its quantities and of time, from half
and twice the numbers, with two offsets of the sensor, and with two tolerances. A fit differs if it is `ok` where the
first is not, gives another number of reasons, or a value that is off by a tenth of its standard deviation.
"""

import dataclasses
import sys
import time
from collections.abc import Callable

import jax
import numpy as np
from scipy.integrate import solve_ivp
from sympy import Abs, sqrt

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der, learning

COUNT, SECONDS = 150, 20.0
TIMES, FINE = np.linspace(SECONDS / COUNT, SECONDS, COUNT), np.linspace(0, SECONDS, 801)


def waves(t):
    return np.sin(0.7 * t) + 0.6 * np.sin(1.9 * t)


def run(slopes, start):
    return solve_ivp(
        slopes, (0, SECONDS), start, t_eval=TIMES, rtol=1e-9, atol=1e-11, max_step=0.05
    ).y  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Plant:
    """States with starts and numbers with first guesses, each with the powers of the quantity's and of time's unit; the
    equations; the record, by whether it differs from the model; powers of the input's unit; and what is measured."""

    starts: dict
    numbers: dict
    equations: Callable
    record: Callable
    input_powers: tuple
    measured: Callable
    push: Callable = waves


PLANTS = {
    "spring": Plant(
        {"x": (1.0, 1, 0), "v": (0.0, 1, -1)}, {"k": (3.0, 0, -2), "d": (0.3, 0, -1)},
        lambda x, v, k, d, u: (v, -k * x - d * v + u),
        lambda w: run(lambda t, s: [s[1], -4 * s[0] - 0.2 * s[1] - 0.3 * w * s[0] ** 3 + waves(t)], [1, 0])[0], (1, -2),
        lambda x, v, k, d, u: x,
    ),
    "room": Plant(
        {"T": (0.0, 1, 0)}, {"C": (4.0, 0, 1), "G": (0.8, 0, 0), "A": (0.3, 1, 0)},
        lambda T, C, G, A, u: ((u - G * (T - A)) / C,),
        lambda w: run(lambda t, s: [(waves(t) * (1 - 0.2 * w * (waves(t) > 0.8)) - s[0] + 0.5) / 5], [0])[0], (1, 0),
        lambda T, C, G, A, u: T,
    ),
    "drag": Plant(
        {"v": (0.0, 1, 0)}, {"k": (0.3, -1, -1)}, lambda v, k, u: (u - k * v * Abs(v),),
        lambda w: run(lambda t, s: [waves(t) - 0.4 * s[0] * abs(s[0]) - 0.05 * w * np.tanh(s[0] / 1e-3)], [0])[0],
        (1, -1), lambda v, k, u: v,
    ),
    "tanks": Plant(
        {"h": (1.0, 1, 0), "g": (1.0, 1, 0)}, {"a": (0.3, 0.5, -1), "b": (0.6, 0.5, -1)},
        lambda h, g, a, b, u: (u - a * sqrt(h), a * sqrt(h) - b * sqrt(g)),
        lambda w: run(
            lambda t, s: [
                0.5 + 0.2 * waves(t) - 0.4 * np.sqrt(s[0]) - 0.02 * w * (t > 10),
                0.4 * np.sqrt(s[0]) - 0.5 * np.sqrt(s[1]),
            ],
            [1, 1],
        )[1],
        (1, -1), lambda h, g, a, b, u: g, lambda t: 0.5 + 0.2 * waves(t),
    ),
    "circuit": Plant(
        {"q": (0.0, 1, 0)}, {"k": (0.5, 0, -1), "R": (0.2, 0, 1)}, lambda q, k, R, u: (u - k * q,),
        lambda w: run(lambda t, s: [waves(t) - 0.7 * s[0]], [0])[0] + 0.3 * waves(TIMES - 0.1 * w), (1, -1),
        lambda q, k, R, u: q + R * u,
    ),
}  # fmt: skip
UNITS = [(1, 1), (1e-9, 1), (1e9, 1), (1, 1e-6), (1, 1e6), (1e-6, 1e3), (1e6, 1e-3)]
VARIANTS = [
    *({"unit": u} for u in UNITS),
    {"start": 0.5}, {"start": 2.0}, {"offset": 1e3}, {"offset": -1e6}, {"rtol": 1e-4}, {"rtol": 1e-9},
]  # fmt: skip


class Measured(Component):
    """A plant whose sensor has an offset O."""

    def __init__(self, ev, plant):
        super().__init__(ev, "c")
        states = {n: self.variable(n, start=s, fixed=True) for n, (s, *_) in plant.starts.items()}
        numbers = {n: self.parameter(n, v) for n, (v, *_) in plant.numbers.items()}
        u, y, offset = self.input("u", default=0.0), self.variable("y"), self.parameter("O", 0.0)
        slopes = plant.equations(**states, **numbers, u=u)
        self.add_equations(*(Eq(der(x), slope) for x, slope in zip(states.values(), slopes, strict=True)))
        self.add_equations(Eq(y, plant.measured(**states, **numbers, u=u) + offset))


def fitted(system, plant, y, noise, estimates, unit=(1, 1), start=1.0, offset=0.0, rtol=None):
    """(the fit of a variant, its numbers in the first units)."""
    x, t = unit

    def scaled(value, powers):
        return value * x ** powers[0] * t ** powers[1]

    initial = {f"c.{n}": scaled(value, powers) for n, (value, *powers) in plant.starts.items()}
    if estimates:
        first = next(iter(initial))
        initial[first] = learning.Unknown(initial[first] * 1.1 + (0.0 if initial[first] else 0.05 * x))
    data = learning.Experiment(
        TIMES * t, {"c.y": (y + noise[0]) * x + offset}, sigma="estimate" if estimates else noise[1] * x,
        inputs={"c.u": (FINE * t, scaled(plant.push(FINE), plant.input_powers))}, initial=initial,
    )  # fmt: skip
    size = {f"c.{n}": scaled(1.0, powers) for n, (_, *powers) in plant.numbers.items()}
    numbers = {f"c.{n}": value * start * size[f"c.{n}"] for n, (value, *_) in plant.numbers.items()}
    there = system.with_parameters(numbers | {"c.O": offset})
    given = {} if rtol is None else {"rtol": rtol, "atol": 1e-2 * rtol * x}
    fit = learning.Problem(there, data, train=list(numbers), **given).fit(warn=False)
    return fit, np.array([fit.values[n] / size[n] for n in numbers])


def main(names):
    differing = count = 0
    for name in names:
        plant, begun = PLANTS[name], time.process_time()
        ev, diagram = EqnEnv(), AcausalDiagram()
        diagram.add(Measured(ev, plant))
        system = AcausalCompiler(ev, diagram)()
        for differs in (0, 1):
            y = plant.record(differs)
            sigma = 0.01 * np.ptp(y)
            noise = sigma * np.random.default_rng(7).standard_normal(COUNT), sigma
            for estimates in (False, True):
                first, expected = fitted(system, plant, y, noise, estimates)
                # Of logarithms, which positive numbers have, or of the numbers' size.
                spread = first.spread[: len(expected)] * np.abs(expected)
                print(f"{name}, differs {differs}, noise estimated {estimates}: ok {first.ok}", expected, flush=True)
                for variant in VARIANTS:
                    fit, values = fitted(system, plant, y, noise, estimates, **variant)
                    count += 1
                    off = float(np.max(np.abs(values - expected) / spread))
                    if fit.ok != first.ok or len(fit.reasons) != len(first.reasons) or off > 0.1:
                        differing += 1
                        print(
                            f"    {variant}: ok {fit.ok}, off by {off:.2g} σ, {fit.message}",
                            *fit.reasons,
                            sep="\n      ",
                        )
        print(f"{name}: {differing} of {count} differ so far, {time.process_time() - begun:.0f} CPU s", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1].split(",") if len(sys.argv) > 1 else PLANTS)
