"""The discrete equations of a component as one map, which events repeat at an instant until nothing changes.

Given are m = F(m, pre(m), y), an equation for each discrete variable m that is kept, in the present values of all
others and in continuous variables y, which follow m by the other equations. At an instant

- m becomes F(m, pre(m), y), while pre(m) is held, until m = F(m, pre(m), y);
- then, if m differs from pre(m), pre(m) becomes m, and all begins again.

This is the event iteration of the Modelica Language Specification 3.6, Appendix B. Both are events here, so that
relations which depend on m turn in between, and derivatives pass through them as through all events. Equations are
sorted: what one of them reads is the new value of another one.

A `when` is a part of the equations of what it assigns: m is the value in its body where its condition is true and was
not in the iteration before, and pre(m) otherwise (sections 8.3.5 and 11.2.7).
"""

import functools
import graphlib
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, Protocol

import sympy

from ..base.aliases import Condition, Expression
from ..base.errors import ModelError
from ..graph.expressions.to_sympy import shortened
from .choices import by_conditions, exchanged
from .events import NO_FLAG, Action, Assign, EventFlag, Reinit, Sampled, Terminate, pre
from .kept_relations import Following, KeptRelations
from .symbols import DiscreteSymbol, VariableSymbol
from .truths import Truth, as_number, both, either, negated, plain

# What two evaluations of one number at one instant may differ by, in parts of it: states are followed over a delay
# that is rounding between them.
SAME = sympy.Float(1e-10)
# How far the initial time is: before the first iteration, in the first one, and from the second one on.
STARTING, AT_FIRST, STARTED = 2, 1, 0
BEFORE = ":pre("  # begins the name of the variable that has another one's value in the iteration before


class Declaring(Following, Protocol):
    """What a component does for its discrete equations."""

    def _unshown(self, name: str, start: float) -> DiscreteSymbol: ...

    def _event(
        self, condition: Any, actions: tuple[Action, ...], on: Any, flags: EventFlag, text: str | None = None
    ) -> None: ...

    def _hidden(self, name: str, expression: sympy.Expr) -> str: ...


class Branch(NamedTuple):
    """A branch of a `when`: `acts` is true in the iteration in which its body holds; `text` is its condition, "" if it
    is that of clocks alone."""

    acts: Condition
    text: str


class DiscreteEquations:
    """The discrete equations of a component, gathered one by one and written at the end.

    - `kept`: relations whose truth is kept between events; those of `quiet` are not.
    - `values`: the new value of each variable that is kept, in present values; `always`: those whose value may change
      without a `when`; `reals`: those that are compared within rounding.
    - `remembered`: variables of which equations read what they were before, and which other events assign.
    - `initial`: the discrete variable that says how far the initial time is; None if nothing asks for it.
    - `initially`: what variables are in the first iteration, where it is not known beforehand.
    - `ticks`: the discrete variables that are 1 in the iteration in which a clock ticks, by the clock.
    """

    def __init__(self, component: Declaring, quiet: Collection[Condition] = ()):
        self.component, self.kept = component, KeptRelations(component, quiet)
        self.values: dict[str, Truth] = {}
        self.always: set[str] = set()
        self.reals: set[str] = set()
        self.remembered: list[DiscreteSymbol] = []
        self.initial: DiscreteSymbol | None = None
        self.initially: dict[DiscreteSymbol, Truth] = {}
        self.ticks: dict[Sampled, DiscreteSymbol] = {}
        self._sampled: dict[tuple[Sampled, Expression], DiscreteSymbol] = {}
        self._before: set[str] = set()
        self._hidden: dict[VariableSymbol, Expression] = {}
        self._conditions: list[tuple[VariableSymbol, DiscreteSymbol]] = []
        self._branches: list[Branch] = []
        self._reinits: dict[VariableSymbol, list[tuple[Condition, Truth]]] = {}
        self._ends: list[tuple[Condition, str]] = []

    # --- what equations read -----------------------------------------------------------------------------------------

    def before(self, name: str) -> DiscreteSymbol:
        """A discrete variable in the iteration before."""
        found = f"{BEFORE}{name})"
        if found not in self._before:
            self._before.add(found)
            self.unshown(found, 0.0)
        return DiscreteSymbol(found)

    def unshown(self, name: str, start: float) -> DiscreteSymbol:
        """Declares a discrete variable that is not shown."""
        return self.component._unshown(name, start)

    def phase(self, number: int) -> Condition:
        """The condition that the initial time is so far: `STARTING`, `AT_FIRST` or `STARTED`."""
        if self.initial is None:
            self.initial = self.unshown(":initial", STARTING)
        return sympy.Eq(self.initial, number)

    def tick(self, clock: Sampled) -> Truth:
        """True in the first iteration at a tick, but not at the initial time before it has settled."""
        if clock not in self.ticks:
            tick = self.ticks[clock] = self.unshown(f":tick[{len(self.ticks)}]", 0.0)
            self.component._event(clock, (Assign(tick, sympy.Integer(1)),), None, NO_FLAG)
        return both(sympy.Eq(self.ticks[clock], 1), self.phase(STARTED))

    def clock_of(self, conditions: Sequence[Truth]) -> Sampled | None:
        """The clock at whose ticks alone one of some conditions becomes true; None if there are several or others."""
        found = [c for c, tick in self.ticks.items() if any(tick in sympy.sympify(t).free_symbols for t in conditions)]
        return found[0] if len(found) == 1 and all(map(self._is_tick, conditions)) else None

    def at_ticks(self, clock: Sampled, value: Expression) -> DiscreteSymbol:
        """A value as it is before anything happens at a tick, and at the initial time when that has settled."""
        if (clock, value) not in self._sampled:
            self.tick(clock)
            before = self._sampled[clock, value] = self.unshown(f":sampled[{len(self._sampled)}]", 0.0)
            # Events of one instant all read the values before it.
            self.component._event(clock, (Assign(before, self.kept.in_discrete(value)),), None, NO_FLAG)
        return self._sampled[clock, value]

    # --- what is gathered --------------------------------------------------------------------------------------------

    def give(self, name: str, value: Truth, always: bool = False) -> None:
        """Says what a variable becomes."""
        if name in self.values:
            raise ModelError(
                f"'{name}' is assigned by two whens, which may happen at one instant: join them by elsewhen, or by if"
            )
        self.values[name] = value
        if always:
            self.always.add(name)

    def branches(self, conditions: list[list[tuple[Truth, bool]]]) -> list[Condition]:
        """When each branch of a `when` acts: one of its conditions becomes true, and those of no branch before do. A
        condition is a pair (truth, whether it counts at the initial time, too)."""
        out: list[Condition] = []
        before: Truth = False
        for entries in conditions:
            rises = functools.reduce(either, (self._rises(*entry) for entry in entries), False)
            acts = self._truth("acts", both(rises, negated(before)))
            before = either(before, acts)
            if not isinstance(acts, bool):
                shown = [self._shown(t) for t, _ in entries if t is not False and not self._is_tick(t)]
                self._branches.append(Branch(acts, " or ".join(shown)))
            out.append(acts)
        return out

    def reinit(self, acts: Condition, state: VariableSymbol, value: Truth) -> None:
        """Starts a state anew at the end of the iteration in which a branch acts."""
        self._reinits.setdefault(state, []).append((acts, value))

    def end(self, acts: Condition, message: str) -> None:
        """Ends the run where a branch acts."""
        self._ends.append((acts, message))

    def _rises(self, truth: Truth, at_start: bool) -> Truth:
        """True in the iteration in which a condition becomes true."""
        if isinstance(truth, bool):
            return False  # it never becomes true
        kept = self.kept.in_discrete(truth)
        if isinstance(kept, bool):
            return False
        started = self.phase(STARTED)
        if self._is_tick(kept):  # true for one iteration: nothing is to be remembered
            return both(kept, started)
        now = self._truth("true", kept)
        was = self.unshown(f":was[{len(self._conditions)}]", 0.0)
        self._conditions.append((next(iter(now.free_symbols)), was))
        rises = both(now, plain(sympy.Eq(was, 0)))
        return rises if at_start else both(rises, started)

    def _is_tick(self, truth: Truth) -> bool:
        """True for a condition that holds at the ticks of clocks only."""
        ticks = {tick: sympy.Integer(0) for tick in self.ticks.values()}
        return isinstance(truth, sympy.Basic) and plain(truth.xreplace(ticks)) is False

    def _truth(self, kind: str, condition: Truth) -> Truth:
        """A condition as a hidden variable that is 1 or 0, so that what is long stands once."""
        if isinstance(condition, bool):
            return condition
        symbol = VariableSymbol(f":when:{kind}[{len(self._hidden)}]")
        self._hidden[symbol] = as_number(condition)
        return sympy.Eq(symbol, 1)

    def share_relations(self) -> None:
        """Lets bodies see the relations that conditions and equations read as these do, when all of them are known."""
        self.values = {n: self.kept.in_bodies(value) for n, value in self.values.items()}
        for cases in self._reinits.values():
            cases[:] = [(acts, self.kept.in_bodies(value)) for acts, value in cases]

    # --- what is written ---------------------------------------------------------------------------------------------

    def write(self) -> None:
        """Adds the events to the component."""
        if not (self.values or self._branches or self.remembered or self.initial is not None or self.ticks):
            return
        new = {DiscreteSymbol(n): VariableSymbol(f":when:new[{n}]") for n in self.values}
        definitions = {new[DiscreteSymbol(n)]: sympy.sympify(as_number(value)) for n, value in self.values.items()}
        definitions |= self._hidden
        first = self.phase(AT_FIRST)
        replaced: dict[sympy.Basic, sympy.Basic] = {
            self.before(s.path): by_conditions((as_number(v), first), (self.before(s.path), sympy.true))
            for s, v in self.initially.items()
        }
        replaced |= new
        definitions = {s: exchanged(e, replaced) for s, e in definitions.items()}
        _check_order(definitions, {v: k.path for k, v in new.items()})
        for symbol, expression in definitions.items():
            self.component._hidden(symbol.path, expression)
        self._write_events(new, replaced)

    def _write_events(self, new: dict[DiscreteSymbol, VariableSymbol], replaced: dict) -> None:
        """The events, in the order in which one waits for another: the start, the equations, the next iteration."""
        c = self.component
        solves = EventFlag.AT_START | EventFlag.REVOCABLE | EventFlag.REPEATED
        names = ", ".join(f"'{s.path}'" for s in new) or "whens"
        starting, started = self.phase(STARTING), negated(self.phase(STARTING))
        initial = self.initial
        assert initial is not None
        # What was before the initial time is the declared start of each variable.
        before = [Assign(self.before(m.path), m) for m in (*new, *self.remembered)]
        c._event(starting, (*before, Assign(initial, sympy.Integer(AT_FIRST))), None, solves, f"start of {names}")
        differs = [self._differs(m, n) for m, n in new.items()]
        pending = self._number("pending", both(started, functools.reduce(either, differs, False)))
        unsettled = pending is not None
        if pending is not None:
            assigned = tuple(Assign(m, n) for m, n in new.items())
            c._event(_is(pending), assigned, None, solves, f"equations of {names}")
        settled = both(started, plain(sympy.Eq(pending, 0))) if unsettled else started
        acts = functools.reduce(either, (b.acts for b in self._branches if b.text), False)
        moves: list[Truth] = [plain(sympy.Ne(new[m], self.before(m.path))) for m in new if m.path in self.always]
        moves += [plain(sympy.Ne(m, self.before(m.path))) for m in self.remembered]
        moves += [plain(sympy.Ne(now, was)) for now, was in self._conditions]
        moves += [plain(sympy.Eq(tick, 1)) for tick in self.ticks.values()]
        goes_on = functools.reduce(either, moves, self.phase(AT_FIRST))
        actions = [
            *(Assign(m, n) for m, n in new.items()),
            *(Assign(self.before(m.path), n) for m, n in new.items()),
            *(Assign(self.before(m.path), m) for m in self.remembered),
            *(Assign(was, now) for now, was in self._conditions),
            *(Assign(tick, _unless(pre(initial), sympy.Integer(0), pre(tick))) for tick in self.ticks.values()),
            *(
                Assign(s, _unless(pre(initial), pre(s), self.kept.in_discrete(v)))
                for (_, v), s in self._sampled.items()
            ),
            Assign(initial, sympy.Integer(STARTED)),
        ]
        # A run ends after the iteration whose body says so: first all other actions of it happen.
        ends = [(self.unshown(f":ends[{k}]", 0.0), text, when) for k, (when, text) in enumerate(self._ends)]
        actions += [Assign(done, as_number(when)) for done, _, when in ends]
        starts = [
            Reinit(x, VariableSymbol(c._hidden(f":when:reinit[{x.path}]", exchanged(_first(cases, x), replaced))))
            for x, cases in self._reinits.items()
        ]
        shown = " or ".join(dict.fromkeys(b.text for b in self._branches if b.text)) or "a tick"
        whens = self._number("happens", both(settled, acts))
        if whens is not None:
            c._event(_is(whens), (*actions, *starts), None, solves | EventFlag.LAST | EventFlag.LISTED, shown)
        quiet = self._number("goes on", both(both(settled, negated(acts)), goes_on))
        if quiet is not None:
            c._event(_is(quiet), (*actions, *starts), None, solves | EventFlag.LAST, f"next iteration of {names}")
        for done, text, _ in ends:
            c._event(sympy.Eq(done, 1), (Terminate(text),), None, EventFlag.LISTED | EventFlag.AT_START, shown)

    def _differs(self, m: DiscreteSymbol, new: VariableSymbol) -> Truth:
        """True while a variable has not the value of its equation."""
        if m.path not in self.reals:
            return sympy.Ne(m, new)
        return sympy.Gt(sympy.Abs(m - new), SAME * (sympy.Abs(m) + sympy.Abs(new)), evaluate=False)

    def _number(self, kind: str, condition: Truth) -> VariableSymbol | None:
        """A hidden variable that is 1 where a condition holds and 0 elsewhere; None where it never does."""
        if isinstance(condition, bool):
            return None
        return VariableSymbol(self.component._hidden(f":when:{kind}", as_number(condition)))

    def _shown(self, truth: Truth) -> str:
        """A condition as the text has it."""
        if not isinstance(truth, sympy.Basic):
            return str(truth)
        names: dict[sympy.Basic, sympy.Basic] = {self.phase(STARTED): sympy.true}
        for clock, tick in self.ticks.items():
            period: Any = sympy.sympify(clock.period)
            names[sympy.Eq(tick, 1)] = sympy.Symbol(f"sampled({f'{float(period):g}' if period.is_number else period})")
        for s in truth.free_symbols:
            if isinstance(s, DiscreteSymbol) and s != self.initial and s not in self.ticks.values():
                names |= dict.fromkeys((sympy.Eq(s, 1), s), sympy.Symbol(str(s).removeprefix(":")))
        return shortened(truth.xreplace(names))


def _is(truth: VariableSymbol) -> Condition:
    """A condition for an event that jumps: it is halfway between the two values of a truth."""
    return sympy.Ge(truth, sympy.Rational(1, 2))


def _unless(initial: Expression, started: Expression, starting: Expression) -> Expression:
    """One value from the time on at which the initial time has settled, and another one before. A tick is over, but for
    one that is not looked at before; what is sampled at the initial time is what it is then."""
    return sympy.Piecewise((started, sympy.Eq(initial, STARTED)), (starting, True), evaluate=False)


def _first(cases: list[tuple[Condition, Truth]], otherwise: Expression) -> Expression:
    """The value of the first case that acts."""
    value = otherwise
    for acts, result in reversed(cases):
        value = by_conditions((as_number(result), acts), (value, sympy.true))
    return sympy.sympify(value)


def _check_order(definitions: dict[VariableSymbol, Expression], names: dict[VariableSymbol, str]) -> None:
    """Raises an error that names the variables whose new values depend on each other."""
    reads = {s: sorted((r for r in e.free_symbols if r in definitions), key=str) for s, e in definitions.items()}
    try:
        tuple(graphlib.TopologicalSorter(reads).static_order())
    except graphlib.CycleError as error:
        # `graphlib` lists a circle from what is read to what reads it, and hidden variables have no name to be shown.
        circle = [names[s] for s in reversed(error.args[1]) if s in names]
        circle = circle if circle[:1] == circle[-1:] else [*circle, *circle[:1]]
        raise ModelError(
            f"at one instant the values of {' → '.join(circle)} depend on each other: let one of them read the value "
            f"before, pre({circle[0]})"
        ) from None
