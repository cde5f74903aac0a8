"""Assertions of a flat model: an error ends the run where its condition becomes false."""

import sympy

from ..base.errors import ModelError
from ..graph.expressions.from_sympy import symbols_of
from ..write.events import has_guard, terminate
from ..write.symbols import DiscreteSymbol, TimeSymbol, VariableSymbol
from .scope import Scope
from .tree import Call, Expression, Reference
from .values import as_condition, negated

_MOVING = (VariableSymbol, DiscreteSymbol, TimeSymbol)


def write_assertion(scope: Scope, call: Call) -> None:
    """Lets the run end where an assertion of the level `error` is violated.

    Those of parameters alone are not looked at, nor those of equality, which a variable passes without a crossing.

    **Raises:**

    - `ModelError` for one that is violated whatever happens.
    """
    condition, text, *others = call.arguments
    level = dict(call.named).get("level", others[0] if others else None)
    if isinstance(level, Reference) and level.path.endswith("warning"):
        return
    holds = scope.evaluate(condition)
    message = f"an assertion is violated: {_text(scope, text)}"
    if holds is False:
        raise ModelError(message)
    if not isinstance(holds, sympy.Basic):
        return
    violated = negated(as_condition(holds))
    if any(isinstance(s, _MOVING) for s in symbols_of(violated)) and has_guard(violated):
        scope.component.when(violated, terminate(message), at_start=True)


def _text(scope: Scope, message: Expression) -> str:
    """A message; without the values that it would have when it is made."""
    try:
        return str(scope.evaluate(message)).strip()
    except (ModelError, TypeError):
        return "its message is not a text that is known beforehand"
