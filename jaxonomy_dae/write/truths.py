"""Truths: Python's, which are known while a model is written, and SymPy's conditions."""

from typing import Any, TypeAlias

import sympy
from sympy.logic.boolalg import Boolean, BooleanAtom

from .choices import by_conditions

Truth: TypeAlias = Any  # bool | Boolean


def plain(value: Truth) -> Truth:
    """SymPy's truths as Python's."""
    return bool(value) if isinstance(value, BooleanAtom) else value


def negated(condition: Truth) -> Truth:
    """Not the condition."""
    return not condition if isinstance(condition, bool) else plain(sympy.Not(condition))


def both(a: Truth, b: Truth) -> Truth:
    """Whether both hold."""
    if isinstance(a, bool):
        return b if a else False
    if isinstance(b, bool):
        return a if b else False
    return plain(sympy.And(a, b))


def either(a: Truth, b: Truth) -> Truth:
    """Whether one of them holds."""
    if isinstance(a, bool):
        return True if a else b
    if isinstance(b, bool):
        return True if b else a
    return plain(sympy.Or(a, b))


def as_number(value: Truth) -> Any:
    """A truth as 1 or 0; other values as they are."""
    if isinstance(value, bool):
        return int(value)
    # A symbol is a `Boolean` for SymPy, too; here it stands for a number.
    if isinstance(value, Boolean) and not isinstance(value, sympy.Symbol):
        return by_conditions((1, value), (0, sympy.true))
    return value
