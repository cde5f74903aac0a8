"""What fits say of themselves: right models doubted, wrong ones noticed, and whether the cause is named.

    python benchmarks/learning/verdicts.py [draws of each right model] [draws of each wrong one] [words of cases]

Eight plants, each with records that SciPy integrates: of the model itself, and of 46 that differ from it by a term, an
input, a sensor or the noise. All are fitted plainly. A cause is named rightly if a reason contains one of the words
beside the case, which were written down before any fit.
"""

import dataclasses
import sys
import time
from collections.abc import Callable

import jax
import numpy as np
import sympy
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der, learning

DAY = 86400.0
SHORT, SAMPLES, LONG = np.linspace(1 / 15, 20, 300), np.linspace(0.08, 20, 250), np.linspace(4, 1000, 250)
HOURS = 3600.0 * np.arange(1, 24 * 7 + 1)
FINE = np.linspace(0, 20, 2001)


def square(t):
    return np.where(np.sin(0.9 * np.floor(np.asarray(t) * 100 + 1e-6) / 100) >= 0, 1.0, -1.0)


def waves(t):
    return np.sin(0.7 * t) + 0.6 * np.sin(1.9 * t)


def volts(t):
    return 2 * np.sin(0.7 * t) + 1.2 * np.sin(1.9 * t + 1)


def inflow(t):
    return 0.3 + 0.25 * np.sin(0.6 * t) + 0.1 * np.sin(1.7 * t)


def current(t):
    return 1.5 * ((np.floor(t) // 60) % 2) - 0.4


def heat(t):
    return 1000.0 * ((t // (3600 * 5)) % 3)  # of one level alone, a heater that saturates would be one of another gain


def outside(t):
    return 5 + 4 * np.sin(2 * np.pi * t / DAY - 2.0) + 1.5 * np.sin(2 * np.pi * t / DAY / 6.3)


class Written(Component):
    """A plant of some equations."""

    def __init__(self, ev, plant):
        super().__init__(ev, "c")
        starts = {n: self.variable(n, start=s, fixed=True) for n, s in plant.starts.items()}
        numbers = {n: self.parameter(n, v, bounds=plant.bounds.get(n)) for n, v in plant.numbers.items()}
        inputs = {n: self.input(n, default=0.0) for n in plant.inputs}
        slopes = plant.slopes(**starts, **numbers, **inputs)
        self.add_equations(*(Eq(der(x), slope) for x, slope in zip(starts.values(), slopes, strict=True)))
        if plant.sensor is not None:
            y = self.variable(plant.measured)
            self.add_equations(Eq(y, plant.sensor(**starts, **numbers, **inputs)))


@dataclasses.dataclass(frozen=True)
class Plant:
    """Starts, numbers and inputs by name; the slopes of the states as a function of all; which variable is measured
    when, and the numbers that are estimated."""

    starts: dict
    numbers: dict
    inputs: dict
    slopes: Callable
    measured: str
    times: np.ndarray
    sigma: float
    train: tuple[str, ...]
    sensor: Callable | None = None
    bounds: dict = dataclasses.field(default_factory=dict)

    def problem(self, data):
        ev, diagram = EqnEnv(), AcausalDiagram()
        diagram.add(Written(ev, self))
        return learning.Problem(AcausalCompiler(ev, diagram)(), data, train=[f"c.{n}" for n in self.train])


CART = {"d": 0.5, "m": 1.0}
PLANTS = {
    "spring": Plant(
        {"x": 1.0, "v": 0.0}, {"k": 4.0, "d": 0.2}, {"u": (FINE, square(FINE), "held")},
        lambda x, v, k, d, u: (v, -k * x - d * v + u), "x", SHORT, 0.01, ("k", "d"),
    ),
    "slider": Plant(
        {"v": 0.0}, CART, {"u": (FINE, waves(FINE))}, lambda v, d, m, u: ((u - d * v) / m,), "v", SHORT, 0.01,
        ("d", "m"),
    ),
    "cart": Plant(
        {"x": 0.0, "v": 0.0}, CART, {"u": (FINE, waves(FINE))}, lambda x, v, d, m, u: (v, (u - d * v) / m), "x", SHORT,
        0.01, ("d", "m"),
    ),
    "room": Plant(
        {"T": 15.0}, {"C": 2e7, "G": 150.0},
        {"P": (600.0 * np.arange(1009), heat(600.0 * np.arange(1009)), "held"),
         "A": (600.0 * np.arange(1009), outside(600.0 * np.arange(1009)))},
        lambda T, C, G, P, A: ((P - G * (T - A)) / C,), "T", HOURS, 0.05, ("C", "G"),
        bounds={"C": (1e3, 1e10), "G": (1.0, 1e5)},
    ),
    "pendulum": Plant(
        {"a": 0.9, "w": 0.0}, {"k": 4.0, "d": 0.1}, {}, lambda a, w, k, d: (w, -k * sympy.sin(a) - d * w), "a", SAMPLES,
        0.005, ("k", "d"),
    ),
    "motor": Plant(
        {"i": 0.0, "w": 0.0}, {"R": 1.0, "K": 0.5, "J": 0.1, "b": 0.05}, {"u": (FINE, volts(FINE))},
        lambda i, w, R, K, J, b, u: ((u - R * i - K * w) / 0.05, (K * i - b * w) / J), "w", SAMPLES, 0.02,
        ("R", "J", "b"),
    ),
    "tanks": Plant(
        {"h": 1.0, "g": 0.5}, {"a": 0.3, "b": 0.25}, {"q": (FINE, inflow(FINE))},
        lambda h, g, a, b, q: (q - a * h, a * h - b * g), "g", SAMPLES, 0.005, ("a", "b"),
    ),
    "cell": Plant(
        {"z": 0.9, "p": 0.0}, {"R": 0.05, "C": 400.0, "r": 0.03},
        {"i": (np.arange(1001.0), current(np.arange(1001.0)), "held")},
        lambda z, p, R, C, r, i: (-i / 3600, (i - p / R) / C), "v", LONG, 0.001, ("R", "C", "r"),
        lambda z, p, R, C, r, i: 3.4 + 0.8 * z - p - r * i,
    ),
}  # fmt: skip


def run(slopes, start, times):
    return solve_ivp(
        slopes, (0, times[-1]), start, t_eval=times, rtol=1e-8, atol=1e-10, max_step=times[-1] / 2000
    ).y  # fmt: skip


def sign(v):
    return np.tanh(v / 1e-3)


def spring(cube=0.0, gain=1.0, dry=0.0, late=0.0):
    return run(
        lambda t, s: [s[1], -4 * s[0] - cube * s[0] ** 3 - 0.2 * s[1] + gain * square(t - late) - dry * sign(s[1])],
        [1, 0], SHORT,
    )[0]  # fmt: skip


def slider(dry=0.0, quad=0.0, off=0.0, late=0.0):
    return run(
        lambda t, s: [waves(t - late) + off - 0.5 * s[0] - dry * sign(s[0]) - quad * s[0] * abs(s[0])], [0], SHORT
    )[0]  # fmt: skip


def cart(dry=0.0, quad=0.0):
    return run(
        lambda t, s: [s[1], waves(t) - 0.5 * s[1] - dry * sign(s[1]) - quad * s[1] * abs(s[1])], [0, 0], SHORT
    )[0]  # fmt: skip


def room(sun=0.0, most=np.inf):
    def slope(t, s):
        hour = (t % DAY) / 3600
        shining = sun * np.sin(np.pi * (hour - 7) / 11) if 7 < hour < 18 else 0.0
        return [(min(heat(t), most) + shining - 150 * (s[0] - outside(t))) / 2e7]

    return run(slope, [15], HOURS)[0]


def pendulum(quad=0.0, dry=0.0, cube=0.0):
    return run(
        lambda t, s: [
            s[1],
            -4 * np.sin(s[0]) - cube * s[0] ** 3 - 0.1 * s[1] - quad * s[1] * abs(s[1]) - dry * sign(s[1]),
        ],
        [0.9, 0], SAMPLES,
    )[0]  # fmt: skip


def motor(dry=0.0, quad=0.0, load=0.0, late=0.0, offset=0.0):
    return run(
        lambda t, s: [
            (volts(t - late) + offset - s[0] - 0.5 * s[1]) / 0.05,
            (0.5 * s[0] - 0.05 * s[1] - dry * sign(s[1]) - quad * s[1] * abs(s[1]) - load * (t > 11)) / 0.1,
        ],
        [0, 0], SAMPLES,
    )[1]  # fmt: skip


def tanks(root=0.0, leak=0.0, off=0.0, most=np.inf):
    def slopes(t, s):
        flow = 0.3 * (np.sqrt(max(s[0], 0)) if root else s[0])
        return [min(inflow(t), most) + off - flow - leak * (t > 9) * s[0], flow - 0.25 * s[1]]

    return run(slopes, [1, 0.5], SAMPLES)[1]


def cell(late=0.0, bend=0.0):
    z, p = run(lambda t, s: [-current(t - late) / 3600, (current(t - late) - s[1] / 0.05) / 400], [0.9, 0], LONG)
    return 3.4 + 0.8 * z + bend * (z - 0.8) ** 2 - p - 0.03 * current(LONG - late)


TRUE = {f.__name__: f for f in (spring, slider, cart, room, pendulum, motor, tanks, cell)}


@dataclasses.dataclass(frozen=True)
class Case:
    """A record of a plant that differs from its model: `exact` values, or a function of the draw; how large its noise
    is (in units of what is stated) and how correlated; and words of the cause."""

    name: str
    plant: str
    exact: Callable
    words: tuple[str, ...] = ()
    estimate: bool = False
    noise: float = 1.0
    rho: float = 0.0
    outliers: float = 0.0  # as large in units of the noise, at some samples

    def data(self, seed):
        plant = PLANTS[self.plant]
        rng = np.random.default_rng([seed, *self.name.encode()])
        count = len(plant.times)
        drawn = rng.standard_normal(count + 100)
        drawn = lfilter([np.sqrt(1 - self.rho**2)], [1, -self.rho], drawn)[100:] * self.noise
        drawn[rng.choice(count, count // 50, replace=False)] += self.outliers
        y = self.exact() + plant.sigma * drawn
        inputs = {f"c.{n}": samples for n, samples in plant.inputs.items()}
        sigma = "estimate" if self.estimate else plant.sigma
        return learning.Experiment(plant.times, {f"c.{plant.measured}": y}, sigma=sigma, inputs=inputs)


def beside(name, extra):
    """A record with something added to what the sensor says."""
    return lambda: TRUE[name]() + extra(PLANTS[name].times)


RIGHT = [Case(f"right {n}", n, TRUE[n], estimate=k % 2 == 1) for k, n in enumerate(PLANTS)]
LINEAR, INPUT = ("not linear", "times its size", "square", "cube"), ("late", "delay")
WRONG = [
    Case("dry friction", "slider", lambda: slider(dry=0.15), ("friction",)),
    Case("little dry friction", "slider", lambda: slider(dry=0.03), ("friction",), estimate=True),
    Case("dry friction", "cart", lambda: cart(dry=0.1), ("friction",)),
    Case("dry friction", "spring", lambda: spring(dry=0.05), ("friction",)),
    Case("dry friction", "pendulum", lambda: pendulum(dry=0.03), ("friction",)),
    Case("dry friction", "motor", lambda: motor(dry=0.05), ("friction",)),
    Case("square drag", "slider", lambda: slider(quad=0.3), LINEAR),
    Case("square drag", "cart", lambda: cart(quad=0.3), LINEAR),
    Case("square drag", "pendulum", lambda: pendulum(quad=0.1), LINEAR),
    Case("square drag", "motor", lambda: motor(quad=0.02), LINEAR),
    Case("hardening", "spring", lambda: spring(cube=0.3), LINEAR),
    Case("hardening", "pendulum", lambda: pendulum(cube=0.6), LINEAR),
    Case("outflow by a root", "tanks", lambda: tanks(root=1.0), LINEAR),
    Case("voltage that bends", "cell", lambda: cell(bend=0.6), LINEAR),
    Case("sun", "room", lambda: room(sun=800.0), ("(a day)", "sun"), estimate=True),
    Case("less sun", "room", lambda: room(sun=300.0), ("(a day)", "sun")),
    Case("input saturates", "room", lambda: room(most=1500.0), ("'c.P'", "saturates", "gain")),
    Case("input saturates", "tanks", lambda: tanks(most=0.5), ("'c.q'", "saturates")),
    Case("input of another gain", "spring", lambda: spring(gain=1.1), ("gain",)),
    Case("input is late", "spring", lambda: spring(late=0.1), INPUT),
    Case("input is late", "motor", lambda: motor(late=0.06), INPUT),
    Case("input is late", "cell", lambda: cell(late=4.0), INPUT),
    Case("input has an offset", "slider", lambda: slider(off=0.05), ("offset", "constant", "bias", "slow")),
    Case("input has an offset", "motor", lambda: motor(offset=0.1), ("offset", "constant", "bias", "slow")),
    Case("inflow has an offset", "tanks", lambda: tanks(off=0.03), ("offset", "constant", "bias")),
    Case("load is switched on", "motor", lambda: motor(load=0.15), ("switched",)),
    Case("leak opens", "tanks", lambda: tanks(leak=0.03), ("switched",)),
    Case("sensor is late", "spring", lambda: np.interp(SHORT - 0.03, np.r_[0, SHORT], np.r_[1, spring()]), INPUT),
    Case("sensor is late", "slider", lambda: np.interp(SHORT - 0.05, np.r_[0, SHORT], np.r_[0, slider()]), INPUT),
    Case("bias steps", "spring", beside("spring", lambda t: 0.03 * (t > 12)), ("steps",)),
    Case("bias steps", "room", beside("room", lambda t: 0.2 * (t > 4 * DAY)), ("steps",), estimate=True),
    Case("bias steps", "slider", beside("slider", lambda t: 0.03 * (t > 7)), ("steps",), estimate=True),
    Case("bias steps", "cell", beside("cell", lambda t: 0.002 * (t > 500)), ("steps",)),
    Case("sensor drifts", "spring", beside("spring", lambda t: 0.002 * t), ("slow", "drift")),
    Case("sensor drifts", "room", beside("room", lambda t: 0.2 * t / t[-1]), ("slow", "drift"), estimate=True),
    Case("sensor drifts", "cell", beside("cell", lambda t: 3e-6 * t), ("slow", "drift")),
    Case("mode", "slider", beside("slider", lambda t: 0.01 * np.sin(9 * t)), ("period",)),
    Case("mode", "spring", beside("spring", lambda t: 0.008 * np.sin(13 * t)), ("period",), estimate=True),
    Case("mode", "motor", beside("motor", lambda t: 0.03 * np.sin(11 * t)), ("period",)),
    Case("correlated noise", "spring", spring, ("correlate",), rho=0.5),
    Case("correlated noise", "slider", slider, ("correlate",), estimate=True, rho=0.4),
    Case("correlated noise", "pendulum", pendulum, ("correlate",), rho=0.5),
    Case("noise is overstated", "spring", spring, ("too large",), noise=0.5),
    Case("noise is understated", "spring", spring, ("too small",), noise=1.5),
    Case("outliers", "slider", slider, ("outliers",), estimate=True, outliers=10.0),
    Case("outliers", "spring", spring, ("outliers",), outliers=-15.0),
]


def main(right, wrong, words):
    jax.config.update("jax_enable_x64", True)
    problems, start = {}, time.process_time()

    def fits(case, draws):
        for seed in range(draws):
            data = case.data(seed)
            if (case.plant, case.estimate) not in problems:
                problems[case.plant, case.estimate] = PLANTS[case.plant].problem(data)
            yield problems[case.plant, case.estimate].fit(data, warn=False)

    chosen = [c for c in [*RIGHT, *WRONG] if not words or any(w in f"{c.name} {c.plant}" for w in words)]
    chosen.sort(key=lambda c: c.plant)  # what is compiled for a plant serves all its cases
    doubted = count = noticed = named = asked = 0
    for case in chosen:
        for seed, fit in enumerate(fits(case, right if case in RIGHT else wrong)):
            if case in RIGHT:
                count, doubted = count + 1, doubted + (not fit.ok)
                is_right = fit.ok
            else:
                is_right = any(word in reason for word in case.words for reason in fit.reasons)
                asked, noticed, named = asked + 1, noticed + (not fit.ok), named + is_right
            if not is_right:
                print(f"{case.name}, {case.plant}, draw {seed}: ok {fit.ok}", *fit.reasons, sep="\n    ", flush=True)
        if case in RIGHT:
            print(f"{case.name}: {right} draws, {time.process_time() - start:.0f} CPU s so far", flush=True)
    print(f"right models doubted: {doubted} of {count}; wrong ones noticed: {noticed}, named: {named} of {asked}")


if __name__ == "__main__":
    given = [*sys.argv[1:], *[None] * 2][:2]
    main(int(given[0] or 13), int(given[1] or 1), sys.argv[3:])
