"""The initial equations of a flat model."""

import dataclasses
import graphlib
import math
from collections.abc import Sequence

import sympy

from ..base.errors import ModelError
from ..graph.expressions.smooth import Smooth
from ..write.symbols import DiscreteSymbol, ParameterSymbol, VariableSymbol
from .continuous import equal, pairs, side_by_side
from .definitions import assigned_in, with_entries
from .iterations import present
from .scope import Scope
from .tree import Branches, Call, Equality, Reference, Statement, each_part
from .values import Value, as_number, is_condition


def in_order(scope: Scope, statements: Sequence[Statement]) -> list[Statement]:
    """Initial equations, those of discrete variables first, each after those of the variables that it reads."""
    given: dict[str, Equality] = {}
    for s in statements:
        if isinstance(s, Equality):
            side = s.left.arguments[0] if isinstance(s.left, Call) and s.left.function == "pre" else s.left
            name = scope.interpreter.name_of(side) if isinstance(side, Reference) else ""
            if name in scope.definitions.stored:
                given[name] = s
    names = {name: (e.path for e in each_part(s.right) if isinstance(e, Reference)) for name, s in given.items()}
    read = {name: set(with_entries(found, scope.flat.model)) & given.keys() for name, found in names.items()}
    try:
        first = [given[name] for name in graphlib.TopologicalSorter(read).static_order()]
    except graphlib.CycleError:
        return list(statements)
    return [*first, *(s for s in statements if not any(s is f for f in first))]


def write_initial_equation(scope: Scope, s: Statement) -> None:
    """Adds what one statement says of the initial time."""
    if isinstance(s, Branches):
        found = side_by_side(scope, s)
    elif isinstance(s, Equality):
        a, b = s.left, s.right
        if isinstance(a, Call) and a.function == "pre":  # before the first event it is what it starts at
            a = a.arguments[0]
            if isinstance(a, Reference) and scope.interpreter.name_of(a) not in scope.definitions.stored:
                return  # nothing reads it
        scope.random.starting = True
        try:
            found = equal(scope, a, b)
        finally:
            scope.random.starting = False
    else:
        return
    for left, right in found:
        _hold_initially(scope, left, right)


def write_initial_algorithm(scope: Scope, statements: tuple[Statement, ...]) -> None:
    """Adds what an algorithm has assigned at its end: a value that it assigns first and replaces later is none."""
    local = scope.interpreter.assigned_by(statements)
    for name in with_entries(assigned_in(statements), scope.flat.model):
        for left, right in pairs(scope.value(name), local[name]):
            _hold_initially(scope, left, right)


def _hold_initially(scope: Scope, left: Value, right: Value) -> None:
    """A start, where one side is a variable and the other is known beforehand; otherwise an equation at the start."""
    c = scope.component
    left, right = present(_unwrapped(left)), present(_unwrapped(right))
    if _is_same(left, right):
        return
    if _waits(scope, left, right) or _waits(scope, right, left):
        scope.waiting.append((left, right))
        return
    for a, b in ((left, right), (right, left)):
        known = _in_parameters(b)
        if isinstance(a, DiscreteSymbol) and a not in scope.said:
            scope.said.add(a)
            if isinstance(b, sympy.Basic) and any(isinstance(s, VariableSymbol) for s in b.free_symbols):
                scope.discrete.initially[a] = b
            else:
                c.parameters[a.path] = c.parameters[a.path].with_value(
                    _plain(b) if known else float(_numerical(scope, b))
                )
            return
        if isinstance(a, VariableSymbol) and known:
            if a.order:
                c.start(a, b, fixed=True)
                return
            # The first such equation is a start. A second one says something about another variable.
            variable = c.variables[a.path]
            if not variable.fixed:
                c.variables[a.path] = dataclasses.replace(variable, start=sympy.sympify(b), fixed=True)
                return
    symbols = {s for side in (left, right) if isinstance(side, sympy.Basic) for s in side.free_symbols}
    if any(isinstance(s, VariableSymbol) for s in symbols):
        c.initially(sympy.Eq(left, right, evaluate=False))
        return
    a, b = (float(_numerical(scope, sympy.sympify(side))) for side in (left, right))
    if not math.isclose(a, b):  # a text has up to sixteen digits
        raise ModelError(f"the initial equation {left} = {right} does not hold for the declared starts")


def _is_same(left: Value, right: Value) -> bool:
    return isinstance(left, sympy.Basic) and left == right


def _waits(scope: Scope, a: Value, b: Value) -> bool:
    """True for a discrete variable that is what another one is, of which nothing is said yet."""
    found = b.free_symbols if isinstance(b, sympy.Basic) else set()
    unsaid = any(isinstance(s, DiscreteSymbol) and s not in scope.said for s in found)
    return scope.postpones and isinstance(a, DiscreteSymbol) and unsaid


def hold_waiting(scope: Scope) -> None:
    """Holds what initial equations say of discrete variables in terms of others, each after these; what is said of none
    of them counts as declared."""
    while scope.waiting:
        before, scope.waiting = scope.waiting, []
        for left, right in before:
            _hold_initially(scope, left, right)
        scope.postpones = len(scope.waiting) < len(before)


def _numerical(scope: Scope, value: Value) -> Value:
    """An expression in parameters and discrete variables at their declared values."""
    values: dict[sympy.Basic, Value] = {scope.component.ev.t: scope.flat.experiment.get("StartTime", 0.0)}
    for s in value.free_symbols:
        if isinstance(s, ParameterSymbol):
            declared = scope.component.parameters[s.path].value
            values[s] = _numerical(scope, declared) if isinstance(declared, sympy.Basic) else declared
    found = value.subs(values) if value.free_symbols else value
    return found.replace(Smooth, lambda inside: inside)  # a number has no kinks


def _unwrapped(value: Value) -> Value:
    """A truth as a number; that of a Boolean variable as the variable."""
    if is_condition(value) and isinstance(value, sympy.Eq) and isinstance(value.args[0], DiscreteSymbol):
        return value.args[0]
    return as_number(value)


def _in_parameters(value: Value) -> bool:
    symbols = value.free_symbols if isinstance(value, sympy.Basic) else set()
    return all(isinstance(s, ParameterSymbol) and not isinstance(s, DiscreteSymbol) for s in symbols)


def _plain(value: Value) -> Value:
    return float(value) if isinstance(value, int | float) or value.is_number else value
