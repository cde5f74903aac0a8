"""Choices between expressions, as SymPy's `Piecewise`, whose branches stay where they stand.

SymPy multiplies out branches that stand in conditions of others whenever it makes such a choice, exponentially many,
also where it is not to evaluate anything. What is made here has the same meaning.
"""

from collections.abc import Mapping
from typing import Any

import sympy
from sympy.core.relational import Relational
from sympy.functions.elementary.piecewise import ExprCondPair

from ..base.aliases import Expression


def by_conditions(*pairs: tuple[Any, Any]) -> Expression:
    """A `Piecewise` with pairs of a value and a condition as they are, up to the first condition that always holds."""
    kept = []
    for value, condition in pairs:
        if condition != sympy.false:
            kept.append(sympy.Tuple.__new__(ExprCondPair, sympy.sympify(value), sympy.sympify(condition)))
        if condition == sympy.true:
            break
    if len(kept) == 1 and kept[0].cond == sympy.true:
        return kept[0].expr
    return sympy.Basic.__new__(sympy.Piecewise, *kept)


def exchanged(value: Any, new: Mapping[Any, Any]) -> Any:
    """An expression or a condition with others in place of some of its parts, as `xreplace`."""
    known = dict(new)

    def of(e: Any) -> Any:
        if e not in known:
            parts = [of(part) for part in e.args]
            if all(a is b for a, b in zip(parts, e.args, strict=True)):
                known[e] = e
            elif isinstance(e, ExprCondPair):
                known[e] = sympy.Tuple.__new__(ExprCondPair, *parts)
            elif isinstance(e, sympy.Piecewise):
                known[e] = by_conditions(*(pair.args for pair in parts))
            elif isinstance(e, Relational):  # SymPy would look into branches for a sign
                known[e] = e.func(*parts, evaluate=all(part.is_Number for part in parts))
            else:
                known[e] = e.func(*parts)
        return known[e]

    return of(value)
