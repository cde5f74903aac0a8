"""A house as resistances and capacities, fitted to its record: DarkGreyBox's demonstration data (MIT).

    JAXONOMY_DAE_DATA=folder python benchmarks/learning/house.py [single,filter,gain]

Forward-chained validation: what the first hours are fitted to predicts the 120 that follow, from the power and the
weather alone. `single` fits runs, `filter` process noise, and its prediction starts where the filter is after the last
sample. `gain` adds a learned gain by the hour of the day, and says what experiments that are held out and the Fisher
information have to say of it.
"""

import csv
import os
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.modeling import POSITIVE, Component, Eq, der

AHEAD, SPLITS = 120, (312, 432, 552)
VALUES = {"Ci": 40.0, "Ce": 400.0, "Ch": 5.0, "Rie": 0.1, "Rea": 1.0, "Ria": 2.0, "Rih": 0.05}
NAMES = [f"house.{k}" for k in VALUES]


class House(Component):
    """Indoor air, walls and heater, from hour to hour, in the unit of the power, which the data do not name. With a
    `gain`, heat that follows the hour of the day."""

    def __init__(self, ev, name="house", gain=None):
        super().__init__(ev, name)
        p = {k: self.parameter(k, v, bounds=POSITIVE) for k, v in VALUES.items()}
        outside, power = self.input("Ta"), self.input("Ph")
        ti, te, th = (self.variable(k, start=20.0, fixed=True) for k in ("Ti", "Te", "Th"))
        extra = 0
        if gain is not None:
            (extra,) = self.learned("gain", gain, inputs=[self.input("cos"), self.input("sin")])
        self.add_equations(
            Eq(p["Ci"] * der(ti), (te - ti) / p["Rie"] + (outside - ti) / p["Ria"] + (th - ti) / p["Rih"] + extra),
            Eq(p["Ce"] * der(te), (ti - te) / p["Rie"] + (outside - te) / p["Rea"]),
            Eq(p["Ch"] * der(th), (ti - th) / p["Rih"] + power),
        )


class Gain(eqx.Module):
    """A heat flow by the hour of the day, of the size of the heater's; zero to begin with."""

    net: eqx.nn.MLP

    def __init__(self):
        net = eqx.nn.MLP(2, 1, 6, 1, jnp.tanh, key=jax.random.key(0))
        self.net = eqx.tree_at(lambda n: n.layers[-1], net, jax.tree.map(jnp.zeros_like, net.layers[-1]))

    def __call__(self, u):
        return 20.0 * self.net(u)


def compiled(gain=None):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(House(ev, gain=gain))
    return AcausalCompiler(ev, diagram)()


def table():
    with open(Path(os.environ["JAXONOMY_DAE_DATA"]) / "house" / "train.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {k: np.array([float(row[k]) for row in rows]) for k in ("Ph", "Ti", "Ta")}


def inputs(columns, first, last, daily=False):
    t = np.arange(first, last, dtype=float)
    found = {f"house.{k}": (t, columns[k][first:last]) for k in ("Ta", "Ph")}
    if daily:
        found |= {f"house.{n}": (t, f(2 * np.pi * t / 24)) for n, f in (("cos", np.cos), ("sin", np.sin))}
    return found


def whole(columns, split, sigma):
    """The record with samples up to a split; the rest is for the model to predict."""
    n = len(columns["Ti"])
    t, measured = np.arange(1.0, n), np.where(np.arange(1, n) < split, columns["Ti"][1:], np.nan)
    first = float(columns["Ti"][0])
    initial = {"house.Ti": learning.Unknown(first, spread=0.2)}
    initial |= {f"house.{k}": learning.Unknown(first, spread=3.0) for k in ("Te", "Th")}
    return learning.Experiment(t, {"house.Ti": measured}, sigma=sigma, inputs=inputs(columns, 0, n), initial=initial)


def validate(columns, system, method):
    """Errors of predictions, split by split."""
    # The sensor has steps of 0.0125 °C; what runs deviate by is another matter.
    sigma = "estimate" if method == "single" else 0.0125 / np.sqrt(12)
    problem = learning.Problem(
        system, whole(columns, SPLITS[0], sigma), train=NAMES, method=method, rtol=1e-5, atol=1e-7
    )
    errors = []
    for split in SPLITS:
        start = time.perf_counter()
        fit = problem.fit(whole(columns, split, sigma), steps=60)
        took = time.perf_counter() - start
        read = fit.predict if isinstance(method, str) else fit.filtered
        predicted = read("house.Ti").mean["house.Ti"]
        ahead = slice(split - 1, split - 1 + AHEAD)
        errors.append(float(np.sqrt(np.mean((predicted - columns["Ti"][1:])[ahead] ** 2))))
        rms = fit.rms["experiment 0"]["house.Ti"]
        print(f"{split} hours, {took:.1f} s: {errors[-1]:.3f} °C ahead, {rms:.3f} fitted, {fit}", flush=True)
    print(f"together {np.sqrt(np.mean(np.square(errors))):.3f} °C")
    print(fit.table(), fit.whiteness, sep="\n")


def daily(columns):
    """With and without a learned gain: the hold-out, and what the gain is confounded with."""
    split, n = SPLITS[-1], len(columns["Ti"])

    def record(first, last, **others):
        guess = float(columns["Ti"][first])
        initial = {f"house.{k}": learning.Unknown(guess, spread=s) for k, s in (("Ti", 0.2), ("Te", 3.0), ("Th", 3.0))}
        t, measured = np.arange(first + 1.0, last), {"house.Ti": columns["Ti"][first + 1 : last]}
        given = inputs(columns, first, last, daily=others.pop("daily"))
        return learning.Experiment(t, measured, inputs=given, initial=initial, t0=float(first), **others)

    for gain in (None, Gain()):
        there = gain is not None
        data = learning.Data(
            record(0, split, name="fitted", daily=there), record(split, n, name="kept", holdout=True, daily=there)
        )
        names = [*NAMES, *(["house.gain"] if there else [])]
        problem = learning.Problem(compiled(gain), data, train=names, rtol=1e-5, atol=1e-7)
        fit = problem.fit(steps=60)
        rms = {label: by["house.Ti"] for label, by in fit.rms.items()}
        print(
            f"{'with' if there else 'without'} the gain: {rms['fitted']:.3f} °C fitted, {rms['kept']:.3f} kept, {fit}"
        )
        print(fit.identifiability(), flush=True)


def main(parts):
    columns = table()
    if "single" in parts:
        validate(columns, compiled(), "single")
    if "filter" in parts:
        noise = {"house.Ti": learning.Unknown(0.05), "house.Te": learning.Unknown(0.1)}
        validate(columns, compiled(), learning.Filter(noise))
    if "gain" in parts:
        daily(columns)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1].split(",") if len(sys.argv) > 1 else ["single", "filter", "gain"])
