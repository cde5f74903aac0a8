"""What a component says of events: conditions, and what happens when they become true."""

import dataclasses
import enum
from typing import TypeAlias

import sympy
from sympy.logic.boolalg import BooleanAtom, BooleanFunction, to_nnf

from ..base.aliases import Condition
from ..base.errors import ModelError
from ..graph.expressions.from_sympy import symbols_of
from .choices import by_conditions
from .declarations import Value
from .symbols import (
    DiscreteSymbol,
    EarlierSymbol,
    ParameterSymbol,
    PreviousSymbol,
    RelationSymbol,
    TimeSymbol,
    VariableSymbol,
)


class EventFlag(enum.Flag):
    """Kinds of events; an event may be of several.

    - `LISTED`: it is counted and listed; one that is not only says that equations change.
    - `AT_START`: it happens at the initial time, too, if its condition holds there.
    - `REVOCABLE`: another event at the same instant may make its condition false before it happens; it does not happen
      then.
    - `RELATION`: it says what the relation of a hidden discrete variable is, from the initial time on.
    - `KINK`: equations go on with the same values where it happens; only their derivatives jump.
    - `STRICT`: its condition is false where its guard is zero.
    - `STRIKE`: it closes a contact, at once with others that close at the same instant.
    - `REPEATED`: it happens again at its instant for as long as its condition holds.
    - `LAST`: it waits until no other event of its instant is left; all that have waited happen at once.
    """

    LISTED = enum.auto()
    AT_START = enum.auto()
    REVOCABLE = enum.auto()
    RELATION = enum.auto()
    KINK = enum.auto()
    STRICT = enum.auto()
    STRIKE = enum.auto()
    REPEATED = enum.auto()
    LAST = enum.auto()


NO_FLAG = EventFlag(0)


LIVE = 2  # a relation that is as its sides say


@dataclasses.dataclass(frozen=True)
class Reinit:
    """A state that starts anew at `value`."""

    target: VariableSymbol
    value: sympy.Expr


@dataclasses.dataclass(frozen=True)
class Assign:
    """A discrete variable that takes a `value`."""

    target: DiscreteSymbol | RelationSymbol
    value: sympy.Expr


@dataclasses.dataclass(frozen=True)
class Terminate:
    """The end of the run."""

    message: str


Action: TypeAlias = Reinit | Assign | Terminate


@dataclasses.dataclass(frozen=True)
class Sampled:
    """A condition that becomes true at offset, offset + period, …; without a period, once."""

    period: sympy.Expr | None
    offset: sympy.Expr


@dataclasses.dataclass(frozen=True)
class When:
    """One `when` of a component.

    `text` is the condition as the user wrote it. `guard` is the name of the hidden variable that falls through zero
    where the condition becomes true; a sampled event has a `clock` instead. `values` are the names of the hidden
    variables, or the numbers, that the actions write.
    """

    text: str
    guard: str | None
    clock: Sampled | None
    actions: tuple[Action, ...]
    values: tuple[str | float | None, ...]
    flags: EventFlag


@dataclasses.dataclass(frozen=True)
class HeldBranch:
    """A branch of `either` that is differentiated.

    - `levels`: the hidden variables that equal the branch and its derivatives below the highest; zero while it holds.
    - `active`: the hidden variable that is 1 while the branch holds, and 0 otherwise.
    - `impulse`: the discrete variable that an event sets to 1 to let an impulse act.
    - `rate`: the discrete variable that is added to the highest derivative of the branch: zero, but the tangent along
        which an impulse acts.
    - A branch that only pushes also has the hidden variable of its force, and the discrete variable that lets go at 0.
    """

    text: str
    levels: tuple[str, ...]
    active: str
    impulse: RelationSymbol
    rate: RelationSymbol
    force: str | None = None
    closed: DiscreteSymbol | None = None


def pre(symbol: sympy.Symbol) -> sympy.Expr:
    """The value of a variable before the present event, for use in `reinit` and `assign`.

    **Raises:**

    - `ModelError` if the argument is neither a variable nor a discrete variable.
    """
    if isinstance(symbol, DiscreteSymbol):
        return PreviousSymbol(symbol.path)
    if isinstance(symbol, VariableSymbol):
        return EarlierSymbol(symbol.path, symbol.order)
    raise ModelError(f"pre takes a variable or a discrete variable; got {symbol}")


def reinit(variable: sympy.Symbol, value: Value) -> Reinit:
    """In `when`: sets a state to a new value. In `value`, variables have their values before the event.

    **Raises:**

    - `ModelError` if the first argument is not a variable, or the value is not an expression.
    """
    if isinstance(variable, ParameterSymbol):
        kind = "discrete variable: write assign(…)" if isinstance(variable, DiscreteSymbol) else "parameter"
        raise ModelError(f"reinit takes a variable; '{variable}' is a {kind}")
    if not isinstance(variable, VariableSymbol) or isinstance(variable, EarlierSymbol):
        raise ModelError(f"reinit takes a variable; got {variable}")
    return Reinit(variable, _expression(value, f"reinit({variable}, …)"))


def assign(variable: sympy.Symbol, value: Value | sympy.Basic) -> Assign:
    """In `when`: assigns a value to a discrete variable, which keeps it until the next event assigns another one.

    **Raises:**

    - `ModelError` if the first argument is not a discrete variable, or the value is not an expression.
    """
    if not isinstance(variable, DiscreteSymbol):
        mend = ": write reinit(…)" if isinstance(variable, VariableSymbol) else ""
        raise ModelError(f"assign takes a discrete variable, as self.discrete(…) returns; got {variable}{mend}")
    return Assign(variable, _expression(value, f"assign({variable}, …)"))


def terminate(message: str) -> Terminate:
    """In `when`: ends the run. `solution.events.terminated` then holds the message."""
    if not isinstance(message, str) or not message:
        raise ModelError(f"terminate takes a text that says why the run ends; got {message!r}")
    return Terminate(message)


def _expression(value: object, where: str) -> sympy.Expr:
    try:
        found = sympy.sympify(value)
    except (sympy.SympifyError, TypeError):
        found = None
    if isinstance(value, str) or not isinstance(found, sympy.Expr):
        raise ModelError(f"{where}: the value is an expression or a number; got {value!r}")
    if found.is_number and not (found.is_extended_real and found.is_finite):
        raise ModelError(f"{where}: the value must be finite and real; got {value!r}")
    return found


def guard_of(condition: Condition, where: str) -> sympy.Expr:
    """An expression that is positive where a condition is false, and falls through zero where it becomes true."""
    relation: Condition = condition
    if isinstance(condition, BooleanAtom | bool):
        raise ModelError(f"{where}: the condition is always {condition}: it contains no variable")
    if _is_discrete(condition):
        # It has just two values: a condition that changes at events only is looked at after them, and no search is
        # needed.
        return sympy.Piecewise((-1, condition), (1, True))
    if isinstance(condition, sympy.And | sympy.Or):
        # Relations in discrete variables alone switch the guard of the others on or off.
        # Of `and` the guard falls when the last condition becomes true, of `or` when the first one does: the largest
        # and the least of their guards.
        fixed = [c for c in condition.args if _is_discrete(c)]
        others = [guard_of(c, where) for c in condition.args if not _is_discrete(c)]
        if isinstance(condition, sympy.And):
            return while_on(sympy.Max(*others), sympy.And(*fixed))
        return sympy.Piecewise((-1, sympy.Or(*fixed)), (sympy.Min(*others), True))
    if isinstance(condition, sympy.Not):
        return guard_of(to_nnf(condition), where)
    if isinstance(condition, sympy.LessThan | sympy.StrictLessThan):
        return relation.lhs - relation.rhs
    if isinstance(condition, sympy.GreaterThan | sympy.StrictGreaterThan):
        return relation.rhs - relation.lhs
    return _refused(condition, where)


def has_guard(condition: Condition) -> bool:
    """True if `guard_of` can make a guard. It is not made: SymPy compares all sides of relations that `and` joins."""
    if isinstance(condition, BooleanAtom | bool):
        return False
    if _is_discrete(condition):
        return True
    if isinstance(condition, sympy.Not):
        return has_guard(to_nnf(condition))
    if isinstance(condition, sympy.And | sympy.Or):
        return all(_is_discrete(c) or has_guard(c) for c in condition.args)
    ordered = sympy.LessThan | sympy.StrictLessThan | sympy.GreaterThan | sympy.StrictGreaterThan
    return isinstance(condition, ordered)


def is_strict(condition: Condition) -> bool:
    """True for a condition that is false where its guard is zero.

    Of several relations that `and` or `or` joins, those whose sides are equal there decide; so they are of one kind,
    all strict or none. Relations in discrete variables are not among them: they switch the guard, which jumps.
    """
    return any(isinstance(r, sympy.StrictLessThan | sympy.StrictGreaterThan) for r in _moving_relations(condition))


def is_of_both_kinds(condition: Condition) -> bool:
    """True if `and` or `or` joins strict relations with others."""
    joined = isinstance(condition, sympy.And | sympy.Or | sympy.Not)
    return joined and len({is_strict(r) for r in _moving_relations(condition)}) > 1


def _moving_relations(condition: Condition) -> list[Condition]:
    """The relations in variables or time, as they stand once `not` is carried inside."""
    if _is_discrete(condition):
        return []
    if isinstance(condition, sympy.Not):
        return _moving_relations(to_nnf(condition))
    if isinstance(condition, sympy.And | sympy.Or):
        return [r for c in condition.args for r in _moving_relations(c)]
    return [condition]


def while_on(guard: sympy.Expr, condition: Condition) -> sympy.Expr:
    """A guard that is there only while a condition in discrete variables holds."""
    return guard if condition is sympy.true else by_conditions((guard, condition), (1, sympy.true))


def relation_in_discretes(mode: Condition, where: str) -> Condition:
    """A condition that changes by events alone: a relation in discrete variables, or one of them, true if not zero.

    **Raises:**

    - `ModelError` for anything else.
    """
    if isinstance(mode, DiscreteSymbol):
        return sympy.Ne(mode, 0)
    if not _is_discrete(mode):
        raise ModelError(f"{where}: the mode is a relation in discrete variables, or one of them; got {mode}")
    return mode


def _is_discrete(condition: Condition) -> bool:
    """True for a relation, or a combination of relations, that contains neither variables nor time: it can change at
    events only."""
    symbols = symbols_of(condition)
    return isinstance(condition, sympy.core.relational.Relational | BooleanFunction) and not any(
        isinstance(s, VariableSymbol | TimeSymbol) for s in symbols
    )


def _refused(condition: object, where: str) -> sympy.Expr:
    if isinstance(condition, sympy.Eq | sympy.Ne):
        raise ModelError(
            f"{where}: {condition} holds at single instants only, if ever: write <= or >=, for a crossing in one "
            "direction; == is for discrete variables"
        )
    raise ModelError(
        f"{where}: the condition is a relation such as h <= 0, several of them in And or Or, or self.sampled(T); "
        f"got {condition!r}"
    )
