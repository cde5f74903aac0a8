"""Relations between expressions in time and parameters: when they turn is known beforehand, and needs no search.

Recognised are a + b·F > c and the like, where F is time, or sin, cos, Mod or frac of p + q·t; and Max, Min and Abs of
such. Others are found while running, as those of variables are.
"""

import dataclasses
from typing import Any

import sympy

from ..base.aliases import Condition, Expression
from ..graph.expressions.from_sympy import symbols_of
from .events import Sampled
from .symbols import DiscreteSymbol, ParameterSymbol, PreviousSymbol, RelationSymbol, TimeSymbol

NEVER_AGAIN = sympy.Float(1e300)  # s: a period that no run lasts, for what parameters stop
_ORDERED = (sympy.StrictGreaterThan, sympy.GreaterThan, sympy.StrictLessThan, sympy.LessThan)
_OPPOSITE = {
    sympy.StrictGreaterThan: sympy.StrictLessThan,
    sympy.GreaterThan: sympy.LessThan,
    sympy.StrictLessThan: sympy.StrictGreaterThan,
    sympy.LessThan: sympy.GreaterThan,
}


@dataclasses.dataclass(frozen=True)
class Edges:
    """The instants at which a relation turns. At each tick of a clock the relation becomes the expression beside that
    clock (1 or 0, in parameters), provided that `turns`, a condition on parameters, holds; otherwise it never turns."""

    clocks: tuple[tuple[Sampled, Expression], ...]
    turns: Condition


def edges_of(relation: Condition) -> Edges | None:
    """The clocks at which a relation turns; None if its form is not recognised, or it depends on more than time."""
    found = _in_time(relation)
    if found is None:
        return None
    slope, head, level = found
    truth = slope if isinstance(relation, sympy.StrictGreaterThan | sympy.GreaterThan) else -slope
    if isinstance(head, TimeSymbol):
        return Edges(((Sampled(None, level), _after(truth)),), _nonzero(slope))
    if isinstance(head, sympy.sin | sympy.cos):
        inside: Expression = head.args[0]
        angle = inside + (sympy.pi / 2 if isinstance(head, sympy.cos) else 0)
        frequency, instant = _affine(angle)
        if frequency is None:
            return None
        crosses = sympy.And(level > -1, level < 1)
        # A level that is not reached has no arcsine. The clocks are there all the same, since parameters may change
        # that, and `turns` keeps them silent.
        first = sympy.asin(_where(crosses, level))
        period, places = 2 * sympy.pi, ((first, 1), (sympy.pi - first, -1))
    else:
        argument, period = head.args if isinstance(head, sympy.Mod) else (head.args[0], sympy.Integer(1))
        if symbols_of(period) and not _in_parameters(period):
            return None
        frequency, instant = _affine(argument)
        if frequency is None:
            return None
        crosses = sympy.And(level / period > 0, level / period < 1)
        places = ((sympy.Integer(0), -1), (level, 1))
    every = _where(_nonzero(frequency), sympy.Abs(period / frequency), NEVER_AGAIN)
    clocks = tuple(
        (Sampled(every, _quotient(place - instant, frequency)), _after(direction * truth * frequency))
        for place, direction in places
    )
    return Edges(clocks, sympy.And(crosses, _nonzero(slope), _nonzero(frequency)))


def whole_edges(argument: Expression) -> Edges | None:
    """The clocks at which floor(argument) changes. Instead of a truth, each clock has the direction: 1 for up by one, 0
    for down."""
    if not _in_parameters(argument):
        return None
    slope, at_zero = _affine(argument)
    if slope is None:
        return None
    every = _where(_nonzero(slope), 1 / sympy.Abs(slope), NEVER_AGAIN)
    return Edges(((Sampled(every, _quotient(-at_zero, slope)), _after(slope)),), _nonzero(slope))


def in_relations_of_time(condition: Condition) -> Condition:
    """The condition with relations of Max, Min and Abs of time replaced by relations of their arguments."""
    if isinstance(condition, sympy.And | sympy.Or | sympy.Not):
        return condition.func(*map(in_relations_of_time, condition.args))
    found = _in_time(condition)
    if found is None:
        return condition
    slope, head, level = found
    # The sign of a slope that follows parameters is not known here, and decides between And and Or.
    if not isinstance(head, sympy.Max | sympy.Min | sympy.Abs) or not slope.is_number:
        return condition
    order: Any = type(condition) if slope > 0 else _OPPOSITE[type(condition)]
    above = issubclass(order, sympy.StrictGreaterThan | sympy.GreaterThan)
    if isinstance(head, sympy.Abs):
        inside = head.args[0]
        parts = [order(inside, level), _OPPOSITE[order](inside, -level)]
        together = sympy.Or if above else sympy.And
    else:
        parts = [order(part, level) for part in head.args]
        together = sympy.Or if above == isinstance(head, sympy.Max) else sympy.And
    return together(*map(in_relations_of_time, parts))


def relations_in(condition: Condition) -> list[Condition]:
    """The relations that a condition is made of."""
    if isinstance(condition, sympy.And | sympy.Or | sympy.Not):
        return list(dict.fromkeys(r for part in condition.args for r in relations_in(part)))
    return [condition] if isinstance(condition, sympy.core.relational.Relational) else []


def _sides(relation: Condition) -> tuple[Expression, Expression]:
    return relation.args


def _in_time(relation: Condition) -> tuple[Expression, Expression, Expression] | None:
    """Writes a relation as slope·(head − level), ordered against zero, where only the head changes with time. Returns
    (slope, head, level), or None."""
    if not isinstance(relation, _ORDERED) or not _in_parameters(relation):
        return None
    left, right = _sides(relation)
    found = _with_one_head(left - right)
    # Where nothing changes with time, sides are constant: such a relation never turns.
    if found is None or found[1] is None:
        return None
    slope, head, rest = found
    return slope, head, _quotient(-rest, slope)


def _with_one_head(e: Expression) -> tuple[Expression, Expression, Expression] | None:
    """Writes an expression as slope·head + rest, where slope and rest do not change with time. Returns (slope, head,
    rest), with head None if nothing does; None if there are several heads."""
    if not _changes(e):
        return sympy.Integer(0), None, e
    if isinstance(e, TimeSymbol | sympy.sin | sympy.cos | sympy.Mod | sympy.frac | sympy.Max | sympy.Min | sympy.Abs):
        return sympy.Integer(1), e, sympy.Integer(0)
    if isinstance(e, sympy.Add):
        parts = [_with_one_head(a) for a in e.args]
        heads = {part[1] for part in parts if part is not None} - {None}
        if None in parts or len(heads) != 1:
            return None
        slopes, _, rests = zip(*parts, strict=True)  # pyright: ignore[reportArgumentType]
        slope = sympy.Add(*slopes)
        return slope, heads.pop() if slope != 0 else None, sympy.Add(*rests)
    if isinstance(e, sympy.Mul):
        constant = [a for a in e.args if not _changes(a)]
        changing = [a for a in e.args if _changes(a)]
        inner = _with_one_head(changing[0]) if len(changing) == 1 else None
        return None if inner is None else (inner[0] * sympy.Mul(*constant), inner[1], inner[2] * sympy.Mul(*constant))
    return None


def _affine(e: Expression) -> tuple[Expression, Expression]:
    """Writes an expression as slope·t + value. Returns (slope, value), or (None, None) if it is not affine in time."""
    found = _with_one_head(e)
    if found is None or not isinstance(found[1], TimeSymbol):
        return None, None
    return found[0], found[2]


def _changes(e: Expression) -> bool:
    return any(isinstance(s, TimeSymbol) for s in symbols_of(e))


def _in_parameters(e: Expression) -> bool:
    """True if an expression contains only time and parameters: no discrete variables, relations or values from before
    an event."""
    changing = DiscreteSymbol | RelationSymbol | PreviousSymbol
    return all(
        isinstance(s, TimeSymbol) or (isinstance(s, ParameterSymbol) and not isinstance(s, changing))
        for s in symbols_of(e)
    )


def _after(direction: Expression) -> Expression:
    """1 if a quantity that passes zero with this slope rises, 0 if it falls."""
    return sympy.Piecewise((1, direction > 0), (0, True))


def _nonzero(e: Expression) -> Condition:
    return sympy.Ne(e, 0)


def _where(condition: Condition, e: Expression, otherwise: Expression = 0) -> Expression:
    return sympy.Piecewise((e, condition), (otherwise, True))


def _quotient(a: Expression, b: Expression) -> Expression:
    """a/b, or 0 where b is 0."""
    return a / b if b.is_number else _where(_nonzero(b), a / b)
