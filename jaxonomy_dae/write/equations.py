"""Equations as residuals."""

import functools

import sympy

from ..base.errors import ModelError
from ..graph.expressions.from_sympy import atoms_of
from .symbols import PreviousSymbol, VariableSymbol


def zero_of(equation: object) -> sympy.Basic:
    """Left side minus right side of an equation; an expression is returned as it is."""
    if isinstance(equation, sympy.Eq):
        return equation.lhs - equation.rhs  # pyright: ignore[reportOperatorIssue]
    return sympy.sympify(equation)


# All instances of a class write the same equations (`symbols`): each is read once.
@functools.lru_cache(maxsize=4096)
def residual_of(equation: object) -> sympy.Expr:
    """Left side minus right side of an equation of a component.

    **Raises:**

    - `ModelError` for what is not an equation between real numbers, contains no variable, or contains a value from
        before an event.
    """
    if isinstance(equation, bool | sympy.logic.boolalg.BooleanAtom):
        raise ModelError(
            "an equation is always True and says nothing (`a == b` compares symbols; write `Eq(a, b)`)"
            if equation
            else "an equation is always False: its sides can never be equal, or one of them is nan or not real "
            "(`a == b` compares symbols; write `Eq(a, b)`)"
        )
    residual = zero_of(equation)
    if not isinstance(residual, sympy.Expr):
        raise ModelError(f"{equation!r} is not an equation")
    atoms = atoms_of(residual)
    # Symbols are real, so that only a coefficient can be complex.
    if sympy.I in atoms:
        raise ModelError(f"the equation {equation} has a complex coefficient: write its real and imaginary part as two")
    previous = sorted((s for s in atoms if isinstance(s, PreviousSymbol)), key=str)
    if previous:
        raise ModelError(f"the equation {equation} holds at all times: {previous[0]} is for reinit and assign in when")
    if not any(isinstance(s, VariableSymbol) for s in atoms):
        raise ModelError(
            f"the equation {equation} contains no variable: use the symbols that self.variable(...) returns"
        )
    return residual
