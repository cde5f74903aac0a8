"""What values read: continuous variables, and discrete ones in this iteration of an event or in the one before."""

import sympy

from ..graph.expressions.from_sympy import symbols_of
from ..write.choices import exchanged
from ..write.discrete_equations import BEFORE
from ..write.symbols import DiscreteSymbol, ParameterSymbol, VariableSymbol
from .values import Record, Value


def is_of_parameters(value: sympy.Expr) -> bool:
    """True for what does not change while a run goes on, but for the time."""
    return all(isinstance(s, ParameterSymbol) and not isinstance(s, DiscreteSymbol) for s in symbols_of(value))


def variables_in(value: Value) -> list[VariableSymbol]:
    """The continuous variables in a value."""
    if isinstance(value, list):
        return [s for v in value for s in variables_in(v)]
    if isinstance(value, Record):
        return [s for v in value.values() for s in variables_in(v)]
    found = symbols_of(value) if isinstance(value, sympy.Basic) else ()
    return [s for s in found if isinstance(s, VariableSymbol)]


def previous(value: Value) -> Value:
    """A value, or a discrete variable, in the iteration before."""
    if isinstance(value, list):
        return [previous(v) for v in value]
    if isinstance(value, Record):
        return Record({k: previous(v) for k, v in value.items()})
    if not isinstance(value, sympy.Basic):
        return value
    found = {s: s.path for s in symbols_of(value) if isinstance(s, DiscreteSymbol)}
    return exchanged(value, {s: DiscreteSymbol(f"{BEFORE}{n})") for s, n in found.items() if not n.startswith(":")})


def present(value: Value) -> Value:
    """A value with what it reads of the iteration before as it is now: at the initial time they are the same."""
    if not isinstance(value, sympy.Basic):
        return value
    names = {s: s.path for s in symbols_of(value) if isinstance(s, DiscreteSymbol)}
    return exchanged(
        value, {s: DiscreteSymbol(n.removeprefix(BEFORE)[:-1]) for s, n in names.items() if n.startswith(BEFORE)}
    )
