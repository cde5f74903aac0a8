"""Models with one to twenty relations of time and state inside their equations, against SciPy's DOP853 stopped and
started anew wherever one turns, at the default tolerances; every other model its derivatives against extrapolated
differences.

Relations stand in rates, in series of blocks, in implicit laws and in arrays of components. Each law is drawn twice: as
it is `written` in a model, and `solved`, with a symbol r that is 1 or 0 in the place of each relation.
"""

import copy
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import sympy
from sympy import Abs, And, Expr, Float, Heaviside, Max, Min, Mod, Piecewise, Symbol, floor, sign, sin

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, der

from .case import Case, Expected, Motion, Slopes, Variant, drawn, names
from .hybrid import APART, Delicate, HybridSystem, Reference, T

MOST = 6  # relations
MANY = 20  # relations of every sixth model
SMALL = 3  # states and relations of what is differentiated
TRAJECTORY = 50e-6  # of a variable's size, at the default tolerances: fifty times rtol
DERIVATIVE = 1e-6  # of the largest derivative, each multiplied by the size of its parameter
STEP = 5e-4  # relative; the error of extrapolated differences is of its fourth power
GROWN = 10.0  # what a change of the starts may grow by: more is not within fifty tolerances
NUDGE = 1e-6
COUNT = 8  # times


class Law(NamedTuple):
    """An expression as it is written, and with r's in the place of relations."""

    written: Any
    solved: Any


class Written(Component):
    """Equations in placeholders for variables, parameters and time."""

    def __init__(self, ev: EqnEnv, name: str, draft: "Draft", order: np.ndarray):
        super().__init__(ev, name)
        now: dict[Any, Any] = {T: ev.t}
        now |= {p: self.parameter(p.name, value) for p, value in draft.values.items()}
        now |= {x: self.variable(x.name, start=start, fixed=True) for x, start in draft.states.items()}
        now |= {y: self.variable(y.name) for y in draft.readings}
        equations = [der(now[x]) - law.written.xreplace(now) for x, law in draft.rates.items()]
        equations += [equation.xreplace(now) for equation in draft.equations]
        self.add_equations(*(equations[k] for k in order))


class Cell(Component):
    """x' = −a·x + b·max(x − level, 0) + sin(w·t): one of an array."""

    def __init__(self, ev: EqnEnv, name: str, a: float, b: float, level: float, w: float):
        super().__init__(ev, name)
        decay, slope, kink, pace = (self.parameter(n, v) for n, v in dict(a=a, b=b, level=level, w=w).items())
        x = self.variable("x", start=0.1, fixed=True)
        self.add_equations(der(x) + decay * x - slope * Max(x - kink, 0) - sin(pace * ev.t))


SHARED = ("rng", "label", "end")


@dataclasses.dataclass
class Draft:
    """A model while it is drawn; `label` gives a name that is not taken."""

    rng: np.random.Generator
    end: float
    label: Callable[[], str]
    values: dict[Symbol, float] = dataclasses.field(default_factory=dict)
    states: dict[Symbol, float] = dataclasses.field(default_factory=dict)
    rates: dict[Symbol, Law] = dataclasses.field(default_factory=dict)
    readings: dict[Symbol, Expr] = dataclasses.field(default_factory=dict)  # solved
    equations: list[Expr] = dataclasses.field(default_factory=list)
    relations: dict[Symbol, Expr] = dataclasses.field(default_factory=dict)
    bounds: list[tuple[Expr, float, float]] = dataclasses.field(default_factory=list)  # within which a law is as solved
    cells: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    ranges: dict[Symbol, tuple[float, float]] = dataclasses.field(default_factory=dict)  # of parameters

    def copy(self) -> "Draft":
        """The same, to be drawn on with by itself."""
        own = {f.name: copy.copy(getattr(self, f.name)) for f in dataclasses.fields(self) if f.name not in SHARED}
        return dataclasses.replace(self, **own)

    def any(self, choices):
        choices = list(choices)
        return choices[int(self.rng.integers(len(choices)))]

    def number(self, low: float, high: float) -> Any:
        """A number of three digits: a parameter, or, sometimes, as it is."""
        value = round(float(self.rng.uniform(low, high)), 3)
        if self.rng.random() < 0.3:
            return Float(value)
        p = Symbol(self.label())
        self.values[p], self.ranges[p] = value, (low, high)
        return p

    def above(self, u: Any) -> Symbol:
        """1 while u > 0, else 0."""
        r = Symbol(self.label())
        self.relations[r] = u
        return r

    def state(self, low: float = -1.0, high: float = 1.0) -> Symbol:
        x = Symbol(self.label())
        self.states[x], self.rates[x] = round(float(self.rng.uniform(low, high)), 3), Law(Float(0), Float(0))
        return x

    def push(self, x: Symbol, law: Law):
        """Adds to a state's rate."""
        self.rates[x] = Law(self.rates[x].written + law.written, self.rates[x].solved + law.solved)

    def reading(self, equation: Callable[[Symbol], Expr], solved: Expr) -> Law:
        """A variable of its own that an equation determines."""
        y = Symbol(self.label())
        self.readings[y] = solved
        self.equations.append(equation(y))
        return Law(y, solved)


# --- what relations compare, and what becomes of it ------------------------------------------------------------------


def _signal(d: Draft) -> Law:
    """Something of size one that varies: a state, a mixture, or a variable of an implicit law."""
    x, y, kind = d.any(d.states), d.any(d.states), d.rng.random()
    if kind < 0.5:
        return Law(x, x)
    mixed = x + d.number(-0.5, 0.5) * y + d.number(0.2, 0.6) * sin(d.number(0.5, 3) * T)
    if kind < 0.75:
        return Law(mixed, mixed)
    k = d.number(0.2, 0.8)
    if kind < 0.87:  # y + k·y³ = u, by hyperbolic functions
        size = sympy.sqrt(3 * k)
        root = 2 / size * sympy.sinh(sympy.asinh(1.5 * size * mixed) / 3)
        return d.reading(lambda y: y + k * y**3 - mixed, root)
    # y + k·y·|y| = u, smooth where it turns. Placeholders are not known to be real: |u| is √u².
    root = 2 * mixed / (1 + sympy.sqrt(1 + 4 * k * sympy.sqrt(mixed**2)))
    return d.reading(lambda y: y + k * y * Abs(y) - mixed, root)


def _compared(d: Draft, u: Any, level: Any) -> Any:
    """u > level, in some writing."""
    return d.any([u > level, u >= level, level < u, sympy.Not(u <= level), u - level > 0])


def _of_state(d: Draft, u: Law) -> Law:
    """A law with a relation of what it is given."""
    level, kind = d.number(-0.6, 0.6), int(d.rng.integers(8))
    v = u.written
    r = d.above(u.solved - level)
    if kind == 0:
        return Law(Max(v - level, 0), r * (u.solved - level))
    if kind == 1:
        return Law(Min(v, level), r * level + (1 - r) * u.solved)
    if kind == 2:
        return Law(Abs(v - level), (2 * r - 1) * (u.solved - level))
    if kind == 3:
        return Law(sign(v - level), 2 * r - 1)
    if kind == 4:
        return Law(Heaviside(v - level), r)
    if kind == 5:
        a, b = d.number(-1, 1), d.number(-1, 1)
        return Law(Piecewise((a, _compared(d, v, level)), (b * v, True)), r * a + (1 - r) * b * u.solved)
    if kind == 6:
        width = d.number(0.2, 0.6)
        s = d.above(u.solved - level - width)
        clipped = level + r * (u.solved - level) - s * (u.solved - level - width)
        return Law(Min(Max(v, level), level + width), clipped)
    other = _signal(d)
    least = d.number(-0.6, 0.6)
    s, a = d.above(other.solved - least), d.number(-1, 1)
    both = And(_compared(d, v, level), _compared(d, other.written, least))
    return Law(Piecewise((a, both), (0, True)), r * s * a)


def _of_time(d: Draft) -> Law:
    """A law with relations of time alone."""
    at, kind = d.number(0.15 * d.end, 0.8 * d.end), int(d.rng.integers(7))
    if kind == 0:
        return Law(Heaviside(T - at), d.above(T - at))
    if kind == 1:
        return Law(Max(T - at, 0), d.above(T - at) * (T - at))
    if kind == 2:
        return Law(Abs(T - at), (2 * d.above(T - at) - 1) * (T - at))
    if kind == 3:  # a pulse, which may be short beside the run
        width = d.number(0.02 * d.end, 0.2 * d.end)
        height = 1 / width
        inside = d.above(T - at) * (1 - d.above(T - at - width))
        return Law(Piecewise((height, And(_compared(d, T, at), T < at + width)), (0, True)), inside * height)
    if kind == 4:
        w, phase, level = d.number(4 / d.end, 12 / d.end), d.number(0, 6), d.number(-0.6, 0.6)
        wave = sin(w * T + phase) - level
        return Law(sign(wave), 2 * d.above(wave) - 1)
    steps = int(d.rng.integers(1, 4))
    pace, ahead = d.number((steps + 0.1) / d.end, (steps + 0.5) / d.end), d.number(0.05, 0.45)
    count = sum((d.above(pace * T + ahead - k) for k in range(1, steps + 1)), sympy.S.Zero)
    d.bounds.append((pace * T + ahead, 0.0, steps + 1.0))
    if kind == 5:
        return Law(floor(pace * T + ahead), count)
    return Law(Mod(pace * T + ahead, 1), pace * T + ahead - count)


def _stairs(d: Draft) -> Law:
    """The whole part of a state."""
    u = _signal(d)
    fine = d.number(0.8, 1.3)
    levels = (-1, 0, 1)
    d.bounds.append((fine * u.solved, -2.0, 2.0))
    return Law(floor(fine * u.written), -2 + sum((d.above(fine * u.solved - k) for k in levels), sympy.S.Zero))


def _implicit(d: Draft) -> Law:
    """y + k·max(y − level, 0) = u: the branches are linear."""
    u, k, level = _signal(d), d.number(0.3, 2.0), d.number(-0.5, 0.5)
    r = d.above(u.solved - level)
    return d.reading(
        lambda y: y + k * Max(y - level, 0) - u.written, r * (u.solved + k * level) / (1 + k) + (1 - r) * u.solved
    )


def _series(d: Draft) -> Law:
    """A block behind a block, each a variable of its own."""
    first = _of_state(d, _signal(d)) if d.rng.random() < 0.6 else _of_time(d)
    y = d.reading(lambda y: y - first.written, first.solved)
    gain, x = d.number(0.4, 1.0), d.any(d.states)
    second = _of_state(d, Law(gain * y.written + x, gain * y.solved + x))
    return d.reading(lambda z: z - second.written, second.solved)


CELLS = dict(a=(0.5, 1.5), b=(-1.5, 0.4), level=(0.1, 0.5), w=(0.8, 3.0))


def _cells(rng: np.random.Generator, n: int) -> dict[str, list[float]]:
    """What is in an array of n cells."""
    return {k: np.round(rng.uniform(low, high, n), 3).tolist() for k, (low, high) in CELLS.items()}


LAWS = (_of_time, lambda d: _of_state(d, _signal(d)), lambda d: _of_state(d, _signal(d)), _stairs, _implicit, _series)


def _draw(rng: np.random.Generator, laws: int) -> Draft:
    label = iter(names(rng, 400))
    d = Draft(rng, round(float(rng.uniform(2, 6)), 3), lambda: next(label))
    for _ in range(int(rng.integers(1, 4))):
        x, decay = d.state(), d.number(0.3, 1.5)
        d.push(x, Law(-decay * x, -decay * x))
        if rng.random() < 0.4:  # a second-order one, which swings
            v, w = d.state(), d.number(0.8, 3.0)
            d.push(v, Law(-(w**2) * x, -(w**2) * x))
            d.push(x, Law(v, v))
        drive = d.number(0.5, 1.2) * sin(d.number(0.5, 3.0) * T + d.number(0, 6))
        d.push(x, Law(drive, drive))
    for _ in range(laws):
        _add(d)
    if rng.random() < 0.25:
        d.cells = _cells(rng, int(rng.integers(2, 4)))
    return d


def _add(d: Draft) -> None:
    """One more law in the rate of a state."""
    law = d.any(LAWS)(d)
    gain = d.number(-0.8, 0.8)
    d.push(d.any(d.states), Law(gain * law.written, gain * law.solved))


def _grown(rng: np.random.Generator) -> Draft:
    """More relations than MOST, one law after the other: of many at once, two nearly always turn at one instant.
    Raises `Delicate` where the first one is."""
    most = int(rng.integers(MOST + 1, MANY + 1))
    d = _draw(rng, 1)
    _course(rng, d, 1)
    for _ in range(2 * MANY):
        more = d.copy()
        _add(more)
        if len(more.relations) + len(more.cells.get("a", ())) > most:
            break
        try:
            _course(rng, more, 1)
        except Delicate:
            continue
        d = more
    return d


def _reference(d: Draft, values: Mapping[Symbol, float]) -> tuple[HybridSystem, dict[Symbol, Expr]]:
    """The system that SciPy solves, with these values of the parameters; and what the readings are."""
    number = {p: Float(v, 17) for p, v in values.items()}
    rates = {x: law.solved.xreplace(number) for x, law in d.rates.items()}
    relations: dict[Symbol, Any] = {r: g.xreplace(number) for r, g in d.relations.items()}
    states = dict(d.states)
    for k in range(len(d.cells.get("a", ()))):
        a, b, level, w = (d.cells[n][k] for n in ("a", "b", "level", "w"))
        x, r = Symbol(f"cell[{k}].x"), Symbol(f"cell[{k}]")
        states[x], relations[r] = 0.1, x - level
        rates[x] = -a * x + b * r * (x - level) + sin(w * T)
    readings: dict[Symbol, Any] = {y: solved.xreplace(number) for y, solved in d.readings.items()}
    return HybridSystem(states, {}, relations, rates, {}, [], []), readings


def _solved(d: Draft, values: Mapping[Symbol, float], ts: np.ndarray, starts=None):
    """Instants, and all variables at the times."""
    system, readings = _reference(d, values)
    reference = Reference(system)
    run = reference.run(d.end, starts)
    found = reference.read(run, ts)
    begins = np.array([begin for begin, *_ in run.segments])
    bounded: list[Any] = [u.xreplace(values) for u, *_ in d.bounds]
    evaluate = reference._compiled([*readings.values(), *bounded])
    rows = []
    for t in np.concatenate([ts, np.linspace(0.0, d.end, 200)]):
        _, sol, q, r = run.segments[int(np.searchsorted(begins, t, side="right")) - 1]
        rows.append([float(v) for v in evaluate(t, sol(t), q, r)])
    table = np.array(rows, float).reshape(len(rows), -1)
    for k, (_, low, high) in enumerate(d.bounds):
        column = table[:, len(readings) + k]
        if column.min() < low or column.max() > high:
            raise Delicate("a whole part outside of what is solved")
    found |= {y: table[: len(ts), k] for k, y in enumerate(readings)}
    return run.instants, found


def make(seed: int, variants: int = 0) -> Case:
    """One to six relations, or up to twenty; what two methods need not agree about is drawn again."""
    rng = np.random.default_rng([seed, 12])
    differentiated, many = bool(seed % 2), seed % 6 == 0
    while True:
        try:
            d = _grown(rng) if many else _draw(rng, int(rng.integers(1, 4)))
        except Delicate:
            continue
        cells, most = len(d.cells.get("a", ())), SMALL if differentiated else MANY if many else MOST
        if not (MOST if many else 0) < len(d.relations) + cells <= most:
            continue
        if differentiated and len(d.states) + cells > SMALL:
            continue
        try:
            return _case(rng, d, differentiated, [seed, 12], variants)
        except Delicate:
            continue


class Course(NamedTuple):
    """What a draft does: the number of its instants, and values and sizes of its variables at times."""

    instants: int
    ts: np.ndarray
    found: dict[Symbol, np.ndarray]
    size: dict[Symbol, float]


def _course(rng: np.random.Generator, d: Draft, count: int) -> Course:
    """At so many random times, none of them an instant. Raises `Delicate`."""
    instants, _ = _solved(d, d.values, np.array([d.end]))
    ts = []
    while len(ts) < count:
        t = float(rng.uniform(0.05, 1.0)) * d.end if ts else d.end
        if not ts or min(abs(t - s) for s in instants) > 0.5 * APART * d.end:
            ts.append(t)
    ts = np.sort(ts)
    _, found = _solved(d, d.values, ts)
    system, _ = _reference(d, d.values)
    starts = np.array(list(system.states.values()))
    again, other = _solved(d, d.values, ts, starts + NUDGE * rng.choice([-1.0, 1.0], len(starts)))
    size = {s: max(float(np.max(np.abs(v))), 0.1) for s, v in found.items()}
    grown = max(float(np.max(np.abs(found[s] - other[s]))) / size[s] for s in found) / NUDGE
    if len(again) != len(instants) or not grown <= GROWN:
        raise Delicate("chaotic")
    return Course(len(instants), ts, found, size)


def _other(rng: np.random.Generator, d: Draft) -> Draft:
    """The draft with other numbers."""
    values = {p: round(float(rng.uniform(*d.ranges[p])), 3) for p in d.values}
    states = {x: round(float(rng.uniform(-1, 1)), 3) for x in d.states}
    return dataclasses.replace(d, values=values, states=states, cells=_cells(rng, len(d.cells["a"])) if d.cells else {})


def _called(s: Symbol) -> str:
    return s.name if s.name.startswith("cell[") else f"sys.{s.name}"


def _motion(course: Course, differentiated: bool) -> Motion:
    values = {_called(s): v for s, v in course.found.items()}
    allowed = {_called(s): TRAJECTORY * size for s, size in course.size.items()}
    return Motion(course.ts, values, allowed, *((1e-9, 1e-11) if differentiated else (1e-6, 1e-8)))


def _case(rng: np.random.Generator, d: Draft, differentiated: bool, seed: list[int], variants: int) -> Case:
    course = _course(rng, d, COUNT)
    if course.instants < 2:
        raise Delicate("nothing turns")
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Written(ev, "sys", d, rng.permutation(len(d.states) + len(d.equations))))
    if d.cells:
        diagram.add_array(ev, "cell", Cell, len(d.cells["a"]), **{k: np.array(v) for k, v in d.cells.items()})
    shown = [list(course.found)[k] for k in rng.permutation(len(course.found))[:3]]
    weights = {s: rng.choice([-1.0, 1.0], COUNT) * rng.uniform(0.3, 1.0, COUNT) for s in shown}
    by = [list(d.values)[k] for k in rng.permutation(len(d.values))[:4]]
    differentiated = differentiated and bool(by)
    slopes = _slopes(d, course, weights, by, seed[0] % 3 == 0) if differentiated else None

    def variant(numbers: np.random.Generator) -> Variant | None:
        other = _other(numbers, d)
        try:
            then = _course(numbers, other, COUNT)
            derivatives = _slopes(other, then, weights, by, False) if differentiated else None
        except Delicate:
            return None
        parameters = {_called(p): v for p, v in other.values.items()}
        parameters |= {f"cell[{k}].{n}": v for n, vs in other.cells.items() for k, v in enumerate(vs)}
        initial = {_called(x): v for x, v in other.states.items()}
        return Variant(parameters, initial, _motion(then, differentiated), derivatives)

    count = len(d.relations) + len(d.cells.get("a", ()))
    note = f"{len(d.states) + len(d.cells.get('a', ()))} states, {count} relations, {course.instants - 1} instants"
    initial = {_called(x): v for x, v in d.states.items()}
    return Case(
        ev, diagram, initial, {}, motion=_motion(course, differentiated), slopes=slopes, always_moves=True,
        variants=drawn(variants, seed, variant), note=note,
    )  # fmt: skip


def _slopes(d: Draft, course: Course, weights: Mapping[Symbol, np.ndarray], by: list[Symbol], forward: bool) -> Slopes:
    """Derivatives by parameters of the weighted sum of values at the times. Raises `Delicate`."""

    def along(values: Mapping[Symbol, float]) -> float:
        number, at = _solved(d, values, course.ts)
        if len(number) != course.instants:
            raise Delicate("other instants after a small change")
        return float(sum(np.sum(w * at[s]) for s, w in weights.items()))

    found = {}
    for p in by:
        h = STEP * max(abs(d.values[p]), 0.1)
        wide, narrow = (
            (along({**d.values, p: d.values[p] + s}) - along({**d.values, p: d.values[p] - s})) / (2 * s)
            for s in (h, h / 2)
        )
        found[p] = (4 * narrow - wide) / 3
    sizes = {p: max(abs(d.values[p]), 0.1) for p in by}
    value = along(d.values)
    terms = sum(float(np.sum(np.abs(w * course.found[s]))) for s, w in weights.items())
    size = max(terms, *(abs(v) * sizes[p] for p, v in found.items()))
    true = {_called(p): Expected(v, DERIVATIVE * size / sizes[p]) for p, v in found.items()}
    return Slopes(
        {_called(s): w for s, w in weights.items()}, Expected(value, DERIVATIVE * size), true, {}, forward=forward
    )
