"""Cascaded tanks that overflow, fitted to their record: the benchmark of Schoukens, Mattsson, Wigren & Noël 2016
(doi 10.4121/12960104, CC BY-SA 4.0).

    JAXONOMY_DAE_DATA=folder python benchmarks/learning/tanks.py [plain,pump,upper,lower] [starts]

A pump fills the upper tank, which flows into the lower one, whose level is measured; both overflow, the upper one in
part into the lower one. `plain` has Bernoulli's law and a linear loss at both outlets; the others learn a correction of
the pump's flow by its voltage, or of an outlet's by the level above it. Three quarters of the record are fitted, and
the model runs through all of it, from a start that is unknown, without looking at the sensor.
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
from sympy import Max, sqrt

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

# Levels in volts of the sensor, which ends at 10 V; the upper tank's in units in which its rim is at 10 too. Seconds.
VALUES = {"pump": 0.05, "a1": 0.04, "b1": 1e-3, "ratio": 0.7, "a2": 0.04, "b2": 1e-3, "share": 0.7}
NAMES = [f"tanks.{k}" for k in VALUES]
BOUNDS = {"tanks.share": (1e-3, 1.0), "tanks.b1": (1e-6, 0.1), "tanks.b2": (1e-6, 0.1)}
STEPS = 150
RIM, SPILL = 10.0, 0.5  # V, and 1/s: how fast what is above the rim leaves


class Correction(eqx.Module):
    """A factor near one, of a number between 0 and 10."""

    net: eqx.nn.MLP

    def __init__(self):
        self.net = silent_network(1)

    def __call__(self, u):
        return 1 + self.net(u / 5 - 1)


class Tanks(Component):
    """h1' = p u − q1 − o1,  h2' = r (q1 + s o1) − q2 − o2, with outflows q = a √h + b h, and with what spills over the
    rims, o = c max(h − 10, 0), of which a share of the upper one's falls into the lower tank."""

    def __init__(self, ev, name="tanks", law=None):
        super().__init__(ev, name)
        p = {k: self.parameter(k, v, bounds=POSITIVE) for k, v in VALUES.items()}
        u = self.input("u")
        h1, h2 = self.variable("h1", start=5.0, fixed=True), self.variable("h2", start=5.0, fixed=True)
        factor = {"pump": 1, "upper": 1, "lower": 1}
        if law is not None:
            seen = {"pump": u, "upper": h1, "lower": h2}[law]
            (factor[law],) = self.learned("law", Correction(), inputs=[seen])
        flow, out = (self.variable(k) for k in ("flow", "out"))
        o1, o2 = (self.variable(k) for k in ("o1", "o2"))
        self.add_equations(
            Eq(flow, (p["a1"] * sqrt(Max(h1, 1e-4)) + p["b1"] * h1) * factor["upper"]),
            Eq(out, (p["a2"] * sqrt(Max(h2, 1e-4)) + p["b2"] * h2) * factor["lower"]),
            Eq(o1, SPILL * Max(h1 - RIM, 0)),
            Eq(o2, SPILL * Max(h2 - RIM, 0)),
            Eq(der(h1), p["pump"] * factor["pump"] * u - flow - o1),
            Eq(der(h2), p["ratio"] * (flow + p["share"] * o1) - out - o2),
        )


def table():
    with open(Path(os.environ["JAXONOMY_DAE_DATA"]) / "tanks" / "estimation.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {k: np.array([float(row[k]) for row in rows]) for k in ("time", "u", "y")}


def record(columns, kept):
    """The whole record, without the samples of a slice."""
    measured = np.array(columns["y"])
    measured[kept] = np.nan
    first = float(columns["y"][0])
    initial = {"tanks.h1": learning.Unknown(first, spread=2.0), "tanks.h2": learning.Unknown(first, spread=0.2)}
    return learning.Experiment(
        columns["time"][1:], {"tanks.h2": measured[1:]}, initial=initial,
        inputs={"tanks.u": (columns["time"], columns["u"], "held")},
    )  # fmt: skip


def main(laws, starts):
    columns = table()
    n = len(columns["y"])
    quarters = {name: slice(k * n // 4, (k + 1) * n // 4) for k, name in ((1, "second"), (2, "third"), (3, "fourth"))}
    for law in laws:
        law = None if law == "plain" else law
        ev, diagram = EqnEnv(), AcausalDiagram()
        diagram.add(Tanks(ev, law=law))
        names = NAMES if law is None else [*NAMES, "tanks.law"]
        system = AcausalCompiler(ev, diagram)()
        problem = learning.Problem(system, record(columns, quarters["second"]), train=names)
        errors = []
        for fold, kept in quarters.items():
            start = time.perf_counter()
            fit = problem.fit(record(columns, kept), starts=starts, bounds=BOUNDS, steps=STEPS)
            run = fit.predict("tanks.h2").mean["tanks.h2"]
            error = (run - columns["y"][1:])[kept.start - 1 : kept.stop - 1]
            errors.append(error)
            took = time.perf_counter() - start
            rms = fit.rms["experiment 0"]["tanks.h2"], np.sqrt(np.mean(error**2))
            name = f"{law or 'plain'}, without the {fold} quarter, {took:.1f} s"
            print(f"{name}: {rms[0]:.3f} V fitted, {rms[1]:.3f} V there, {fit}", flush=True)
        print(f"{law or 'plain'}: {np.sqrt(np.mean(np.concatenate(errors) ** 2)):.3f} V", fit.table(), sep="\n")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    chosen = sys.argv[1].split(",") if len(sys.argv) > 1 else ["plain", "pump", "upper", "lower"]
    main(chosen, int(sys.argv[2]) if len(sys.argv) > 2 else 1)
