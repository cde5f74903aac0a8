"""A house as resistances and capacities, fitted to its record: DarkGreyBox's demonstration data (MIT).

    JAXONOMY_DAE_DATA=folder python benchmarks/learning/house.py [single,filter,gain]

Forward-chained validation: what the first hours are fitted to predicts the 120 that follow, from the power and the
weather alone. `single` fits runs, `filter` process noise, and its prediction starts where the filter is after the last
sample. `gain` adds to runs a learned gain by the hour of the day, and says what it is confounded with.
"""

import csv
import os
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from silent import silent_network

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

SENSOR = 0.0125 / np.sqrt(12)  # °C: the record has steps of 0.0125
AHEAD, SPLITS = 120, (312, 432, 552)
VALUES = {"Ci": 40.0, "Ce": 400.0, "Ch": 5.0, "Rie": 0.1, "Rea": 1.0, "Ria": 2.0, "Rih": 0.05}
NAMES = [f"house.{k}" for k in VALUES]
BOUNDS = {"house.Ch": (0.5, 500.0), "house.Rih": (5e-3, 10.0)}  # a faster heater cannot be told by hourly rows


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
        self.net = silent_network(2)

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


def inputs(columns, daily):
    t = np.arange(len(columns["Ti"]), dtype=float)
    found = {f"house.{k}": (t, columns[k]) for k in ("Ta", "Ph")}
    if daily:
        found |= {f"house.{n}": (t, f(2 * np.pi * t / 24)) for n, f in (("cos", np.cos), ("sin", np.sin))}
    return found


def whole(columns, split, sigma, daily):
    """The record with samples up to a split; the rest is for the model to predict."""
    n = len(columns["Ti"])
    t, measured = np.arange(1.0, n), np.where(np.arange(1, n) < split, columns["Ti"][1:], np.nan)
    first = float(columns["Ti"][0])
    initial = {"house.Ti": learning.Unknown(first, spread=0.2)}
    initial |= {f"house.{k}": learning.Unknown(first, spread=3.0) for k in ("Te", "Th")}
    return learning.Experiment(t, {"house.Ti": measured}, sigma=sigma, inputs=inputs(columns, daily), initial=initial)


def validate(columns, method, gain=None):
    """Errors of predictions, split by split; what is known in the end."""
    names = NAMES if gain is None else [*NAMES, "house.gain"]
    sigma = "estimate" if method == "single" else SENSOR
    first = whole(columns, SPLITS[0], sigma, gain is not None)
    problem = learning.Problem(compiled(gain), first, train=names, method=method)
    errors = []
    for split in SPLITS:
        start = time.perf_counter()
        fit = problem.fit(whole(columns, split, sigma, gain is not None), steps=60, bounds=BOUNDS)
        took = time.perf_counter() - start
        read = fit.predict if isinstance(method, str) else fit.filtered
        predicted = read("house.Ti").mean["house.Ti"]
        ahead = slice(split - 1, split - 1 + AHEAD)
        errors.append(float(np.sqrt(np.mean((predicted - columns["Ti"][1:])[ahead] ** 2))))
        rms = fit.rms["experiment 0"]["house.Ti"]
        print(f"{split} hours, {took:.1f} s: {errors[-1]:.3f} °C ahead, {rms:.3f} fitted, {fit}", flush=True)
    print(f"together {np.sqrt(np.mean(np.square(errors))):.3f} °C")
    print(fit.table(), fit.whiteness, fit.identifiability(), sep="\n", flush=True)


def main(parts):
    columns = table()
    if "single" in parts:
        validate(columns, "single")
    if "filter" in parts:
        noise = {"house.Ti": learning.Unknown(0.05), "house.Te": learning.Unknown(0.1)}
        validate(columns, learning.Filter(noise))
    if "gain" in parts:
        validate(columns, "single", Gain())


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1].split(",") if len(sys.argv) > 1 else ["single", "filter", "gain"])
