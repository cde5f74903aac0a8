"""Evaluates Modelica expressions and algorithms over symbols: what is constant is computed, the rest becomes SymPy.

Functions are carried out statement by statement. An `if` whose condition is not constant is carried out in both
branches, and a choice joins what they assign. Loops must have constant bounds.
"""

import math
from collections.abc import Callable, Mapping
from itertools import islice
from typing import Any, NoReturn

import sympy

from ..errors import ModelError, nearest
from ..modeling.symbols import VariableSymbol, der
from .builtin import FUNCTIONS, filled, matrix_product
from .flat_model import literal_numbers
from .operations import ARITHMETIC, RELATIONS, moves, of_complex_numbers
from .tree import (
    Array,
    Assignment,
    Binary,
    Branches,
    Call,
    Choice,
    Class,
    Comprehension,
    Declaration,
    End,
    Equality,
    Expression,
    Jump,
    Loop,
    Matrix,
    Number,
    Part,
    Range,
    Reference,
    Several,
    Statement,
    Text,
    Truth,
    Unary,
    Whole,
)
from .values import (
    Record,
    Results,
    Value,
    both,
    chosen,
    either,
    entrywise,
    is_condition,
    negated,
)

Names = Callable[[str], Value]  # the value of a name; raises KeyError for an unknown one
MOST_ROUNDS = 100_000  # of a loop that is carried out while the model is read
LONG = 30  # nodes of an expression of a function that gets a name; a sum of three products has ten
DEEPEST = 200  # calls within calls; Python's own limit lies at a thousand frames


class Interpreter:
    """Evaluates what stands in a flat model.

    - `classes`: functions, records and enumerations, by name.
    - `names`: what a name of the model means.
    - `special`: calls that only the model can answer, such as `pre`, by name: from the arguments as written.
    - `externals`: functions in place of those that are written in C, by name.
    - `named`: gives an expression of a function a name, so that what is read several times stands once.
    - `entries`: the places of the entries that are declared one by one, by the name of their array.
    """

    def __init__(
        self,
        classes: Mapping[str, Class],
        names: Names,
        special: Mapping[str, Callable[..., Value]],
        externals: Mapping[str, Callable[..., Value]],
        entries: Mapping[str, list[tuple[int, ...]]] | None = None,
        named: Callable[[sympy.Expr], Value] = lambda e: e,
    ):
        self.classes, self.names, self.entries = classes, names, entries or {}
        self.special, self.externals = special, externals
        self.literals = literal_numbers(classes)
        self.quiet = False  # True inside of noEvent, smooth and functions: conditions there are no events
        self.quieted: set[sympy.Basic] = set()  # conditions that stood in noEvent
        self.named = named
        self.depth = 0
        self.guarded = 0  # conditions that are not constant, around what is carried out

    # --- expressions -------------------------------------------------------------------------------------------------

    def evaluate(self, e: Expression, names: Names | None = None) -> Value:
        """The value of an expression, with `names` in place of the model's; the first result of a function."""
        value = self.results(e, names)
        return value[0] if isinstance(value, Results) else value

    def results(self, e: Expression, names: Names | None = None) -> Value:
        """As `evaluate`, but all results of a function."""
        return _EVALUATED[type(e)](self, e, names or self.names)

    def _reference(self, e: Reference, names: Names) -> Value:
        path = e.path
        if path in self.literals:
            return self.literals[path]
        if not any(e.subscripts):
            try:
                return names(path)
            except KeyError:
                pass
        return self._by_parts(e, names)

    def _by_parts(self, e: Reference, names: Names) -> Value:
        """A reference into an array or record: the longest beginning that has a name, then fields and subscripts."""
        if any(e.subscripts):
            written = self._entry_name(e, names)
            if written is not None:
                try:
                    return names(written)
                except KeyError:
                    pass
        for n in range(len(e.parts), 0, -1):
            try:
                value = names(".".join(e.parts[:n]))
            except KeyError:
                continue
            if any(e.subscripts[: n - 1]):
                continue
            value = self._entry(value, e.subscripts[n - 1], names)
            for field, subscripts in zip(e.parts[n:], e.subscripts[n:], strict=True):
                value = self._entry(_field(value, field), subscripts, names)
            return value
        raise ModelError(f"'{e.path}' is not declared")

    def name_of(self, e: Reference) -> str:
        """The name of a variable that is declared by itself, an entry of an array among them."""
        return (self._entry_name(e, self.names) if any(e.subscripts) else None) or e.path

    def _entry_name(self, e: Reference, names: Names) -> str | None:
        """The name of an entry that is declared by itself, as 'x[2].y'."""
        out = []
        for part, subscripts in zip(e.parts, e.subscripts, strict=True):
            try:
                numbers = [self.constant(s, names) for s in subscripts if not isinstance(s, Whole | End)]
            except (ModelError, KeyError):
                return None
            if len(numbers) != len(subscripts) or not all(isinstance(n, int) for n in numbers):
                return None
            out.append(f"{part}[{','.join(map(str, numbers))}]" if numbers else part)
        return ".".join(out)

    def _entry(self, value: Value, subscripts: tuple[Expression, ...], names: Names) -> Value:
        if not subscripts:
            return value
        if not isinstance(value, list):
            raise ModelError(f"{value!r} is not an array, but has a subscript")
        first, *rest = subscripts
        if isinstance(first, Whole):
            chosen_rows: Value = value
        else:
            index = self.evaluate(first, _with_end(names, len(value)))
            if isinstance(index, list):
                chosen_rows = [value[_index(k, len(value))] for k in index]
            elif isinstance(index, int | float):
                return self._entry(value[_index(index, len(value))], tuple(rest), names)
            else:
                return self._by_choice(value, index, tuple(rest), names)
        return [self._entry(row, tuple(rest), names) for row in chosen_rows]

    def _by_choice(self, value: list, index: Value, rest: tuple, names: Names) -> Value:
        """The entry of an array whose subscript is not constant."""
        entries = [self._entry(row, rest, names) for row in value]
        out = entries[-1]
        for k in range(len(entries) - 1, 0, -1):
            out = chosen(RELATIONS["=="](index, k), entries[k - 1], out, self.quiet)
        return out

    def _unary(self, e: Unary, names: Names) -> Value:
        value = self.evaluate(e.operand, names)
        return entrywise(negated if e.operator == "not" else lambda x: -x, value)

    def _binary(self, e: Binary, names: Names) -> Value:
        sign = e.operator
        if sign in ("and", "or"):
            a = self.evaluate(e.left, names)
            if isinstance(a, bool) and a == (sign == "or"):
                return a
            return entrywise(both if sign == "and" else either, a, self.evaluate(e.right, names))
        a, b = self.evaluate(e.left, names), self.evaluate(e.right, names)
        if sign in RELATIONS:
            return RELATIONS[sign](a, b) if sign in ("==", "<>") else RELATIONS[sign](*map(self._compared, (a, b)))
        if sign == "*" and isinstance(a, list) and isinstance(b, list):
            return matrix_product(a, b)
        if sign == "+" and isinstance(a, str):
            return a + str(b)
        if isinstance(a, Record) or isinstance(b, Record):
            return of_complex_numbers(sign, a, b)
        return entrywise(ARITHMETIC[sign.removeprefix(".")], a, b)

    def _compared(self, value: Value) -> Value:
        """A side of a relation. A choice in it that moves gets a name: SymPy would spread the relation over all
        branches, and compare these as sets."""
        if self.guarded or not isinstance(value, sympy.Expr) or not value.has(sympy.Piecewise):
            return value
        stays = isinstance(value, sympy.Piecewise) and not moves(value)
        return self.named(value) if value.atoms(VariableSymbol) and not stays else value

    def _choice(self, e: Choice, names: Names) -> Value:
        pairs = []
        guarded = self.guarded
        for condition, value in e.branches:
            holds = self.evaluate(condition, names)
            if holds is False:
                continue
            if holds is True:
                pairs.append((True, self.evaluate(value, names)))
                break
            self.guarded = guarded + 1
            pairs.append((holds, self.evaluate(value, names)))
        else:
            pairs.append((True, self.evaluate(e.otherwise, names)))
        self.guarded = guarded
        out = pairs[-1][1]
        for condition, value in reversed(pairs[:-1]):
            out = chosen(condition, value, out, self.quiet or condition in self.quieted)
        return out

    def _comprehension(self, e: Comprehension, names: Names) -> list:
        (name, over), *rest = e.iterators
        values = self._range_of(over, names)
        inner = Comprehension(e.value, tuple(rest)) if rest else e.value
        return [self.evaluate(inner, _with(names, name, v)) for v in values]

    def _range_of(self, e: Expression | None, names: Names) -> list:
        if e is None:
            raise ModelError("a loop without a range")
        values = self.evaluate(e, names)
        return values if isinstance(values, list) else [values]

    def _range(self, e: Range, names: Names) -> list:
        first, step, last = (self.constant(x, names) for x in (e.first, e.step, e.last))
        count = math.floor(round((last - first) / step, 6)) + 1  # rounding: 0.3 / 0.1 is below 3
        return [first + k * step for k in range(max(count, 0))]

    def _matrix(self, e: Matrix, names: Names) -> list:
        rows = []
        for row in e.rows:
            entries = [self.evaluate(x, names) for x in row]
            rows.append([x for entry in entries for x in (entry if isinstance(entry, list) else [entry])])
        return rows

    def _part(self, e: Part, names: Names) -> Value:
        whole = self.evaluate(e.whole, names)
        return _field(whole, e.field) if e.field is not None else self._entry(whole, e.subscripts, names)

    def constant(self, e: Expression, names: Names | None = None) -> Value:
        """The value of an expression that must be known now, such as a subscript or the end of a loop."""
        value = self.evaluate(e, names)
        if not isinstance(value, int | float | bool | str | list):
            raise ModelError(f"a constant is needed; got {value}")
        return value

    # --- calls -------------------------------------------------------------------------------------------------------

    def _call(self, e: Call, names: Names) -> Value:
        name = e.function
        if name in self.special:
            return self.special[name](*e.arguments)
        if name in ("noEvent", "smooth"):
            return self._without_events(e, names)
        if name == "der":
            return entrywise(der, self.evaluate(e.arguments[0], names))
        arguments = [self.evaluate(a, names) for a in e.arguments]
        named = {k: self.evaluate(v, names) for k, v in e.named}
        if name in FUNCTIONS:
            return FUNCTIONS[name](*arguments, **named)
        return self.call(name, arguments, named)

    def _without_events(self, e: Call, names: Names) -> Value:
        if e.function == "smooth" and self.constant(e.arguments[0], names) == 0:
            return self.evaluate(e.arguments[1], names)  # continuous only: its kinks stay events
        before, self.quiet = self.quiet, True
        try:
            value = self.evaluate(e.arguments[-1], names)
        finally:
            self.quiet = before
        if is_condition(value) and not isinstance(value, bool):
            self.quieted.add(value)
        return value

    def call(self, name: str, arguments: list[Value], named: dict[str, Value]) -> Value:
        """The results of a function: one value, or a list of several."""
        last = name.rpartition(".")[2]
        for known in (name, last):
            if known in self.externals:
                return self.externals[known](*arguments, **named)
        function = self.classes.get(name)
        if function is None or function.external is not None:
            if name.startswith("Modelica.Math.") and last in FUNCTIONS:
                return FUNCTIONS[last](*arguments, **named)
        if function is None:
            raise ModelError(f"the function '{name}' is not known: {nearest(name, [*FUNCTIONS, *self.classes])}")
        inputs = [d for d in function.declarations if "input" in d.prefixes]
        if function.kind == "record":
            inputs = list(function.declarations)
        given = dict(zip((d.name for d in inputs), arguments, strict=False)) | named
        if function.kind == "record":
            return Record({d.name: self._input(d, given, given) for d in inputs})
        if function.external is not None:
            external = self.externals.get(function.external)
            if external is None:
                raise ModelError(f"the function '{name}' calls '{function.external}', which is written in C")
            return external(*(self._input(d, given, given) for d in inputs))
        return self._carried_out(function, inputs, given)

    def _input(self, d: Declaration, given: dict[str, Value], known: Mapping[str, Value]) -> Value:
        if d.name in given:
            return given[d.name]
        if d.value is None:
            raise ModelError(f"the argument '{d.name}' is missing")
        return self.evaluate(d.value, _local(known, self.names))

    def _carried_out(self, function: Class, inputs: list[Declaration], given: dict[str, Value]) -> Value:
        if self.depth > DEEPEST:
            raise ModelError(f"the function '{function.name}' calls itself too often")
        before, guarded, self.quiet, self.depth = self.quiet, self.guarded, True, self.depth + 1
        local: dict[str, Value] = {}
        names = _local(local, self.names)
        try:
            for d in function.declarations:
                if "input" in d.prefixes:
                    local[d.name] = self._named(self._input(d, given, local))
                elif d.value is not None:
                    local[d.name] = self._named(self.evaluate(d.value, names))
                else:
                    local[d.name] = self._unset(d, names)
            for statements in function.algorithms:
                self.execute(statements, local, names)
        except ModelError as error:
            raise ModelError(f"{function.name}: {error}") from None
        finally:
            self.quiet, self.guarded, self.depth = before, guarded, self.depth - 1
        outputs = [local[d.name] for d in function.declarations if "output" in d.prefixes]
        return outputs[0] if len(outputs) == 1 else Results(outputs)

    def _named(self, value: Value) -> Value:
        """A value of a function by names for what is long in it. Under a condition nothing gets a name: it need not
        have a value where the condition does not hold."""
        if isinstance(value, list):
            return [self._named(v) for v in value]
        if isinstance(value, Record):
            return Record({k: self._named(v) for k, v in value.items()})
        if not self.depth or self.guarded or not isinstance(value, sympy.Expr):
            return value
        return value if sum(1 for _ in islice(sympy.preorder_traversal(value), LONG)) < LONG else self.named(value)

    def _unset(self, d: Declaration, names: Names) -> Value:
        """What a variable of a function holds before it is assigned."""
        of = self.classes.get(d.type)
        empty: Value = None
        if of is not None and of.kind in ("record", "class") and not of.literals and of.external is None:
            empty = Record({f.name: self._unset(f, names) for f in of.declarations})
        counts = []
        for dimension in d.dimensions:
            if isinstance(dimension, Whole):
                return None
            counts.append(self.constant(dimension, names))
        if isinstance(empty, Record):
            one = d._replace(dimensions=d.dimensions[1:])
            return [self._unset(one, names) for _ in range(counts[0])] if counts else empty
        return filled(None, *counts)

    # --- statements --------------------------------------------------------------------------------------------------

    def execute(self, statements: tuple[Statement, ...], local: dict[str, Value], names: Names) -> None:
        """Carries out an algorithm; assigns to `local`.

        `return` and `break` become truths in `local`, conditions under a condition that is not constant. What follows
        is carried out where they do not hold.
        """
        for s in statements:
            ended = either(local.get("return", False), local.get("break", False))
            if ended is True:
                return
            if ended is False:
                self._statement(s, local, names)
                continue
            copied = dict(local)
            self.guarded += 1
            self._statement(s, copied, _local(copied, names))
            self.guarded -= 1
            self._join(ended, dict(local), copied, local)

    def _statement(self, s: Statement, local: dict[str, Value], names: Names) -> None:
        if isinstance(s, Assignment | Equality):
            target, value = (s.target, s.value) if isinstance(s, Assignment) else (s.left, s.right)
            found = (self.results if isinstance(target, Several) else self.evaluate)(value, names)
            self._assign(target, self._named(found), local, names)
        elif isinstance(s, Branches):
            self._branches(s, local, names)
        elif isinstance(s, Loop):
            self._loop(s, local, names)
        elif isinstance(s, Jump):
            local[s.kind] = True
        # What stands alone is a check or a message: assert, print.

    def _join(self, condition: Value, a: dict[str, Value], b: dict[str, Value], local: dict[str, Value]) -> None:
        """Assigns what two branches assign: that of `a` where the condition holds."""
        for name in a.keys() | b.keys():
            otherwise = False if name in ("return", "break") else local.get(name)
            local[name] = _joined(condition, a.get(name, otherwise), b.get(name, otherwise), self.quiet)

    def _assign(self, target: Expression, value: Value, local: dict[str, Value], names: Names) -> None:
        if isinstance(target, Several):
            for each, v in zip(target.entries, value, strict=False):
                if each is not None:
                    self._assign(each, v, local, names)
            return
        if not isinstance(target, Reference):
            raise ModelError("only variables can be assigned")
        if len(target.parts) == 1 and not target.subscripts[0]:
            self._assign_whole(target.parts[0], _copied(value), local)
            return
        entry = self._entry_name(target, names)
        if entry is not None and (entry in local or target.parts[0] not in local):
            local[entry] = value
            return
        local[target.parts[0]] = self._changed(
            local.get(target.parts[0]), target.subscripts[0], target.parts[1:], target.subscripts[1:], value, names
        )

    def _assign_whole(self, name: str, value: Value, local: dict[str, Value]) -> None:
        """Assigns to a variable; one by one to the entries of an array of the model, which are declared one by one."""
        places = self.entries.get(name, ()) if name not in local and isinstance(value, list) else ()
        if not places:
            local[name] = value
        for place in places:
            entry = value
            for k in place:
                entry = entry[k - 1]
            local[f"{name}[{','.join(map(str, place))}]"] = entry

    def _changed(self, old: Value, subscripts: tuple, parts: tuple, rest: tuple, value: Value, names: Names) -> Value:
        """An array or record with one place changed."""
        if subscripts:
            first, *others = subscripts
            entries = list(old) if isinstance(old, list) else []
            if isinstance(first, Whole):
                where: Value = list(range(1, len(entries) + 1))
            else:
                where = self.evaluate(first, _with_end(names, len(entries)))
            if not isinstance(where, list):
                if not isinstance(where, int | float):
                    raise ModelError(f"the place of an assigned entry must be constant; got {where}")
                k = _index(where, len(entries))
                entries[k] = self._changed(entries[k], tuple(others), parts, rest, value, names)
                return entries
            for k, v in zip(where, value, strict=True):
                at = _index(k, len(entries))
                entries[at] = self._changed(entries[at], tuple(others), parts, rest, v, names)
            return entries
        if parts:
            record = Record(old if isinstance(old, dict) else {})
            record[parts[0]] = self._changed(record.get(parts[0]), rest[0], parts[1:], rest[1:], value, names)
            return record
        return _copied(value)

    def _branches(self, s: Branches, local: dict[str, Value], names: Names) -> None:
        """An `if`; a branch whose condition is not constant is carried out on a copy."""
        for k, (condition, body) in enumerate(s.branches):
            holds = self.evaluate(condition, names)
            if holds is False:
                continue
            if holds is True:
                self.execute(body, local, names)
                return
            rest = s._replace(branches=s.branches[k + 1 :])
            results = []
            self.guarded += 1
            for statements in (body, (rest,)):
                copied = dict(local)
                self.execute(statements, copied, _local(copied, names))
                results.append(copied)
            self.guarded -= 1
            self._join(holds, results[0], results[1], local)
            return

    def _loop(self, s: Loop, local: dict[str, Value], names: Names) -> None:
        outer = local.get("break", False)
        if s.condition is None:
            self._rounds(s.iterators, s.body, local, names)
        else:
            self._while(s.condition, s.body, local, names)
        local["break"] = outer

    def _while(self, condition: Expression, body: tuple, local: dict[str, Value], names: Names) -> None:
        for _ in range(MOST_ROUNDS):
            holds = self.evaluate(condition, names)
            if not isinstance(holds, bool):
                raise ModelError(f"the condition of a while loop must be constant; got {holds}")
            if not holds or local.get("return") is True or local.get("break") is True:
                return
            self.execute(body, local, names)
        raise ModelError(f"a while loop takes more than {MOST_ROUNDS} rounds")

    def _rounds(self, iterators: tuple, body: tuple, local: dict[str, Value], names: Names) -> None:
        (name, over), *rest = iterators
        was_there, shadowed = name in local, local.get(name)
        for value in self._range_of(over, names):
            if local.get("return") is True or local.get("break") is True:
                break
            local[name] = value
            if rest:
                self._rounds(tuple(rest), body, local, names)
            else:
                self.execute(body, local, names)
        local.pop(name, None)
        if was_there:
            local[name] = shadowed


def _joined(condition: Value, a: Value, b: Value, quiet: bool) -> Value:
    if a is b:
        return a
    if a is None or b is None:
        return b if a is None else a
    return chosen(condition, a, b, quiet)


def _copied(value: Value) -> Value:
    """Arrays are values: no two names share one."""
    if isinstance(value, list):
        return [_copied(v) for v in value]
    return Record({k: _copied(v) for k, v in value.items()}) if isinstance(value, Record) else value


def _field(value: Value, name: str) -> Value:
    if isinstance(value, list):
        return [_field(v, name) for v in value]
    if not isinstance(value, dict) or name not in value:
        raise ModelError(f"there is no field '{name}' in {value!r}")
    return value[name]


def _index(k: Value, count: int) -> int:
    if not (float(k).is_integer() and 1 <= k <= count):
        raise ModelError(f"the subscript {k} is outside of 1:{count}")
    return int(k) - 1


def _with(names: Names, name: str, value: Value) -> Names:
    return lambda n: value if n == name else names(n)


def _with_end(names: Names, count: int) -> Names:
    return _with(names, "end", count)


def _local(local: Mapping[str, Value], outer: Names) -> Names:
    def names(name: str) -> Value:
        if name in local:
            value = local[name]
            if value is None:
                raise ModelError(f"'{name}' is read before it is assigned")
            return value
        return outer(name)

    return names


def _refused(_: Interpreter, e: Any, __: Names) -> NoReturn:
    raise ModelError(f"{type(e).__name__} cannot stand in an expression")


_EVALUATED: dict[type, Callable[[Interpreter, Any, Names], Value]] = {
    Number: lambda self, e, names: e.value,
    Truth: lambda self, e, names: e.truth,
    Text: lambda self, e, names: e.text,
    End: lambda self, e, names: names("end"),
    Reference: Interpreter._reference,
    Call: Interpreter._call,
    Unary: Interpreter._unary,
    Binary: Interpreter._binary,
    Choice: Interpreter._choice,
    Array: lambda self, e, names: [x for a in e.entries for x in _entries(self, a, names)],
    Matrix: Interpreter._matrix,
    Range: Interpreter._range,
    Comprehension: Interpreter._comprehension,
    Part: Interpreter._part,
    Several: lambda self, e, names: [None if x is None else self.evaluate(x, names) for x in e.entries],
    Whole: _refused,
}


def _entries(self: Interpreter, e: Expression, names: Names) -> list[Value]:
    """The entries that one argument of {…} stands for: several for `f(i) for i in …`."""
    value = self.evaluate(e, names)
    return value if isinstance(e, Comprehension) else [value]
