"""Small hybrid systems as data, solved by SciPy from event to event.

    x' = f(t, x, q, r),   y + c·y³ = s(t, x, q, r),   r = 1 while g(t, x, y) > 0, else 0,

with discrete variables q that only events write. The reference puts y's closed form into everything else, integrates
with DOP853 up to the next change of a condition or tick of a clock, does what is written for that instant, and starts
anew. Where two instants come too close, a condition is only grazed, or what follows is chaotic, no two methods need
agree: such a system is `Delicate`, and not judged.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import scipy.integrate
import sympy
from sympy import Expr, Symbol

T = Symbol("t")
TIGHT = dict(method="DOP853", rtol=1e-11, atol=1e-13)

# Of the run's duration, with states, conditions and rates of size one.
APART = 0.01  # between two instants
MOST = 40  # instants
LARGE = 1e3  # a state
EVALUATIONS = 3_000  # of the rates between two instants
AMPLIFIED = 100.0  # what a change of the starts may grow by


@dataclasses.dataclass(frozen=True)
class Limits:
    """What counts as delicate: a condition that is crossed at a rate below `crossing`, or that comes as `near` to zero
    and turns back, as seen at so many `looks` between two instants."""

    crossing: float = 0.05
    near: float = 1e-3
    looks: int = 60


USUAL = Limits()


class Delicate(ArithmeticError):
    """What happens hangs on less than a solver promises."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """A variable y with y + cubic·y³ = right."""

    cubic: float
    right: Expr

    def solved(self) -> Expr:
        """The one real root, by hyperbolic functions."""
        if not self.cubic:
            return self.right
        size = sympy.sqrt(3 * self.cubic)
        return 2 / size * sympy.sinh(sympy.asinh(1.5 * size * self.right) / 3)


@dataclasses.dataclass(frozen=True)
class Rule:
    """What is written where `guard` falls to zero; with `mode` (q, value), only while q has this value."""

    guard: Expr
    writes: Mapping[Symbol, Expr]
    mode: tuple[Symbol, float] | None = None


@dataclasses.dataclass(frozen=True)
class Clock:
    """What is written at 0, period, 2·period, …"""

    period: float
    writes: Mapping[Symbol, Expr]


@dataclasses.dataclass(frozen=True)
class HybridSystem:
    """States and discrete variables with their starts, relations by their g, the states' rates, readings, events. What
    is written reads values before the event."""

    states: Mapping[Symbol, float]
    discretes: Mapping[Symbol, float]
    relations: Mapping[Symbol, Expr]
    rates: Mapping[Symbol, Expr]
    readings: Mapping[Symbol, Reading]
    rules: Sequence[Rule]
    clocks: Sequence[Clock]


@dataclasses.dataclass(frozen=True)
class Run:
    """Segments (begin, dense output, q, r) one after the other, and the instants at which something happened."""

    segments: Sequence[tuple]
    instants: Sequence[float]


class Reference:
    """A hybrid system as functions of NumPy arrays."""

    def __init__(self, system: HybridSystem, limits: Limits = USUAL):
        self.system, self.limits = system, limits
        self.solved = {y: reading.solved() for y, reading in system.readings.items()}
        states, rates = list(system.states), [self._explicit(system.rates[x]) for x in system.states]
        # Conditions: those of the rules, that fall when they become true, and those of the relations.
        guards = [self._explicit(g) for g in (*(rule.guard for rule in system.rules), *system.relations.values())]
        slopes = [
            sympy.diff(g, T) + sum((sympy.diff(g, x) * f for x, f in zip(states, rates, strict=True)), sympy.S.Zero)
            for g in guards
        ]
        self.rates, self.guards, self.slopes = self._compiled(rates), self._compiled(guards), self._compiled(slopes)
        self.single = [self._compiled([g]) for g in guards]
        events = [*system.rules, *system.clocks]
        self.writes = [(list(e.writes), self._compiled([self._explicit(w) for w in e.writes.values()])) for e in events]

    def _explicit(self, expression: Expr) -> Expr:
        return sympy.sympify(expression).xreplace(self.solved)

    def _compiled(self, expressions: Sequence[Expr]):
        system = self.system
        arguments = [T, list(system.states), list(system.discretes), list(system.relations)]
        return sympy.lambdify(arguments, list(expressions), "numpy", cse=True)

    # --- one run -----------------------------------------------------------------------------------------------------

    def run(self, end: float, starts: Sequence[float] | None = None) -> Run:
        """From 0 to `end`. Raises `Delicate`."""
        system = self.system
        rules = len(system.rules)
        t, x = 0.0, np.array(list(system.states.values()) if starts is None else starts, float)
        q = np.array(list(system.discretes.values()), float)
        r = np.zeros(len(system.relations))
        for _ in range(len(r) + 1):  # a relation may compare what another one chooses
            values = np.array(self.guards(t, x, q, r))
            if np.any(np.abs(values) < self.limits.near):
                raise Delicate("a condition is zero at the start")
            before, r = r, (values[rules:] > 0).astype(float)
            if np.array_equal(before, r):
                break
        else:
            raise Delicate("relations that lead back at the start")
        holds = self._true(values[:rules], q)
        segments, instants = [], [0.0]
        ticks = sorted({k * c.period for c in system.clocks for k in range(int(end / c.period) + 1)})
        if 0.0 in ticks:
            q = self._ticked(t, x, q, r)
            x, q, r, holds = self._settled(t, x, q, r, holds, None)
        while True:
            stop = min((tick for tick in ticks if tick > t + 1e-9), default=end)
            crossed, solution = self._segment(t, min(stop, end), x, q, r, holds)
            segments.append((t, solution.sol, q.copy(), r.copy()))
            t, x = float(solution.t[-1]), solution.y[:, -1]
            if crossed is None and t >= end:
                return Run(segments, instants)
            if t - instants[-1] < APART * end or end - t < APART * end or len(instants) > MOST:
                raise Delicate(f"instants {instants[-1]} and {t}")
            instants.append(t)
            if crossed is None:
                q = self._ticked(t, x, q, r)
            x, q, r, holds = self._settled(t, x, q, r, holds, crossed)

    def _true(self, values: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Which rules' conditions hold, modes included."""
        place = {s: k for k, s in enumerate(self.system.discretes)}
        modes = [rule.mode is None or q[place[rule.mode[0]]] == rule.mode[1] for rule in self.system.rules]
        return (values <= 0) & np.array(modes, bool)

    def _segment(self, t, stop, x, q, r, holds):
        """Up to the next condition that changes: its number, or None, and SciPy's solution."""
        rules = len(self.system.rules)
        # A rule in another mode is watched, too: it changes nothing then.
        direction = np.array([*np.where(holds, 1.0, -1.0), *np.where(r > 0, -1.0, 1.0)])
        place = {s: k for k, s in enumerate(self.system.discretes)}
        watched = []
        for k, guard in enumerate(self.single):
            mode = self.system.rules[k].mode if k < rules else None
            if mode is not None and q[place[mode[0]]] != mode[1]:
                continue

            def event(t, x, guard=guard):
                return guard(t, x, q, r)[0]

            event.terminal, event.direction = True, direction[k]
            watched.append((k, event))
        evaluations = itertools.count()

        def rates(t, x):
            if not np.all(np.abs(x) < LARGE) or next(evaluations) > EVALUATIONS:
                raise Delicate("it grows without bounds, or is stiff")
            return self.rates(t, x, q, r)

        solution = scipy.integrate.solve_ivp(
            rates, (t, stop), x, events=[e for _, e in watched], dense_output=True,
            max_step=max((stop - t) * 12 / self.limits.looks, 1e-3), **TIGHT,
        )  # fmt: skip
        if solution.status < 0 or not np.all(np.abs(solution.y[:, -1]) < 1e2):
            raise Delicate("it grows without bounds")
        hits = [k for (k, _), found in zip(watched, solution.t_events, strict=True) if len(found)]
        times = np.linspace(t, solution.t[-1], self.limits.looks)
        looks = np.array([self.guards(s, solution.sol(s), q, r) for s in times])
        for k, _ in watched:
            size = np.abs(looks[:, k])
            turns = (size[1:-1] < size[:-2]) & (size[1:-1] < size[2:]) & (size[1:-1] < self.limits.near)
            changes = np.sum(np.diff(np.sign(looks[2:-1, k])) != 0)
            if turns.any() or changes:
                raise Delicate(f"condition {k} is grazed")
        return (hits[0] if hits else None), solution

    def _ticked(self, t, x, q, r) -> np.ndarray:
        """The discrete variables after all clocks that tick now; each reads what was before."""
        new, place = q.copy(), {s: k for k, s in enumerate(self.system.discretes)}
        for clock, (targets, values) in zip(self.system.clocks, self.writes[len(self.system.rules) :], strict=True):
            if abs(t / clock.period - round(t / clock.period)) < 1e-9:
                for s, value in zip(targets, values(t, x, q, r), strict=True):
                    new[place[s]] = value
        return new

    def _settled(self, t, x, q, r, holds, crossed):
        """What follows at this instant, one event after another, beginning with the condition that has `crossed`."""
        rules = len(self.system.rules)
        if crossed is not None and abs(self.slopes(t, x, q, r)[crossed]) < self.limits.crossing:
            raise Delicate(f"condition {crossed} is hardly crossed")
        fired = None
        if crossed is not None and crossed >= rules:
            r = r.copy()
            r[crossed - rules] = 1.0 - r[crossed - rules]
        elif crossed is not None and not holds[crossed]:
            fired = crossed
        for _ in range(10):
            if fired is not None:
                x, q = self._fired(fired, t, x, q, r)
            values, slopes = (np.array(f(t, x, q, r)) for f in (self.guards, self.slopes))
            above = values[rules:] > 0
            for k in np.flatnonzero(np.abs(values) < self.limits.near):
                # Only the one that has crossed may be at zero: what it does next decides.
                if k != crossed or abs(values[k]) > 1e-8 or abs(slopes[k]) < self.limits.crossing:
                    raise Delicate(f"condition {k} is zero beside another")
                values[k] = slopes[k]
                if k >= rules:
                    above[k - rules] = slopes[k] > 0
            if crossed is not None and crossed >= rules and above[crossed - rules] != (r[crossed - rules] > 0):
                raise Delicate(f"relation {crossed - rules} is pushed back from both sides")
            true = self._true(values[:rules], q)
            new = true & ~holds
            if fired is not None:
                new[fired] = False
                holds = holds | (np.arange(rules) == fired)
            holds = holds & true
            switched = above != (r > 0)
            if new.sum() + switched.sum() > 1:
                raise Delicate("two events follow at once")
            r = above.astype(float)
            fired = int(np.flatnonzero(new)[0]) if new.any() else None
            if fired is None and not switched.any():
                return x, q, r, holds
        raise Delicate("events follow each other without end")

    def _fired(self, rule: int, t, x, q, r):
        """States and discrete variables after a rule's event."""
        place = {s: k for k, s in enumerate([*self.system.states, *self.system.discretes])}
        targets, values = self.writes[rule]
        both = np.concatenate([x, q])
        for s, value in zip(targets, values(t, x, q, r), strict=True):
            both[place[s]] = value
        return both[: len(x)], both[len(x) :]

    # --- readings ----------------------------------------------------------------------------------------------------

    def read(self, run: Run, ts: np.ndarray) -> dict[Symbol, np.ndarray]:
        """All variables at the times; at an instant, what holds after it."""
        system = self.system
        begins = np.array([begin for begin, *_ in run.segments])
        readings = self._compiled(list(self.solved.values()))
        rows = []
        for t in ts:
            _, sol, q, r = run.segments[int(np.searchsorted(begins, t, side="right")) - 1]
            x = sol(t)
            rows.append([*x, *q, *readings(t, x, q, r)])
        names = [*system.states, *system.discretes, *system.readings]
        return dict(zip(names, np.array(rows, float).T, strict=True))
