"""A linear network written down twice: as components by a family, and here as E·y' + A·y = f with names to read."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.linalg

from jaxonomy_dae import Component, EqnEnv

from .case import ROUNDING, TOLERANCE, Case, Expected, Motion, diagram_of
from .linear_dae import LARGE, Flow, NoUniqueSolution, flow

ORDER = 4


@dataclasses.dataclass
class Reading:
    """A variable of the model: Σ y[k]·values[k] + Σ y'[k]·rates[k] + constant, a quantity of this `kind`."""

    name: str
    kind: str
    values: Mapping[int, float]
    rates: Mapping[int, float] = dataclasses.field(default_factory=dict)
    constant: float = 0.0


class LinearNetwork:
    """Unknowns, equations and readings, one after the other; `parts` and `nodes` are the model itself."""

    def __init__(self, ev: EqnEnv):
        self.ev = ev
        self.count = 0
        self.rows: list[tuple[Mapping[int, float], Mapping[int, float], Sequence[float]]] = []
        self.readings: list[Reading] = []
        self.start_name: dict[int, str] = {}  # how the model calls an unknown that can be given at the start
        self.parts: list[Component] = []
        self.nodes: list[list[Any]] = []

    def unknown(self) -> int:
        self.count += 1
        return self.count - 1

    def equation(self, values: Mapping[int, float], rates: Mapping[int, float] | None = None, right=(0.0,)) -> None:
        """Σ rates[k]·y'[k] + Σ values[k]·y[k] = right; `right` lists the derivatives of the right-hand side."""
        self.rows.append((values, rates or {}, tuple(right)))

    def read(self, name: str, kind: str, values, rates=None, constant: float = 0.0) -> None:
        self.readings.append(Reading(name, kind, values, rates or {}, constant))

    def case(self, rng: np.random.Generator, size: float, refusal: Sequence[str], note: str, end=0.0) -> Case:
        """The case at a random consistent point whose free unknowns lie in ±`size`; if the equations have no unique
        solution, the case that must be refused. With `end`, a motion up to `end` periods of its fastest mode; for
        constant right-hand sides only."""
        n = self.count
        e, a = np.zeros((len(self.rows), n)), np.zeros((len(self.rows), n))
        forcing = np.zeros((ORDER + 1, len(self.rows)))
        for r, (values, rates, right) in enumerate(self.rows):
            for k, v in values.items():
                a[r, k] += v
            for k, v in rates.items():
                e[r, k] += v
            forcing[: len(right), r] = right[: ORDER + 1]
        diagram = diagram_of(rng, self.parts, self.nodes)
        try:
            at = flow(e, a, forcing, [k for k in range(n) if k not in self.start_name], ORDER)
        except NoUniqueSolution as problem:
            return Case(self.ev, diagram, {}, {}, refusal=refusal, note=f"{note}; {problem}")
        x = np.array([size * rng.uniform(-1, 1) for _ in at.free])
        y, dy = at.y0 + at.P @ x, at.d0 + at.Q @ x
        found, rates = {}, {}
        for reading in self.readings:
            if not all(at.dy_known[k] for k in reading.rates):
                continue
            terms = [c * y[k] for k, c in reading.values.items()] + [c * dy[k] for k, c in reading.rates.items()]
            found[reading.name] = (reading.kind, sum(terms, LARGE(reading.constant)), max(map(abs, terms), default=0))
            if not reading.rates and reading.values and all(at.dy_known[k] for k in reading.values):
                terms = [c * dy[k] for k, c in reading.values.items()]
                rates[reading.name] = (f"der {reading.kind}", sum(terms, LARGE(0)), max(map(abs, terms)))
        largest: dict[str, float] = {}
        for kind, _, term in (*found.values(), *rates.values()):
            largest[kind] = max(largest.get(kind, 0.0), float(term))
        floor = ROUNDING * max(1.0, float(np.max(np.abs(y), initial=0)), float(np.max(np.abs(dy), initial=0)))

        def true(table):
            return {m: Expected(float(v), TOLERANCE * largest[k] + floor) for m, (k, v, _) in table.items()}

        initial = {self.start_name[k]: float(y[k]) for k in at.free}
        motion = None
        if end and not np.any(forcing[1:]):
            motion = self._motion(at, x, end, largest, found)
        return Case(
            self.ev, diagram, initial, true(found), true(rates), len(at.free), motion=motion, note=f"{note}, size {n}"
        )

    def _motion(self, at: Flow, x: np.ndarray, end: float, largest: Mapping[str, float], found) -> Motion:
        fastest = max(1e-3, float(np.max(np.abs(np.linalg.eigvals(_generator(at))), initial=0)))
        ts = np.linspace(0.0, 2 * np.pi * end / fastest, 4)[1:]
        readings = [r for r in self.readings if r.name in found]
        values, grown = _followed(at, x, ts, readings)
        allowed = {r.name: 1e-6 * max(largest[r.kind], grown[r.name], 1e-6) for r in readings}
        unknown = {name: k for k, name in self.start_name.items()}

        def follow(initial: Mapping[str, float], ts: np.ndarray) -> Mapping[str, np.ndarray]:
            rows = [unknown[name] for name in initial]
            given = np.array(list(initial.values())) - at.y0[rows].astype(float)
            return _followed(at, np.linalg.solve(at.P[rows].astype(float), given), ts, readings)[0]

        return Motion(ts, values, allowed, 1e-9, 1e-11, follow)


def _generator(at: Flow) -> np.ndarray:
    """The matrix M of d(x, 1)/dt = M·(x, 1) for the free unknowns x."""
    m = len(at.free)
    matrix = np.zeros((m + 1, m + 1))
    matrix[:m, :m], matrix[:m, m] = at.Q[at.free], at.d0[at.free]
    return matrix


def _followed(at: Flow, x: np.ndarray, ts: np.ndarray, readings: Sequence[Reading]):
    """The readings at the times, from x at zero; and the largest of the terms that each of them sums."""
    matrix = _generator(at)
    points = np.array([scipy.linalg.expm(matrix * t) @ [*x, 1.0] for t in ts])[:, :-1]
    ys = at.y0.astype(float) + points @ at.P.astype(float).T
    dys = at.d0.astype(float) + points @ at.Q.astype(float).T
    values, grown = {}, {}
    for r in readings:
        parts = [c * ys[:, k] for k, c in r.values.items()] + [c * dys[:, k] for k, c in r.rates.items()]
        values[r.name] = sum(parts, np.full(len(ts), r.constant))
        grown[r.name] = max((float(np.max(np.abs(part))) for part in parts), default=0.0)
    return values, grown
