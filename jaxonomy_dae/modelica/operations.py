"""Modelica's operators on numbers, truths, texts and expressions."""

from collections.abc import Callable

import sympy

from ..base.errors import ModelError
from ..write.symbols import VariableSymbol
from .builtin import power, quotient
from .values import Record, Value, as_number, both, either, is_condition, negated, parts_of_choice, plain


def _equal(a: Value, b: Value) -> Value:
    if is_condition(a) or is_condition(b):
        return either(both(a, b), both(negated(a), negated(b)))
    if isinstance(a, str) or isinstance(b, str) or (isinstance(a, int | float) and isinstance(b, int | float)):
        return a == b
    for choice, number in ((a, b), (b, a)):
        if isinstance(choice, sympy.Piecewise) and isinstance(number, int | float):
            return _of_branches(choice, lambda v: _equal(v, number))  # noqa: B023
    # SymPy decides what it can: equal expressions give a truth and no event.
    return plain(sympy.Eq(a, b))


def _plain_number(value: Value) -> Value:
    """SymPy's numbers as Python's."""
    if isinstance(value, sympy.Integer):
        return int(value)
    return float(value) if isinstance(value, sympy.Number) else value


def _relation(number: Callable[[Value, Value], bool], symbol: Callable[..., Value]) -> Callable[[Value, Value], Value]:
    def relation(a: Value, b: Value) -> Value:
        a, b = as_number(a), as_number(b)
        if isinstance(a, int | float | str) and isinstance(b, int | float | str):
            return number(a, b)
        for choice, on_left in ((a, True), (b, False)):
            if isinstance(choice, sympy.Piecewise) and not moves(choice):
                return _of_branches(choice, lambda v: relation(v, b) if on_left else relation(a, v))  # noqa: B023
        return plain(symbol(a, b))

    return relation


def moves(choice: sympy.Piecewise) -> bool:
    """True if a branch changes between events."""
    branches: tuple[Value, ...] = choice.args
    return any(
        moves(value) if isinstance(value, sympy.Piecewise) else bool(value.atoms(VariableSymbol))
        for value, _ in branches
    )


def _of_branches(choice: sympy.Piecewise, holds: Callable[[Value], Value]) -> Value:
    """Whether a relation holds of a choice: of the branch that is taken. SymPy would compare all conditions as sets."""
    found: Value = False
    for value, condition in parts_of_choice(choice):
        found = either(found, both(condition, holds(_plain_number(value))))
    return found


RELATIONS: dict[str, Callable[[Value, Value], Value]] = {
    "<": _relation(lambda a, b: a < b, sympy.Lt),
    "<=": _relation(lambda a, b: a <= b, sympy.Le),
    ">": _relation(lambda a, b: a > b, sympy.Gt),
    ">=": _relation(lambda a, b: a >= b, sympy.Ge),
    "==": _equal,
    "<>": lambda a, b: negated(_equal(a, b)),
}
ARITHMETIC: dict[str, Callable[[Value, Value], Value]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": quotient,
    "^": power,
}


def of_complex_numbers(sign: str, a: Value, b: Value) -> Value:
    """An operation of complex numbers, the only operator record of flat models."""
    x, y = (v if isinstance(v, Record) else Record(re=v, im=0.0) for v in (a, b))
    if sign in "+-":
        return Record({k: ARITHMETIC[sign](x[k], y[k]) for k in x})
    if sign == "*":
        return Record(re=x["re"] * y["re"] - x["im"] * y["im"], im=x["re"] * y["im"] + x["im"] * y["re"])
    if sign == "/":
        size = y["re"] ** 2 + y["im"] ** 2
        return Record(
            re=quotient(x["re"] * y["re"] + x["im"] * y["im"], size),
            im=quotient(x["im"] * y["re"] - x["re"] * y["im"], size),
        )
    raise ModelError(f"'{sign}' of records")
