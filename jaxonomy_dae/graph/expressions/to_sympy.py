"""Writes graphs as SymPy expressions, sharing what is shared."""

from collections.abc import Callable
from fractions import Fraction

import sympy

from ...base.aliases import Expression
from .functions import TABLE
from .node import Node, Number, postorder
from .smooth import Smooth


def write(node: Node, symbol: Callable[[tuple], sympy.Basic]) -> Expression:
    """The SymPy expression of a graph; `symbol(label)` gives the symbol of a leaf."""
    known: dict[Node, Expression] = {}
    for n in postorder([node]):
        known[n] = symbol(n.data) if n.operation == "leaf" else _write(n, [known[a] for a in n.arguments])
    return known[node]


def _number(value: Number) -> Expression:
    return sympy.Rational(value.numerator, value.denominator) if isinstance(value, Fraction) else sympy.sympify(value)


def _write(n: Node, inside: list[Expression]) -> Expression:
    operation = n.operation
    if operation == "constant":
        return _number(n.data)
    if operation == "sum":
        start, coefficients = n.data
        return sympy.Add(_number(start), *(_number(c) * a for c, a in zip(coefficients, inside, strict=True)))
    if operation == "product":
        return sympy.Mul(*(a ** _number(e) for a, e in zip(inside, n.data, strict=True)))
    if operation in _OPERATIONS:
        return _OPERATIONS[operation](*inside)
    return TABLE[operation].sympy(*inside)


_OPERATIONS: dict[str, Callable[..., Expression]] = {
    "power": sympy.Pow,
    "smooth": Smooth,
    "select": lambda c, a, b: sympy.Piecewise((a, c), (b, True)),
    "true": lambda: sympy.true,
    "false": lambda: sympy.false,
    "not": sympy.Not,
    "and": sympy.And,
    "or": sympy.Or,
    "less": sympy.Lt,
    "less_equal": sympy.Le,
    "equal": sympy.Eq,
}


LONGEST = 300  # operations in a text


def shortened(expression: sympy.Basic) -> str:
    """The expression as text, its inner parts left out if it is long; linear in the size of what is shared."""
    size: dict[int, int] = {}
    stack = [(expression, False)]
    while stack:
        e, finished = stack.pop()
        if finished:
            size[id(e)] = 1 + sum(size[id(a)] for a in e.args)
        elif id(e) not in size:
            stack.append((e, True))
            stack.extend((a, False) for a in e.args if id(a) not in size)

    def cut(e: Expression, budget: int) -> Expression:
        if size[id(e)] <= budget or not e.args:
            return e
        if budget < 4 or not isinstance(e, sympy.Expr):
            return sympy.Symbol("…")
        inside = [cut(a, budget // len(e.args)) if isinstance(a, sympy.Expr) else a for a in e.args]
        if any(not isinstance(a, sympy.Expr) for a in e.args):
            return sympy.Symbol("…")
        return e.func(*inside)

    return str(cut(expression, LONGEST))
