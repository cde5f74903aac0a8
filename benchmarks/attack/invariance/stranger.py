"""Parts of kinds at which packages like this one go wrong: drawn for models from the number `STRANGER_FROM` on."""

import numpy as np
import sympy
from sympy import Abs, Eq, Heaviside, Max, Min, Mod, Piecewise, atan2, cos, floor, log, sin, sqrt, tanh

from .drawing import Draft, draw
from .sketch import Happens, Mode, Sketch, T, before, rate

STRANGER_FROM = 1000


def _diode(d: Draft):
    """A current that a voltage source drives through an ideal diode."""
    i, v, w = d.variable("i"), d.variable("vd"), d.number_of("w", 2, 5)
    q = d.state("x", 0.0)
    d.equations += [v + d.uniform(0.5, 2) * i - sin(w * T) + 0.3 * q, rate(q) - i]
    d.modes.append(Mode("complementary", (-v, i), {"name": f"on{d.number}"}))
    d.signals.append(q)


def _switch(d: Draft):
    """An ideal switch that a clock turns."""
    i, v, s, x = d.variable("i"), d.variable("vs"), d.discrete("s", float(d.rng.integers(2))), d.state("x", 0.2)
    d.equations += [1.0 - v - i - x, rate(x) - i]
    d.modes.append(Mode("either", (Eq(s, 1), v, i), {}))
    d.events.append(Happens(None, (("assign", s.name, 1 - before(s)),), sympy.Float(d.uniform(0.2, 0.4))))
    d.signals.append(x)


def _two_conditions(d: Draft):
    x, n, y = d.state("x", 0.0), d.discrete("n"), d.variable("y")
    d.equations += [rate(x) - cos(d.uniform(2, 4) * T), y - x**2 + 0.1]
    kind = (sympy.And, sympy.Or)[int(d.rng.integers(2))]
    condition = kind(x > d.uniform(0.05, 0.2), y < d.uniform(0.0, 0.3), evaluate=False)
    d.events.append(Happens(condition, (("assign", n.name, before(n) + 1),)))
    d.signals.append(y)


def _nested(d: Draft):
    """Relations within relations, of time and of states."""
    x = d.state("x", d.uniform(-0.2, 0.2))
    wave = sin(d.uniform(2, 4) * T)
    law = (
        Max(Min(x + wave, 0.4), floor(2 * wave) / 2),
        Piecewise((Max(x, wave), Abs(x) < 0.3), (floor(1.5 + wave), True)),
        sympy.sign(Max(x, Mod(T, 0.8) - 0.4)),
        Abs(Abs(wave) - 0.5),
        Mod(floor(3 * T), 3) * Heaviside(wave, 0.5),
        Piecewise((1.0, sympy.And(T > 0.5, wave > 0)), (-1.0, wave < -0.5), (0.0, True)),
        Min(Mod(floor(2 * T) + 1, 2), Max(0, sympy.sign(wave))),
    )[int(d.rng.integers(7))]
    d.equations.append(rate(x) + 0.5 * x - law)
    d.signals.append(x)


def _three_in_a_row(d: Draft):
    """Events that turn the conditions of each other, of which the last resets a state."""
    x, p, q = d.state("x", 0.0), d.discrete("p"), d.discrete("q")
    d.equations.append(rate(x) - 1 - 0.2 * q)
    level = d.uniform(0.3, 0.6)
    d.events += [
        Happens(p - q >= 0.5, (("assign", q.name, before(q) + 1), ("reinit", x.name, x - 0.5 * level))),
        Happens(x >= level, (("assign", p.name, before(p) + 1),)),
    ]
    d.signals.append(x)


def _tick_and_dose(d: Draft):
    """A clock that ticks where a dose is given and another clock ticks."""
    period = d.uniform(0.1, 0.2)
    x, u, w, y = d.state("x", 0.5), d.discrete("u"), d.discrete("w"), d.state("y", 0.0)
    d.equations += [rate(x) + x - u, rate(y) - w + 0.5 * y]
    d.events += [
        Happens(None, (("assign", u.name, 0.3 - x + 0.2 * before(u)),), sympy.Float(period)),
        Happens(None, (("assign", w.name, before(u) + x), ("reinit", y.name, y + before(u))), 3 * sympy.Float(period)),
        Happens(T >= 6 * period, (("reinit", x.name, x + 0.4), )),
    ]  # fmt: skip
    d.signals.append(y)


def _slope_start(d: Draft):
    """A derivative whose start is given, where the equation has two solutions for it."""
    x, y = d.state("x", d.uniform(0.5, 1)), d.variable("y", start=-1.0)
    d.equations += [rate(x) - y, y**2 - x]


def _rests(d: Draft):
    """What stays at zero, and a parameter that switches a term off."""
    x, y, p = d.state("x", 0.0), d.state("y", 0.4), d.parameter("p", 0.0)
    d.equations += [rate(x) + 2 * x - p * y, rate(y) + y + p * x]
    d.signals.append(y)


def _offset(d: Draft):
    """A small motion on a large value."""
    size = 10.0 ** float(d.rng.integers(3, 7))
    x, y = d.state("x", size, size), d.variable("y", size)  # known as well as x
    d.equations += [rate(x) + (x - size) - sin(d.uniform(1, 3) * T), y - (x - size)]


def _accumulates(d: Draft):
    h, v, n = d.state("h", d.uniform(0.3, 0.6)), d.state("v", 0.0), d.discrete("n")
    d.equations += [rate(h) - v, rate(v) + 9.81]
    e = d.parameter("e", d.uniform(0.2, 0.4))
    d.events.append(
        Happens(
            h <= 0, (("reinit", v.name, -e * v), ("reinit", h.name, sympy.S.Zero), ("assign", n.name, before(n) + 1))
        )
    )


def _leaves_the_domain(d: Draft):
    x, k = d.state("x", d.uniform(0.3, 0.6)), d.parameter("k", d.uniform(0.8, 1.2))
    d.equations.append(
        (rate(x) + k - log(x), rate(x) + k * sqrt(x - 0.1), rate(x) + k / (x - 0.05))[int(d.rng.integers(3))]
    )


def _no_solution_beyond(d: Draft):
    x, y = d.state("x", d.uniform(0.4, 0.9)), d.variable("y", start=0.7)
    d.equations += [rate(x) + d.number_of("k", 0.8, 1.2), y**2 - x]


def _van_der_pol(d: Draft):
    x, y, mu = d.state("x", 2.0), d.state("y", 0.0), d.number_of("mu", 20, 60)
    d.equations += [rate(x) - y, rate(y) - mu * (1 - x**2) * y + x]
    d.signals.append(x)


def _prescribed(d: Draft):
    """A course whose derivatives the equations need: index 3 by an input of time."""
    x, v, f, w = d.variable("x"), d.variable("v"), d.variable("f"), d.number_of("w", 1, 3)
    d.equations += [x - sin(w * T), rate(x) - v, rate(v) - f + 2 * x]
    d.signals.append(f)


def _functions(d: Draft):
    x, y = d.state("x", d.uniform(0.2, 0.8)), d.variable("y")
    law = (tanh(3 * x), atan2(x, 1 + x**2), log(1 + x**2), (x**2 + 0.1) ** 1.5, sqrt(x**2 + 1e-4), x**3 / (1 + x**2))
    d.equations += [rate(x) + law[int(d.rng.integers(6))] - d.socket(), y - sympy.exp(-(x**2))]
    d.signals.append(y)


def _ends_at_once(d: Draft):
    """A condition that ends the run and holds, or nearly holds, at the start."""
    start = float(d.rng.choice([0.5, 0.0, -1e-3]))
    x = d.state("x", start)
    d.equations.append(rate(x) - 1)
    condition = (x >= 0, x > 0)[int(d.rng.integers(2))]
    d.events.append(Happens(condition, (("terminate", "it is there", sympy.S.Zero),), at_start=d.likely(0.5)))


def _on_the_level(d: Draft):
    """Conditions and relations that begin exactly on their level."""
    x, n = d.state("x", 0.0), d.discrete("n")
    slope = float(d.rng.choice([-1.0, 1.0]))
    relation = (x > 0, x >= 0, x < 0, x <= 0)[int(d.rng.integers(4))]
    d.equations.append(rate(x) - slope - Piecewise((0.5, relation), (0.0, True)))
    other = (x > 0, x >= 0)[int(d.rng.integers(2))]
    d.events.append(Happens(other, (("assign", n.name, before(n) + 1),), at_start=d.likely(0.5)))
    d.signals.append(x)


def _vector_like(d: Draft):
    """A chain of like parts, which are computed as an array."""
    n = int(d.rng.integers(4, 8))
    k = d.parameter("k", d.uniform(0.5, 1.5))
    xs = [d.state(f"x{j}_", d.uniform(-1, 1)) for j in range(n)]
    for j, x in enumerate(xs):
        left, right = xs[j - 1] if j else sympy.S.Zero, xs[j + 1] if j + 1 < n else sympy.S.Zero
        d.equations.append(rate(x) - k * (left - 2 * x + right))
    d.signals.append(xs[0])


def _parameter_pivot(d: Draft):
    """A block whose best pivot hangs on a parameter that may be small."""
    p = d.parameter("p", float(d.rng.choice([1e-9, 1.0, 1e6])))
    x, y, z = d.state("x", 0.5), d.variable("y"), d.variable("z")
    d.equations += [p * y + z - x, y - z + 0.2, rate(x) + y * p / (1 + p) + x]
    d.signals.append(z)


STRANGER = (
    _diode, _switch, _two_conditions, _nested, _nested, _three_in_a_row, _tick_and_dose, _slope_start, _rests, _offset,
    _accumulates, _leaves_the_domain, _no_solution_beyond, _van_der_pol, _prescribed, _functions, _ends_at_once,
    _on_the_level, _vector_like, _parameter_pivot,
)  # fmt: skip


def drawn(number: int, rng: np.random.Generator) -> Sketch:
    """The sketch of a number: from `STRANGER_FROM` on, with one of these parts in it."""
    if number < STRANGER_FROM:
        return draw(rng)
    kind = STRANGER[int(rng.integers(len(STRANGER)))]
    return draw(rng, 1, (kind,), more=bool(rng.random() < 0.5))
