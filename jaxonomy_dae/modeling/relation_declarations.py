"""Relations in a component's equations whose changes are events: declared, or found when the component is complete."""

from typing import Any

import sympy
from sympy.logic.boolalg import BooleanAtom

from ..expressions.to_sympy import shortened
from .automatic_events import Stepping, Turning, turned, with_events
from .event_declarations import EventDeclarations
from .events import LIVE, Assign, Sampled
from .symbols import PreviousSymbol, RelationSymbol


class RelationDeclarations(EventDeclarations):
    """The part of `Component` that concerns relations."""

    relations: list[float]  # the starts of discrete variables that are not shown
    as_written: dict[sympy.Expr, sympy.Expr]  # of equations in which relations are events

    def relation(self, condition: Any, edges: tuple[Sampled, Any, Sampled, Any] | None = None) -> Any:
        """A condition for `Piecewise` whose changes are events: steps end where it turns, on either side equations see
        it as it is there, and derivatives know that the time of the change moves. Conditions in `Piecewise` become such
        by themselves; this one can be given to several equations, and the clocks of a periodic one be said.

        ```python
        self.output("y", Piecewise((h, self.relation(ev.t >= start)), (0, True)))
        ```

        **Arguments:**

        - `condition`: as in `when`, without clocks.
        - `edges`: for a condition that turns periodically, `(up, 1, down, 0)`: two clocks, and what the condition
            becomes when they tick, expressions in parameters. It is then not watched otherwise.

        **Raises:**

        - `ModelError` for what is not a condition.
        """
        if isinstance(condition, BooleanAtom | bool):
            return condition
        known = self._hidden_discrete(float(LIVE))
        unknown: Any = sympy.Eq(known, LIVE)
        self._turns(Turning(known.number, condition, sympy.true if edges is None else unknown))
        if edges is not None:
            for clock, value in (edges[:2], edges[2:]):
                self._event(clock, (Assign(known, sympy.sympify(value)),), None, False, noted=False)
        return turned(known.number, condition)

    def _hidden_discrete(self, start: float) -> RelationSymbol:
        """Declares a discrete variable that is not shown."""
        self.relations.append(start)
        return RelationSymbol(len(self.relations) - 1)

    def _with_events(self) -> None:
        """Makes events of the relations in all equations that were written."""
        new, watched = with_events(tuple(self.equations), len(self.relations))
        if not watched:
            return
        self.as_written = {n: e for n, e in zip(new, self.equations, strict=True) if n is not e}
        self.equations[:] = new
        for each in watched:
            self.relations.extend(each.starts)
        for each in watched:
            if isinstance(each, Turning):
                self._turns(each)
            else:
                self._steps(each)

    def _turns(self, relation: Turning) -> None:
        known, condition = RelationSymbol(relation.number), relation.condition
        for holds, value in ((condition, 1), (sympy.Not(condition), 0)):
            self._relation_event(holds, shortened(condition), relation.watched, Assign(known, sympy.Integer(value)))

    def _steps(self, whole: Stepping) -> None:
        """Events of a whole part. One may leave more than one number behind at an instant, where the argument jumps."""
        live, known = RelationSymbol(whole.number), RelationSymbol(whole.number + 1)
        before, now = PreviousSymbol(known.path), sympy.floor(whole.argument)
        unknown: Any = sympy.Eq(live, LIVE)
        found: Any = sympy.Ne(live, LIVE)
        text, watched = shortened(now), whole.watched
        self._relation_event(unknown, text, watched, Assign(live, sympy.Integer(0)), Assign(known, now))
        for condition, value in (
            (sympy.Ge(whole.argument, known + 1, evaluate=False), sympy.Max(before + 1, now)),
            (sympy.Lt(whole.argument, known, evaluate=False), sympy.Min(before - 1, now)),
        ):
            self._relation_event(condition, text, sympy.And(found, watched), Assign(known, value))

    def _relation_event(self, condition: Any, text: str, watched: Any, *actions: Assign) -> None:
        self._event(condition, actions, None, True, False, True, text, True, watched)
