"""Relations that discrete equations read: each has one truth at a time, kept in a hidden discrete variable.

Between events the truth is kept, as in Modelica. All modes of an instant see the same truth, also where a quantity
rests at the level, and continuous equations see the one that the modes see.
"""

import sympy

from ..base.aliases import Condition, Expression
from ..write.automatic_events import varies
from ..write.component import Component
from .values import Value, plain

_ORDER = (sympy.StrictGreaterThan, sympy.GreaterThan, sympy.StrictLessThan, sympy.LessThan)


class KeptRelations:
    """The relations of a component whose truth is kept."""

    def __init__(self, component: Component):
        self.component = component
        # (form in equations, form in conditions of events)
        self.forms: dict[Condition, tuple[Condition, Condition]] = {}

    def in_events(self, condition: Value, alone: bool = True) -> Value:
        """A condition of an event in kept truths. One relation alone stays as it is: it is found where it turns."""
        if isinstance(condition, bool) or (alone and isinstance(condition, _ORDER)):
            return condition
        return plain(self._replaced(condition, 1))

    def in_equations(self, expression: Expression) -> Expression:
        """An expression with relations that events read replaced by their kept truths."""
        if not self.forms:
            return expression
        found = {r: self._form(r, 0) for r in expression.atoms(*_ORDER) if self._known(r)}
        return expression.xreplace(found) if found else expression

    def _replaced(self, condition: Condition, form: int) -> Condition:
        if isinstance(condition, _ORDER) and varies(condition):
            return self._form(condition, form)
        if isinstance(condition, sympy.And | sympy.Or | sympy.Not):
            return condition.func(*(self._replaced(part, form) for part in condition.args))
        return condition

    def _known(self, relation: Condition) -> bool:
        return relation in self.forms or sympy.Not(relation) in self.forms

    def _form(self, relation: Condition, form: int) -> Condition:
        opposite = sympy.Not(relation)
        if opposite in self.forms:
            return sympy.Not(self.forms[opposite][form])
        if relation not in self.forms:
            self.forms[relation] = self.component._followed(relation)
        return self.forms[relation][form]
