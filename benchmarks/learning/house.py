"""A house as resistances and capacities, fitted to its record: DarkGreyBox's demonstration data (MIT).

    JAXONOMY_DAE_DATA=folder python benchmarks/learning/house.py

Fits the first 552 hours and keeps the 120 that follow out of the fit, with a start of their own.
"""

import csv
import os
import time
from pathlib import Path

import jax
import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.modeling import POSITIVE, Component, Eq, der

jax.config.update("jax_enable_x64", True)
KEPT = 120


class House(Component):
    """Indoor air, walls and heater, from hour to hour: capacities in kWh/K, resistances in K/kW, power in kW."""

    def __init__(self, ev, name="house"):
        super().__init__(ev, name)
        value = {"Ci": 3.0, "Ce": 10.0, "Ch": 1.0, "Rie": 1.0, "Rea": 5.0, "Ria": 10.0, "Rih": 1.0}
        p = {k: self.parameter(k, v, bounds=POSITIVE) for k, v in value.items()}
        outside, power = self.input("Ta"), self.input("Ph")
        ti, te, th = (self.variable(k, start=20.0, fixed=True) for k in ("Ti", "Te", "Th"))
        self.add_equations(
            Eq(p["Ci"] * der(ti), (te - ti) / p["Rie"] + (outside - ti) / p["Ria"] + (th - ti) / p["Rih"]),
            Eq(p["Ce"] * der(te), (ti - te) / p["Rie"] + (outside - te) / p["Rea"]),
            Eq(p["Ch"] * der(th), (ti - th) / p["Rih"] + power),
        )


def main():
    path = Path(os.environ["JAXONOMY_DAE_DATA"]) / "house" / "train.csv"
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {k: np.array([float(row[k]) for row in rows]) for k in ("Ph", "Ti", "Ta")}
    hours = np.arange(len(rows), dtype=float)
    split = len(rows) - KEPT

    def record(first, last, **others):
        t = hours[first:last]
        initial = {"house.Ti": columns["Ti"][first]}
        initial |= {f"house.{k}": learning.Unknown(float(columns["Ti"][first])) for k in ("Te", "Th")}
        inputs = {f"house.{k}": (t, columns[k][first:last]) for k in ("Ta", "Ph")}
        measured = {"house.Ti": columns["Ti"][first + 1 : last]}
        return learning.Experiment(t[1:], measured, inputs=inputs, initial=initial, t0=t[0], **others)

    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(House(ev))
    system = AcausalCompiler(ev, diagram)()
    data = learning.Data(record(0, split, name="fitted"), record(split, len(rows), holdout=True, name="kept"))
    names = [f"house.{k}" for k in ("Ci", "Ce", "Ch", "Rie", "Rea", "Ria", "Rih")]
    problem = learning.Problem(system, data, train=names)
    for _ in range(2):
        start, cpu = time.perf_counter(), time.process_time()
        fit = problem.fit(steps=60)
        print(f"{time.perf_counter() - start:.1f} s, {time.process_time() - cpu:.1f} s CPU: {fit}", flush=True)
    print(fit.table(), fit.rms, fit.sigma, fit.whiteness, fit.identifiability(), sep="\n")


if __name__ == "__main__":
    main()
