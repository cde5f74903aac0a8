"""Random sketches: small parts of ordinary and of strange kinds, coupled at random."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy
from sympy import Abs, Expr, Max, Min, Mod, Piecewise, Symbol, cos, floor, sin, sqrt

from .sketch import Declared, Happens, Mode, Part, Sketch, T, before, rate

STRANGE_SHARE = 0.35  # of parts


@dataclasses.dataclass
class Draft:
    """A part while it is drawn. `signals`: variables that others may read; `sockets`: variables that something else
    must determine."""

    rng: np.random.Generator
    number: int
    end: float
    declared: list[Declared] = dataclasses.field(default_factory=list)
    equations: list[Expr] = dataclasses.field(default_factory=list)
    events: list[Happens] = dataclasses.field(default_factory=list)
    modes: list[Mode] = dataclasses.field(default_factory=list)
    signals: list[Symbol] = dataclasses.field(default_factory=list)
    sockets: list[Symbol] = dataclasses.field(default_factory=list)
    inputs: dict[str, Any] = dataclasses.field(default_factory=dict)
    sizes: dict[str, float] = dataclasses.field(default_factory=dict)

    def uniform(self, low: float, high: float) -> float:
        """A number of three digits, which a reader can copy."""
        return round(float(self.rng.uniform(low, high)), 3)

    def likely(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def _add(self, kind: str, name: str, args: dict[str, Any]) -> Symbol:
        self.declared.append(Declared(kind, f"{name}{self.number}", args))
        return Symbol(f"{name}{self.number}")

    def number_of(self, name: str, low: float, high: float, **args: Any) -> Expr:
        """A parameter, or just a number."""
        value = self.uniform(low, high)
        if self.likely(0.25) and not args:
            return sympy.Float(value)
        return self.parameter(name, value, **args)

    def parameter(self, name: str, value: Any, **args: Any) -> Symbol:
        return self._add("parameter", name, {"value": value, **args})

    def variable(self, name: str, size: float = 1.0, **args: Any) -> Symbol:
        x = self._add("variable", name, args)
        if size != 1.0:
            self.sizes[x.name] = size
        return x

    def state(self, name: str, start: Any, size: float = 1.0, **args: Any) -> Symbol:
        return self.variable(name, size, start=start, fixed=True, **args)

    def discrete(self, name: str, start: float = 0.0) -> Symbol:
        return self._add("discrete", name, {"start": start})

    def socket(self) -> Symbol:
        """A variable that is coupled to others afterwards."""
        u = self.variable("u")
        self.sockets.append(u)
        return u


def _decay(d: Draft):
    k, x, u = d.number_of("k", 0.3, 1.5), d.state("x", d.uniform(-1, 1)), d.socket()
    d.equations.append(rate(x) + k * x - u)
    d.signals.append(x)


def _oscillator(d: Draft):
    x, v, u = d.state("x", d.uniform(-1, 1)), d.state("v", d.uniform(-1, 1)), d.socket()
    m, c, r = d.number_of("m", 0.5, 2, bounds=(0.01, 100.0)), d.number_of("c", 1, 9), d.number_of("r", 0.05, 0.5)
    d.equations += [rate(x) - v, m * rate(v) + c * x + r * v - u]
    d.signals += [x, v]


def _second_order(d: Draft):
    x, w = d.state("x", d.uniform(-1, 1)), d.number_of("w", 1, 3)
    d.equations.append(rate(rate(x)) + w**2 * x + 0.2 * rate(x) - d.socket())
    d.signals.append(x)


def _driven(d: Draft):
    a, w, x = d.number_of("a", 0.5, 1.5), d.number_of("w", 0.5, 4), d.state("x", d.uniform(-1, 1))
    d.equations.append(rate(x) + x - a * sin(w * T + d.uniform(0, 6)))
    d.signals.append(x)


def _cubic(d: Draft):
    c, x = d.number_of("c", 0.2, 1.5, bounds=(0.0, 10.0)), d.state("x", d.uniform(-1, 1))
    y, u = d.variable("y"), d.socket()
    d.equations += [y + c * y**3 - x - u, rate(x) + y]
    d.signals += [x, y]


def _linear_block(d: Draft):
    x, y, z = d.state("x", d.uniform(0.2, 1)), d.variable("y"), d.variable("z")
    a, b = d.number_of("a", 1.5, 3), d.number_of("b", 0.2, 0.9)
    d.equations += [a * y + z - x, y + b * z + d.socket(), rate(x) + y]
    d.signals += [x, z]


def _pendulum(d: Draft):
    angle, L = d.parameter("angle", d.uniform(-1, 1)), d.parameter("L", d.uniform(0.6, 1.4), bounds=(0.05, 10.0))
    x, y = d.state("x", L * sin(angle)), d.variable("y", start=-L * cos(angle))
    v, w, lam = d.state("v", 0.0), d.variable("w"), d.variable("lam")
    d.equations += [
        rate(x) - v, rate(y) - w, rate(v) + lam * x + 0.1 * v - d.socket(), rate(w) + lam * y + 9.81,
        x**2 + y**2 - L**2,
    ]  # fmt: skip
    d.signals += [x, y]


def _two_rates_one_constraint(d: Draft):
    """Index 2: what keeps the sum of two states on a course."""
    x, y, f = d.state("x", d.uniform(-1, 1)), d.variable("y"), d.variable("f")
    d.equations += [rate(x) + x - f, rate(y) + 2 * y - f - d.socket(), x + y - sin(d.uniform(0.5, 2) * T)]
    d.signals += [x, y]


def _tank(d: Draft):
    area, outlet = d.number_of("area", 0.5, 2, bounds=(0.1, 10.0)), d.number_of("outlet", 0.2, 0.5)
    h = d.state("h", d.uniform(1, 2), bounds=(0.0, 100.0))
    d.equations.append(area * rate(h) + outlet * sqrt(h + 0.01) - 0.5)
    d.signals.append(h)


def _input(d: Draft):
    default, x = d.uniform(-1, 1), d.state("x", d.uniform(-1, 1))
    u = d._add("input", "e", {"default": default})
    if d.likely(0.7):
        ts = np.linspace(0.0, d.end, 5)
        kind = ("linear", "cubic", "held")[int(d.rng.integers(3))]
        d.inputs[u.name] = (ts, np.round(d.rng.uniform(-1, 1, 5), 3), kind)
    d.equations.append(rate(x) + d.number_of("k", 0.5, 1.5) * x - u)
    d.signals.append(x)


def _follows(d: Draft):
    """Parameters and starts that follow from others."""
    p = d.parameter("p", d.uniform(0.4, 0.9))
    q = d.parameter("q", 2 * p)
    x = d.state("x", p * q)
    d.equations.append(rate(x) + q * x - d.socket())
    d.signals.append(x)


def _with_size(d: Draft):
    size = 10.0 ** float(d.rng.integers(-9, 7))
    x = d.state("x", size * d.uniform(0.5, 1), size, nominal=size)
    k = d.number_of("k", 0.3, 1.5)
    y = d.variable("y")
    d.equations += [rate(x) + k * x, y - x / size]
    d.signals.append(y)


ORDINARY = (
    _decay, _oscillator, _second_order, _driven, _cubic, _linear_block, _pendulum, _two_rates_one_constraint, _tank,
    _input, _follows, _with_size,
)  # fmt: skip


def _thermostat(d: Draft):
    q = d.discrete("q", float(d.rng.integers(0, 2)))
    loss, power, x = d.number_of("loss", 0.4, 1.2), d.uniform(1, 3), d.state("x", d.uniform(0.0, 0.2))
    d.equations.append(rate(x) + loss * x - power * q)
    d.events += [
        Happens(x <= d.uniform(0.25, 0.35), (("assign", q.name, sympy.Float(1)),)),
        Happens(x >= d.uniform(0.45, 0.6), (("assign", q.name, sympy.Float(0)),)),
    ]
    d.signals.append(x)


def _bounce(d: Draft):
    h, v, n = d.state("h", d.uniform(0.5, 1.5)), d.state("v", d.uniform(-1, 1)), d.discrete("n")
    e = d.number_of("e", 0.7, 0.95, bounds=(0.0, 1.0))
    d.equations += [rate(h) - v, rate(v) + d.uniform(3, 9)]
    d.events.append(
        Happens(
            h <= 0,
            (("reinit", v.name, -e * v), ("reinit", h.name, sympy.S.Zero), ("assign", n.name, before(n) + 1)),
        )
    )
    d.signals.append(h)


def _clock(d: Draft):
    x, u, period = d.state("x", d.uniform(-1, 1)), d.discrete("s"), d.number_of("T", 0.1, 0.3)
    d.equations.append(rate(x) + 0.5 * x - u - 0.1 * d.socket())
    law = d.uniform(-1, -0.3) * (x - 0.3) + d.uniform(0.1, 0.5) * before(u)
    d.events.append(Happens(None, (("assign", u.name, law),), period, sympy.Float(d.uniform(0, 0.05))))
    if d.likely(0.5):
        w = d.discrete("w")
        d.events.append(Happens(None, (("assign", w.name, before(w) + before(u) * x),), 2 * period))
    d.signals.append(x)


def _dose(d: Draft):
    x, te = d.state("x", d.uniform(0.5, 1)), d.parameter("te", round(d.uniform(0.2, 0.8) * d.end, 3))
    d.equations.append(rate(x) + d.number_of("k", 0.3, 1) * x)
    d.events.append(Happens(T >= te, (("reinit", x.name, x + d.uniform(0.2, 0.6)),)))
    d.signals.append(x)


def _two_modes(d: Draft):
    """A discrete variable that two conditions write, one of which reads another discrete variable."""
    x, q, n = d.state("x", 0.0), d.discrete("q", 1.0), d.discrete("n")
    d.equations.append(rate(x) - d.number_of("speed", 0.8, 1.5) * q)
    top = d.uniform(0.3, 0.7)
    d.events += [
        Happens(x >= top, (("assign", q.name, -before(q)), ("assign", n.name, before(n) + 1))),
        Happens(x <= -top, (("assign", q.name, -before(q)), ("assign", n.name, before(n) + before(q)))),
    ]
    d.signals.append(x)


def _sides(d: Draft):
    """Relations inside an equation."""
    x, a = d.state("x", d.uniform(-1, 1)), d.uniform(-0.4, 0.4)
    law = (
        Max(x, a) + Min(x, 0.2),
        Abs(x - a),
        Piecewise((x, x > a), (2 * x - a, True)),
        Max(sin(2 * T), 0.3),
    )[int(d.rng.integers(4))]
    d.equations.append(rate(x) + law - sin(d.number_of("w", 1, 3) * T))
    d.signals.append(x)


HAPPENING = (_thermostat, _bounce, _clock, _dose, _two_modes, _sides)


def _aliases(d: Draft):
    x, y, z = d.state("x", d.uniform(-1, 1)), d.variable("y"), d.variable("z")
    d.equations += [rate(x) + x - d.socket(), y + d.uniform(1.5, 3) * x, z - y]
    d.signals.append(z)


def _constants(d: Draft):
    x, y = d.state("x", d.uniform(-1, 1)), d.variable("y")
    d.equations += [rate(x), y - d.number_of("a", 1, 2)]
    d.signals.append(x)


def _fast(d: Draft):
    x = d.state("x", d.uniform(-1, 1))
    d.equations.append(rate(x) + d.number_of("k", 800, 3000) * (x - sin(T)))
    d.signals.append(x)


def _tiny(d: Draft):
    """A state without a nominal value whose start tells its size."""
    size = 10.0 ** float(d.rng.integers(-18, -5))
    x, v = d.state("x", size * d.uniform(0.5, 1), size), d.state("v", size * d.uniform(0.5, 1), size)
    d.equations += [rate(x) - v, rate(v) + d.number_of("c", 1, 4) * x]


def _amount(d: Draft):
    """A gas whose amount is tiny beside one that is usual."""
    size = 10.0 ** float(d.rng.integers(-18, -8))
    n, p, V = d.state("n", size, size), d.variable("p"), d.parameter("V", size * d.uniform(1, 3))
    d.equations += [rate(n) + n, p * (V - d.uniform(0.1, 0.3) * n) - n]
    d.signals.append(p)


def _silent(d: Draft):
    x, a = d.state("x", d.uniform(0.5, 1)), d.parameter("a", 0.0)
    d.equations.append(rate(x) + x - a * sin(d.uniform(20, 90) * T))
    d.signals.append(x)


def _square(d: Draft):
    x = d.state("x", 0.0)
    wave = (
        1 - 2 * Mod(floor(2 * T), 2),
        sympy.sign(sin(3 * T)),
        Piecewise((1.0, Mod(T, 0.7) < 0.3), (-0.5, True)),
        Max(Mod(T, 1.1), Min(0.4, T)),
        floor(Mod(T, 1.3) + 0.5),
        sympy.sign(Mod(T, 0.9) - 0.4) * floor(T + 0.25),
    )[int(d.rng.integers(6))]
    d.equations.append(rate(x) + 0.3 * x - wave)
    d.signals.append(x)


def _repeated_start(d: Draft):
    x, y = d.state("x", 0.5), d.variable("y", start=1.0, fixed=True)
    d.equations += [rate(x) + x - d.socket(), y - 2 * x]
    d.signals.append(y)


def _contradicting_start(d: Draft):
    x, y = d.state("x", 0.5), d.variable("y", start=1.7, fixed=True)
    d.equations += [rate(x) + x, y - 2 * x]


def _no_solution(d: Draft):
    x, y = d.state("x", d.uniform(-3, -1)), d.variable("y", start=1.0)
    d.equations += [rate(x) + x, y**2 - x]


def _grows(d: Draft):
    """A state that becomes infinite for some parameters."""
    k, x = d.parameter("k", 0.3), d.state("x", 1.0)
    d.equations.append(rate(x) - k * x**2 * 0.5)


def _ends(d: Draft):
    x, level = d.state("x", 0.0), d.uniform(0.5, 0.9)
    d.equations.append(rate(x) - 1 / d.number_of("tau", 1, 3))
    d.events.append(Happens(x >= level, (("terminate", "it is there", sympy.S.Zero),)))


def _at_once(d: Draft):
    """Two events at one instant, one of which reads what the other writes."""
    te = round(d.uniform(0.3, 0.7) * d.end, 3)
    x, p, q = d.state("x", d.uniform(0.5, 1)), d.discrete("p", 1.0), d.discrete("q", 2.0)
    d.equations.append(rate(x) + 0.3 * x - 0.1 * p + 0.05 * q)
    d.events += [
        Happens(T >= te, (("assign", p.name, before(q) + x), ("reinit", x.name, x + before(p)))),
        Happens(T >= te, (("assign", q.name, before(p) + x),)),
    ]
    d.signals.append(x)


def _cascade(d: Draft):
    """An event that turns the condition of another."""
    x, p, q = d.state("x", 0.0), d.discrete("p"), d.discrete("q")
    d.equations.append(rate(x) - 1 + 0.5 * q)
    d.events += [
        Happens(x >= d.uniform(0.2, 0.6), (("assign", p.name, before(p) + 1),)),
        Happens(p >= 0.5, (("assign", q.name, before(q) + 1),)),
    ]
    d.signals.append(x)


def _free_level(d: Draft):
    """A start that equations and guesses leave open."""
    x, y, z = d.variable("x", start=d.uniform(0.2, 0.5)), d.variable("y", start=0.7), d.variable("z")
    d.equations += [rate(x) + x - y, rate(y) + y - z, z - x * y]
    d.signals.append(x)


STRANGE = (
    _aliases, _constants, _fast, _tiny, _amount, _silent, _square, _repeated_start, _grows, _ends, _at_once, _cascade,
    _free_level,
)  # fmt: skip
HOPELESS = (_contradicting_start, _no_solution)  # to be refused


def draw(
    rng: np.random.Generator, most: int = 3, first: Sequence[Callable[[Draft], None]] = (), more: bool = True
) -> Sketch:
    """One to `most` parts; before them, those of `first`, alone unless there are `more`."""
    end = round(float(rng.uniform(1.5, 3.0)), 3)
    kinds = list(first)
    strange = bool(first)
    if more:
        for _ in range(int(rng.integers(1, most + 1))):
            strange_one = rng.random() < STRANGE_SHARE
            strange = strange or strange_one
            rooms = (*STRANGE, *HOPELESS) if rng.random() < 0.1 else STRANGE
            table = rooms if strange_one else HAPPENING if rng.random() < 0.4 else ORDINARY
            kinds.append(table[int(rng.integers(len(table)))])
    drafts = []
    for k, kind in enumerate(kinds):
        d = Draft(rng, k, end)
        kind(d)
        drafts.append(d)
    signals = [s for d in drafts for s in d.signals]
    couplings = []
    for d in drafts:
        for u in d.sockets:
            others = [s for s in signals if s not in d.signals]
            if others and rng.random() < 0.7:
                other = others[int(rng.integers(len(others)))]
                couplings.append(u - d.uniform(-0.5, 0.5) * other)
            else:
                couplings.append(u - d.uniform(-0.5, 0.5))
    parts = tuple(
        Part(f"part{d.number}", tuple(d.declared), tuple(d.equations), tuple(d.events), modes=tuple(d.modes))
        for d in drafts
    )
    note = "+".join(kind.__name__[1:] for kind in kinds)
    return Sketch(
        parts, tuple(couplings), {k: v for d in drafts for k, v in d.inputs.items()}, end,
        {k: v for d in drafts for k, v in d.sizes.items()}, note, strange,
    )  # fmt: skip
