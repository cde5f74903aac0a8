"""Rectifiers and converters of library parts with random sources and leaks, against modified nodal analysis whose modes
are enumerated and whose motion, linear in each mode, is a matrix exponential.

A mode says which diodes conduct: a conducting one has no negative current, a blocking one no positive voltage.
"""

import dataclasses
import functools
import itertools
from typing import Any

import numpy as np
from scipy.linalg import expm

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library import electrical, signal

from .case import Case, Motion, Variant, diagram_of, drawn, log_uniform, names, numbers_of, varied

TRAJECTORY = 50e-6  # of a variable's size, at the default tolerances: fifty times rtol
GRID = 400  # points of the shortest period at which diodes are looked at
ZERO = 1e-9  # of a margin's size
SINGULAR = 1e-15  # smallest singular value of an equilibrated matrix beside the largest
STATES = ("C", "L")


class Delicate(Exception):
    """What the reference cannot decide: no mode holds, or more than one."""


@dataclasses.dataclass(frozen=True)
class Element:
    """One between nodes `a` and `b`; node 0 is ground. `numbers` by kind: R, C, L: their value; V: offset, amplitude,
    frequency, phase; D: Ron, Goff; S: Ron, Goff, period, width."""

    kind: str
    a: int
    b: int
    numbers: tuple[float, ...]


class Circuit:
    """Elements as a linear system for each mode: w' = A·w, where w has the states, sine and cosine of each source, and
    a constant 1."""

    def __init__(self, elements: list[Element]):
        self.elements = elements
        self.nodes = max(max(e.a, e.b) for e in elements)
        self.states = [k for k, e in enumerate(elements) if e.kind in STATES]
        self.sources = [k for k, e in enumerate(elements) if e.kind == "V"]
        self.diodes = [k for k, e in enumerate(elements) if e.kind == "D"]
        self.switches = [k for k, e in enumerate(elements) if e.kind == "S"]
        self.size = len(self.states) + 2 * len(self.sources) + 1

    def start(self, values: dict[int, float]) -> np.ndarray:
        """w at time 0, with values of states by element."""
        waves = [f(self.elements[k].numbers[3]) for k in self.sources for f in (np.sin, np.cos)]
        return np.array([*(values[k] for k in self.states), *waves, 1.0])

    @functools.cache  # noqa: B019 (a circuit lives as long as its model)
    def mode(self, closed: tuple[bool, ...]) -> tuple[np.ndarray, np.ndarray] | None:
        """(A, margins of the diodes as functions of w) while these diodes and then these switches are closed; None for
        equations without a solution."""
        n, m = self.nodes, len(self.elements)
        matrix, right = np.zeros((n + m, n + m)), np.zeros((n + m, self.size))
        is_closed = dict(zip([*self.diodes, *self.switches], closed, strict=True))
        voltage = np.zeros((m, n + m))
        for k, e in enumerate(self.elements):
            for node, sign in ((e.a, 1.0), (e.b, -1.0)):
                if node:
                    matrix[node - 1, n + k] += sign
                    voltage[k, node - 1] += sign
            row, current = n + k, n + k
            if e.kind == "R":
                matrix[row] = voltage[k]
                matrix[row, current] -= e.numbers[0]
            elif e.kind == "C":
                matrix[row], right[row, self.states.index(k)] = voltage[k], 1.0
            elif e.kind == "L":
                matrix[row, current], right[row, self.states.index(k)] = 1.0, 1.0
            elif e.kind == "V":
                place = len(self.states) + 2 * self.sources.index(k)
                matrix[row], right[row, -1], right[row, place] = voltage[k], e.numbers[0], e.numbers[1]
            elif is_closed[k]:
                matrix[row] = voltage[k]
                matrix[row, current] -= e.numbers[0]
            else:
                matrix[row] = -e.numbers[1] * voltage[k]
                matrix[row, current] += 1.0
        for _ in range(4):
            scales = np.abs(matrix).max(axis=1)
            if not scales.all():
                return None
            matrix, right = matrix / scales[:, None], right / scales[:, None]
        values = np.linalg.svd(matrix, compute_uv=False)
        if values[-1] <= SINGULAR * values[0]:
            return None
        solved = np.linalg.solve(matrix, right)
        a = np.zeros((self.size, self.size))
        for place, k in enumerate(self.states):
            e = self.elements[k]
            found = solved[n + k] if e.kind == "C" else voltage[k] @ solved
            a[place] = found / e.numbers[0]
        for j, k in enumerate(self.sources):
            rate, place = 2 * np.pi * self.elements[k].numbers[2], len(self.states) + 2 * j
            a[place, place + 1], a[place + 1, place] = rate, -rate
        margins = [solved[n + k] if is_closed[k] else -voltage[k] @ solved for k in self.diodes]
        return a, np.array(margins).reshape(len(self.diodes), self.size)

    def holding(self, w: np.ndarray, switches: tuple[bool, ...], ahead: float) -> tuple[bool, ...]:
        """The mode that holds at w and a little later."""
        best, chosen = -np.inf, None
        for diodes in itertools.product((False, True), repeat=len(self.diodes)):
            found = self.mode((*diodes, *switches))
            if found is None:
                continue
            a, margins = found
            size = np.abs(margins) @ np.abs(w) + 1e-300
            now, later = margins @ w / size, margins @ (expm(a * ahead) @ w) / size
            if np.min(now, initial=0.0) >= -ZERO and np.min(later, initial=np.inf) > best:
                best, chosen = np.min(later, initial=np.inf), (*diodes, *switches)
        if chosen is None or best < -ZERO:
            raise Delicate("no mode holds")
        return chosen

    def run(self, values: dict[int, float], ts: np.ndarray, step: float) -> np.ndarray:
        """w at times; diodes are looked at once every `step`."""
        edges = sorted({float(t) for t in ts} | {t for k in self.switches for t in self._edges(k, float(ts[-1]))})
        w, t, out = self.start(values), 0.0, []
        mode = self.holding(w, self._closed(0.0), 1e-3 * step)
        wanted = {float(v) for v in ts}
        for edge in edges:
            while edge - t > 1e-13 * edge:
                a, margins = self.mode(mode)  # pyright: ignore[reportGeneralTypeIssues]
                h = min(step, edge - t)
                after = self._ahead(mode, h) @ w
                size = np.abs(margins) @ np.abs(w) + 1e-300
                if np.min(margins @ after / size, initial=0.0) >= -ZERO:
                    w, t = after, t + h
                    continue
                low, high = 0.0, h
                for _ in range(50):
                    middle = 0.5 * (low + high)
                    holds = np.min(margins @ (expm(a * middle) @ w) / size) >= -ZERO
                    low, high = (middle, high) if holds else (low, middle)
                w, t = expm(a * high) @ w, t + high
                mode = self.holding(w, mode[len(self.diodes) :], 1e-3 * step)
            t = edge
            if edge in wanted:
                out.append(w)
            if (closed := self._closed(edge + 1e-9 * step)) != mode[len(self.diodes) :]:
                mode = self.holding(w, closed, 1e-3 * step)
        return np.array(out)

    @functools.cache  # noqa: B019
    def _ahead(self, mode: tuple[bool, ...], h: float) -> np.ndarray:
        return expm(self.mode(mode)[0] * h)  # pyright: ignore[reportOptionalSubscript]

    def _edges(self, k: int, end: float) -> list[float]:
        _, _, period, width = self.elements[k].numbers
        count = int(end / period) + 1
        return [t for j in range(count) for t in (j * period, (j + width) * period) if 0 < t < end]

    def _closed(self, t: float) -> tuple[bool, ...]:
        parts = [self.elements[k].numbers for k in self.switches]
        return tuple(bool((t / period) % 1.0 < width) for _, _, period, width in parts)


def _leaks(rng: np.random.Generator, leak: bool) -> tuple[float, float]:
    """Ron and Goff."""
    on = 0.0 if rng.random() < 0.4 else log_uniform(rng, -3, -1)
    return on, log_uniform(rng, -9, -3) if leak else 0.0


def _rectifier(rng: np.random.Generator, leak: bool) -> tuple[list[Element], float]:
    """Elements, and the shortest period."""
    f, amplitude = log_uniform(rng, 1, 3), log_uniform(rng, 0, 2)
    resistance, load = log_uniform(rng, -1, 1), log_uniform(rng, 1, 3)
    capacity = log_uniform(rng, -1, 1) * 2 / (f * load)
    on, off = _leaks(rng, leak)
    kind = int(rng.integers(3))
    phase = float(rng.uniform(-3, 3))
    out: list[Element] = []

    def source(a: int, b: int, inner: int, phase: float):
        """A sine behind a resistor, and maybe an inductor: a loop from b to a."""
        out.append(Element("V", inner, b, (0.0, amplitude, f, phase)))
        if inductive:
            middle = len(nodes) + 1
            nodes.append(middle)
            out.append(Element("R", inner, middle, (resistance,)))
            out.append(Element("L", middle, a, (log_uniform(rng, -1, 0) * resistance / (6 * f),)))
        else:
            out.append(Element("R", inner, a, (resistance,)))

    inductive = bool(rng.random() < 0.4)
    if kind == 0:  # half a wave
        nodes = [1, 2, 3]
        source(1, 0, 2, phase)
        out += [Element("D", 1, 3, (on, off)), Element("C", 3, 0, (capacity,)), Element("R", 3, 0, (load,))]
    elif kind == 1:  # a bridge, its load on ground
        nodes = [1, 2, 3, 4]
        source(1, 2, 3, phase)
        out += [Element("D", a, b, (on, off)) for a, b in ((1, 4), (2, 4), (0, 1), (0, 2))]
        out += [Element("C", 4, 0, (capacity,)), Element("R", 4, 0, (load,))]
    else:  # two phases to one load
        nodes = [1, 2, 3, 4, 5]
        source(1, 0, 2, phase)
        source(3, 0, 4, phase + float(rng.uniform(1, 3)))
        out += [Element("D", a, 5, (on, off)) for a in (1, 3)]
        if rng.random() < 0.5:
            out += [Element("C", 5, 0, (capacity,)), Element("R", 5, 0, (load,))]
        else:
            nodes.append(len(nodes) + 1)
            out += [Element("L", 5, nodes[-1], (load / (3 * f),)), Element("R", nodes[-1], 0, (load,))]
            out += [Element("D", 0, 5, (on, off))]
    return out, 1 / f


def _converter(rng: np.random.Generator, leak: bool) -> tuple[list[Element], float]:
    """Elements, and the period of the switch."""
    period, width = 1 / log_uniform(rng, 3, 4.3), float(rng.uniform(0.25, 0.75))
    volt, load = log_uniform(rng, 0, 2), log_uniform(rng, 0.5, 2)
    coil, capacity = log_uniform(rng, -1, 1) * load * period, log_uniform(rng, 0, 1) * 3 * period / load
    (on, off), (diode_on, diode_off) = _leaks(rng, leak), _leaks(rng, leak)
    switch, diode = (on, off, period, width), (diode_on, diode_off)
    source = Element("V", 1, 0, (volt, 0.0, 1.0, 0.0))
    kind = int(rng.integers(3))
    if kind == 0:  # buck
        middle = [Element("S", 1, 2, switch), Element("D", 0, 2, diode), Element("L", 2, 3, (coil,))]
    elif kind == 1:  # boost
        middle = [Element("L", 1, 2, (coil,)), Element("S", 2, 0, switch), Element("D", 2, 3, diode)]
    else:  # buck–boost
        middle = [Element("S", 1, 2, switch), Element("L", 2, 0, (coil,)), Element("D", 3, 2, diode)]
    return [source, *middle, Element("C", 3, 0, (capacity,)), Element("R", 3, 0, (load,))], period


def _other(rng: np.random.Generator, e: Element, clock: float) -> Element:
    """The element with other numbers; what is zero stays so, and clocks go slower by one factor."""
    numbers = tuple(varied(rng, v) for v in e.numbers)
    if e.kind == "V":
        numbers = (*numbers[:2], e.numbers[2] / clock, e.numbers[3] and float(rng.uniform(-3, 3)))
    if e.kind == "S":
        numbers = (*numbers[:2], e.numbers[2] * clock, float(rng.uniform(0.25, 0.75)))
    return dataclasses.replace(e, numbers=numbers)


def make(seed: int, variants: int = 0) -> Case:
    """A rectifier or a converter over some periods; one in four without leaks, where that has a solution."""
    rng = np.random.default_rng([seed, 31])
    for attempt in itertools.count():
        leak = bool(rng.random() < 0.75) or attempt > 3
        is_rectifier = rng.random() < 0.5
        elements, period = (_rectifier if is_rectifier else _converter)(rng, leak)
        found = _course(rng, Circuit(elements), period, is_rectifier)
        if found is not None:
            break
    ev, diagram, _, label = _built([seed, 32], elements)

    def variant(numbers: np.random.Generator) -> Variant | None:
        clock = varied(numbers, 1.0)
        circuit = Circuit([_other(numbers, e, clock) for e in elements])
        course = _course(numbers, circuit, period * clock, is_rectifier)
        if course is None:
            return None
        motion, starts = _motion(circuit, label, *course)
        return Variant(numbers_of(_built([seed, 32], circuit.elements)[2]), starts, motion)

    circuit = Circuit(elements)
    motion, starts = _motion(circuit, label, *found)
    leaks = sorted({e.numbers[1] for e in elements if e.kind in "DS"})
    return Case(
        ev, diagram, starts, {}, motion=motion, always_moves=True, may_refuse=("Goff",) if 0.0 in leaks else (),
        variants=drawn(variants, [seed, 31], variant),
        note=f"{len(circuit.diodes)} diodes, {len(circuit.switches)} switches, leaks {leaks}",
    )  # fmt: skip


def _course(rng: np.random.Generator, circuit: Circuit, period: float, is_rectifier: bool) -> Any:
    """Starts, times and values; None if the reference cannot decide."""
    kinds = {k: circuit.elements[k].kind for k in circuit.states}
    starts = {k: 0.1 * float(rng.normal()) for k in circuit.states if kinds[k] == "C"}
    starts |= {k: 0.0 for k in circuit.states if kinds[k] == "L"}
    ts = np.sort(rng.uniform(0.2, 1.0, 6)) * period * (4 if is_rectifier else 8)
    try:
        values = circuit.run(starts, ts, period / GRID)
    except Delicate:
        return None
    return (starts, ts, values) if np.isfinite(values).all() else None


def _which(circuit: Circuit, label: list[str]) -> dict[int, str]:
    """The names of the states by element."""
    return {k: f"{label[k]}.{'v' if circuit.elements[k].kind == 'C' else 'i'}" for k in circuit.states}


def _motion(
    circuit: Circuit, label: list[str], starts: dict[int, float], ts: np.ndarray, values: Any
) -> tuple[Motion, dict[str, float]]:
    """The trajectory with what it may be off by, and the starts by name."""
    elements, which = circuit.elements, _which(circuit, label)
    rows = {which[k]: values[:, place] for place, k in enumerate(circuit.states)}
    # A current that a diode keeps at zero has the size of those that flow elsewhere.
    sizes = {kind: max((np.abs(rows[which[k]]).max() for k in which if elements[k].kind == kind), default=0.0)
             for kind in STATES}  # fmt: skip
    volts = max(sizes["C"], *(sum(map(abs, elements[k].numbers[:2])) for k in circuit.sources))
    resistance = max(e.numbers[0] for e in elements if e.kind == "R")
    least = {"C": volts, "L": max(sizes["L"], volts / resistance)}
    motion = Motion(ts, rows, {which[k]: TRAJECTORY * least[elements[k].kind] for k in which}, rtol=1e-6, atol=1e-9)
    return motion, {which[k]: v for k, v in starts.items()}


def _built(seed: list[int], elements: list[Element]) -> tuple[EqnEnv, Any, list[Any], list[str]]:
    """The model, its parts, and their names by element."""
    rng = np.random.default_rng(seed)
    ev, circuit = EqnEnv(), Circuit(elements)
    label = names(rng, len(elements) + 1 + len(circuit.switches))
    ground = electrical.Ground(ev, label[-1])
    parts: list[Any] = [ground]
    nodes: list[list[Any]] = [[] for _ in range(circuit.nodes + 1)]
    nodes[0].append(ground.p)
    wires = []
    for e, name in zip(elements, label, strict=False):
        part: Any
        if e.kind == "V":
            offset, amplitude, frequency, phase = e.numbers
            part = electrical.SineVoltage(ev, name, amplitude, frequency, phase, offset)
            if not amplitude:
                part = electrical.VoltageSource(ev, name, offset)
        elif e.kind == "S":
            part = electrical.Switch(ev, name, *e.numbers[:2])
            gate = signal.Pulse(ev, label[len(elements) + len(wires)], 1.0, *e.numbers[2:])
            wires.append([gate.y, part.u])
            parts.append(gate)
        else:
            kinds = dict(R="Resistor", C="Capacitor", L="Inductor", D="IdealDiode")
            part = getattr(electrical, kinds[e.kind])(ev, name, *e.numbers)
        parts.append(part)
        nodes[e.a].append(part.p)
        nodes[e.b].append(part.n)
    return ev, diagram_of(rng, parts, [*nodes, *wires]), parts, label
