"""The functions that every Modelica model may call."""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import sympy

from ..base.errors import ModelError
from ..write.automatic_events import smooth
from .values import Value, as_number, both, chosen, either, entrywise, is_condition


def of_numbers(number: Callable[..., float], symbol: Callable[..., Value]) -> Callable[..., Value]:
    """A function of entries: `number` of constants, `symbol` of expressions."""

    def one(*arguments: Value) -> Value:
        arguments = tuple(map(as_number, arguments))
        if all(isinstance(a, int | float) for a in arguments):
            return number(*arguments)
        return symbol(*map(sympy.sympify, arguments))

    return lambda *arguments: entrywise(one, *arguments)


def _sign(x: float) -> int:
    return (x > 0) - (x < 0)


def _quotient(a: Value, b: Value) -> Value:
    """The quotient without its fraction, rounded towards zero."""
    # The sign needs no event: the whole part beside it is zero where it jumps.
    q = sympy.sympify(a) / sympy.sympify(b)
    return smooth(sympy.sign(q)) * sympy.floor(smooth(sympy.Abs(q)))


DIVISIONS = ("div", "mod", "rem")


def of_whole_numbers(name: str, a: sympy.Expr, b: int) -> Value:
    """`div`, `mod` or `rem` of whole numbers by one that is not zero. The quotient is moved by half of the distance to
    the next one: it is computed as a product with 1/b, and 49 (1/49) is less than one."""
    half = sympy.Rational(1, 2)
    if name == "mod":
        return a - b * sympy.floor((a + half * _sign(b)) / b)
    q = _sign(b) * smooth(sympy.sign(a)) * sympy.floor((smooth(sympy.Abs(a)) + half) / abs(b))
    return q if name == "div" else a - q * b


def _extreme(smaller: bool) -> Callable[..., Value]:
    """`min` or `max` of two values or of the entries of an array. As in Modelica it is not an event."""
    number, symbol = (min, sympy.Min) if smaller else (max, sympy.Max)

    def extreme(*arguments: Value) -> Value:
        entries = flattened(arguments[0]) if len(arguments) == 1 else list(arguments)
        if not entries:
            raise ModelError(f"{number.__name__} of an empty array")
        if all(is_condition(e) for e in entries):
            return functools.reduce(both if smaller else either, entries)
        if all(isinstance(e, int | float) for e in entries):
            return number(entries)
        # Unevaluated: SymPy would compare all pairs of entries.
        return smooth(symbol(*entries, evaluate=False))

    return extreme


def flattened(value: Value) -> list[Value]:
    """All entries of an array, in rows."""
    return [x for entry in value for x in flattened(entry)] if isinstance(value, list) else [value]


def sizes(value: Value) -> list[int]:
    """The size of each dimension of an array."""
    return [len(value), *(sizes(value[0]) if value else [])] if isinstance(value, list) else []


def filled(value: Value, *counts: int) -> Value:
    return value if not counts else [filled(value, *counts[1:]) for _ in range(int(counts[0]))]


def total(value: Value) -> Value:
    out: Value = 0
    for entry in flattened(value):
        out = out + entry
    return out


def product(value: Value) -> Value:
    out: Value = 1
    for entry in flattened(value):
        out = out * entry
    return out


def matrix_product(a: list, b: list) -> Value:
    """The product of arrays of one or two dimensions; that of two vectors without entries is zero."""
    if not a:
        return [] if b else 0.0
    columns = sizes(a)[-1]
    if columns != len(b):
        raise ModelError(f"the product of arrays of sizes {sizes(a)} and {sizes(b)}: {columns} is not {len(b)}")
    if not isinstance(a[0], list):
        if not isinstance(b[0], list):
            return total([x * y for x, y in zip(a, b, strict=True)])
        return [total([x * row[j] for x, row in zip(a, b, strict=True)]) for j in range(len(b[0]))]
    return [matrix_product(row, b) for row in a]


def matrix_power(a: list, n: Value) -> list:
    """A square matrix times itself, as `a ^ n` means; `a .^ n` is the power of each entry (Modelica Language
    Specification 3.6, section 10.6.7)."""
    if len(set(sizes(a))) != 1 or len(sizes(a)) != 2 or not isinstance(n, int | float) or n < 0 or int(n) != n:
        raise ModelError(f"a square matrix has powers 0, 1, 2, …; got sizes {sizes(a)} to the power {n}")
    out = _identity(len(a))
    for _ in range(int(n)):
        out = matrix_product(out, a)
    return out


def _identity(n: int) -> list:
    return [[1.0 if i == j else 0.0 for j in range(n)] for i in range(n)]


def symmetric(a: list) -> list:
    """The matrix with its upper triangle below the diagonal, too."""
    return [[a[min(i, j)][max(i, j)] for j in range(len(a))] for i in range(len(a))]


def rows_joined(rows: Sequence[Sequence[Value]]) -> list:
    """`[a, b; c, d]`: entries become matrices, a vector a column, and are joined from left to right, then rows from top
    to bottom (section 10.4.2)."""
    return concatenated(1, *(concatenated(2, *(promoted(entry, 2) for entry in row)) for row in rows))


def transposed(a: list) -> list:
    return [list(column) for column in zip(*a, strict=True)]


def _cross(a: list, b: list) -> list:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def concatenated(dimension: int, *arrays: list) -> list:
    if dimension == 1:
        return [entry for array in arrays for entry in array]
    return [concatenated(dimension - 1, *rows) for rows in zip(*arrays, strict=True)]


def promoted(value: Value, dimensions: int) -> Value:
    """An array with dimensions of one entry added at the end."""
    missing = dimensions - len(sizes(value))
    for _ in range(missing):
        value = entrywise(lambda x: [x], value) if not isinstance(value, list) else _innermost(value)
    return value


def _innermost(value: list) -> list:
    return [_innermost(v) if isinstance(v, list) else [v] for v in value]


def _linspace(first: Value, last: Value, count: int) -> list:
    if count < 2:
        raise ModelError(f"linspace needs two points or more; got {count}")
    return [first + (last - first) * k / (count - 1) for k in range(int(count))]


def _size(value: Value, dimension: int | None = None) -> Value:
    found = sizes(value)
    if dimension is None:
        return found
    if not 1 <= dimension <= len(found):
        raise ModelError(f"the size of dimension {dimension} of an array with the sizes {found}")
    return found[int(dimension) - 1]


def _integer(x: Value) -> Value:
    return x if isinstance(x, int) else math.floor(x) if isinstance(x, float) else sympy.floor(x)


def _semi_linear(x: Value, positive: Value, negative: Value) -> Value:
    return chosen(x >= 0, positive * x, negative * x, quiet=True)


def _text(value: Value, *_: Value, **__: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _boolean_as_integer(value: Value) -> Value:
    return as_number(value) if is_condition(value) else value


ALIKE = "sin cos tan asin acos atan atan2 sinh cosh tanh exp log sqrt".split()  # in Modelica, Python and SymPy
FUNCTIONS: dict[str, Callable[..., Value]] = {
    **{name: of_numbers(getattr(math, name), getattr(sympy, name)) for name in ALIKE},
    "log10": of_numbers(math.log10, lambda x: sympy.log(x) / math.log(10.0)),
    "abs": of_numbers(
        lambda x: x if x >= 0 else -x, lambda x: smooth(sympy.Abs(x, evaluate=False))
    ),  # SymPy would expand x
    "sign": of_numbers(_sign, lambda x: smooth(sympy.sign(x, evaluate=False))),
    "floor": of_numbers(math.floor, sympy.floor),
    "ceil": of_numbers(math.ceil, sympy.ceiling),
    "integer": lambda x: entrywise(_integer, x),
    "mod": of_numbers(lambda a, b: a - math.floor(a / b) * b, sympy.Mod),
    "div": of_numbers(lambda a, b: math.trunc(a / b), _quotient),
    "rem": of_numbers(lambda a, b: a - math.trunc(a / b) * b, lambda a, b: a - _quotient(a, b) * b),
    "min": _extreme(True),
    "max": _extreme(False),
    "sum": total,
    "product": product,
    "size": _size,
    "ndims": lambda a: len(sizes(a)),
    "array": lambda *entries: list(entries),
    "fill": filled,
    "zeros": lambda *n: filled(0.0, *n),
    "ones": lambda *n: filled(1.0, *n),
    "identity": _identity,
    "diagonal": lambda v: [[v[i] if i == j else 0.0 for j in range(len(v))] for i in range(len(v))],
    "linspace": _linspace,
    "cat": concatenated,
    "promote": promoted,
    "transpose": transposed,
    "symmetric": symmetric,
    "cross": _cross,
    "skew": lambda x: [[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]],
    "outerProduct": lambda a, b: [[x * y for y in b] for x in a],
    "scalar": lambda a: flattened(a)[0],
    "vector": flattened,
    "matrix": lambda a: promoted(a, 2),
    "semiLinear": _semi_linear,
    "homotopy": lambda actual, simplified: actual,
    "String": _text,
    "Integer": _boolean_as_integer,
    "cardinality": lambda a: 0,
}


def applied(name: str, arguments: Sequence[Value], named: Mapping[str, Value]) -> Value:
    """The value of a built-in function.

    **Raises:**

    - `ModelError` for numbers of which it has none.
    """
    with numbers_checked(lambda: f"{name}({', '.join(map(str, arguments))})"):
        return FUNCTIONS[name](*arguments, **named)


@contextlib.contextmanager
def numbers_checked(what: Callable[[], str]) -> Iterator[None]:
    """Errors of Python's arithmetic as one that says what was computed."""
    try:
        yield
    except ModelError:
        raise
    except (ArithmeticError, ValueError) as error:
        raise ModelError(f"{what()}: {error}") from None


def power(a: Value, b: Value) -> Value:
    if isinstance(a, int | float) and isinstance(b, int | float):
        # Python's power of a negative number would be complex.
        found = a**b if a >= 0 or float(b).is_integer() else math.nan
        float(found)  # an integer may be too large to be a Real
        return found
    if isinstance(b, float) and b.is_integer():
        b = int(b)
    return sympy.sympify(a) ** b


def quotient(a: Value, b: Value) -> Value:
    if isinstance(a, int | float) and isinstance(b, int | float):
        if b == 0:
            raise ModelError(f"division of {a} by zero")
        return a / b
    if isinstance(b, int | float) and b == 0:
        raise ModelError(f"division of {a} by zero")
    # Modelica divides Reals, where SymPy would keep a fraction of integers.
    return a / sympy.Float(b) if isinstance(b, int | float) else a / b
