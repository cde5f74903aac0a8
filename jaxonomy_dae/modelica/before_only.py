"""Which modes follow from what was before an instant alone: none of this kind takes back what another one does."""

from collections.abc import Sequence

import sympy

from ..base.errors import ModelError
from ..write.symbols import DiscreteSymbol, PreviousSymbol, VariableSymbol
from .definitions import OfAlgorithm, with_entries
from .scope import Scope
from .tree import Call, Equality, Expression, Reference, each_part
from .values import Value


class BeforeOnly:
    """Looks into the equations of modes, and of the continuous variables that they read: `pre(m)`, time, states and
    what whens assign are known before an instant, other discrete variables are not."""

    def __init__(self, scope: Scope, by_when: Sequence[str]):
        self.scope = scope
        equations = scope.definitions.equations
        self.by_when = set(with_entries(by_when, scope.flat.model))
        self.states = {
            scope.interpreter.name_of(e.arguments[0])
            for e in each_part(tuple(equations))
            if isinstance(e, Call) and e.function == "der" and isinstance(e.arguments[0], Reference)
        }
        self.given: dict[str, list[Expression]] = {}
        for s in equations:
            if isinstance(s, Equality) and not isinstance(s.right, OfAlgorithm):
                for side, other in ((s.left, s.right), (s.right, s.left)):
                    if isinstance(side, Reference):
                        self.given.setdefault(scope.interpreter.name_of(side), []).append(other)
        self.found: dict[str, bool] = {}

    def is_mode(self, name: str) -> bool:
        """True for a mode of this kind."""
        with self.scope.at_event():
            return self._is(self.scope.defined(name, self.scope.definitions.of[name]))

    def _is(self, value: Value) -> bool:
        symbols = value.free_symbols if isinstance(value, sympy.Basic) else set()
        return all(self._is_symbol(s) for s in symbols)

    def _is_symbol(self, s: object) -> bool:
        if isinstance(s, VariableSymbol):
            return not s.order and self._is_variable(s.path)
        return not isinstance(s, DiscreteSymbol) or isinstance(s, PreviousSymbol) or s.path in self.by_when

    def _is_variable(self, name: str) -> bool:
        if name in self.states:
            return True
        if name not in self.found:
            self.found[name] = False  # in a circle of equations, nothing is known
            self.found[name] = any(self._is_expression(e) for e in self.given.get(name, ()))
        return self.found[name]

    def _is_expression(self, e: Expression) -> bool:
        try:
            with self.scope.at_event():
                return self._is(self.scope.evaluate(e))
        except ModelError:
            return False
