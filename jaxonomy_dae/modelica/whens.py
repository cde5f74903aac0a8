"""The `when`s and the other discrete equations of a flat model, read into its `DiscreteEquations`."""

import collections
from collections.abc import Iterator
from typing import TypeAlias

import sympy

from ..base.errors import ModelError
from ..write.symbols import DiscreteSymbol, VariableSymbol
from . import tree
from .continuous import pairs
from .definitions import assigned_in, with_entries
from .iterations import previous
from .scope import Scope
from .values import Value, as_condition, as_number, both, chosen, negated

Target: TypeAlias = sympy.Symbol | str  # what an action writes; a text for `terminate`


def read_followed(scope: Scope, name: str) -> None:
    """A discrete variable that has an equation outside of whens."""
    value = scope.defined(name, scope.definitions.of[name])
    scope.discrete.give(name, scope.kept.in_discrete(scope.kept.with_jumps_as_variables(value)), always=True)


def read_when(scope: Scope, s: tree.Branches) -> None:
    """A `when` among equations: what its body assigns is what it was before where no branch acts."""
    conditions = [list(_conditions(scope, c, scope.value)) for c, _ in s.branches]
    acting = scope.discrete.branches(conditions)
    cases: dict[str, list[tuple[Value, Value]]] = {}
    for acts, when, (_, body) in zip(acting, conditions, s.branches, strict=True):
        # What a variable was before a tick is known, as nothing has happened at the instant.
        scope.clock = scope.discrete.clock_of([truth for truth, _ in when])
        for target, value in _each_action(scope, body):
            if isinstance(target, DiscreteSymbol):
                cases.setdefault(target.path, []).append((acts, value))
            else:
                _act(scope, acts, target, value)
        scope.clock = None
    for name, given in cases.items():
        scope.discrete.give(name, _first(given, previous(DiscreteSymbol(name))))


def read_section(scope: Scope, section: tuple[tree.Statement, ...]) -> None:
    """An algorithm with whens: its statements count one after another, so that the last assignment does."""
    algorithm = _Algorithm(scope, section)
    for s in section:
        if isinstance(s, tree.Branches) and s.kind == "when":
            algorithm.carry_out_when(s)
        else:
            algorithm.carry_out(s)
            algorithm.keep_relations()
    for name in algorithm.kept:
        scope.discrete.give(name, algorithm.once.get(name, algorithm.local[name]), always=True)


class _Algorithm:
    """An algorithm with whens, carried out statement by statement.

    - `local`: the values so far. A variable that is kept has its value before the event until it is assigned; what is
      assigned once stands for itself from then on, so that long expressions stand once.
    - `once`: the values of the latter.
    """

    def __init__(self, scope: Scope, section: tuple[tree.Statement, ...]):
        self.scope = scope
        self.count = collections.Counter(n for s in _statements(section) for n in self._assigned(s))
        self.kept = [n for n in self.count if n in self.scope.definitions.stored]
        self.local: dict[str, Value] = {n: previous(self.scope.stored(n)) for n in self.kept}
        self.once: dict[str, Value] = {}

    def names(self, name: str) -> Value:
        return self.scope.interpreter.local_names(self.local, self.scope.value)(name)

    def carry_out(self, s: tree.Statement) -> None:
        if isinstance(s, tree.Effect):
            return
        self.scope.interpreter.execute((s,), self.local, self.names)
        for n in self._assigned(s):
            self._settle(n, self.local.get(n))

    def keep_relations(self) -> None:
        """Keeps the truth of relations that were read outside of whens."""
        for values in (self.local, self.once):
            values.update({n: self.scope.kept.in_discrete(values[n]) for n in self.kept if n in values})

    def carry_out_when(self, s: tree.Branches) -> None:
        acting = self.scope.discrete.branches([list(_conditions(self.scope, c, self.names)) for c, _ in s.branches])
        # Each branch begins with the values before the `when`: only one of them acts.
        before, results = dict(self.local), []
        for acts, (_, body) in zip(acting, s.branches, strict=True):
            self.local = dict(before)
            for each in body:
                self.carry_out(each)
                if isinstance(each, tree.Effect):
                    for target, value in _each_action(self.scope, (each,)):
                        _act(self.scope, acts, target, value)
            once = {n: self.once[n] for each in body for n in self._assigned(each) if n in self.once}
            results.append((acts, self.local | once))
        self.local = dict(before)
        for n in self.kept:
            if any(n in self._assigned(each) for _, body in s.branches for each in body):
                self.local[n] = _first([(acts, after[n]) for acts, after in results], before[n])
                self._settle(n, self.local[n])

    def _settle(self, name: str, value: Value) -> None:
        if name in self.kept and self.count[name] == 1:
            self.once[name], self.local[name] = value, self.scope.stored(name)

    def _assigned(self, s: tree.Statement) -> list[str]:
        return with_entries(assigned_in((s,)), self.scope.flat.model)


def _statements(section: tuple[tree.Statement, ...]) -> Iterator[tree.Statement]:
    """The statements of an algorithm, with those of its whens one by one."""
    for s in section:
        if isinstance(s, tree.Branches) and s.kind == "when":
            yield from (each for _, body in s.branches for each in body)
        else:
            yield s


def _act(scope: Scope, acts: Value, target: Target, value: Value) -> None:
    """What a branch does beside assigning."""
    if isinstance(target, str):
        scope.discrete.end(acts, target)
    elif isinstance(target, VariableSymbol):
        scope.discrete.reinit(acts, target, value)
    else:
        raise ModelError(f"reinit takes a state; got {target}")


def _conditions(scope: Scope, condition: tree.Expression, names) -> Iterator[tuple[Value, bool]]:
    """The conditions of which each makes a branch act, those of an array by themselves, each with whether it counts at
    the initial time."""
    if isinstance(condition, tree.Array):
        for entry in condition.entries:
            yield from _conditions(scope, entry, names)
        return
    at_start = any(isinstance(e, tree.Call) and e.function == "initial" for e in tree.each_part(condition))
    value = scope.interpreter.evaluate(condition, names)
    for each in value if isinstance(value, list) else [value]:
        yield as_condition(each), at_start


def _first(cases: list[tuple[Value, Value]], otherwise: Value) -> Value:
    """The value of the first case whose condition holds."""
    value = otherwise
    for acts, result in reversed(cases):
        value = chosen(acts, result, value)
    return value


def _each_action(scope: Scope, body: tuple[tree.Statement, ...]) -> Iterator[tuple[Target, Value]]:
    """Pairs (variable, new value); a text for `terminate`."""
    # What assigns one after another is carried out as a whole; what acts otherwise stands by itself.
    if any(isinstance(s, tree.Assignment | tree.Loop) for s in body):
        yield from _of_loops(scope, tuple(s for s in body if not isinstance(s, tree.Effect)))
        body = tuple(s for s in body if isinstance(s, tree.Effect))
    for s in body:
        if isinstance(s, tree.Effect):
            name, arguments = s.call.function, s.call.arguments
            if name == "reinit":
                states, values = map(scope.evaluate, arguments)
                for state, value in pairs(states, values):
                    yield state, sympy.sympify(value)
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


def _of_loops(scope: Scope, body: tuple[tree.Statement, ...]) -> Iterator[tuple[Target, Value]]:
    """What loops of equations assign."""
    local: dict[str, Value] = {}
    scope.interpreter.execute(body, local, scope.interpreter.local_names(local, scope.value))
    for n in with_entries(assigned_in(body), scope.flat.model):
        if n in scope.definitions.stored and n in local:
            yield DiscreteSymbol(n), local[n]


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
        discrete = isinstance(target, DiscreteSymbol)
        yield target, _first(cases, previous(target) if discrete else target)
