"""The continuous equations of a flat model."""

import sympy

from ..base.errors import ModelError
from .assertions import write_assertion
from .definitions import OfAlgorithm
from .scope import Scope
from .tree import Branches, Effect, Equality, Expression, Several, Statement
from .values import Record, Value, as_number, chosen

Sides = tuple[Value, Value]


def write_equation(scope: Scope, s: Statement) -> None:
    """Adds the equations of one statement to the component."""
    if isinstance(s, Equality | Branches):
        for sides in equal(scope, s.left, s.right) if isinstance(s, Equality) else side_by_side(scope, s):
            add(scope, sides)
    elif isinstance(s, Effect):
        if s.call.function == "connect":
            raise ModelError("connect(…) is not flat: Modelica with connections is read by load(source, model=…)")
        if s.call.function == "assert":
            write_assertion(scope, s.call)
    else:
        raise ModelError("a loop of equations is not read")


def equal(scope: Scope, left: Expression, right: Expression) -> list[Sides]:
    if isinstance(right, OfAlgorithm):
        return pairs(scope.evaluate(left), scope.algorithm(right.number)[right.name])
    if not isinstance(left, Several):
        return pairs(scope.evaluate(left), scope.evaluate(right))
    values = scope.interpreter.results(right)
    given = [(e, v) for e, v in zip(left.entries, values, strict=False) if e is not None]
    return [pair for e, v in given for pair in pairs(scope.evaluate(e), v)]


def add(scope: Scope, sides: Sides) -> None:
    """Adds an equation of two values."""
    left, right = map(as_number, sides)
    # Texts decide nothing that a run computes.
    if isinstance(left, str) or isinstance(right, str):
        return
    if isinstance(left, int | float) and isinstance(right, int | float):
        if left != right:
            raise ModelError(f"the equation {left} = {right} is false")
        return
    left, right = (scope.kept.in_equations(sympy.sympify(side)) for side in (left, right))
    scope.component.add_equations(sympy.Eq(left, right, evaluate=False))


def _sides(scope: Scope, statements: tuple[Statement, ...]) -> list[Sides]:
    out: list[Sides] = []
    for s in statements:
        if isinstance(s, Equality):
            out += equal(scope, s.left, s.right)
        elif isinstance(s, Branches) and s.kind == "if":
            out += side_by_side(scope, s)
        elif not isinstance(s, Effect):
            raise ModelError("only equations can stand in an if")
    return [(as_number(a), as_number(b)) for a, b in out]


def side_by_side(scope: Scope, s: Branches) -> list[Sides]:
    """The equations of an `if`, as pairs (left, right): the first ones of all branches are one equation, and so on."""
    branches: list[tuple[Value, list[Sides]]] = []
    for condition, body in s.branches:
        holds = scope.evaluate(condition)
        if holds is False:
            continue
        branches.append((holds, _sides(scope, body)))
        if holds is True:
            break
    if not branches or not any(sides for _, sides in branches):
        return []
    if branches[0][0] is True:
        return branches[0][1]
    counts = {len(sides) for _, sides in branches}
    if branches[-1][0] is not True or len(counts) != 1:
        raise ModelError(f"the branches of an if have {sorted(counts)} equations; they must have equally many")
    return [_one_equation(scope, [(holds, sides[k]) for holds, sides in branches]) for k in range(counts.pop())]


def _one_equation(scope: Scope, branches: list[tuple[Value, Sides]]) -> Sides:
    """One equation of which a condition chooses the branch: of the right sides, where all left sides are the same."""
    left = branches[0][1][0]
    # A common left side stays outside of the branches: the equation is solved for it whichever of them holds.
    same = all(sides[0] == left for _, sides in branches)
    value: Value = None
    for holds, (a, b) in reversed(branches):
        part = b if same else a - b
        quiet = holds in scope.interpreter.quieted
        value = part if value is None else chosen(holds, part, value, quiet)
    return (left, value) if same else (value, 0.0)


def pairs(a: Value, b: Value) -> list[Sides]:
    """The entries of two values, one beside the other."""
    if isinstance(a, list) and isinstance(b, float) and b == 0:  # a residual, which is an array
        return [pair for x in a for pair in pairs(x, b)]
    if isinstance(a, list) or isinstance(b, list):
        if not (isinstance(a, list) and isinstance(b, list)) or len(a) != len(b):
            raise ModelError(f"the sides of an equation differ in size: {a} and {b}")
        return [pair for x, y in zip(a, b, strict=True) for pair in pairs(x, y)]
    if isinstance(a, Record) and isinstance(b, Record):
        return [pair for k in a for pair in pairs(a[k], b[k])]
    if isinstance(a, Record) or isinstance(b, Record):
        raise ModelError(f"the sides of an equation differ in kind: {a} and {b}")
    return [(a, b)]
