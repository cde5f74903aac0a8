"""Relations that discrete equations read: each has one truth at a time, kept in a hidden discrete variable.

Between events the truth is kept, as in Modelica. All modes of an instant see the same truth, also where a quantity
rests at the level, and continuous equations see the one that the modes see.
"""

from collections.abc import Collection
from typing import Protocol

import sympy

from ..base.aliases import Condition, Expression
from ..graph.expressions.from_sympy import symbols_of
from ..graph.expressions.smooth import Smooth
from .automatic_events import ROUNDING, varies
from .choices import exchanged
from .symbols import DiscreteSymbol, VariableSymbol
from .truths import Truth, plain

_ORDER = (sympy.StrictGreaterThan, sympy.GreaterThan, sympy.StrictLessThan, sympy.LessThan)
_JUMPING = (*ROUNDING, sympy.sign, sympy.Heaviside)


class Following(Protocol):
    """What a component does for relations whose truth is kept."""

    def _followed(self, condition: Condition) -> tuple[Condition, Condition]: ...

    def _as_variable(self, side: Expression) -> VariableSymbol: ...


class KeptRelations:
    """The relations of a component whose truth is kept; those of `quiet` are not."""

    def __init__(self, component: Following, quiet: Collection[Condition]):
        self.component, self.quiet = component, quiet
        self.forms: dict[Condition, Condition] = {}
        self.variables: dict[Expression, Expression] = {}

    def in_discrete(self, value: Truth) -> Truth:
        """A value of discrete equations with all its relations replaced by their kept truths."""
        if not isinstance(value, sympy.Basic):
            return value
        found = {r: self._form(r) for r in _outermost(value, _ORDER) if varies(r) and r not in self.quiet}
        return plain(exchanged(value, found)) if found else value

    def in_bodies(self, value: Truth) -> Truth:
        """A value in the body of a `when` with those of its relations replaced that others read, or that turn at times
        known beforehand: the rest is looked at where the body holds only."""
        if not isinstance(value, sympy.Basic):
            return value
        found = {r: self._form(r) for r in _outermost(value, _ORDER) if self._known(r) or _is_of_time(r)}
        return plain(exchanged(value, found)) if found else value

    def in_equations(self, expression: Expression) -> Expression:
        """An expression with relations that discrete equations read replaced by their kept truths."""
        if not self.forms:
            return expression
        found = {r: self._form(r) for r in expression.atoms(*_ORDER) if self._known(r)}
        return exchanged(expression, found) if found else expression

    def with_jumps_as_variables(self, value: Truth) -> Truth:
        """A value with whole parts of what changes in time as variables, whose equations have events as others have."""
        if not isinstance(value, sympy.Basic):
            return value
        for e in _outermost(value, _JUMPING):
            if e not in self.variables and varies(e):
                self.variables[e] = self.component._as_variable(e)
        return exchanged(value, self.variables)

    def _known(self, relation: Condition) -> bool:
        return relation in self.forms or sympy.Not(relation) in self.forms

    def _form(self, relation: Condition) -> Condition:
        # SymPy writes the negation of x < y as x ≥ y. One truth serves both, so that they cannot both hold, nor both
        # fail.
        opposite = sympy.Not(relation)
        if opposite in self.forms:
            return sympy.Not(self.forms[opposite])
        if relation not in self.forms:
            self.forms[relation] = self.component._followed(relation)[0]
        return self.forms[relation]


def _is_of_time(relation: Condition) -> bool:
    symbols = symbols_of(relation)
    return varies(relation) and not any(isinstance(s, VariableSymbol | DiscreteSymbol) for s in symbols)


def _outermost(value: Expression, kinds: tuple[type, ...]) -> list[Expression]:
    """The parts of these kinds that stand in no other one, nor in what is smooth; each once, in an order that is the
    same in every process."""
    walk = sympy.preorder_traversal(value)
    seen: set[Expression] = set()
    found: list[Expression] = []
    for e in walk:
        if isinstance(e, Smooth) or e in seen:
            walk.skip()
        elif isinstance(e, kinds):
            walk.skip()
            seen.add(e)
            found.append(e)
    return sorted(found, key=str) if len(found) > 1 else found
