"""What Modelica expressions become: numbers, texts, truths, SymPy expressions and conditions, and lists of these.

Constants stay Python numbers, so that most of a flat text is computed while it is read. A record is a `Record`.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import sympy
from sympy.logic.boolalg import Boolean

from ..base.errors import ModelError
from ..write.automatic_events import smooth
from ..write.choices import by_conditions
from ..write.truths import as_number as as_number
from ..write.truths import both as both_hold
from ..write.truths import either as one_holds
from ..write.truths import plain as plain

Value: TypeAlias = Any  # float | int | bool | str | sympy.Expr | Boolean | list | Record


class Record(dict):
    """The values of a record's fields, in the order of their declaration."""


class Results(list):
    """The results of a function that has several."""


def is_condition(value: Value) -> bool:
    return isinstance(value, bool | Boolean) and not isinstance(value, sympy.Symbol)


def as_condition(value: Value) -> Value:
    """A number that stands for a truth as a condition: it holds where the number is not zero."""
    if is_condition(value):
        return bool(value) if isinstance(value, sympy.logic.boolalg.BooleanAtom) else value
    if isinstance(value, int | float):
        return value != 0
    if isinstance(value, sympy.Expr):
        return sympy.Eq(value, 1)  # of the type Boolean: a discrete variable that is 0 or 1
    raise ModelError(f"a condition was expected; got {value!r}")


def entrywise(operation: Callable[..., Value], *values: Value) -> Value:
    """An operation on each entry of arrays of one shape; what is no array counts as an array of equal entries."""
    arrays = [v for v in values if isinstance(v, list)]
    if not arrays:
        return operation(*values)
    sizes = {len(a) for a in arrays}
    if len(sizes) > 1:
        raise ModelError(f"arrays of {' and '.join(map(str, sorted(sizes)))} entries do not fit together")
    spread = [v if isinstance(v, list) else [v] * len(arrays[0]) for v in values]
    return [entrywise(operation, *each) for each in zip(*spread, strict=True)]


def negated(condition: Value) -> Value:
    condition = as_condition(condition)
    return not condition if isinstance(condition, bool) else sympy.Not(condition)


def both(a: Value, b: Value) -> Value:
    return both_hold(as_condition(a), as_condition(b))


def either(a: Value, b: Value) -> Value:
    return one_holds(as_condition(a), as_condition(b))


def chosen(condition: Value, a: Value, b: Value, quiet: bool = False) -> Value:
    """`if condition then a else b`; its condition is not an event if `quiet`."""
    condition = as_condition(condition)
    if isinstance(condition, bool):
        return a if condition else b
    # By type, too: 1, 1.0 and True are equal in Python.
    if a is b or (type(a) is type(b) and a == b):
        return a
    if isinstance(a, list) or isinstance(b, list):
        return entrywise(lambda x, y: chosen(condition, x, y, quiet), a, b)
    if isinstance(a, Record):
        return Record({k: chosen(condition, a[k], b[k], quiet) for k in a})
    if is_condition(a) and is_condition(b):
        return either(both(condition, a), both(negated(condition), b))
    out = by_conditions((as_number(a), condition), (as_number(b), sympy.true))
    return smooth(out) if quiet else out


def parts_of_choice(value: Value) -> list[tuple[Value, Value]]:
    """The branches of a choice as pairs (value, condition), nested ones one after another; conditions exclude each
    other."""
    if not isinstance(value, sympy.Piecewise):
        return [(value, True)]
    out: list[tuple[Value, Value]] = []
    otherwise: Value = True
    branches: tuple[Value, ...] = value.args
    for branch, condition in branches:
        here = both(otherwise, plain(condition))
        out.extend((v, both(here, c)) for v, c in parts_of_choice(branch))
        otherwise = both(otherwise, negated(plain(condition)))
    return [(v, c) for v, c in out if c is not False]
