"""Relations in equations whose changes are events, found and written as such.

`Piecewise`, `Max`, `Min`, `Abs`, `sign`, `Heaviside`, `floor`, `ceiling`, `frac` and `Mod` of what changes in time
become branches on discrete variables, which are as the relation says until an event has set them. What stands in
`smooth(...)` is left alone.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import sympy

from ..base.aliases import Condition, Expression
from ..base.errors import ModelError
from ..graph.expressions.branches import ALWAYS, NEVER, Needed, union, within
from ..graph.expressions.from_sympy import UnsupportedExpression, parts_of, symbols_of
from ..graph.expressions.node import postorder
from ..graph.expressions.smooth import Smooth
from .choices import by_conditions
from .events import LIVE, has_guard
from .symbols import RelationSymbol, TimeSymbol, VariableSymbol
from .timed_relations import Edges, edges_of, in_relations_of_time, relations_in, whole_edges

ROUNDING = (sympy.floor, sympy.ceiling, sympy.frac, sympy.Mod)
KINKED = (sympy.Max, sympy.Min, sympy.Abs, sympy.sign, sympy.Heaviside, *ROUNDING)


def smooth(expression: object) -> Expression:
    """Marks an expression so that its relations do not become events. Use it for kinks whose effect does not justify
    the extra steps, and for branches that agree where they meet, such as a series near a point and a formula elsewhere.

    ```python
    self.add_equations(Eq(q, smooth(Max(u, 0)) * k))
    ```

    The solver then takes small steps across kinks, and derivatives ignore the shift of a jump in time.

    **Raises:**

    - `ModelError` if the argument is not an expression.
    """
    found = sympy.sympify(expression)
    if isinstance(expression, str) or not isinstance(found, sympy.Expr):
        raise ModelError(f"smooth takes an expression; got {expression!r}: write smooth(Max(u, 0)), for instance")
    return found if isinstance(found, sympy.Symbol) else Smooth(found)


@dataclasses.dataclass(frozen=True)
class Turning:
    """A condition whose truth becomes the hidden discrete variable `number`: 1, 0, or LIVE (decided by its sides).

    It turns at times that are known beforehand, `when` is then their `Edges`; or while a condition holds, `when`. It is
    a `kink` if both branches have the same value where it turns.
    """

    number: int
    condition: Condition
    when: Condition | Edges
    kink: bool = False
    starts: ClassVar = (float(LIVE),)  # of the hidden discrete variables


@dataclasses.dataclass(frozen=True)
class Stepping:
    """The whole part of an argument as a hidden discrete variable: `number` is LIVE until an event has set variable
    `number` + 1 to the whole part. It changes at times that are known beforehand, or while a condition holds: `when`,
    as that of `Turning`."""

    number: int
    argument: Expression
    when: Condition | Edges
    starts: ClassVar = (float(LIVE), 0.0)


Watched = Turning | Stepping


class Splitting:
    """Replaces the relations in conditions that turn at known times by hidden discrete variables, each relation once.
    Numbers count from `first`."""

    def __init__(self, first: int):
        self.next = first
        self.timed: dict[Condition, Turning] = {}

    def split(self, condition: Condition) -> tuple[Condition, Condition]:
        """Returns (the condition for equations, the condition for guards), with relations that turn at known times
        replaced by hidden discrete variables."""
        simple = in_relations_of_time(condition)
        found = [r for r in relations_in(simple) if self._is_timed(r)]
        if not found:
            return condition, condition
        numbers = {r: self.timed[r].number for r in found}
        known: dict[Condition, Condition] = {r: sympy.Eq(RelationSymbol(n), 1) for r, n in numbers.items()}
        return _replaced(simple, {r: turned(n, r) for r, n in numbers.items()}), _replaced(simple, known)

    def _is_timed(self, relation: Condition) -> bool:
        if relation not in self.timed:
            edges = edges_of(relation)
            if edges is None:
                return False
            self.timed[relation] = Turning(self.next, relation, edges)
            self.next += 1
        return True


def _replaced(condition: Condition, forms: dict[Condition, Condition]) -> Condition:
    """The condition with relations replaced by other expressions."""
    if condition in forms:
        return forms[condition]
    if isinstance(condition, sympy.And | sympy.Or | sympy.Not):
        return condition.func(*(_replaced(part, forms) for part in condition.args))
    return condition


def varies(condition: Condition) -> bool:
    """True if the truth of a condition can change between events: some symbol in it moves."""
    return any(_moves(s) for s in symbols_of(condition))


def turned(number: int, condition: Condition) -> Condition:
    """The condition in terms of the hidden discrete variable that holds its truth."""
    known = RelationSymbol(number)
    holds: Condition = sympy.Eq(known, 1)
    unknown: Condition = sympy.Eq(known, LIVE)
    return sympy.Or(holds, sympy.And(unknown, condition))


def jumps(e: Expression) -> bool:
    """True if an expression has a part that may jump while its symbols do not, and is not marked as smooth."""
    order = _inside_out([e])
    varying = _varying(order)
    return any(isinstance(part, (sympy.Piecewise, sympy.sign, sympy.Heaviside, *ROUNDING)) for part in varying)


@functools.lru_cache(maxsize=4096)  # large models write the same few equations
def with_events(residuals: tuple[sympy.Expr, ...], first: int) -> tuple[tuple[sympy.Expr, ...], tuple[Watched, ...]]:
    """Replaces relations in equations by hidden discrete variables, numbered from `first`. Returns (equations, the
    events that set the variables). Equations that events read stay as they are."""
    residuals = tuple(r if _is_hidden(r) else _with_marks(r) for r in residuals)
    order = _inside_out([r for r in residuals if not _is_hidden(r)])
    varying = _varying(order)
    if not any(isinstance(e, (sympy.Piecewise, *KINKED)) and e in varying for e in order):
        return residuals, ()
    return _Rewriting(residuals, order, varying, first).done()


class _Rewriting:
    """Rewrites all parts of equations, inner ones first, and keeps their new forms."""

    def __init__(
        self, residuals: tuple[sympy.Expr, ...], order: list[Expression], varying: set[Expression], first: int
    ):
        self.residuals, self.order, self.varying = residuals, order, varying
        self.numbers = Splitting(first)
        inside = set(order)
        self.needed = _needed_where([r for r in residuals if r in inside], order)
        self.new: dict[Expression, Expression] = {}
        self.old: dict[Expression, Expression] = {}  # the other way round
        self.timed_steps: list[Stepping] = []
        self.conditions: dict[Condition, Condition] = {}
        # (kind, number, condition or argument, the expressions that it stands in)
        self.found: list[tuple[type, int, Expression, list[Expression]]] = []
        self.places: dict[Expression, list[Expression]] = {}  # of a condition, the same list
        # of a relation of time: the places of all conditions that it is in
        self.timed_places: dict[Expression, list[list[Expression]]] = {}

    def done(self) -> tuple[tuple[sympy.Expr, ...], tuple[Watched, ...]]:
        for e in self.order:
            self.new[e] = self._written(e)
            self.old[self.new[e]] = e

        watched = tuple(self._watched(*each) for each in self.found)
        turning = (
            dataclasses.replace(each, kink=all(_is_continuous(e) for places in self.timed_places[r] for e in places))
            for r, each in self.numbers.timed.items()
        )
        timed = (*turning, *self.timed_steps)
        in_order = tuple(sorted((*watched, *timed), key=lambda w: w.number))
        return tuple(self.new.get(r, r) for r in self.residuals), in_order

    def _watched(self, kind: type, number: int, watched: Expression, places: list[Expression]) -> Turning | Stepping:
        where = _holding(functools.reduce(union, (self.needed[e] for e in places)), self.conditions.__getitem__)
        if kind is Stepping:
            return Stepping(number, watched, where)
        # A guard inside a branch is not monitored while the branch is off, and may have turned before.
        return Turning(number, watched, where, where is sympy.true and all(map(_is_continuous, places)))

    def _written(self, e: Expression) -> Expression:
        if isinstance(e, sympy.Piecewise):
            return self._piecewise(e)
        if not e.args or isinstance(e, Smooth):
            return e
        inside = [self.new[a] for a in e.args]
        if _has_an_end(e) and not e.args[0].is_number:
            inside[0] = self._within_domain(e, inside[0])
        if isinstance(e, KINKED) and e in self.varying:
            return _FORMS[type(e)](functools.partial(self._turns, [e]), functools.partial(self._stepping, e), *inside)
        if all(new is old for new, old in zip(inside, e.args, strict=True)):
            return e
        return e.func(*inside)

    def _piecewise(self, e: Expression) -> Expression:
        pairs = []
        for branch, condition in e.args:
            if condition not in self.conditions:
                self.places[condition] = [e]
                inside = {r: r.func(*(self.new[a] for a in r.args), evaluate=False) for r in _sides_of(condition)}
                self.conditions[condition] = (
                    self._turning(self.places[condition], condition, inside) if _can_turn(condition) else condition
                )
            else:
                self.places[condition].append(e)
            pairs.append((self.new[branch], self.conditions[condition]))
        return by_conditions(*pairs)

    def _within_domain(self, e: Expression, argument: Expression) -> Expression:
        """The argument of a root or the like where a branch is kept beyond its end, and the function may have no value:
        brought back, unless it has none as the equations were written either."""
        live = e.args[0]
        turns = any(_can_turn(c) for part in self.needed[e] for c, _ in part)
        if argument is live and not (turns and live in self.varying):
            return argument
        low, high = _DOMAINS.get(type(e), (0, None))
        # Mirrored at zero, not cut off there, where a logarithm has no value and a root no slope.
        mirrored, outside = (-argument if low == 0 else sympy.Integer(low)), sympy.Lt(live, low)
        back: Expression = argument
        if high is not None:
            outside = sympy.Or(outside, sympy.Gt(live, high))
            back = by_conditions((back, sympy.Le(argument, high, evaluate=False)), (high, True))
        back = by_conditions((back, sympy.Ge(argument, low, evaluate=False)), (mirrored, True))
        written_so = sympy.And(_holding(self.needed[e], lambda c: c), outside)
        return back if written_so is sympy.false else by_conditions((live, written_so), (back, True))

    def _turns(self, places: list[Expression], relation: Condition) -> Condition:
        """`_turning` for a relation whose sides are in their new forms."""
        written = relation.func(*(self.old.get(side, side) for side in relation.args), evaluate=False)
        return self._turning(places, written, {written: relation})

    def _turning(
        self, places: list[Expression], condition: Condition, inside: dict[Expression, Expression]
    ) -> Condition:
        """The condition, as it is written, in terms of hidden discrete variables; `inside` has its relations with sides
        in their new forms. The variables that it needs are noted, to be declared later."""
        live, guarded = self.numbers.split(condition)
        for r in relations_in(in_relations_of_time(condition)):
            self.timed_places.setdefault(r, []).append(places)
        if not varies(guarded):
            return live
        # The guard uses the discrete variables of relations of time and of relations inside its sides: it jumps at
        # their events, and moves with them. Equations use the plain relations: they are evaluated outside of runs, too.
        forms = dict(inside)
        if not isinstance(condition, sympy.core.relational.Relational):
            # Of two sides that jump onto each other, the kind of their own relation decides.
            for r in (r for r in relations_in(guarded) if r in inside and any(map(jumps, r.args))):
                own = self._numbers(1)
                self.found.append((Turning, own, inside[r], places))
                forms[r] = sympy.Eq(RelationSymbol(own), 1)
        number = self._numbers(1)
        self.found.append((Turning, number, _replaced(guarded, forms), places))
        return turned(number, condition)

    def _numbers(self, count: int) -> int:
        """The first of so many numbers of hidden discrete variables."""
        first = self.numbers.next
        self.numbers.next += count
        return first

    def _stepping(self, e: Expression, argument: Expression) -> Expression:
        """The whole part of an argument in the expression e, as a discrete variable."""
        number = self._numbers(2)
        live, whole = RelationSymbol(number), RelationSymbol(number + 1)
        edges = whole_edges(argument)
        if edges is None:
            self.found.append((Stepping, number, argument, [e]))
        else:
            self.timed_steps.append(Stepping(number, argument, edges))
        unknown: Condition = sympy.Eq(live, LIVE)
        return by_conditions((sympy.floor(argument), unknown), (whole, True))


def _holding(needed: Needed, form: Callable[[Expression], Expression]) -> Condition:
    """The condition under which a part is needed, with conditions in some form."""
    if needed == ALWAYS:
        return sympy.true
    parts: list[Condition] = [
        sympy.And(*(form(c) if holds else sympy.Not(form(c)) for c, holds in part)) for part in needed
    ]
    return sympy.Or(*parts)


_DOMAINS: dict[type, tuple[int, int]] = {sympy.asin: (-1, 1), sympy.acos: (-1, 1)}


def _has_an_end(e: Expression) -> bool:
    """True for functions that are defined on a part of the real numbers only: log, asin and acos of their argument, and
    powers with an exponent that is not an integer."""
    return isinstance(e, (sympy.log, sympy.asin, sympy.acos)) or (isinstance(e, sympy.Pow) and not e.exp.is_integer)


Turn = Callable[[Any], Any]


def _larger(turn: Turn, _: Turn, *arguments: Expression) -> Expression:
    return functools.reduce(lambda a, b: _chosen(turn, a, b, sympy.Ge), arguments)


def _smaller(turn: Turn, _: Turn, *arguments: Expression) -> Expression:
    return functools.reduce(lambda a, b: _chosen(turn, a, b, sympy.Le), arguments)


def _chosen(turn: Turn, a: Expression, b: Expression, relation: Callable[..., Condition]) -> Expression:
    if a.is_number:
        a, b = b, a
    condition = relation(a, b, evaluate=False)
    return by_conditions((a, turn(condition) if varies(condition) else condition), (b, True))


def _absolute(turn: Turn, _: Turn, u: Expression) -> Expression:
    return by_conditions((u, turn(sympy.Ge(u, 0, evaluate=False))), (-u, True))


def _by_sign(turn: Turn, u: Expression, above: Expression, at_zero: Expression, below: Expression) -> Expression:
    """Branches for u > 0, u = 0 and u < 0: at zero a solution may stay."""
    positive, negative = (turn(relation(u, 0, evaluate=False)) for relation in (sympy.Gt, sympy.Lt))
    return by_conditions((above, positive), (below, negative), (at_zero, True))


def _sign(turn: Turn, _: Turn, u: Expression) -> Expression:
    return _by_sign(turn, u, sympy.Integer(1), sympy.Integer(0), sympy.Integer(-1))


def _heaviside(turn: Turn, _: Turn, u: Expression, at_zero: Expression) -> Expression:
    return _by_sign(turn, u, sympy.Integer(1), at_zero, sympy.Integer(0))


_FORMS: dict[type, Callable[..., Expression]] = {
    sympy.Max: _larger,
    sympy.Min: _smaller,
    sympy.Abs: _absolute,
    sympy.sign: _sign,
    sympy.Heaviside: _heaviside,
    sympy.floor: lambda turn, step, u: step(u),
    sympy.ceiling: lambda turn, step, u: -step(-u),
    sympy.frac: lambda turn, step, u: u - step(u),
    sympy.Mod: lambda turn, step, a, b: a - b * step(a / b),
}


def relations_left_alone(residual: sympy.Expr) -> tuple[Expression, ...]:
    """The parts of an equation that change with relations which do not become events: it is smooth there, or was
    declared to be."""
    if _is_hidden(residual):
        return ()
    order = _inside_out([_with_marks(residual)])
    found = [e.args[0] for e in order if isinstance(e, Smooth)]
    kinked = (sympy.Piecewise, *KINKED)
    return tuple(Smooth(e) for e in found if any(isinstance(p, kinked) for p in _varying(_inside_out([e]))))


@functools.lru_cache(maxsize=4096)
def _with_marks(residual: sympy.Expr) -> sympy.Expr:
    """The equation with marks of smoothness on those parts whose branches meet with the same value and slope, as those
    of q·|q|. A jump inside a condition gets none, even if the condition is the same on both sides of it: it may jump
    onto the border of a relation, where the relation's kind decides."""
    order = _inside_out([residual])
    conditions = [c for e in order if isinstance(e, sympy.Piecewise) for _, c in _pairs(e)]
    in_conditions = set(_inside_out([side for c in conditions for r in _sides_of(c) for side in r.args]))
    varying = _varying(order)
    kinks = [e for e in order if e in varying and isinstance(e, (sympy.Piecewise, *KINKED))]
    marks = {}
    for e in kinks:
        alone = not any(inner in kinks for inner in _inside_out([e]) if inner is not e)
        parts = _two_branches(e) if alone else None
        if parts is None or (e in in_conditions and not _is_continuous(e)):
            continue
        one, other, where = parts
        # In the whole equation, since a factor beside a kink may vanish where it turns: q·|q| has none.
        whole: Expression = residual
        if _meet_smoothly(whole.xreplace({e: one}) - whole.xreplace({e: other}), where):
            marks[e] = Smooth(e)
    out: Expression = residual.xreplace(marks)
    return out


def _two_branches(e: Expression) -> tuple[Expression, Expression, Expression] | None:
    """Splits an expression with one relation into (first branch, second branch, difference that is zero where they
    meet); None for other expressions."""
    if isinstance(e, sympy.Abs):
        return e.args[0], -e.args[0], e.args[0]
    if isinstance(e, sympy.sign | sympy.Heaviside):
        return sympy.Integer(1), sympy.Integer(-1 if isinstance(e, sympy.sign) else 0), e.args[0]
    if isinstance(e, sympy.Max | sympy.Min) and len(e.args) == 2:
        a, b = _untyped(e)
        return a, b, a - b
    if isinstance(e, sympy.Piecewise) and len(e.args) == 2:
        (first, condition), (second, otherwise) = _pairs(e)
        if otherwise == True and isinstance(condition, sympy.core.relational._Inequality):  # noqa: E712
            left, right = _untyped(condition)
            return first, second, left - right
    return None


def _is_continuous(e: Expression) -> bool:
    """True if the expression has the same value on both sides of its relation, as Max, Min and Abs have."""
    if isinstance(e, sympy.Max | sympy.Min | sympy.Abs):
        return True
    parts = _two_branches(e)
    if parts is None:
        return False
    clock = {s: sympy.Dummy() for s in symbols_of(parts[2]) if isinstance(s, TimeSymbol)}  # to be solved for
    one, other, where = (part.xreplace(clock) for part in parts)
    return _vanish_on(where, lambda _: (one - other,))


def _meet_smoothly(difference: Expression, surface: Expression) -> bool:
    """True if `difference` and its derivative vanish wherever `surface` does."""
    return _vanish_on(surface, lambda v: (difference, sympy.diff(difference, v)))


def _vanish_on(surface: Expression, expressions_in: Callable[[Expression], tuple[Expression, ...]]) -> bool:
    """True if all expressions vanish wherever `surface` is zero. The surface is solved for a variable `v` that it
    contains linearly, and `expressions_in(v)` is evaluated there; False if there is no such variable."""
    for v in sorted((s for s in symbols_of(surface) if isinstance(s, VariableSymbol | sympy.Dummy)), key=str):
        slope = sympy.diff(surface, v)
        if slope.is_number and slope.is_nonzero:
            place, differences = {v: v - surface / slope}, expressions_in(v)
            if any(d.has(sympy.Derivative, sympy.Subs) for d in differences):
                return False  # inside what jumps, which SymPy does not differentiate
            # What `expand` does not see to be zero gets an event that it may not need: that costs a step, and is right.
            return all(sympy.expand(d.xreplace(place)) == 0 for d in differences)
    return False


def _is_hidden(residual: sympy.Expr) -> bool:
    """True if the residual defines what events read. Sides of conditions of their own have events themselves."""
    return any(isinstance(s, VariableSymbol) and s.path.startswith((":when", ":held")) for s in symbols_of(residual))


def _inside_out(roots: Sequence[Expression]) -> list[Expression]:
    """The parts of expressions, each once, inner ones first. Parts marked as smooth are left out."""
    return postorder(roots, lambda e: reversed(_arguments(e)))


def _untyped(e: Expression) -> tuple[Expression, ...]:
    """The arguments of an expression. SymPy's stubs declare them with a narrower type."""
    return e.args


def _pairs(e: Expression) -> tuple[tuple[Expression, Expression], ...]:
    """The branches of a `Piecewise` with their conditions."""
    return e.args


def _arguments(e: Expression) -> list[Expression]:
    if isinstance(e, Smooth):
        return []
    if isinstance(e, sympy.Piecewise):
        sides = [a for _, condition in _pairs(e) for r in _sides_of(condition) for a in r.args]
        return [*(branch for branch, _ in _pairs(e)), *sides]
    try:
        return list(parts_of(e))
    except UnsupportedExpression:  # refused when the equation is read
        return []


def _sides_of(condition: Condition) -> list[Expression]:
    """The relations whose sides are parts of an expression: those of a condition that can become an event."""
    return relations_in(condition) if _can_turn(condition) else []


def _varying(order: list[Expression]) -> set[Expression]:
    """The parts of an expression whose value can change with time."""
    out: set[Expression] = set()
    for e in order:
        conditions = (c for _, c in _pairs(e)) if isinstance(e, sympy.Piecewise) else ()
        if _moves(e) or any(a in out for a in _arguments(e)) or any(varies(c) for c in conditions):
            out.add(e)
    return out


def _moves(symbol: Expression) -> bool:
    return isinstance(symbol, VariableSymbol | TimeSymbol)


def _can_turn(condition: Condition) -> bool:
    """True if a condition can become an event: it varies between events, contains no event's relation yet, and a guard
    can be made both of it and of its negation."""
    if not varies(condition) or any(isinstance(s, RelationSymbol) for s in symbols_of(condition)):
        return False  # constant between events; or an event already
    return has_guard(condition) and has_guard(sympy.Not(condition))


def _needed_where(roots: Sequence[Expression], order: list[Expression]) -> dict[Expression, Needed]:
    """The conditions under which the value of each part reaches an equation."""
    needed: dict[Expression, Needed] = {e: NEVER for e in order} | {root: ALWAYS for root in roots}
    for e in reversed(order):
        # Outer parts first, in reverse order: where a part is needed is known when all that contain it have been
        # passed.
        here = needed[e]
        if not isinstance(e, sympy.Piecewise):
            for a in _arguments(e):
                needed[a] = union(needed[a], here)
            continue
        for branch, condition in _pairs(e):
            for a in (a for r in _sides_of(condition) for a in r.args):
                needed[a] = union(needed[a], here)
            # A branch is taken where its own condition holds and none before it does.
            taken = here
            if condition is not sympy.true:
                taken, here = within(here, (condition, True)), within(here, (condition, False))
            needed[branch] = union(needed[branch], taken)
    return needed
