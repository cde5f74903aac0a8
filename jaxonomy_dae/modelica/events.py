"""What happens at events of a flat model: modes that follow their equations, and `when`.

A mode m = f(pre(m), relations, reals) is a discrete variable with one event for each value that f can take: it happens
where f has that value and m has not. Events of one instant are repeated until none is left, so that m = f(m) then, with
the continuous variables of their loop solved for in between: the event iteration of the Modelica Language Specification
3.6, Appendix B.
"""

import collections
import functools
from collections.abc import Callable, Iterator
from typing import TypeAlias, TypeVar

import sympy
from sympy.core.relational import Relational

from ..base.aliases import Condition
from ..base.errors import ModelError
from ..write.events import Action, Assign, EventFlag, Sampled, assign, pre, reinit, terminate
from ..write.symbols import DiscreteSymbol, PreviousSymbol, VariableSymbol
from . import tree
from .before_only import BeforeOnly
from .definitions import assigned_in, with_entries
from .scope import Scope, before, located
from .values import (
    Value,
    as_condition,
    as_number,
    both,
    chosen,
    either,
    is_condition,
    negated,
    parts_of_choice,
    plain,
)

T = TypeVar("T")
Target: TypeAlias = sympy.Symbol | str  # what an action assigns; a text for `terminate`


def write_modes(scope: Scope) -> None:
    """Adds the events by which discrete variables follow their equations."""
    known = BeforeOnly(scope, [n for s in _simple_whens(scope) for n in assigned_in(s.branches[0][1])])
    before_only = [n for n in scope.definitions.followed if _located(scope, n, lambda _, n: known.is_mode(n))]
    if len(before_only) < 2:
        before_only = []
    for name in scope.definitions.followed:
        if name not in before_only:
            _located(scope, name, _write_mode)
    _write_together(scope, before_only)


def _located(scope: Scope, name: str, do: Callable[[Scope, str], T]) -> T:
    return located(scope.flat.name, scope.declared[name].line, do, scope, name)


def _cases(scope: Scope, name: str) -> list[tuple[Value, Value]]:
    """The values that a mode can take, each with the condition under which it should have it."""
    value = _with_whens(scope, scope.defined(name, scope.definitions.of[name]))
    if is_condition(value):
        return [(sympy.Integer(1), as_condition(value)), (sympy.Integer(0), negated(value))]
    cases = parts_of_choice(sympy.sympify(value))
    for result, _ in cases:
        if any(isinstance(s, VariableSymbol) for s in sympy.sympify(result).free_symbols):
            raise ModelError(f"its value {result} changes in time")
    return cases


def _write_mode(scope: Scope, name: str) -> None:
    m = DiscreteSymbol(name)
    for result, holds in _cases(scope, name):
        pending = False if result == m else both(holds, plain(sympy.Ne(m, result)))
        condition = scope.kept.in_events(pending)
        if not isinstance(condition, bool):
            scope.pending.append(pending)
            scope.component._event(condition, (assign(m, result),), None, EventFlag.AT_START | EventFlag.REVOCABLE)


def _write_together(scope: Scope, names: list[str]) -> None:
    """Adds the events of modes that change at once: each gets the value that its equation has before."""
    pending: Value = False
    actions = []
    for name in names:
        m = DiscreteSymbol(name)
        cases = _located(scope, name, _cases)
        value: Value = cases[-1][0]
        for result, holds in cases:
            pending = either(pending, both(holds, plain(sympy.Ne(m, result))))
        for result, holds in reversed(cases[:-1]):
            value = chosen(scope.kept.in_events(holds, alone=False), result, value)
        actions.append(assign(m, before(sympy.sympify(value))))
    if isinstance(pending, bool):
        return
    scope.pending.append(pending)
    _in_turn(scope, ":turn", pending, actions, EventFlag.AT_START)


def _in_turn(scope: Scope, name: str, pending: Value, actions: list[Action], flags: EventFlag) -> None:
    """Adds two events in turn: an event happens where its condition becomes true, and these may have to happen
    again."""
    turn = _hidden(scope, name, 0)
    for now in (0, 1):
        condition = scope.kept.in_events(both(pending, plain(sympy.Eq(turn, now))))
        scope.component._event(condition, (*actions, assign(turn, 1 - now)), None, flags)


def _hidden(scope: Scope, name: str, start: float) -> DiscreteSymbol:
    """Declares a discrete variable that is not the text's."""
    scope.component.discrete(name, start=start)
    return DiscreteSymbol(name)


def _with_whens(scope: Scope, value: Value, within: tuple[tree.Branches, ...] = ()) -> Value:
    """The value of a mode where a `when` is due that assigns what the mode reads: equations and whens of an instant are
    one system, so that a mode that makes the when happen does not meet the values before it. So does the condition of a
    when that reads what another one assigns; `within` are those asked about already."""
    found: list[Replacement] = []
    for s in _simple_whens(scope):
        targets = {DiscreteSymbol(n) for n in with_entries(assigned_in(s.branches[0][1]), scope.flat.model)}
        if s in within or not isinstance(value, sympy.Basic) or not value.free_symbols & targets:
            continue
        condition = scope.evaluate(s.branches[0][0])
        if isinstance(condition, bool | Sampled) or not is_condition(condition) or condition.atoms(PreviousSymbol):
            continue  # `change(…)` holds at an instant only: what the mode reads is changed when it has happened
        done = scope.done.get(s)
        if done is None:
            done = scope.done[s] = _hidden(scope, f":done[{len(scope.done)}]", 1)
            ends = scope.kept.in_events(both(negated(condition), plain(sympy.Ne(done, 0))))
            scope.component._event(ends, (assign(done, 0),), None, EventFlag.AT_START | EventFlag.REVOCABLE)
        due = both(_with_whens(scope, condition, (*within, s)), plain(sympy.Eq(done, 0)))
        new: dict[sympy.Basic, sympy.Basic] = {
            a.target: a.value.xreplace(_present(a.value))
            for a in _actions(scope, s.branches[0][1], True)
            if isinstance(a, Assign)
        }
        found.append((due, new))
    return _replaced(value, found) if found else value


Replacement: TypeAlias = tuple[
    Value, dict[sympy.Basic, sympy.Basic]
]  # a condition; what stands for symbols if it holds


def _replaced(value: sympy.Basic, replacements: list[Replacement]) -> Value:
    """A value after replacements on their conditions. Each relation is chosen by itself where no symbol stands outside
    of relations, so that all else stands once."""
    relations = value.atoms(Relational)
    outside = value.xreplace({r: sympy.Dummy() for r in relations}).free_symbols
    if any(outside & new.keys() for _, new in replacements):
        return _chosen_of(value, replacements)
    return plain(value.xreplace({r: sympy.sympify(_chosen_of(r, replacements)) for r in relations}))


def _chosen_of(value: Value, replacements: list[Replacement]) -> Value:
    for k, (due, new) in enumerate(replacements):
        if isinstance(value, sympy.Basic) and value.free_symbols & new.keys():
            rest = replacements[k + 1 :]
            return chosen(due, _chosen_of(plain(value.xreplace(new)), rest), _chosen_of(value, rest))
    return value


def _simple_whens(scope: Scope) -> Iterator[tree.Branches]:
    """The whens of one branch that assign values and do nothing else."""
    for s in scope.definitions.whens:
        if len(s.branches) == 1 and all(isinstance(each, tree.Equality | tree.Assignment) for each in s.branches[0][1]):
            yield s


def _present(value: sympy.Basic) -> dict[sympy.Basic, sympy.Basic]:
    """The values before an event as the present ones, which they are until it happens."""
    return {s: DiscreteSymbol(s.path) for s in value.free_symbols if isinstance(s, PreviousSymbol)}


def write_end_of_start(scope: Scope) -> None:
    """Ends the initial time when all modes have settled."""
    if scope.initial is None:
        return
    ends: Condition = sympy.Eq(scope.initial, 1)
    for pending in scope.pending:
        ends = both(ends, negated(pending))
    condition = scope.kept.in_events(ends)
    scope.component._event(condition, (assign(scope.initial, 0),), None, EventFlag.AT_START | EventFlag.REVOCABLE)


Rise = tuple[
    DiscreteSymbol, Value
]  # the truth of a condition when branches were chosen last, a discrete variable; the condition


def write_when(scope: Scope, s: tree.Branches) -> None:
    """Adds the events of a `when`."""
    done = [assign(scope.done[s], 1)] if s in scope.done else []
    chain: list[tuple[list[Rise], tuple[tree.Statement, ...]]] = []
    for condition, body in s.branches:
        found = [_event(scope, each, body, chain, done, len(s.branches) > 1) for each in _each_condition(condition)]
        chain.append(([r for r in found if r is not None], body))
    if any(rises for rises, _ in chain):
        _write_chain(scope, chain)


def _event(
    scope: Scope, condition: tree.Expression, body: tuple[tree.Statement, ...], chain: list, more: list, among: bool
) -> Rise | None:
    """Adds one event, with `more` actions; for a branch `among` others, returns what its event rests on instead.
    Branches of clocks and of the initial time are events of their own; a clock's does not act where a branch before it
    in the chain does."""
    parts = _conjuncts(condition)
    values = [scope.evaluate(_inner(p)) for p in parts]
    clocks = [v for v in values if isinstance(v, Sampled)]
    holds = functools.reduce(both, [v for v in values if not isinstance(v, Sampled)], True)
    if holds is False or (holds is True and not clocks):
        return None  # it never becomes true
    if clocks:  # at a tick, pre(m) is the value before it
        conditions = [*_before_tick(scope, parts), *(negated(_risen(rises)) for rises, _ in chain)]
        if actions := _actions(scope, body, functools.reduce(both, conditions, True)):
            scope.component.when(clocks[0], *actions, *more)
        return None
    at_start = any(isinstance(p, tree.Call) and p.function == "initial" for p in parts)
    if among and not at_start:
        return _hidden(scope, f":held[{len(scope.component.parameters)}]", 1), holds
    if actions := _actions(scope, body, True):
        scope.component.when(scope.kept.in_events(holds), *actions, *more, at_start=at_start)
    return None


def _risen(rises: list[Rise]) -> Value:
    """True from when one of these conditions becomes true until branches are chosen."""
    return functools.reduce(either, (both(holds, plain(sympy.Eq(held, 0))) for held, holds in rises), False)


def _write_chain(scope: Scope, chain: list[tuple[list[Rise], tuple[tree.Statement, ...]]]) -> None:
    """Adds the events of branches of which the first acts whose condition becomes true (Modelica Language Specification
    3.6, 8.3.5). Two events in turn, as for modes that change at once."""
    kept, ends = scope.kept.in_events, EventFlag.AT_START | EventFlag.REVOCABLE
    risen: Value = False
    cases: dict[sympy.Symbol, list[tuple[Value, Value]]] = {}
    for rises, body in chain:
        here = both(_risen(rises), negated(risen))
        risen = either(risen, here)
        for held, holds in rises:
            still = both(negated(holds), plain(sympy.Ne(held, 0)))
            scope.component._event(kept(still), (assign(held, 0),), None, ends)
            cases[held] = [(before(kept(holds, alone=False)), 1)]
        for target, value in _pairs(scope, body) if here is not False else ():
            if isinstance(target, str):
                scope.component.when(kept(here), terminate(target))
            else:
                cases.setdefault(target, []).append((before(kept(here, alone=False)), value))
    actions = [_action(target, _first(target, found)) for target, found in cases.items()]
    _in_turn(scope, f":turn[{len(scope.component.parameters)}]", risen, actions, EventFlag.LISTED)


def _before_tick(scope: Scope, parts: list[tree.Expression]) -> list[Value]:
    """The conditions beside a clock, at its tick."""
    with scope.at_event():
        return [v for v in (scope.evaluate(_inner(p)) for p in parts) if not isinstance(v, Sampled)]


def _pairs(scope: Scope, body: tuple[tree.Statement, ...]) -> list[tuple[Target, Value]]:
    """Pairs (variable, new value) of all actions, as `_each_action` finds them, with the values before the event."""
    with scope.at_event():
        return list(_each_action(scope, body))


def _actions(scope: Scope, body: tuple[tree.Statement, ...], only_if: Value) -> list[Action]:
    return [
        terminate(target) if isinstance(target, str) else _action(target, _first(target, [(only_if, value)]))
        for target, value in _pairs(scope, body)
    ]


def _action(target: sympy.Symbol, value: Value) -> Action:
    return assign(target, value) if isinstance(target, DiscreteSymbol) else reinit(target, value)


def _first(target: sympy.Symbol, cases: list[tuple[Value, Value]]) -> Value:
    """The value of the first case whose condition holds; the one before the event if none does."""
    discrete = isinstance(target, DiscreteSymbol)
    value: Value = pre(target) if discrete else target
    for condition, result in reversed(cases):
        value = chosen(condition, as_number(result) if discrete else result, value)
    return value


def _each_action(scope: Scope, body: tuple[tree.Statement, ...]) -> Iterator[tuple[Target, Value]]:
    """Pairs (variable, new value); a text for `terminate`."""
    if any(isinstance(s, tree.Assignment | tree.Loop) for s in body):
        yield from _of_algorithm(scope, tuple(s for s in body if not isinstance(s, tree.Effect)))
        body = tuple(s for s in body if isinstance(s, tree.Effect))
    for s in body:
        if isinstance(s, tree.Effect):
            name, arguments = s.call.function, s.call.arguments
            if name == "reinit":
                yield scope.evaluate(arguments[0]), sympy.sympify(scope.evaluate(arguments[1]))
            elif name == "terminate":
                yield str(scope.evaluate(arguments[0])), None
        elif isinstance(s, tree.Equality | tree.Assignment):
            several = isinstance(s.left, tree.Several)
            found = scope.interpreter.results(s.right) if several else scope.evaluate(s.right)
            yield from _assigned(scope, s.left, found)
        elif isinstance(s, tree.Branches) and s.kind == "if":
            yield from _chosen_actions(scope, s)
        else:
            raise ModelError(f"a {type(s).__name__.lower()} in a when")


def _of_algorithm(scope: Scope, body: tuple[tree.Statement, ...]) -> Iterator[tuple[Target, Value]]:
    """What statements assign one after another. A variable has its value before the event until it is assigned, and
    what is assigned once and then read is read as the new value of the variable."""
    model, stored = scope.flat.model, scope.definitions.stored
    count = collections.Counter(n for s in body for n in with_entries(assigned_in((s,)), model))
    local: dict[str, Value] = {n: before(scope.stored(n)) for n in count if n in stored}
    found: dict[str, Value] = {}
    for s in body:
        scope.interpreter.execute((s,), local, lambda n: local[n] if n in local else scope.value(n))
        for n in with_entries(assigned_in((s,)), model):
            if n in stored:
                found[n] = local[n]
                if count[n] == 1:
                    local[n] = scope.stored(n)
    for n, value in found.items():
        yield DiscreteSymbol(n), sympy.sympify(as_number(value))


def _assigned(scope: Scope, target: tree.Expression, value: Value) -> Iterator[tuple[Target, Value]]:
    if isinstance(target, tree.Several):
        for each, v in zip(target.entries, value, strict=False):
            if each is not None:
                yield from _assigned(scope, each, v)
        return
    if not isinstance(target, tree.Reference):
        raise ModelError("in a when, a variable stands on the left")
    name = scope.interpreter.name_of(target)
    if isinstance(value, list):
        for each, entry in scope.interpreter.entries_of(name, value):
            yield DiscreteSymbol(each), sympy.sympify(as_number(entry))
        return
    if name not in scope.definitions.stored:
        raise ModelError(f"'{name}' cannot be assigned in a when")
    if not isinstance(value, str):
        yield DiscreteSymbol(name), sympy.sympify(as_number(value))


def _chosen_actions(scope: Scope, s: tree.Branches) -> Iterator[tuple[Target, Value]]:
    """An `if` within a when: each target has the value of the branch that holds, or the one before."""
    found: dict[sympy.Symbol, list[tuple[Value, Value]]] = {}
    otherwise: Value = True
    for condition, body in s.branches:
        holds = as_condition(scope.evaluate(condition))
        here = both(otherwise, holds)
        for target, value in _each_action(scope, body) if here is not False else ():
            if isinstance(target, str):
                raise ModelError("terminate under an if in a when")
            found.setdefault(target, []).append((here, value))
        otherwise = both(otherwise, negated(holds))
        if otherwise is False:
            break
    for target, cases in found.items():
        yield target, _first(target, cases)


def _conjuncts(e: tree.Expression) -> list[tree.Expression]:
    """The conditions that `and` joins."""
    if isinstance(e, tree.Binary) and e.operator == "and":
        return [*_conjuncts(e.left), *_conjuncts(e.right)]
    return [e]


def _each_condition(condition: tree.Expression) -> tuple[tree.Expression, ...]:
    """The conditions of which each makes the event: the entries of an array; `change(b)` is b and not b."""
    if isinstance(condition, tree.Array):
        return tuple(c for entry in condition.entries for c in _each_condition(entry))
    if isinstance(condition, tree.Call) and condition.function == "change":
        return (condition.arguments[0], tree.Unary("not", condition.arguments[0]))
    return (condition,)


def _inner(condition: tree.Expression) -> tree.Expression:
    """The condition whose change to true makes an event: `edge(b)` is that of b."""
    return condition.arguments[0] if isinstance(condition, tree.Call) and condition.function == "edge" else condition
