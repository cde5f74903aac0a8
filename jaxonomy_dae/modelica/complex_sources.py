"""Equations between complex numbers in Modelica sources, written as two equations between real numbers.

rumoca 0.10.2 reads records and calls of functions of records, but not the overloaded operators of the operator record
`Complex`: v = Z*i counts as one equation for two unknowns. Here, each equation of such quantities becomes one of their
real parts and one of their imaginary parts, and each real expression with complex numbers inside one without. Functions
of complex numbers are replaced by what they compute, as their sources say. Lines stay where they are. An equation that
is not understood stays as it is, and rumoca refuses the class that has it.
"""

import contextlib
import functools
import re
from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from . import tree
from .marked_source import Change, Mark, changed_text, size_of, type_of, where_array, with_entry
from .sources import Constant, Found, Sources
from .tree_text import text_of

Pair: TypeAlias = tuple[tree.Expression, tree.Expression]  # the real and the imaginary part
COMPLEX = "Complex"
_MENTIONED = re.compile(r"\bComplex|\bQuasiStatic\b")
_ZERO, _ONE = tree.Number(0), tree.Number(1)
_ELEMENTWISE = {"smooth": 1, "noEvent": 0, "homotopy": 0, "der": 0, "pre": 0}  # calls, and their first such argument
_ENTRY = "k__"  # counts entries where a function of numbers is called with arrays


class _NotSplit(Exception):
    """An expression that is not understood."""


def with_real_equations(sources: Sources, text: str) -> str:
    """The text of a file of a library without operations on complex numbers."""
    return changed_text(sources, text, functools.partial(_tried, sources, text)) if _MENTIONED.search(text) else text


def _tried(sources: Sources, text: str, of: Found, mark: Mark) -> Iterator[Change]:
    if not (isinstance(mark.right, tree.Call) and mark.right.function == "connect"):
        with contextlib.suppress(_NotSplit, RecursionError):
            # All changes of an equation or none: what is not understood may show when a part of it has been split.
            yield from list(_changed(_Complex(sources, of, {}, frozenset(mark.local)), mark, text))


def _changed(split: "_Complex", mark: Mark, text: str) -> Iterator[Change]:
    """What stands in place of an equation or a value, if it has operations on complex numbers."""
    if not split.has_operations(mark.right) and not (mark.left and split.has_operations(mark.left)):
        return
    if mark.left is not None:
        sides = mark.left, mark.right
        if any(map(split.is_complex, sides)):
            (a, b), (c, d) = map(split.pair, sides)
            new = f"{text_of(a)} = {text_of(c)}; {text_of(b)} = {text_of(d)}"
        else:
            new = " = ".join(text_of(split.real(e)) for e in sides)
        yield mark.begin, mark.end, new
    elif not split.is_complex(mark.right):
        yield mark.begin, mark.end, f" = {text_of(split.real(mark.right))}"
    elif mark.declared is not None:
        re_, im = map(text_of, split.pair(mark.right))
        before = text[: mark.begin].rstrip()
        if mark.declared.modifiers:
            yield len(before) - 1, mark.end, f", re = {re_}, im = {im})"
        else:
            yield mark.begin, mark.end, f"(re = {re_}, im = {im})"


class _Complex:
    """The complex expressions in a class or function.

    - `values`: what names of a function stand for: an expression, or the pair of a complex number.
    - `local`: the names of iterators.
    """

    def __init__(
        self, sources: Sources, of: Found, values: Mapping[str, tree.Expression | Pair], local: frozenset[str]
    ):  # fmt: skip
        self.sources, self.of, self.values, self.local = sources, of, dict(values), local
        self.members = {d.name: (d, scopes) for d, scopes in sources.declarations(of)}
        self.in_function = of.source.kind == "function"

    def within(self, iterators: tuple[tuple[str, tree.Expression | None], ...]) -> "_Complex":
        """As in the value of a comprehension."""
        # Not by the constructor, which would gather the declarations of the class again.
        inner = object.__new__(_Complex)
        inner.__dict__.update(self.__dict__, local=self.local | {n for n, _ in iterators})
        return inner

    # --- what an expression is ---------------------------------------------------------------------------------------

    def is_complex(self, e: tree.Expression) -> bool:
        if isinstance(e, tree.Reference):
            return self.kind_of(e)[0]
        if isinstance(e, tree.Unary):
            return self.is_complex(e.operand)
        if isinstance(e, tree.Binary):
            return e.operator in "+-*/^.+.-.*./" and (self.is_complex(e.left) or self.is_complex(e.right))
        if isinstance(e, tree.Choice):
            return any(map(self.is_complex, (*(v for _, v in e.branches), e.otherwise)))
        if isinstance(e, tree.Array):
            return any(map(self.is_complex, e.entries))
        if isinstance(e, tree.Comprehension):
            return self.within(e.iterators).is_complex(e.value)
        if isinstance(e, tree.Call):
            return self._call_is_complex(e)
        if isinstance(e, tree.Part):
            return e.field is None and self.is_complex(e.whole)
        return False

    def _call_is_complex(self, e: tree.Call) -> bool:
        if e.function in (COMPLEX, "fill", "sum", *_ELEMENTWISE):
            first = _ELEMENTWISE.get(e.function, 0)
            return e.function == COMPLEX or len(e.arguments) > first and self.is_complex(e.arguments[first])
        function = self.function(e)
        return function is not None and self._is_complex_type(_output(self.sources, function))

    def has_operations(self, e: tree.Expression) -> bool:
        """True for what rumoca does not read: operations on complex numbers, and arrays that are not variables."""
        if isinstance(e, tree.Comprehension):
            return self.is_complex(e) or self.within(e.iterators).has_operations(e.value)
        if isinstance(e, tree.Call):
            if self.is_complex(e) and e.function != COMPLEX:
                return True
            if any(self.is_complex(a) and not isinstance(a, tree.Reference) for a in e.arguments):
                return True
            return any(map(self.has_operations, (*e.arguments, *(v for _, v in e.named))))
        if isinstance(e, tree.Unary | tree.Binary | tree.Choice | tree.Array) and self.is_complex(e):
            return True
        if isinstance(e, tree.Part):
            return self.is_complex(e.whole)
        inside = e if isinstance(e, tuple) else ()
        return any(self.has_operations(p) for p in tree.each_part(tuple(inside)) if _is_expression(p) and p is not e)

    def kind_of(self, e: tree.Reference) -> tuple[bool, int]:
        """(True for a complex number, how many dimensions it has)."""
        first = e.parts[0]
        if first in self.local:
            return False, 0
        if first in self.values:
            known = self.values[first]
            return _is_pair(known) and len(e.parts) == 1, 0
        kind, rank, followed = type_of(self.sources, self.of, e)
        return kind is not None and kind.path == COMPLEX and followed == len(e.parts), rank

    def rank(self, e: tree.Expression) -> int:
        if isinstance(e, tree.Reference):
            return self.kind_of(e)[1]
        if isinstance(e, tree.Unary):
            return self.rank(e.operand)
        if isinstance(e, tree.Binary):
            return max(self.rank(e.left), self.rank(e.right))
        if isinstance(e, tree.Choice):
            return self.rank(e.otherwise)
        if isinstance(e, tree.Array):
            only = e.entries[0] if e.entries else _ZERO
            return self.rank(only) + (0 if isinstance(only, tree.Comprehension) else 1)
        if isinstance(e, tree.Comprehension):
            return len(e.iterators) + self.within(e.iterators).rank(e.value)
        if isinstance(e, tree.Call):
            if e.function == "fill":
                return len(e.arguments) - 1
            function = self.function(e)
            if function is not None:
                inputs = _inputs(self.sources, function)
                more = [self.rank(a) - len(d.dimensions) for a, (d, _) in zip(e.arguments, inputs, strict=False)]
                return max([0, *more]) + len(_output(self.sources, function)[0].dimensions)
            return (
                0 if e.function in ("sum", "product", "size", "max", "min") else max([0, *map(self.rank, e.arguments)])
            )
        return 0

    def function(self, e: tree.Call) -> Found | None:
        """The function that is called, if a library defines it. Where a function of complex numbers has the name of a
        built-in one, `.sqrt(x)` of a real x is the latter: the reader leaves the dot out."""
        found = self.sources.class_of(e.function, self.of.inside)
        if found is None or found.source.kind != "function":
            return None
        inputs = _inputs(self.sources, found)
        if e.arguments and inputs and self._is_complex_type(inputs[0]) and not self.is_complex(e.arguments[0]):
            return None
        return found

    def _is_complex_type(self, declared: tuple[tree.Declaration, tuple[Found, ...]]) -> bool:
        found = self.sources.class_of(declared[0].type, declared[1])
        return found is not None and found.path == COMPLEX

    # --- real and imaginary parts ------------------------------------------------------------------------------------

    def pair(self, e: tree.Expression) -> Pair:
        """The real and the imaginary part of an expression."""
        if not self.is_complex(e):
            real = self.real(e)
            return real, (_ZERO if self.rank(e) == 0 else _times(_ZERO, real))
        if isinstance(e, tree.Reference):
            return self._pair_of_reference(e)
        if isinstance(e, tree.Unary):
            return _mapped(lambda x: tree.Unary("-", x), self.pair(e.operand))
        if isinstance(e, tree.Binary):
            return self._pair_of_operation(e)
        if isinstance(e, tree.Choice):
            conditions = [self.real(c) for c, _ in e.branches]
            values = [self.pair(v) for _, v in e.branches]
            otherwise = self.pair(e.otherwise)
            first, second = (
                tree.Choice(tuple((c, v[k]) for c, v in zip(conditions, values, strict=True)), otherwise[k])
                for k in (0, 1)
            )
            return first, second
        if isinstance(e, tree.Array):
            pairs = [self.pair(x) for x in e.entries]
            return tree.Array(tuple(p[0] for p in pairs)), tree.Array(tuple(p[1] for p in pairs))
        if isinstance(e, tree.Comprehension):
            iterators = self._iterators(e)
            return _mapped(lambda x: tree.Comprehension(x, iterators), self.within(e.iterators).pair(e.value))
        if isinstance(e, tree.Call):
            return self._pair_of_call(e)
        raise _NotSplit

    def _pair_of_reference(self, e: tree.Reference) -> Pair:
        if e.parts[0] in self.values:
            value = self.values[e.parts[0]]
            if not _is_pair(value) or any(e.subscripts):
                raise _NotSplit
            return value  # type: ignore[return-value]
        if e.parts[0] not in self.members:
            found = self.sources.lookup(e.path, self.of.inside)
            value = found[0].declaration.value if found and isinstance(found[0], Constant) and not found[1] else None
            if found is None or value is None:
                raise _NotSplit
            return _Complex(self.sources, found[0].scopes[0], {}, frozenset()).pair(value)  # type: ignore[union-attr]
        e = self._subscripted(e)
        return _part(e, "re"), _part(e, "im")

    def _pair_of_operation(self, e: tree.Binary) -> Pair:
        operator = e.operator.removeprefix(".")
        one, other = map(self.is_complex, (e.left, e.right))
        if operator in ("+", "-"):
            (a, b), (c, d) = self.pair(e.left), self.pair(e.right)
            imaginary = d if not one and operator == "+" else tree.Unary("-", d) if not one else b
            return tree.Binary(operator, a, c), tree.Binary(operator, b, d) if one and other else imaginary
        if self.rank(e.left) and self.rank(e.right) and not e.operator.startswith("."):
            raise _NotSplit  # a scalar product
        if operator == "*":
            return _product(self, e.left, e.right)
        if operator == "/" and not other:
            by = self.real(e.right)
            return _mapped(lambda x: tree.Binary(e.operator, x, by), self.pair(e.left))
        if operator == "/":
            c, d = self.pair(e.right)
            square = tree.Binary("+", _times(c, c), _times(d, d))
            inverse = tree.Binary("/", c, square), tree.Binary("/", tree.Unary("-", d), square)
            if not one:
                a = self.real(e.left)
                return _times(a, inverse[0]), _times(a, inverse[1])
            return _multiplied(self.pair(e.left), inverse)
        if operator == "^" and e.right == tree.Number(2):
            return _product(self, e.left, e.left)
        raise _NotSplit

    def _pair_of_call(self, e: tree.Call) -> Pair:
        if e.function == COMPLEX:
            given = dict(e.named)
            re_ = e.arguments[0] if e.arguments else given["re"]
            im = e.arguments[1] if len(e.arguments) > 1 else given.get("im", _ZERO)
            return self.real(re_), self.real(im)
        if e.function in ("fill", "sum", *_ELEMENTWISE):
            first = _ELEMENTWISE.get(e.function, 0)
            pairs = [self.pair(a) if self.is_complex(a) else (self.real(a),) * 2 for a in e.arguments]
            if not self.is_complex(e.arguments[first]):
                raise _NotSplit
            return tuple(tree.Call(e.function, tuple(p[k] for p in pairs), ()) for k in (0, 1))  # type: ignore
        out = self._inlined(e)
        if not _is_pair(out):
            raise _NotSplit
        return out  # type: ignore[return-value]

    def real(self, e: tree.Expression) -> tree.Expression:
        """A real expression without complex ones inside."""
        if isinstance(e, tree.Reference):
            return self._real_reference(e)
        if isinstance(e, tree.Unary):
            return tree.Unary(e.operator, self.real(e.operand))
        if isinstance(e, tree.Binary):
            if self.is_complex(e.left) or self.is_complex(e.right):
                raise _NotSplit  # a comparison
            return tree.Binary(e.operator, self.real(e.left), self.real(e.right))
        if isinstance(e, tree.Choice):
            branches = tuple((self.real(c), self.real(v)) for c, v in e.branches)
            return tree.Choice(branches, self.real(e.otherwise))
        if isinstance(e, tree.Array):
            return tree.Array(tuple(map(self.real, e.entries)))
        if isinstance(e, tree.Matrix):
            return tree.Matrix(tuple(tuple(map(self.real, row)) for row in e.rows))
        if isinstance(e, tree.Range):
            return tree.Range(*map(self.real, e))
        if isinstance(e, tree.Comprehension):
            return tree.Comprehension(self.within(e.iterators).real(e.value), self._iterators(e))
        if isinstance(e, tree.Part) and e.field in ("re", "im") and self.is_complex(e.whole):
            return self.pair(e.whole)[e.field == "im"]
        if isinstance(e, tree.Call):
            return self._real_call(e)
        if isinstance(e, tree.Part):
            raise _NotSplit
        return e

    def _real_reference(self, e: tree.Reference) -> tree.Expression:
        first = e.parts[0]
        if first in self.values:
            value = self.values[first]
            if _is_pair(value):
                if len(e.parts) != 2 or e.parts[1] not in ("re", "im") or any(e.subscripts):
                    raise _NotSplit
                return value[e.parts[1] == "im"]  # type: ignore[index, return-value]
            if len(e.parts) > 1 or any(e.subscripts):
                raise _NotSplit
            return value  # type: ignore[return-value]
        if first in self.local or first in self.members and not self.in_function:
            return self._subscripted(e)
        if not self.in_function:
            return self._subscripted(e)
        found = self.sources.lookup(e.path, self.of.inside)
        if found is None or not isinstance(found[0], Constant) or any(e.subscripts) or first in self.members:
            raise _NotSplit
        value = found[0].declaration.value
        return _Complex(self.sources, found[0].scopes[0], {}, frozenset()).real(value) if value else _refused()

    def _subscripted(self, e: tree.Reference) -> tree.Reference:
        return tree.Reference(e.parts, tuple(tuple(map(self.real, s)) for s in e.subscripts))

    def _iterators(self, e: tree.Comprehension) -> tuple[tuple[str, tree.Expression | None], ...]:
        return tuple((n, None if r is None else self.real(r)) for n, r in e.iterators)

    def _real_call(self, e: tree.Call) -> tree.Expression:
        if any(self.is_complex(a) for a in e.arguments):
            out = self._inlined(e)
            if _is_pair(out):
                raise _NotSplit
            return out  # type: ignore[return-value]
        arguments = tuple(map(self.real, e.arguments))
        named = tuple((n, self.real(v)) for n, v in e.named)
        name = e.function
        if self.in_function:
            found = self.function(e)
            name = found.path if found is not None else name.rpartition(".")[2]
        return tree.Call(name, arguments, named)

    # --- functions ---------------------------------------------------------------------------------------------------

    def _inlined(self, e: tree.Call) -> tree.Expression | Pair:
        """What a function computes, from its source: assignments of whole variables one after the other. For arguments
        with more dimensions than the function has, each entry by itself."""
        function = self.function(e)
        if function is None or e.function.rpartition(".")[2] == "String":
            raise _NotSplit
        inputs = _inputs(self.sources, function)
        more = [self.rank(a) - len(d.dimensions) for a, (d, _) in zip(e.arguments, inputs, strict=False)]
        if max(more, default=0) == 1 and not e.named:
            return self._of_entries(e, [m == 1 for m in more])
        if max(more, default=0) > 0 or any(d.dimensions for d, _ in inputs):
            raise _NotSplit
        given: dict[str, tree.Expression] = dict(zip((d.name for d, _ in inputs), e.arguments, strict=False))
        given |= dict(e.named)
        values: dict[str, tree.Expression | Pair] = {
            n: self.pair(a) if self.is_complex(a) else self.real(a) for n, a in given.items()
        }
        for d, scopes in inputs:
            if self._is_complex_type((d, scopes)) and d.name in values and not _is_pair(values[d.name]):
                values[d.name] = values[d.name], _ZERO  # type: ignore[assignment]
        body = _Complex(self.sources, function, values, frozenset())
        for d, _ in self.sources.declarations(function):
            if d.name not in values and d.value is not None:
                body.assign(d.name, d.value)
        for part in self.sources.lineage(function):
            for section in part.source.algorithms:
                for s in section:
                    if not isinstance(s, tree.Assignment) or not isinstance(s.left, tree.Reference):
                        raise _NotSplit
                    if len(s.left.parts) != 1 or any(s.left.subscripts):
                        raise _NotSplit
                    body.assign(s.left.path, s.right)
        result = _output(self.sources, function)[0].name
        if result not in body.values:
            raise _NotSplit
        return body.values[result]

    def assign(self, name: str, value: tree.Expression) -> None:
        self.values[name] = self.pair(value) if self.is_complex(value) else self.real(value)

    def _of_entries(self, e: tree.Call, which: list[bool]) -> tree.Expression | Pair:
        # A call within the arguments of another one counts by a name of its own.
        depth = sum(n.startswith(_ENTRY) for n in self.local)
        name = f"{_ENTRY}{depth}"
        place = tree.Reference((name,))
        sizes = [self._size(a) for a, w in zip(e.arguments, which, strict=False) if w]
        size = next((s for s in sizes if s is not None), None)
        if size is None:
            raise _NotSplit
        arguments = [self._entry(a, place) if w else a for a, w in zip(e.arguments, which, strict=False)]
        iterators = ((name, tree.Range(_ONE, _ONE, size)),)
        call = tree.Call(e.function, (*arguments, *e.arguments[len(which) :]), ())
        inner = self.within(iterators)
        out = inner.pair(call) if inner.is_complex(call) else inner.real(call)
        array: Callable = lambda x: tree.Array((tree.Comprehension(x, iterators),))  # noqa: E731
        return _mapped(array, out) if _is_pair(out) else array(out)  # type: ignore[arg-type]

    def _entry(self, e: tree.Expression, place: tree.Expression) -> tree.Expression:
        """One entry of an expression with one dimension."""
        if self.rank(e) == 0:
            return e
        if isinstance(e, tree.Reference):
            return with_entry(e, self._where_array(e), place)
        if isinstance(e, tree.Unary):
            return tree.Unary(e.operator, self._entry(e.operand, place))
        if isinstance(e, tree.Binary):
            return tree.Binary(e.operator.removeprefix("."), self._entry(e.left, place), self._entry(e.right, place))
        if isinstance(e, tree.Array) and len(e.entries) == 1 and isinstance(e.entries[0], tree.Comprehension):
            inner = e.entries[0]
            (name, range_), *rest = inner.iterators
            if not rest and isinstance(range_, tree.Range) and range_.first == _ONE and range_.step == _ONE:
                return _renamed(inner.value, name, place)
        if isinstance(e, tree.Call) and e.function == "fill":
            return e.arguments[0]
        if isinstance(e, tree.Call) and self.function(e) is not None and not e.named:
            return tree.Call(e.function, tuple(self._entry(a, place) for a in e.arguments), ())
        raise _NotSplit

    def _size(self, e: tree.Expression) -> tree.Expression | None:
        """The number of entries of an expression with one dimension."""
        if isinstance(e, tree.Reference) and self.rank(e):
            return size_of(e, self._where_array(e))
        if isinstance(e, tree.Unary):
            return self._size(e.operand)
        if isinstance(e, tree.Binary):
            return self._size(e.left) or self._size(e.right)
        if isinstance(e, tree.Array) and isinstance(e.entries[0], tree.Comprehension):
            range_ = e.entries[0].iterators[0][1]
            return range_.last if isinstance(range_, tree.Range) else None
        if isinstance(e, tree.Call) and e.function == "fill":
            return e.arguments[1]
        if isinstance(e, tree.Call):
            return next((s for a in e.arguments if (s := self._size(a)) is not None), None)
        return None

    def _where_array(self, e: tree.Reference) -> int:
        """The part of a reference with one dimension that has it."""
        at = where_array(self.sources, self.of, e)
        if at is None:
            raise _NotSplit
        return at


def _inputs(sources: Sources, function: Found) -> list[tuple[tree.Declaration, tuple[Found, ...]]]:
    return [(d, s) for d, s in sources.declarations(function) if "input" in d.prefixes]


def _output(sources: Sources, function: Found) -> tuple[tree.Declaration, tuple[Found, ...]]:
    for d, s in sources.declarations(function):
        if "output" in d.prefixes:
            return d, s
    raise _NotSplit


def _is_pair(value: tree.Expression | Pair) -> bool:
    return type(value) is tuple


def _is_expression(part: object) -> bool:
    return isinstance(part, tuple) and type(part) is not tuple


def _refused() -> tree.Expression:
    raise _NotSplit


def _mapped(f: Callable[[tree.Expression], tree.Expression], pair: Pair) -> Pair:
    return f(pair[0]), f(pair[1])


def _part(e: tree.Reference, field: str) -> tree.Reference:
    return tree.Reference((*e.parts, field), (*e.subscripts, ()))


def _times(a: tree.Expression, b: tree.Expression) -> tree.Expression:
    return b if a == _ONE else a if b == _ONE else tree.Binary("*", a, b)


def _product(of: _Complex, left: tree.Expression, right: tree.Expression) -> Pair:
    one, other = map(of.is_complex, (left, right))
    if one and other:
        return _multiplied(of.pair(left), of.pair(right))
    factor, number = (right, left) if one else (left, right)
    real, single = of.real(factor), of.rank(factor) == 0
    return _mapped(lambda x: _ZERO if x == _ZERO and single else _times(real, x), of.pair(number))


def _multiplied(a: Pair, b: Pair) -> Pair:
    """The product of two complex numbers. The imaginary unit, as in j*omega*L*i, leaves no terms with zero."""
    if a[0] == _ZERO and a[1] != _ZERO:
        return tree.Unary("-", _times(a[1], b[1])), _times(a[1], b[0])
    return (
        tree.Binary("-", _times(a[0], b[0]), _times(a[1], b[1])),
        tree.Binary("+", _times(a[0], b[1]), _times(a[1], b[0])),
    )


def _renamed(e: tree.Expression, name: str, value: tree.Expression) -> tree.Expression:
    """An expression with another name for an iterator."""
    if isinstance(e, tree.Reference) and e.parts == (name,):
        return value
    if isinstance(e, tuple):
        parts = [_renamed(x, name, value) for x in e]  # type: ignore[arg-type]
        return tuple(parts) if type(e) is tuple else type(e)(*parts)  # type: ignore[return-value]
    return e
