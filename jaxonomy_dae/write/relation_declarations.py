"""Relations in a component's equations whose changes are events: declared, or found when the component is complete."""

import sympy
from sympy.logic.boolalg import BooleanAtom, to_nnf

from ..base.aliases import Condition, Expression
from ..graph.expressions.to_sympy import shortened
from .automatic_events import Splitting, Stepping, Turning, jumps, turned, varies, with_events
from .event_declarations import EventDeclarations
from .events import LIVE, NO_FLAG, Assign, EventFlag, Sampled, is_of_both_kinds, is_strict
from .symbols import PreviousSymbol, RelationSymbol, VariableSymbol
from .timed_relations import Edges

_ORDERED = (sympy.StrictLessThan, sympy.LessThan, sympy.StrictGreaterThan, sympy.GreaterThan)


class RelationDeclarations(EventDeclarations):
    """The part of `Component` that concerns relations."""

    relations: list[float]  # the starts of discrete variables that are not shown
    as_written: dict[sympy.Expr, sympy.Expr]  # of equations in which relations are events

    def relation(self, condition: Condition) -> Condition:
        """A condition for `Piecewise` whose changes are events: steps end where it turns, on either side equations see
        it as it is there, and derivatives know that the time of the change moves. Conditions in `Piecewise` become such
        by themselves; this one can be given to several equations.

        ```python
        self.output("y", Piecewise((h, self.relation(ev.t >= start)), (0, True)))
        ```

        **Arguments:**

        - `condition`: as in `when`, without clocks.

        **Raises:**

        - `ModelError` for what is not a condition.
        """
        return condition if isinstance(condition, BooleanAtom | bool) else self._followed(condition)[0]

    def _followed(self, condition: Condition) -> tuple[Condition, Condition]:
        """Declares the events of a condition. Returns (the condition as equations see it between events, the truth that
        the last event has left)."""
        numbers = Splitting(len(self.relations))
        live, guarded = numbers.split(condition)
        for each in numbers.timed.values():
            self.relations.extend(each.starts)
            self._turns(each)
        if numbers.timed and not varies(guarded):
            return live, guarded
        known: Condition = self._hidden_discrete(float(LIVE))
        self._turns(Turning(known.number, self._strict_apart(self._without_jumps(guarded)), sympy.true))
        return turned(known.number, condition), sympy.Eq(known, 1)

    def _strict_apart(self, condition: Condition) -> Condition:
        """The condition as one guard can tell it, with relations of one kind.

        Where the guard is zero the condition is that of the relation whose sides are equal, and a guard knows only
        whether all of its relations are strict. So strict ones among others are events of their own.
        """
        return self._strict_alone(condition) if is_of_both_kinds(condition) else condition

    def _strict_alone(self, condition: Condition) -> Condition:
        if isinstance(condition, sympy.Not):
            return self._strict_alone(to_nnf(condition))
        if isinstance(condition, sympy.And | sympy.Or):
            return condition.func(*map(self._strict_alone, condition.args))
        return self._alone(condition) if is_strict(condition) else condition

    def _without_jumps(self, condition: Condition) -> Condition:
        """The condition for a guard that turns where sides jump, as floor(x) does, and moves with these jumps: such a
        side is a variable of its own, whose equation has events as others have.

        Where two sides may jump onto each other, so that the kind of their relation decides, it is an event of its own:
        among several conditions, and where equal sides make it true.
        """
        if isinstance(condition, sympy.And | sympy.Or | sympy.Not):
            return condition.func(*(self._turning_alone(part, self._without_jumps(part)) for part in condition.args))
        if not isinstance(condition, sympy.core.relational.Relational):
            return condition
        sides = [self._as_variable(side) if jumps(side) else side for side in condition.args]
        own = condition.func(*sides, evaluate=False)
        return own if is_strict(condition) else self._turning_alone(condition, own)

    def _turning_alone(self, condition: Condition, own: Condition) -> Condition:
        return own if own == condition or not isinstance(own, _ORDERED) else self._alone(own)

    def _alone(self, relation: Condition) -> Condition:
        """Declares the events of a relation. Returns the truth that the last of them has left."""
        known = self._hidden_discrete(float(LIVE))
        self._turns(Turning(known.number, relation, sympy.true))
        return sympy.Eq(known, 1)

    def _as_variable(self, side: Expression) -> VariableSymbol:
        symbol = self._declare(f":side[{len(self.equations)}]", "event")
        self.equations.append(symbol - side)
        return symbol

    def _hidden_discrete(self, start: float) -> RelationSymbol:
        """Declares a discrete variable that is not shown."""
        self.relations.append(start)
        return RelationSymbol(len(self.relations) - 1)

    def _with_events(self) -> None:
        """Turns the relations in all equations written so far into events."""
        new, watched = with_events(tuple(map(self._as_kept, self.equations)), len(self.relations))
        if not watched and all(n is e for n, e in zip(new, self.equations, strict=True)):
            return
        before, pairs = self.as_written, [*zip(new, self.equations, strict=True)]
        self.as_written = {n: before.get(e, e) for n, e in pairs if n is not e or e in before}
        self.equations[:] = new
        for each in watched:
            self.relations.extend(each.starts)
        for each in watched:
            if isinstance(each, Turning):
                self._turns(each)
            else:
                self._steps(each)

    def _as_kept(self, equation: sympy.Expr) -> sympy.Expr:
        """An equation with those of its relations that discrete equations read as these read them."""
        return equation

    def _turns(self, relation: Turning) -> None:
        """Events of a relation. At the initial time it is as its sides say, unless a clock ticks there."""
        known, condition, edges = RelationSymbol(relation.number), relation.condition, relation.when
        if isinstance(edges, Edges):
            unknown: Condition = sympy.Eq(PreviousSymbol(known.path), LIVE)
            as_it_is = sympy.Piecewise((1, condition), (0, True))
            for clock, after in edges.clocks:
                value = _unless(sympy.Or(unknown, sympy.Not(edges.turns)), as_it_is, after)
                self._relation_event(clock, shortened(condition), Assign(known, value), kink=relation.kink)
            return
        for holds, value in ((condition, 1), (sympy.Not(condition), 0)):
            action = Assign(known, sympy.Integer(value))
            self._relation_event(holds, shortened(condition), action, watched=edges, kink=relation.kink)

    def _steps(self, whole: Stepping) -> None:
        """Events of a whole part. Of time, it is halfway to the next number from the one that it has at a tick. Other
        events may leave more than one number behind at an instant, where the argument jumps."""
        live, known = RelationSymbol(whole.number), RelationSymbol(whole.number + 1)
        now, watched = sympy.floor(whole.argument), whole.when
        text, decided = shortened(now), Assign(live, sympy.Integer(0))
        if isinstance(watched, Edges):
            unknown: Condition = sympy.Eq(PreviousSymbol(live.path), LIVE)
            for clock, rises in watched.clocks:
                after = sympy.floor(whole.argument + rises - sympy.Rational(1, 2))
                value = _unless(sympy.Or(unknown, sympy.Not(watched.turns)), now, after)
                self._relation_event(clock, text, decided, Assign(known, value))
            return
        before = PreviousSymbol(known.path)
        found: Condition = sympy.Ne(live, LIVE)
        self._relation_event(sympy.Eq(live, LIVE), text, decided, Assign(known, now), watched=watched)
        for condition, value in (
            (sympy.Ge(whole.argument, known + 1, evaluate=False), sympy.Max(before + 1, now)),
            (sympy.Lt(whole.argument, known, evaluate=False), sympy.Min(before - 1, now)),
        ):
            self._relation_event(condition, text, Assign(known, value), watched=sympy.And(found, watched))

    def _relation_event(
        self, condition: Condition, text: str, *actions: Assign, watched: Condition = sympy.true, kink: bool = False
    ) -> None:
        flags = EventFlag.RELATION | (EventFlag.KINK if kink else NO_FLAG)
        if not isinstance(condition, Sampled):
            flags |= EventFlag.AT_START | EventFlag.REVOCABLE
        self._event(condition, actions, None, flags, text, watched)


def _unless(condition: Condition, otherwise: Expression, value: Expression) -> Expression:
    return sympy.Piecewise((otherwise, condition), (value, True), evaluate=False)
