"""Models at and beside singular positions: one verdict, whatever rounds.

A model is drawn at a singular position, off by 0, by up to ±4 eps or by 1e-14 to 1e-6, and judged in NumPy alone
(compiled, its blocks examined at the start), under all of OpenBLAS' kernels that the processor runs, and again with
every number off by ±4 eps. Off by rounding it must be refused, or have the constraint of the singular model, from which
nobody can tell it. Off by 1e-6 it must be accepted, with the number of states that its equations have by hand. Between,
either; but one of them.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from sympy import Eq, cos, sin

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, der
from jaxonomy_dae.library.electrical import Capacitor, CurrentSource, Ground, Resistor
from jaxonomy_dae.library.planar import MassiveLink, Revolute, World
from jaxonomy_dae.library.rotational import IdealGear, Inertia
from jaxonomy_dae.library.translational import Mass, Rod

from .case import diagram_of, log_uniform, names
from .kernels import Verdict, kernels_for
from .outcome import Outcome

EPS = float(np.finfo(float).eps)
OFFSETS = (0.0, *(k * EPS for k in (-4, -3, -2, -1, 1, 2, 3, 4)), *(10.0**k for k in range(-14, -5)))
CLEAR = 1e-6  # so far from singular, a model is accepted
ROUNDINGS = (None, 1)  # seeds of what the numbers are off by
WORDS = (
    "singular", "determine", "depend", "contradict", "condition", "floating", "constraint", "no ground", "one too many",
)  # fmt: skip

Number = Callable[[float], float]


@dataclasses.dataclass(frozen=True)
class Position:
    """A model at an offset from a singular position.

    - `at`, `beside`: what is true of it at the singular position, and clear of it: how many states it has, or None
        where it must be refused.
    - `exact`: whether the offset is a number of the model, known to its last digit beside whatever is larger.
    """

    diagram: AcausalDiagram
    mode: str
    at: int | None
    beside: int | None
    note: str
    exact: bool = False
    offset: float = 0.0

    @property
    def true(self) -> tuple[int | None, ...]:
        """What may be said of it."""
        if abs(self.offset) <= 4 * EPS:
            return (self.at, self.beside) if self.exact else (self.at,)
        return (self.beside,) if abs(self.offset) >= CLEAR else (self.at, self.beside)


def make(seed: int, roundings: int | None = None) -> Position:
    """A model and its offset; with `roundings`, every number that it is given is off by ±4 eps."""
    rng = np.random.default_rng([seed, 12])
    offset = OFFSETS[int(rng.integers(len(OFFSETS)))]
    signs = None if roundings is None else np.random.default_rng([seed, 13, roundings])

    def number(value: float, size: float | None = None) -> float:
        """The value; off by 4 eps of `size`."""
        by = 0.0 if signs is None else 4 * EPS * float(signs.choice([-1.0, 1.0]))
        return value + by * (abs(value) if size is None else size)

    kinds = (_parallelogram, _in_line, _dead_centre, _lever, _knee, _gears, _rods, _leak, _opposite, _dense, _masses)
    found = kinds[int(rng.integers(len(kinds)))](rng, offset, number)
    return dataclasses.replace(found, offset=offset, note=f"{found.note}, off by {offset:.3g}")


# --- mechanisms ------------------------------------------------------------------------------------------------------


class Loop(Component):
    """J·q'' = forces + (∂g/∂q)ᵀ·λ with 0 = g(q) in the plane, the first of q given at the start."""

    def __init__(self, ev, name, starts, inertias, closure):
        super().__init__(ev, name)
        q = []
        for k, start in enumerate(starts):
            given = self.parameter(f"start{k}", start)
            q.append(self.variable(f"q{k}", start=given, fixed=k == 0))
        speed = [self.variable("w0", start=1.0, fixed=True), *(self.variable(f"w{k}") for k in range(1, len(q)))]
        multipliers = [self.variable("lx"), self.variable("ly")]
        g = closure(self, *q)
        for k, (position, w) in enumerate(zip(q, speed, strict=True)):
            force = sum(m * sympy.diff(e, position) for m, e in zip(multipliers, g, strict=True))
            inertia = self.parameter(f"J{k}", inertias[k])
            self.add_equations(Eq(der(position), w), Eq(inertia * der(w), 0.3 - w + force))
        self.add_equations(*(Eq(e, 0) for e in g))


def _loop(rng, number: Number, starts, closure) -> AcausalDiagram:
    ev = EqnEnv()
    inertias = [number(log_uniform(rng, -1, 1)) for _ in starts]
    return AcausalDiagram().add(Loop(ev, names(rng, 1)[0], starts, inertias, closure))


def _parallelogram(rng, offset: float, number: Number):
    """Four bars in a line; the angle is off."""
    short, long = log_uniform(rng, -0.5, 0.3), log_uniform(rng, 0.4, 1)
    turns = int(rng.integers(-3, 4))
    angle = turns * math.pi
    start = number(angle + offset * max(1.0, abs(angle)), max(1.0, abs(angle)))

    def closure(part, crank, coupler, rocker):
        a, b = part.parameter("a", short), part.parameter("b", long)
        return (
            a * cos(crank) + b * cos(coupler) - a * cos(rocker) - b,
            a * sin(crank) + b * sin(coupler) - a * sin(rocker),
        )

    coupler = number(0.0, 1.0)
    return Position(
        _loop(rng, number, (start, coupler, start), closure),
        "dummy_derivatives",
        None,
        2,
        f"parallelogram at {turns} pi",
    )


def _in_line(rng, offset: float, number: Number):
    """Two bodies of the library between pins as far apart as they are long: no other position, so singular whatever
    the offset of the guess."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    length = log_uniform(rng, -1, 1)
    first, second = length * (1 + offset), length
    one = MassiveLink(ev, "one", length, guess_x=number(first / 2))
    two = MassiveLink(ev, "two", length, guess_x=number(length + second / 2))
    west, east = World(ev, "west"), World(ev, "east", 2 * length)
    pins = [Revolute(ev, name) for name in ("first", "second", "third")]
    diagram.add(west, east, one, two, *pins)
    ends = [west.frame, one.frame_a, one.frame_b, two.frame_a, two.frame_b, east.frame]
    for k, pin in enumerate(pins):
        diagram.connect(ends[2 * k], pin.frame_a)
        diagram.connect(pin.frame_b, ends[2 * k + 1])
    return Position(diagram, "dummy_derivatives", None, None, "two bodies in line")


def _dead_centre(rng, offset: float, number: Number):
    """A slider-crank of equal bars, upright, with the slider at the crank's pin: it may leave with the crank or
    not."""
    length = log_uniform(rng, -1, 1)
    at = math.pi / 2
    start = number(at + offset * at, at)

    def closure(part, crank, rod, s):
        r = part.parameter("r", number(length))
        return r * cos(crank) + r * cos(rod) - s, r * sin(crank) + r * sin(rod)

    place = 2 * length * math.cos(start)
    return Position(
        _loop(rng, number, (start, -start, place), closure), "dummy_derivatives", None, 2, "equal bars upright"
    )


# --- blocks ----------------------------------------------------------------------------------------------------------


class _Lever(Component):
    """A force that carries the torque of a weight on a lever at the angle phi."""

    def __init__(self, ev, name, start, arm, weight):
        super().__init__(ev, name)
        start, arm, weight = (
            self.parameter("start", start),
            self.parameter("arm", arm),
            self.parameter("weight", weight),
        )
        phi, force = self.variable("phi", start=start, fixed=True), self.variable("force")
        self.add_equations(Eq(der(phi), 1.0), Eq(arm * sin(phi) * force, weight * (2 + cos(phi))))


def _lever(rng, offset: float, number: Number):
    turns = int(rng.integers(-3, 4))
    angle = turns * math.pi
    size = max(1.0, abs(angle))
    start = number(angle + offset * size, size)
    arm, weight = number(log_uniform(rng, -3, 3)), number(log_uniform(rng, -3, 3))
    diagram = AcausalDiagram().add(_Lever(EqnEnv(), names(rng, 1)[0], start, arm, weight))
    return Position(diagram, "auto", None, 1, f"lever at {turns} pi")


class _Knee(Component):
    """Bars in a toggle: the forces in them carry a load across their line."""

    def __init__(self, ev, name, start, load, ratio):
        super().__init__(ev, name)
        start, load, ratio = (
            self.parameter("start", start),
            self.parameter("load", load),
            self.parameter("ratio", ratio),
        )
        phi = self.variable("phi", start=start, fixed=True)
        one, two = self.variable("one"), self.variable("two")
        self.add_equations(
            Eq(der(phi), 0.1),
            Eq(one * sin(phi) + ratio * two * sin(phi), load),
            Eq(one * cos(phi) - two * cos(phi), phi),
        )


def _knee(rng, offset: float, number: Number):
    quarters = int(rng.integers(-3, 4))
    angle = quarters * math.pi / 2
    size = max(1.0, abs(angle))
    start = number(angle + offset * size, size)
    load, ratio = number(log_uniform(rng, -3, 3)), number(log_uniform(rng, -1, 1))
    diagram = AcausalDiagram().add(_Knee(EqnEnv(), names(rng, 1)[0], start, load, ratio))
    return Position(diagram, "auto", None, 1, f"knee at {quarters} pi / 2")


# --- networks --------------------------------------------------------------------------------------------------------


def _gears(rng, offset: float, number: Number):
    """Gears in a ring whose ratios multiply to 1 (one is too many), or to 1 + offset (then nothing turns)."""
    n = int(rng.integers(2, 5))
    ratios = [log_uniform(rng, -1, 1) for _ in range(n - 1)]
    ratios.append((1 + offset) / math.prod(ratios))
    ev, label = EqnEnv(), names(rng, 2 * n)
    gears = [IdealGear(ev, label[k], number(r)) for k, r in enumerate(ratios)]
    discs = [Inertia(ev, label[n + k], number(log_uniform(rng, -2, 2))) for k in range(n)]
    nodes = [[gears[k - 1].flange_b, gears[k].flange_a, discs[k].flange_a] for k in range(n)]
    return Position(diagram_of(rng, [*gears, *discs], nodes), "auto", None, 0, f"{n} gears in a ring")


def _rods(rng, offset: float, number: Number):
    """A loop of rigid rods, closed to the offset: one follows from the others, or contradicts them."""
    n = int(rng.integers(2, 5))
    lengths = [float(rng.uniform(-1, 1)) for _ in range(n - 1)]
    lengths.append(-sum(lengths) + offset)
    ev, label = EqnEnv(), names(rng, 2 * n)
    rods = [Rod(ev, label[k], number(r)) for k, r in enumerate(lengths)]
    masses = [Mass(ev, label[n + k], number(log_uniform(rng, -2, 2))) for k in range(n)]
    nodes = [[rods[k - 1].flange_b, rods[k].flange_a, masses[k].flange] for k in range(n)]
    return Position(diagram_of(rng, [*rods, *masses], nodes), "auto", None, None, f"{n} rods in a loop")


def _leak(rng, offset: float, number: Number):
    """A circuit beside ground: its potential is carried by a resistor of (largest R) / offset, or by nothing."""
    n = int(rng.integers(2, 6))
    ev, label = EqnEnv(), names(rng, 3 * n + 3)
    values = [log_uniform(rng, -1, 3) for _ in range(n)]
    ring = [Resistor(ev, label[k], number(v)) for k, v in enumerate(values)]
    nodes = [[ring[k - 1].n, ring[k].p] for k in range(n)]
    source = CurrentSource(ev, label[n], number(float(rng.uniform(0.1, 1))))
    nodes[0].append(source.p)
    nodes[1 % n].append(source.n)
    ground = Ground(ev, "ground")
    rest = Resistor(ev, label[n + 1], number(values[0]))
    store = Capacitor(ev, label[n + 2], number(1.0))
    parts: list[Any] = [*ring, source, ground, rest, store]
    nodes += [[rest.p, store.p], [rest.n, store.n, ground.p]]
    if offset > 0:
        leak = Resistor(ev, label[n + 3], number(max(values) / offset))
        parts.append(leak)
        nodes[int(rng.integers(n))].append(leak.p)
        nodes[-1].append(leak.n)
    return Position(
        diagram_of(rng, parts, nodes), "auto", None, 1 if offset > 0 else None, f"a circuit of {n}", offset > 0
    )


def _opposite(rng, offset: float, number: Number):
    """Two conductances at a node that cancel but for the offset, and a source into it."""
    ev, label = EqnEnv(), names(rng, 5)
    value = log_uniform(rng, -2, 4)
    one, other = Resistor(ev, label[0], number(value)), Resistor(ev, label[1], number(-value * (1 + offset)))
    source, ground = CurrentSource(ev, label[2], number(float(rng.uniform(0.1, 1)))), Ground(ev, "ground")
    rest, store = Resistor(ev, label[3], number(value)), Capacitor(ev, label[4], number(1.0))
    nodes = [
        [one.p, other.p, source.n, rest.p],
        [one.n, other.n, source.p, ground.p, store.n],
        [rest.n, store.p],
    ]
    # The node's current balance determines its potential by the conductance to the capacitor, too: leave that out.
    nodes[0].remove(rest.p)
    nodes[1].append(rest.p)
    return Position(
        diagram_of(rng, [one, other, source, ground, rest, store], nodes), "auto", None, 1, "opposite conductances"
    )


class _Linear(Component):
    """E·y' + A·y = b·sin(t), the numbers in the equations or parameters."""

    def __init__(self, ev, name, e, a, b, as_parameters):
        super().__init__(ev, name)
        y = [self.variable(f"y{k}") for k in range(a.shape[1])]

        def given(label, value):
            return self.parameter(label, value) if as_parameters and value else value

        for r in range(len(a)):
            terms = [given(f"a{r}_{k}", float(a[r, k])) * y[k] for k in range(len(y)) if a[r, k]]
            terms += [given(f"e{r}_{k}", float(e[r, k])) * der(y[k]) for k in range(len(y)) if e[r, k]]
            self.add_equations(Eq(sympy.Add(*terms), float(b[r]) * sympy.sin(ev.t)))


def _dependent(rng, n: int, offset: float) -> np.ndarray:
    """A matrix whose last row is a combination of the others, but for an offset in one entry."""
    a = rng.uniform(0.5, 2.0, (n, n)) * rng.choice([-1.0, 1.0], (n, n))
    weights = rng.uniform(0.5, 2.0, n - 1) * rng.choice([-1.0, 1.0], n - 1)
    a[-1] = (weights[:, None] * a[:-1]).sum(axis=0)
    k = int(rng.integers(n))
    a[-1, k] += offset * np.abs(weights * a[:-1, k]).sum()
    return a


def _scaled(rng, number: Number, a: np.ndarray) -> np.ndarray:
    rows, columns = (10.0 ** rng.integers(-4, 5, n) for n in a.shape)
    a = rows[:, None] * a * columns
    return np.array([[number(float(v)) for v in row] for row in a])


def _dense(rng, offset: float, number: Number):
    """Algebraic equations of which one is nearly a combination of the others, beside a state."""
    n = int(rng.integers(2, 7))
    a = _scaled(rng, number, _dependent(rng, n, offset))
    full, e = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    full[:n, :n], full[n, n], e[n, n] = a, 1.0, 1.0
    as_parameters = bool(rng.random() < 0.5)
    part = _Linear(EqnEnv(), names(rng, 1)[0], e, full, rng.uniform(0.5, 1, n + 1), as_parameters)
    note = f"{n} equations{', parameters' * as_parameters}"
    return Position(AcausalDiagram().add(part), "auto", None, 1, note)


def _masses(rng, offset: float, number: Number):
    """Rates with a matrix that is nearly singular: a constraint where its entries are numbers; refused where they are
    parameters, with others of which there are more states."""
    n = int(rng.integers(2, 5))
    e = _scaled(rng, number, _dependent(rng, n, offset))
    as_parameters = bool(rng.random() < 0.5)
    part = _Linear(
        EqnEnv(), names(rng, 1)[0], e, np.diag(rng.uniform(0.5, 2, n)), rng.uniform(0.5, 1, n), as_parameters
    )
    note = f"{n} coupled rates{', parameters' * as_parameters}"
    return Position(AcausalDiagram().add(part), "auto", None if as_parameters else n - 1, n, note)


# --- verdicts --------------------------------------------------------------------------------------------------------


def model(seed: int, roundings: int | None) -> tuple[AcausalDiagram, str]:
    """What is judged, and how its states are selected."""
    found = make(seed, roundings)
    return found.diagram, found.mode


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """What model it is, and the one verdict of all kernels and roundings about it, or all."""
    position = make(seed)
    by_kernel, seconds = kernels_for("singular").verdicts(seed)
    return position.note, [dataclasses.replace(_judged(position, by_kernel), seconds=seconds)]


def _judged(position: Position, by_kernel: Mapping[str, Sequence[Verdict]]) -> Outcome:
    found = {v.states for verdicts in by_kernel.values() for v in verdicts}
    texts = {_shape_of(v.text) for verdicts in by_kernel.values() for v in verdicts}
    if len(found) > 1 or len(texts) > 1:
        each = [f"{core}, roundings {r}: {_said(v)}" for core, vs in by_kernel.items() for r, v in enumerate(vs)]
        return Outcome("wrong", math.inf, "several verdicts. " + "; ".join(each), 0.0)
    (states,), (text,) = found, texts
    if states is None:
        if None not in position.true or not any(word in text for word in WORDS):
            return Outcome("untrue", math.inf, f"expected {position.true}: {text}", 0.0)
        return Outcome("refused", math.inf, text, 0.0)
    if states not in position.true:
        return Outcome("wrong", math.inf, f"accepted with {states} states, expected {position.true}", 0.0)
    return Outcome("right", 0.0, f"{states} states", 0.0)


def _shape_of(text: str) -> str:
    """A text without its numbers, which roundings may show in."""
    return re.sub(r"-?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)


def _said(found: Verdict) -> str:
    return f"{found.states} states" if found.states is not None else f"refused: {found.text[:150]}"
