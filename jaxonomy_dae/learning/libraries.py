"""Libraries: which terms are tried, before it is known of which inputs."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import sympy
from jax.typing import ArrayLike

from ..base.errors import ModelError, explained_keywords, nearest, whole_number
from ..graph.expressions.from_sympy import UnsupportedExpression, read, symbols_of
from ..write.networks import count_outputs, of_scalars
from .term import AbstractTerm, Inner, OfFunction, Power, Written, inner_of, local_name

Text: TypeAlias = str | sympy.Expr | float
# The terms of a block, from the names of its inputs, the number of its outputs, and what a message begins with.
Entry: TypeAlias = Callable[[tuple[str, ...], int, str], list[AbstractTerm]]


@dataclasses.dataclass(frozen=True)
class Library:
    """Terms before it is known of which inputs. `powers(3) + terms("tanh(v/0.1)")` joins libraries."""

    entries: tuple[Entry, ...]

    def __add__(self, other: "Library") -> "Library":
        if not isinstance(other, Library):
            return NotImplemented
        return Library(self.entries + other.entries)

    def of(self, inputs: tuple[str, ...], outputs: int, where: str) -> tuple[AbstractTerm, ...]:
        """The terms of a block with inputs of these names and so many outputs; the same term counts once.

        **Raises:**

        - `ModelError` for symbols that are no inputs, for expressions that cannot be evaluated, and for other counts of
            outputs.
        """
        found = tuple(dict.fromkeys(term for entry in self.entries for term in entry(inputs, outputs, where)))
        numbers = [one.name for one in inner_of(found)]
        for name in numbers:
            if numbers.count(name) > 1:
                raise ModelError(f"{where}: '{name}' stands in several terms, with several ranges: give one for all")
        return found


@explained_keywords()
def powers(highest: int) -> Library:
    """The terms v, v|v|, v|v|², …, v|v|^(highest−1): the usual terms of friction and drag.

    For a block of several inputs and as many outputs, v is the vector of its inputs and |v| its length, and each term
    has one coefficient.

    **Raises:**

    - `ModelError` if `highest` is not a whole number ≥ 1; when used, for blocks with other counts of outputs.
    """
    return Library((_Powers(whole_number(highest, "powers: highest")),))


def terms(*expressions: Text | Sequence[Text], **others: Callable[..., ArrayLike] | tuple[float, float]) -> Library:
    """Terms from expressions and functions. Symbols that are not inputs are numbers to be found with the coefficients:

    ```python
    learning.terms("v", "v*Abs(v)", "sign(v)*exp(-(v/v_s)**2)", v_s=(0.01, 1.0))
    ```

    **Arguments:**

    - `expressions`: SymPy expressions or texts, `"v*Abs(v)"`, `"tanh(v/0.1)"`, in the names of the block's inputs, full
        (SymPy symbols) or without their component. A block of one input accepts any symbol. For a block of several
        outputs, a tuple with one expression for each is one term; a single expression is one term for each output, each
        with its own coefficient.
    - `others`: JAX functions by name, `plateau=lambda v: jnp.tanh(v / 0.1)`, called with a scalar for each input;
        they return a scalar, as a single expression, or one value for each output. Also ranges `(low, high)` of numbers
        inside expressions. A number without a range is positive and is searched around 1 and around the size of the
        inputs. The same name in several terms is the same number.

    **Raises:**

    - `ModelError` for other arguments; when used, for expressions without an input and for numbers that act only as a
        coefficient does.
    """
    ranges = {name: _range(name, given) for name, given in others.items() if not callable(given)}
    entries: list[Entry] = []
    for given in expressions:
        row = given if isinstance(given, tuple | list) else (given,)
        parts = tuple(p for p in row if isinstance(p, str | sympy.Expr | int | float))
        if len(parts) < len(row):
            raise ModelError(
                f"terms takes SymPy expressions, texts, or functions by name (drag=lambda v: …); got {given!r}"
            )
        entries.append(_Expressions(parts, isinstance(given, tuple | list), tuple(ranges.items())))
    entries.extend(_Function(name, function) for name, function in others.items() if callable(function))
    if not entries:
        raise ModelError('terms needs at least one expression or function: terms("v", "v*Abs(v)")')
    return Library(tuple(entries))


def _range(name: str, given: Any) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in given)
    except (TypeError, ValueError):
        raise ModelError(
            f"terms: '{name}' needs a function of the block's inputs, or a range (low, high) of a number; got {given!r}"
        ) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ModelError(f"terms: the range of '{name}' is a pair low < high; got ({low:g}, {high:g})")
    return low, high


@dataclasses.dataclass(frozen=True)
class _Powers:
    highest: int

    def __call__(self, inputs: tuple[str, ...], outputs: int, where: str) -> list[AbstractTerm]:
        if len(inputs) != outputs:
            raise ModelError(
                f"{where}: powers are for blocks with an output for each input; it has {len(inputs)} inputs and "
                f"{outputs} outputs: name terms of your own, learning.terms(…)"
            )
        return [Power(k, inputs) for k in range(1, self.highest + 1)]


@dataclasses.dataclass(frozen=True)
class _Expressions:
    parts: tuple[Text, ...]
    is_vector: bool
    ranges: tuple[tuple[str, tuple[float, float]], ...]  # of numbers inside, by name

    def __call__(self, inputs: tuple[str, ...], outputs: int, where: str) -> list[AbstractTerm]:
        symbols = tuple(sympy.Symbol(f"u{k}", real=True) for k in range(len(inputs)))
        written = tuple(self._read(part, inputs, symbols, where) for part in self.parts)
        texts = [str(part) for part in self.parts]
        if self.is_vector and len(written) != outputs:
            raise ModelError(f"{where}: term {self.parts} has {len(written)} entries, but the block {outputs} outputs")
        if self.is_vector or outputs == 1:
            label = texts[0] if outputs == 1 else f"[{', '.join(texts)}]"
            return [self._written(label, symbols, written)]
        zero = sympy.Integer(0)
        rows = [tuple(written[0] if k == j else zero for k in range(outputs)) for j in range(outputs)]
        return [self._written(f"{texts[0]} in output {j}", symbols, row) for j, row in enumerate(rows)]

    def _written(self, label: str, symbols: tuple[sympy.Symbol, ...], written: tuple[sympy.Expr, ...]) -> Written:
        """A term as a function of its inputs, and after them of the numbers inside it that are found with it."""
        inside = sorted({s for e in written for s in symbols_of(e)} - set(symbols), key=str)
        numbers = tuple(Inner(s.name, dict(self.ranges).get(s.name)) for s in inside)
        return Written(label, (*symbols, *inside), written, numbers)

    def _read(self, part: Text, inputs: tuple[str, ...], symbols: tuple[sympy.Symbol, ...], where: str) -> sympy.Expr:
        """An expression in the symbols of the inputs, and of the numbers inside it."""
        local = [local_name(name) for name in inputs]
        known = {n: s for n, s, count in zip(local, symbols, map(local.count, local), strict=True) if count == 1}
        known |= dict(zip(inputs, symbols, strict=True))
        ranges = dict(self.ranges)
        both = [name for name in ranges if name in known]
        if both:
            raise ModelError(f"{where}: '{both[0]}' is an input of the block, and cannot be a number to be found")
        numbers = {name: _number(name, ranges.get(name)) for name in ranges}
        try:
            expression = sympy.sympify(part, locals=known | numbers)  # pyright: ignore[reportCallIssue]
        except (sympy.SympifyError, SyntaxError, TypeError, AttributeError) as error:
            raise ModelError(f"{where}: term {part!r} is no expression that SymPy reads") from error
        found = sorted((s for s in symbols_of(expression) if s not in symbols), key=str)
        other = {s: known[s.name] for s in found if s.name in known}
        strange = [s for s in found if s not in other]
        reads = bool(other) or bool(set(symbols) & symbols_of(expression))
        free = [s for s in strange if s.name not in ranges]
        if len(inputs) == 1 and len(free) == 1 and not reads:
            other[free[0]], reads = symbols[0], True
            strange.remove(free[0])
        if strange and not reads:
            raise ModelError(
                f"{where}: '{strange[0]}' in term '{part}' is no input of the block: " + nearest(str(strange[0]), known)
            )
        other |= {s: _number(s.name, ranges.get(s.name)) for s in strange}
        expression = expression.subs(other, simultaneous=True)
        try:
            read(expression, lambda s: s)
        except UnsupportedExpression as error:
            raise ModelError(f"{where}: term '{part}': {error}") from None
        for s in strange:
            number = other[s]
            if not set(symbols) & symbols_of(sympy.simplify(sympy.diff(expression, number) / expression)):
                raise ModelError(
                    f"{where}: '{s}' in term '{part}' is no input of the block: {nearest(s.name, known)}; as a number "
                    "to be found, it does what the term's coefficient does"
                )
        return expression


def _number(name: str, range: tuple[float, float] | None) -> sympy.Symbol:
    """The symbol of a number inside."""
    return sympy.Symbol(name, positive=True) if Inner(name, range).is_log else sympy.Symbol(name, real=True)


@dataclasses.dataclass(frozen=True)
class _Function:
    name: str
    function: Callable[..., ArrayLike]

    def __call__(self, inputs: tuple[str, ...], outputs: int, where: str) -> list[AbstractTerm]:
        found = count_outputs(of_scalars(self.function), len(inputs), f"{where}: term '{self.name}'", noun="function")
        if found not in (1, outputs):
            raise ModelError(f"{where}: term '{self.name}' returns {found} values, but the block has {outputs} outputs")
        if found == outputs:
            return [OfFunction(self.name, self.function, outputs, None)]
        return [OfFunction(self.name, self.function, outputs, j) for j in range(outputs)]
