"""Evaluates Modelica expressions over symbols: what is constant is computed, the rest becomes SymPy."""

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

import sympy

from ..base.errors import ModelError
from ..write.symbols import VariableSymbol, der
from . import tree
from .builtin import (
    DIVISIONS,
    FUNCTIONS,
    applied,
    matrix_power,
    matrix_product,
    numbers_checked,
    of_whole_numbers,
    rows_joined,
)  # fmt: skip
from .flat_model import literal_numbers
from .operations import ARITHMETIC, RELATIONS, moves, of_complex_numbers
from .read_expressions import FUNCTION
from .values import Record, Results, Value, both, chosen, either, entrywise, is_condition, negated

Names = Callable[[str], Value]  # the value of a name; raises KeyError for an unknown one


class Quieted:
    """Conditions that stand in noEvent everywhere. One that stands elsewhere, too, is an event there."""

    def __init__(self):
        self.within: set[Value] = set()
        self.elsewhere: set[Value] = set()

    def __contains__(self, condition: object) -> bool:
        return condition in self.within and condition not in self.elsewhere

    def __iter__(self) -> Iterator[Value]:
        return iter(self.within - self.elsewhere)

    def __len__(self) -> int:
        return len(self.within - self.elsewhere)


class Evaluator:
    """Evaluates the expressions of a flat model. `call` carries out functions.

    - `classes`: functions, records and enumerations, by name.
    - `names`: what a name of the model means.
    - `special`: calls that only the model can answer, such as `pre`, by name: from the arguments as written.
    - `externals`: functions in place of those that are written in C, by name.
    - `named`: gives an expression of a function a name, so that what is read several times stands once.
    - `opaque`: the results of a function of JAX, so many, from the values of its arguments, and
        what messages call it.
    - `entries`: the places of the entries that are declared one by one, by the name of their array.
    """

    def __init__(
        self,
        classes: Mapping[str, tree.Class],
        names: Names,
        special: Mapping[str, Callable[..., Value]],
        externals: Mapping[str, Callable[..., Value]],
        entries: Mapping[str, list[tuple[int, ...]]] | None = None,
        named: Callable[[sympy.Expr], Value] = lambda e: e,
        opaque: Callable[[Callable, Sequence[Value], int, str], Sequence[Value]] = lambda *_: (),
    ):
        self.classes, self.names = classes, names
        self.entries = {} if entries is None else entries  # an empty one may be filled later
        self.special, self.externals = special, externals
        self.literals = literal_numbers(classes)
        self.quiet = False  # True inside of noEvent, smooth and functions: conditions there are no events
        self.quieted = Quieted()
        self.named, self.opaque = named, opaque
        self.is_integer: Callable[[str], bool] = lambda name: False  # true for Integer variables
        self.depth = 0
        self.around = names  # where a special call stands: the iterators of loops are among them
        self.guards: list[Value] = []  # conditions that are not constant, around what is carried out

    # --- expressions -------------------------------------------------------------------------------------------------

    def evaluate(self, e: tree.Expression, names: Names | None = None) -> Value:
        """The value of an expression, with `names` in place of the model's; the first result of a function."""
        value = self.results(e, names)
        return value[0] if isinstance(value, Results) else value

    def results(self, e: tree.Expression, names: Names | None = None) -> Value:
        """As `evaluate`, but all results of a function."""
        return _EVALUATED[type(e)](self, e, names or self.names)

    def _reference(self, e: tree.Reference, names: Names) -> Value:
        return self.referred(e, names, names)

    def referred(self, e: tree.Reference, names: Names, inside: Names) -> Value:
        """What a reference stands for; `inside` are the names in its subscripts."""
        path = e.path
        if path in self.literals:
            return self.literals[path]
        written = self._entry_name(e, inside) if any(e.subscripts) else path
        if written is not None:
            try:
                return names(written)
            except KeyError:
                pass
        # It leads into an array or a record: the longest beginning that has a name, then fields and subscripts.
        for n in range(len(e.parts), 0, -1):
            try:
                value = names(".".join(e.parts[:n]))
            except KeyError:
                continue
            if any(e.subscripts[: n - 1]):
                continue
            value = self._entry(value, e.subscripts[n - 1], inside)
            for field, subscripts in zip(e.parts[n:], e.subscripts[n:], strict=True):
                value = self._entry(_field(value, field), subscripts, inside)
            return value
        if path == "Boolean":
            return [False, True]
        if path in self.classes and self.classes[path].literals:  # all values of an enumeration, as in `for e in E`
            return list(range(1, len(self.classes[path].literals) + 1))
        raise ModelError(f"'{path}' is not declared")

    def count(self, dimension: tree.Expression, names: Names | None = None) -> int:
        """The size of a dimension: a number, or that of an enumeration."""
        found = self.constant(dimension, names)
        return len(found) if isinstance(found, list) else int(found)

    def local_names(self, local: Mapping[str, Value], outer: Names) -> Names:
        """The names in a function or algorithm: those of `local` hide others."""

        def names(name: str) -> Value:
            if name in local:
                value = local[name]
                if value is None:
                    raise ModelError(f"'{name}' is read before it is assigned")
                return value
            # An entry or a field of a local variable is not that of a variable of the model with the same name.
            if beginning(name) in local:
                raise KeyError(name)
            places = self.entries.get(name, ())
            if any(tree.entry_name(name, p) in local for p in places):  # an algorithm has assigned some of them
                return array_of(name, places, names)
            return outer(name)

        return names

    def name_of(self, e: tree.Reference) -> str:
        """The name of a variable that is declared by itself, an entry of an array among them."""
        return (self._entry_name(e, self.names) if any(e.subscripts) else None) or e.path

    def entries_of(self, name: str, value: list) -> Iterator[tuple[str, Value]]:
        """The entries of an array that are declared one by one: names and values."""
        for place in self.entries.get(name, ()):
            yield tree.entry_name(name, place), functools.reduce(lambda entry, k: entry[k - 1], place, value)

    def _entry_name(self, e: tree.Reference, names: Names) -> str | None:
        """The name of an entry that is declared by itself, as 'x[2].y'."""
        out = []
        for part, subscripts in zip(e.parts, e.subscripts, strict=True):
            try:
                numbers = [self.constant(s, names) for s in subscripts if not isinstance(s, tree.Whole | tree.End)]
            except (ModelError, KeyError):
                return None
            if len(numbers) != len(subscripts) or not all(isinstance(n, int) for n in numbers):
                return None
            out.append(tree.entry_name(part, numbers) if numbers else part)
        return ".".join(out)

    def _entry(self, value: Value, subscripts: tuple[tree.Expression, ...], names: Names) -> Value:
        if not subscripts:
            return value
        if not isinstance(value, list):
            raise ModelError(f"{value!r} is not an array, but has a subscript")
        first, *rest = subscripts
        if isinstance(first, tree.Whole):
            chosen_rows: Value = value
        else:
            index = self.evaluate(first, with_end(names, len(value)))
            if isinstance(index, list):
                chosen_rows = [value[index_of(k, len(value))] for k in index]
            elif isinstance(index, int | float):
                return self._entry(value[index_of(index, len(value))], tuple(rest), names)
            else:
                return self._by_choice(value, index, tuple(rest), names)
        return [self._entry(row, tuple(rest), names) for row in chosen_rows]

    def _by_choice(self, value: list, index: Value, rest: tuple, names: Names) -> Value:
        """The entry of an array whose subscript is not constant."""
        # The last entry needs no condition: a subscript outside of the array means nothing.
        entries = [self._entry(row, rest, names) for row in value]
        out = entries[-1]
        for k in range(len(entries) - 1, 0, -1):
            out = chosen(RELATIONS["=="](index, k), entries[k - 1], out, self.quiet)
        return out

    def _unary(self, e: tree.Unary, names: Names) -> Value:
        value = self.evaluate(e.operand, names)
        return entrywise(negated if e.operator == "not" else lambda x: -x, value)

    def _binary(self, e: tree.Binary, names: Names) -> Value:
        sign = e.operator
        if sign in ("and", "or"):
            a = self.evaluate(e.left, names)
            # The right side may have no value, as the entry of an array of size zero behind "n > 0 and".
            if isinstance(a, bool) and a == (sign == "or"):
                return a
            return entrywise(both if sign == "and" else either, a, self.evaluate(e.right, names))
        a, b = self.evaluate(e.left, names), self.evaluate(e.right, names)
        if sign in RELATIONS:
            sides = (a, b) if sign in ("==", "<>") else map(self._compared, (a, b))
            found = RELATIONS[sign](*sides)
            if not self.quiet:
                self.quieted.elsewhere.add(found)
            return found
        if sign == "*" and isinstance(a, list) and isinstance(b, list):
            return matrix_product(a, b)
        if sign == "^" and isinstance(a, list):
            return matrix_power(a, b)
        if sign == "+" and isinstance(a, str):
            return a + str(b)
        if sign in ("/", "./") and self.guards and isinstance(b, int | float) and b == 0:
            b = self.named(sympy.Float(0))  # in a branch that is never taken, as a ramp that takes no time
        if isinstance(a, Record) or isinstance(b, Record):
            return of_complex_numbers(sign, a, b)
        with numbers_checked(lambda: f"{a} {sign} {b}"):
            return entrywise(ARITHMETIC[sign.removeprefix(".")], a, b)

    def _compared(self, value: Value) -> Value:
        """A side of a relation. A choice in it that moves gets a name: SymPy would spread the relation over all
        branches, and compare these as sets."""
        if not isinstance(value, sympy.Expr) or not value.has(sympy.Piecewise):
            return value
        stays = isinstance(value, sympy.Piecewise) and not moves(value)
        return self.give_name(value) if value.atoms(VariableSymbol) and not stays else value

    def _choice(self, e: tree.Choice, names: Names) -> Value:
        pairs = []
        depth = len(self.guards)
        for condition, value in e.branches:
            holds = self.evaluate(condition, names)
            if holds is False:
                continue
            if holds is True:
                pairs.append((True, self.evaluate(value, names)))
                break
            # What is named inside holds under this condition only.
            self.guards.append(holds)
            pairs.append((holds, self.evaluate(value, names)))
            self.guards[-1] = negated(holds)
        else:
            pairs.append((True, self.evaluate(e.otherwise, names)))
        del self.guards[depth:]
        out = pairs[-1][1]
        for condition, value in reversed(pairs[:-1]):
            out = chosen(condition, value, out, self.quiet or condition in self.quieted)
        return out

    def _comprehension(self, e: tree.Comprehension, names: Names) -> list:
        # `{f(i, j) for i in a, j in b}` is `{{f(i, j) for i in a} for j in b}`: the last iterator counts the rows
        # (Modelica Language Specification 3.6, section 10.4.1.1).
        *rest, (name, over) = e.iterators
        values = self._range_of(over, names)
        inner: tree.Expression = e.value
        if rest:
            inner = tree.Array((tree.Comprehension(e.value, tuple(rest)),))
        return [self.evaluate(inner, _with(names, name, v)) for v in values]

    def _range_of(self, e: tree.Expression | None, names: Names) -> list:
        if e is None:
            raise ModelError("a loop without a range")
        values = self.evaluate(e, names)
        return values if isinstance(values, list) else [values]

    def _range(self, e: tree.Range, names: Names) -> list:
        first, step, last = (self.constant(x, names) for x in (e.first, e.step, e.last))
        if isinstance(first, bool):
            return [b for b in (False, True) if first <= b <= last]
        if step == 0:
            raise ModelError(f"the range {first}:0:{last} has no step")
        count = math.floor(round((last - first) / step, 6)) + 1  # rounding: 0.3 / 0.1 is below 3
        return [first + k * step for k in range(max(count, 0))]

    def _matrix(self, e: tree.Matrix, names: Names) -> list:
        return rows_joined([[self.evaluate(x, names) for x in row] for row in e.rows])

    def _part(self, e: tree.Part, names: Names) -> Value:
        whole = self.evaluate(e.whole, names)
        return _field(whole, e.field) if e.field is not None else self._entry(whole, e.subscripts, names)

    def constant(self, e: tree.Expression, names: Names | None = None) -> Value:
        """The value of an expression that must be known now, such as a subscript or the end of a loop."""
        value = self.evaluate(e, names)
        if not isinstance(value, int | float | bool | str | list):
            raise ModelError(f"a constant is needed; got {value}")
        return value

    # --- calls -------------------------------------------------------------------------------------------------------

    def _call(self, e: tree.Call, names: Names) -> Value:
        name = e.function
        if name in self.classes:  # a function of the text hides one that is built in
            return self.call(name, *self._arguments(e, names))
        if name in self.special:
            before, self.around = self.around, names
            try:
                return self.special[name](*e.arguments)
            finally:
                self.around = before
        if name in ("noEvent", "smooth"):
            return self._without_events(e, names)
        if name == FUNCTION:
            return self._applied(e.arguments[0], names)
        if name == "der":
            return entrywise(der, self.evaluate(e.arguments[0], names))
        arguments, named = self._arguments(e, names)
        if name in DIVISIONS and len(arguments) == 2 and not named:
            a, b = arguments
            if isinstance(a, sympy.Expr) and isinstance(b, int) and b and self._is_whole(a):
                return of_whole_numbers(name, a, b)
        if name in FUNCTIONS:
            return applied(name, arguments, named)
        # A function that is an argument is called by the argument's name.
        if "." not in name:
            try:
                return names(name)(*arguments, **named)
            except KeyError:
                pass
        return self.call(name, arguments, named)

    def _is_whole(self, value: sympy.Expr) -> bool:
        """True for what is seen to be a whole number: sums, products and choices of Integer variables."""
        parts = sympy.preorder_traversal(value)
        return all(
            p.is_Integer if p.is_Number else self.is_integer(str(p)) if p.is_Symbol else not p.is_Pow for p in parts
        )

    def _arguments(self, e: tree.Call, names: Names) -> tuple[list[Value], dict[str, Value]]:
        return [self.evaluate(a, names) for a in e.arguments], {k: self.evaluate(v, names) for k, v in e.named}

    def _without_events(self, e: tree.Call, names: Names) -> Value:
        if e.function == "smooth" and self.constant(e.arguments[0], names) == 0:
            return self.evaluate(e.arguments[1], names)  # continuous only: its kinks stay events
        # Put back rather than set to False: `noEvent` may stand in another one.
        before, self.quiet = self.quiet, True
        try:
            value = self.evaluate(e.arguments[-1], names)
        finally:
            self.quiet = before
        if is_condition(value) and not isinstance(value, bool):
            self.quieted.within.add(value)
        return value

    def _applied(self, e: tree.Expression, names: Names) -> Value:
        """A function as an argument, with those of its arguments that are given."""
        if not isinstance(e, tree.Call):
            raise ModelError("a function as an argument has its arguments in parentheses")
        given = {k: self.evaluate(v, names) for k, v in e.named}
        return lambda *arguments, **more: self.call(e.function, list(arguments), given | more)

    def call(self, name: str, arguments: list[Value], named: dict[str, Value]) -> Value:
        """The results of a function that is not built in."""
        raise NotImplementedError

    def give_name(self, value: sympy.Expr) -> Value:
        """A value by a name. Under conditions it is named as zero where they do not hold, for it need not have a
        value there."""
        if not self.guards:
            return self.named(value)
        condition = functools.reduce(both, self.guards)
        if isinstance(condition, bool):  # what is never reached stays as it is
            return value
        guarded = chosen(condition, value, 0.0, quiet=True)
        named = self.named(guarded)
        return value if named is guarded else named


def _field(value: Value, name: str) -> Value:
    if isinstance(value, list):
        return [_field(v, name) for v in value]
    if not isinstance(value, dict) or name not in value:
        raise ModelError(f"there is no field '{name}' in {value!r}")
    return value[name]


def index_of(k: Value, count: int) -> int:
    k = k + 1 if isinstance(k, bool) else k  # of a dimension that is Boolean
    if not (float(k).is_integer() and 1 <= k <= count):
        raise ModelError(f"the subscript {k} is outside of 1:{count}")
    return int(k) - 1


def _with(names: Names, name: str, value: Value) -> Names:
    return lambda n: value if n == name else names(n)


def with_end(names: Names, count: int) -> Names:
    return _with(names, "end", count)


def array_of(name: str, places: Sequence[tuple[int, ...]], value_of: Names, depth: int = 0) -> list:
    """The array of the entries at these places, which have equal numbers before `depth`."""
    out = []
    for k in sorted({p[depth] for p in places}):
        inside = [p for p in places if p[depth] == k]
        if len(inside[0]) > depth + 1:
            out.append(array_of(name, inside, value_of, depth + 1))
        else:
            out.append(value_of(tree.entry_name(name, inside[0])))
    return out


def beginning(name: str) -> str:
    """The first part of a name, without its subscripts."""
    return name.partition("[")[0].partition(".")[0]


def _refused(_: Evaluator, e: object, __: Names) -> NoReturn:
    raise ModelError(f"{type(e).__name__} cannot stand in an expression")


_EVALUATED: dict[type, Callable[[Evaluator, Any, Names], Value]] = {
    tree.Number: lambda self, e, names: e.value,
    tree.Truth: lambda self, e, names: e.truth,
    tree.Text: lambda self, e, names: e.text,
    tree.End: lambda self, e, names: names("end"),
    tree.Reference: Evaluator._reference,
    tree.Call: Evaluator._call,
    tree.Unary: Evaluator._unary,
    tree.Binary: Evaluator._binary,
    tree.Choice: Evaluator._choice,
    tree.Array: lambda self, e, names: [x for a in e.entries for x in _entries(self, a, names)],
    tree.Matrix: Evaluator._matrix,
    tree.Range: Evaluator._range,
    tree.Comprehension: Evaluator._comprehension,
    tree.Part: Evaluator._part,
    tree.Several: lambda self, e, names: [None if x is None else self.evaluate(x, names) for x in e.entries],
    tree.Result: lambda self, e, names: self.results(e.call, names)[e.number],
    tree.Whole: _refused,
}


def _entries(self: Evaluator, e: tree.Expression, names: Names) -> list[Value]:
    """The entries that one argument of {…} stands for: several for `f(i) for i in …`."""
    value = self.evaluate(e, names)
    return value if isinstance(e, tree.Comprehension) else [value]
