"""Small systems with events, relations and clocks, against SciPy's DOP853 stopped and started anew at each event."""

import dataclasses
from collections.abc import Callable

import numpy as np
import sympy
from sympy import Piecewise, Symbol

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, assign, der, pre, reinit

from .case import Case, Motion, names
from .hybrid import AMPLIFIED, APART, USUAL, Clock, Delicate, HybridSystem, Limits, Reading, Reference, Rule, T

ALLOWED = 1e-6  # of a variable's size
NUDGE = 1e-6  # of the starts, to see what it grows to


class Style:
    """How readings and guards are written: as they are."""

    def reading(self, component: Component, y: Symbol, cubic, right) -> list:
        """The equations 0 = … of a reading y + cubic·y³ = right."""
        return [(y + cubic * y**3 if cubic else y) - right]

    def guard(self, guard, rng: np.random.Generator):
        """An expression of the same sign."""
        return guard


PLAIN = Style()


class Written(Component):
    """A hybrid system in the words of the package; some of its numbers are parameters."""

    def __init__(self, ev: EqnEnv, name: str, system: HybridSystem, rng: np.random.Generator, style: Style = PLAIN):
        super().__init__(ev, name)
        now: dict = {T: ev.t}
        for x, start in system.states.items():
            now[x] = self.variable(x.name, start=start, fixed=True)
        for y in system.readings:
            now[y] = self.variable(y.name)
        discretes = {q: self.discrete(q.name, start=start) for q, start in system.discretes.items()}
        now |= discretes
        before = now | {q: pre(symbol) for q, symbol in discretes.items()}
        count = 0

        def number(value: float):
            nonlocal count
            count += 1
            return self.parameter(f"p{count}", value) if rng.random() < 0.5 else value

        def told(expression, symbols):
            """The expression in the package's symbols."""
            expression = sympy.sympify(expression)
            numbers = sorted(expression.atoms(sympy.Float), key=float)
            return expression.xreplace({n: sympy.sympify(number(float(n))) for n in numbers}).xreplace(symbols)

        for r, condition in system.relations.items():
            left = told(condition, now)
            relation = self.relation((left > 0, left >= 0, -left < 0, -left <= 0)[int(rng.integers(4))])
            now[r] = before[r] = Piecewise((1.0, relation), (0.0, True))
        equations = [der(now[x]) - told(rate, now) for x, rate in system.rates.items()]
        for y, reading in system.readings.items():
            cubic = told(reading.cubic, now) if reading.cubic else 0
            equations += style.reading(self, now[y], cubic, told(reading.right, now))
        self.add_equations(*(equations[k] for k in rng.permutation(len(equations))))

        def actions(writes):
            for target, value in writes.items():
                act = assign if target in system.discretes else reinit
                yield act(now[target], told(value, before))

        for rule in (system.rules[k] for k in rng.permutation(len(system.rules))):
            guard = style.guard(told(rule.guard, now), rng)
            condition = (guard <= 0, guard < 0, -guard >= 0, -guard > 0)[int(rng.integers(4))]
            if rule.mode is None:
                self.when(condition, *actions(rule.writes))
            else:
                self.when(condition, *actions(rule.writes), on=sympy.Eq(now[rule.mode[0]], rule.mode[1]))
        for clock in system.clocks:
            self.when(self.sampled(number(clock.period)), *actions(clock.writes))


@dataclasses.dataclass
class Draft:
    """A hybrid system while it is drawn; `label` gives a name that is not taken."""

    rng: np.random.Generator
    end: float
    label: Callable[[], str]
    states: dict = dataclasses.field(default_factory=dict)
    discretes: dict = dataclasses.field(default_factory=dict)
    relations: dict = dataclasses.field(default_factory=dict)
    rates: dict = dataclasses.field(default_factory=dict)
    readings: dict = dataclasses.field(default_factory=dict)
    rules: list = dataclasses.field(default_factory=list)
    clocks: list = dataclasses.field(default_factory=list)

    def uniform(self, low: float, high: float) -> float:
        """A number of three digits, which a reader can copy."""
        return round(float(self.rng.uniform(low, high)), 3)

    def state(self, start: float, rate) -> Symbol:
        x = Symbol(self.label())
        self.states[x], self.rates[x] = start, rate(x)
        return x

    def discrete(self, start: float = 0.0) -> Symbol:
        q = Symbol(self.label())
        self.discretes[q] = start
        return q

    def began(self) -> None:
        """Called once there are states, before any event."""

    def any(self, symbols) -> Symbol:
        symbols = list(symbols)
        return symbols[int(self.rng.integers(len(symbols)))]

    def seen(self, x: Symbol):
        """The state itself, or a variable that is given by it."""
        if self.rng.random() < 0.6:
            return x
        y = Symbol(self.label())
        cubic = self.uniform(0.1, 1.0) if self.rng.random() < 0.5 else 0.0
        self.readings[y] = Reading(cubic, x + (cubic and cubic * x))
        return y


def _base(d: Draft):
    """One to three states that decay or swing, pushed by time or by each other."""
    for _ in range(int(d.rng.integers(1, 4))):
        decay, push, w = d.uniform(0.2, 1.5), d.uniform(0.3, 1.5), d.uniform(0.5, 4.0)
        if d.rng.random() < 0.4:
            v = d.state(d.uniform(-1, 1), lambda v: 0)
            x = d.state(d.uniform(-1, 1), lambda x, v=v: v)
            d.rates[v] = -round(w**2, 3) * sympy.sin(x) - 0.1 * decay * v
        else:
            x = d.state(d.uniform(-1, 1), lambda x, decay=decay: -decay * x - (0.5 * x**3 if decay > 1 else 0))
            v = x
        if d.rng.random() < 0.6:
            d.rates[v] += push * sympy.sin(w * T + d.uniform(0, 6))
        others = [s for s in d.states if s not in (x, v)]
        if others and d.rng.random() < 0.7:
            d.rates[v] += d.uniform(-0.8, 0.8) * d.any(others)


def _thermostat(d: Draft):
    """A quantity that is heated below a level and cools above another."""
    loss, power = d.uniform(0.3, 1.5), d.uniform(1.0, 3.0)
    q = d.discrete(float(d.rng.integers(0, 2)))
    x = d.state(d.uniform(0.0, 0.2), lambda x: -loss * x + power * q)
    low, high = (d.uniform(a, a + 0.2) * power / loss for a in (0.2, 0.5))
    y = d.seen(x)
    d.rules += [Rule(y - round(low, 3), {q: sympy.Float(1)}), Rule(round(high, 3) - y, {q: sympy.Float(0)})]


def _fire(d: Draft):
    """A quantity that grows and is taken back at a level; the events are counted."""
    n = d.discrete()
    push, drop = d.uniform(0.8, 2.5), d.uniform(0.4, 1.0)
    x = d.state(d.uniform(-0.5, 0.3), lambda x: push - d.uniform(0.1, 0.6) * x)
    back = x - drop if d.rng.random() < 0.5 else sympy.Float(-drop) * d.uniform(0.3, 1.0)
    d.rules.append(Rule(d.uniform(0.5, 1.0) - d.seen(x), {x: back, n: n + 1}))


def _bounce(d: Draft):
    """A body that falls onto the floor."""
    v = d.state(d.uniform(-1, 2), lambda v: -d.uniform(3, 9) - 0.1 * v)
    h = d.state(d.uniform(0.5, 2), lambda h: v)
    n = d.discrete()
    d.rules.append(Rule(h, {v: -d.uniform(0.6, 0.95) * v, h: sympy.Float(0), n: n + 1}))


def _clock(d: Draft):
    """A sampled controller of one of the states, or two of commensurate periods."""
    x = d.any(d.states)
    period = d.uniform(0.08, 0.3) * d.end
    for k in range(int(d.rng.integers(1, 3))):
        u = d.discrete(d.uniform(-0.5, 0.5))
        d.rates[x] += d.uniform(0.3, 1.5) * u
        law = d.uniform(-1.2, -0.2) * (d.any(d.states) - d.uniform(-0.5, 0.5)) + d.uniform(-0.5, 0.7) * u
        d.clocks.append(Clock(round(period * (k + 1), 3), {u: law}))
        if d.rng.random() < 0.4:
            d.clocks[-1].writes[d.discrete()] = d.uniform(0.5, 1.5) * u + d.any(d.discretes)


def _relation(d: Draft):
    """A rate that changes with the side of a level on which another state, or time, is."""
    r = Symbol(d.label())
    d.relations[r] = T - d.uniform(0.2, 0.8) * d.end if d.rng.random() < 0.3 else d.any(d.states) - d.uniform(-0.6, 0.6)
    x = d.any(d.states)
    if d.relations[r].has(x):
        # Else it might be pushed back to the level from both sides.
        d.rates[x] += r * d.uniform(0.1, 0.5) * (x + 2)
    else:
        d.rates[x] += r * d.uniform(-1.0, 1.0)


def _timed(d: Draft):
    """A dose at a given time."""
    x, n = d.any(d.states), d.discrete()
    d.rules.append(
        Rule(d.uniform(0.2, 0.8) * d.end - T, {x: d.uniform(-0.8, 0.8) * x + d.uniform(-0.5, 0.5), n: n + 1})
    )


def _mode(d: Draft):
    """A discrete variable that changes at a level in one mode only, and back at another level."""
    q, x = d.discrete(), d.any(d.states)
    d.rates[d.any(d.states)] += d.uniform(-0.8, 0.8) * q
    middle, width = d.uniform(-0.3, 0.3), d.uniform(0.1, 0.5)
    d.rules += [
        Rule(round(middle + width, 3) - x, {q: 1 - q}, (q, 0.0)),
        Rule(x - round(middle - width, 3), {q: q - 1}, (q, 1.0)),
    ]


FEATURES = (_thermostat, _fire, _bounce, _clock, _relation, _timed, _mode)


def drawn(rng: np.random.Generator, draft: type[Draft] = Draft) -> tuple[HybridSystem, float]:
    """A system with one to four events, and how long it runs."""
    label = iter(names(rng, 40))
    d = draft(rng, round(float(rng.uniform(2, 6)), 3), lambda: next(label))
    _base(d)
    d.began()
    for k in rng.permutation(len(FEATURES))[: int(rng.integers(1, 4))]:
        FEATURES[k](d)
    for _ in range(int(rng.integers(0, 2))):
        d.seen(d.any(d.states))
    system = HybridSystem(d.states, d.discretes, d.relations, d.rates, d.readings, d.rules, d.clocks)
    return system, d.end


def make(seed: int) -> Case:
    """One to seven states with events; what two methods need not agree about is drawn again."""
    rng = np.random.default_rng([seed, 10])
    while True:
        system, end = drawn(rng)
        if not 1 <= len(system.rules) + len(system.clocks) + len(system.relations) <= 4:
            continue
        try:
            return case_of(rng, system, end)
        except Delicate:
            continue


def case_of(
    rng: np.random.Generator, system: HybridSystem, end: float, style: Style = PLAIN, limits: Limits = USUAL
) -> Case:
    """What a system does up to `end`. Raises `Delicate`."""
    reference = Reference(system, limits)
    run = reference.run(end)
    if len(run.instants) < 2:
        raise Delicate("nothing happens")
    ts = np.sort(rng.uniform(0.05, 1.0, 12)) * end
    ts[-1] = end
    ts = np.array([t for t in ts if min(abs(t - s) for s in run.instants) > 0.5 * APART * end])
    values = reference.read(run, ts)
    starts = np.array(list(system.states.values()))
    nudged = reference.run(end, starts + NUDGE * rng.choice([-1.0, 1.0], len(starts)))
    other = reference.read(nudged, ts)
    if len(nudged.instants) != len(run.instants):
        raise Delicate("other events after a small change")
    size = {s: max(float(np.max(np.abs(v))), 0.1) for s, v in values.items()}
    grown = max(float(np.max(np.abs(values[s] - other[s]))) / size[s] for s in values) / NUDGE
    if not grown <= AMPLIFIED:
        raise Delicate("chaotic")
    ev = EqnEnv()
    part = Written(ev, "sys", system, rng, style)
    motion = Motion(
        ts,
        {f"sys.{s}": v for s, v in values.items()},
        {f"sys.{s}": ALLOWED * size[s] for s in values},
        1e-9,
        1e-11,
    )
    note = (
        f"{len(system.states)} states, {len(system.rules)} events, {len(system.relations)} relations, "
        f"{len(system.clocks)} clocks, {len(run.instants) - 1} instants"
    )
    return Case(ev, AcausalDiagram().add(part), {}, {}, motion=motion, always_moves=True, note=note)
