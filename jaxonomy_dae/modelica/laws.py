"""Which equation is the law of a variable or part, and what is written in its place."""

from collections.abc import Iterator
from typing import NamedTuple

from ..base.errors import ModelError, nearest
from .continuous import add
from .definitions import OfAlgorithm
from .learned_law import Law
from .scope import Scope
from .tree import Binary, Call, Equality, Expression, Reference, Unary
from .values import Value


class Given(NamedTuple):
    """The equation that gives a variable by itself: the variable, and what it is equal to."""

    statement: Equality
    variable: Expression
    value: Expression


def equation_of(scope: Scope, name: str) -> Given:
    """The equation that is the law of a variable, of a derivative `der(v)`, or of a part such as `resistor1`: one side
    is the variable alone. Equations that only add variables up, such as `v = p.v - n.v`, count if there is no other."""
    found = [g for s in scope.definitions.equations if isinstance(s, Equality) for g in _sides(scope, s, name)]
    found = [g for g in found if not _only_adds(scope, g.value)] or found
    if len(found) == 1:
        return found[0]
    known = {*scope.declared, *scope.fields}
    if name not in known and not name.startswith("der("):
        raise ModelError(f"there is no variable or part '{name}': {nearest(name, known)}")
    each = [f"'{_name(scope, g.variable)}' on line {g.statement.line}" for g in found]
    more = f"; found those of {' and '.join(each)}: name one of them" if each else "; found none"
    raise ModelError(f"a law for '{name}' takes the place of the one equation '{name} = …'{more}")


def _sides(scope: Scope, s: Equality, name: str) -> Iterator[Given]:
    for side, other in ((s.left, s.right), (s.right, s.left)):
        of = _name(scope, side)
        if (of == name or of.startswith(f"{name}.")) and not isinstance(other, Reference | OfAlgorithm):
            yield Given(s, side, other)


def _name(scope: Scope, e: Expression) -> str:
    """The name of a variable, or `der(name)`; the empty text for other expressions."""
    if isinstance(e, Call) and e.function == "der" and isinstance(e.arguments[0], Reference):
        return f"der({scope.interpreter.name_of(e.arguments[0])})"
    return scope.interpreter.name_of(e) if isinstance(e, Reference) else ""


def _only_adds(scope: Scope, e: Expression) -> bool:
    if isinstance(e, Binary) and e.operator in ("+", "-"):
        return _only_adds(scope, e.left) and _only_adds(scope, e.right)
    if isinstance(e, Unary):
        return _only_adds(scope, e.operand)
    d = scope.declared.get(_name(scope, e))
    return d is not None and not d.prefixes & {"parameter", "constant"}


def write_law(scope: Scope, given: Given, law: Law) -> None:
    """Adds what a law says in place of an equation."""
    value: Value = law(scope.component, scope.evaluate(given.value))
    add(scope, (scope.evaluate(given.variable), value))
