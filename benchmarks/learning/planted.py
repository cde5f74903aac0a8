"""How often `ok` is said of slightly wrong models, and how often right ones are doubted.

    python benchmarks/learning/planted.py [seeds of each planted error] [seeds of each right model]

Truths are integrated by SciPy or exactly. Each error is as small as a few tenths of the noise; λ is its χ² after a fit
of the record without noise. Beside the share that is noticed stands what an oracle would notice by a χ² test of that
level, who knows the error but for its size (of a mode: but for amplitudes and phases). The oracle of the last column
does not know the frequency either, and looks at all.
"""

import functools
import sys
import time
from collections import Counter

import jax
import numpy as np
import scipy.linalg
import scipy.stats
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der, learning

LEVEL = 0.02  # of the oracle, as that of the test
SPRING, ROOM = np.linspace(0.05, 10, 200), np.linspace(0.08, 12, 150)
HELD = np.linspace(0, 12, 1201)  # the times of a heater's powers


class Spring(Component):
    """x'' = −k x − d x'."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        k, d = self.parameter("k", 4.0), self.parameter("d", 0.2)
        self.add_equations(Eq(der(x), v), Eq(der(v), -k * x - d * v))


class Room(Component):
    """C T' = u − T/R."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        temperature = self.variable("T", start=0.0, fixed=True)
        u, c, r = self.input("u", default=0.0), self.parameter("C", 1.0), self.parameter("R", 1.0)
        self.add_equations(Eq(c * der(temperature), u - temperature / r))


@functools.cache
def spring(cubic=0.0, memory=0.0):
    """x and v of an oscillator whose spring hardens, or creeps: a Maxwell element beside it."""

    def field(t, s):
        x, v, e = s
        return [v, -4 * x - cubic * x**3 - 0.2 * v - memory * (x - e), (x - e) / 1.5]

    return solve_ivp(field, (0, 10), [1, 0, 1], t_eval=SPRING, rtol=1e-10, atol=1e-12).y[:2]


def power(t, k):
    """The heat of the k-th record: steps at its own times."""
    return 1.0 * (np.sin(1.1 * t + 2 * k) > 0) + 0.5 * (np.sin(0.43 * t + k) > 0.2)


@functools.cache
def room(k, heater=0.0, limit=np.inf, delay=0.0):
    """T of a room whose heater has a time constant, or saturates, or is late: exact where powers are held."""
    given = np.minimum(power(HELD - delay, k), limit) * (HELD >= delay)
    rates = np.array([[-1.0, 1.0], [0.0, -1 / heater]]) if heater else np.array([[-1.0]])
    by = np.array([0.0, 1 / heater]) if heater else np.array([1.0])
    step = scipy.linalg.expm(rates * (HELD[1] - HELD[0]))
    push = np.linalg.solve(rates, (step - np.eye(len(rates))) @ by)
    states = [np.zeros(len(rates))]
    for u in given[:-1]:
        states.append(step @ states[-1] + push * u)
    return np.array(states)[8::8, 0]


def mode(rng, amplitude, ts):
    """An oscillation that all outputs show, at a frequency that the record resolves."""
    frequency = rng.uniform(3, 0.35 * len(ts)) / (ts[-1] - ts[0])
    return amplitude * np.sin(2 * np.pi * frequency * ts + rng.uniform(0, 2 * np.pi))


class Case:
    """Records of one model with an error, in units of the noise."""

    def __init__(self, name, model, error=None, rho=0.0, df=1, **truth):
        self.name, self.model, self.error, self.rho, self.df, self.truth = name, model, error, rho, df, truth

    def clean(self, seed):
        """The record without noise: outputs by experiments, and their noise."""
        rng = np.random.default_rng(1000 + seed)
        if self.model is Spring:
            records, noise, ts = spring(**self.truth)[None], np.array([0.01, 0.02]), SPRING
        else:
            records, noise, ts = np.stack([room(k, **self.truth)[None] for k in (0, 1)]), np.array([0.01]), ROOM
        extra = 0.0 if self.error is None else self.error(rng, ts)
        return ts, records + noise[:, None] * extra, noise

    def data(self, seed, is_noisy=True):
        ts, records, noise = self.clean(seed)
        drawn = np.random.default_rng([*self.name.encode(), seed]).standard_normal(records.shape)
        if self.rho:
            drawn = lfilter([np.sqrt(1 - self.rho**2)], [1, -self.rho], np.concatenate([drawn] * 2, -1))[..., len(ts) :]
        records = records + is_noisy * noise[:, None] * drawn
        if self.model is Spring:
            columns = {"c.x": records[0, 0], "c.v": records[0, 1]}
            return learning.Data(learning.Experiment(ts, columns, sigma={"c.x": 0.01, "c.v": 0.02}))
        inputs = [{"c.u": (HELD, power(HELD, k), "held")} for k in (0, 1)]
        return learning.Data(
            *(
                learning.Experiment(ts, {"c.T": r[0]}, sigma=0.01, inputs=u)
                for r, u in zip(records, inputs, strict=True)
            )
        )


RIGHT = [Case("right spring", Spring), Case("right room", Room)]
PLANTED = [
    Case("mode, amplitude 0.5 σ", Spring, lambda rng, ts: mode(rng, 0.5, ts), df=4),
    Case("mode, amplitude 0.35 σ", Spring, lambda rng, ts: mode(rng, 0.35, ts), df=4),
    Case("mode of a room, 0.5 σ", Room, lambda rng, ts: mode(rng, 0.5, ts), df=4),
    Case("slow input, 0.3 σ", Spring, lambda rng, ts: 0.42 * np.sin(0.9 * ts + rng.uniform(0, 6))),
    Case("hardening spring, 0.3 σ", Spring, cubic=0.072),
    Case("creeping spring", Spring, memory=0.045),
    Case("noise of AR(1), 0.3", Spring, rho=0.3),
    Case("noise of AR(1), 0.3, room", Room, rho=0.3),
    Case("heater's time constant", Room, heater=0.012),
    Case("heater saturates", Room, limit=1.48),
    Case("heater is late", Room, delay=0.01),
]  # fmt: skip


def oracle(case, problem, seed):
    """(λ, the shares that the two oracles notice) of one record."""
    if case.rho:
        size = sum(len(column) for one in case.data(0).experiments for column in one.data.values())
        share = scipy.stats.norm.sf(scipy.stats.norm.isf(LEVEL) - np.sqrt(size) * case.rho)
        return np.nan, share, share
    left = problem.fit(case.data(seed, is_noisy=False), warn=False).chi2
    levels = LEVEL, LEVEL / (len(case.clean(0)[0]) / 2 if case.df == 4 else 1)
    return left, *(scipy.stats.ncx2.sf(scipy.stats.chi2.isf(level, case.df), case.df, left) for level in levels)


def main(planted, right):
    problems = {}
    for model, train in ((Spring, ["c.k", "c.d"]), (Room, ["c.C", "c.R"])):
        ev, diagram = EqnEnv(), AcausalDiagram()
        diagram.add(model(ev))
        case = next(case for case in RIGHT if case.model is model)
        problems[model] = learning.Problem(AcausalCompiler(ev, diagram)(), case.data(0), train=train)
    print("| case | λ | ok | noticed | oracle | of all frequencies |\n|---|---|---|---|---|---|")
    for case in [*RIGHT, *PLANTED]:
        problem, said, limits, start = problems[case.model], Counter(), [], time.process_time()
        count, ok = right if case in RIGHT else planted, 0
        for seed in range(count):
            fit = problem.fit(case.data(seed), warn=False)
            ok += fit.ok
            said.update(reason.split(". ")[0][-60:] for reason in fit.reasons)
            if case in PLANTED and (seed < 5 or case.error is not None):
                limits.append(oracle(case, problem, seed))
        left, best, searched = np.mean(limits, axis=0) if limits else (0.0, LEVEL, LEVEL)
        print(
            f"| {case.name} | {left:.1f} | {ok} of {count} | {1 - ok / count:.1%} | {best:.0%} | {searched:.0%} | "
            f"{said.most_common(3)} {time.process_time() - start:.1f} CPU s",
            flush=True,
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    given = [*sys.argv[1:], *[None] * 2][:2]
    main(int(given[0] or 20), int(given[1] or 100))
