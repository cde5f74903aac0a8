"""Symbols of a component's equations.

A symbol is named by its path *relative to the component that uses it* (`v`, `p.i`, and `child.v` in a parent),
so all instances of a component class share literally the same SymPy expressions. Which variable of the model a
symbol means is decided when the diagram is flattened, by integers. What a component is given by its parent begins with
`../`, as in `../R`: a path seen from the parent (of a component at the top, from the diagram).
"""

import functools
import sys
from typing import Any, SupportsFloat

import numpy as np
import sympy

from ..base.aliases import Condition
from ..base.errors import ModelError
from ..graph.expressions.differentiate import directional_derivative, raised
from ..graph.expressions.from_sympy import UnsupportedExpression, read, symbols_of
from ..graph.expressions.to_sympy import shortened, write


class ComponentSymbol(sympy.Symbol):
    """A symbol whose comparison with a number is refused: SymPy would say False, whatever the value will be."""

    __slots__ = ()

    def __eq__(self, other):
        if isinstance(other, int | float):
            _refuse(f"`{self} == {other}`", self, other)
        return super().__eq__(other)

    def __ne__(self, other):
        if isinstance(other, int | float):
            _refuse(f"`{self} != {other}`", self, other)
        return super().__ne__(other)

    # Python takes the hash from a class that defines `__eq__`.
    __hash__ = sympy.Symbol.__hash__


def _refuse(comparison: str, symbol: sympy.Symbol, number: object):
    """Raises a `ModelError` unless SymPy or this package compares symbols as what they are."""
    # Wrappers that check types, in tests, stand between a line and the comparison in it.
    caller, package = sys._getframe(1), __name__
    while caller is not None and (package == __name__ or package.startswith(("jaxtyping", "beartype"))):
        caller, package = caller.f_back, caller.f_globals.get("__name__", "")
    if package.split(".")[0] not in ("sympy", __name__.split(".")[0]):
        raise ModelError(
            f"{comparison} compares the symbol, which has no value yet when equations are written: the answer would be "
            f"the same whatever its value is. For a branch write Piecewise((a, Eq({symbol}, {number})), (b, True)), "
            f"for an equation Eq({symbol}, {number})"
        )


class VariableSymbol(ComponentSymbol):
    """A variable, or its `order`-th time derivative, seen from one component."""

    __slots__ = ("order", "path")
    path: str
    order: int

    @functools.lru_cache(maxsize=65536)  # noqa: B019 (large models ask for the same few symbols again and again)
    def __new__(cls, path: str, order: int = 0):
        name = "der(" * order + path + ")" * order
        symbol = super().__new__(cls, name, real=True)
        symbol.path = path
        symbol.order = order
        return symbol

    def __getnewargs_ex__(self):
        return (self.path, self.order), {}


class EarlierSymbol(VariableSymbol):
    """A variable before the event that is being handled, in what an event writes."""

    __slots__ = ()

    @functools.lru_cache(maxsize=65536)  # noqa: B019
    def __new__(cls, path: str, order: int = 0):
        symbol = ComponentSymbol.__new__(cls, f"pre({'der(' * order}{path}{')' * order})", real=True)
        symbol.path, symbol.order = path, order
        return symbol


class ParameterSymbol(ComponentSymbol):
    """A parameter seen from one component."""

    __slots__ = ("path",)
    path: str

    @functools.lru_cache(maxsize=65536)  # noqa: B019
    def __new__(cls, path: str):
        symbol = super().__new__(cls, path, real=True)
        symbol.path = path
        return symbol

    def __getnewargs_ex__(self):
        return (self.path,), {}


class DiscreteSymbol(ParameterSymbol):
    """A discrete variable: constant between events, so that equations read it as they read a parameter."""

    __slots__ = ()


class RelationSymbol(ParameterSymbol):
    """The truth of a relation of a component: 1 for true, 0 for false, 2 for "as its sides say"."""

    __slots__ = ("number",)
    number: int

    @functools.lru_cache(maxsize=65536)  # noqa: B019
    def __new__(cls, number: int):
        symbol = ComponentSymbol.__new__(cls, f":relation[{number}]", real=True)
        symbol.path, symbol.number = f":relation[{number}]", number
        return symbol

    def __getnewargs_ex__(self):
        return (self.number,), {}


class PreviousSymbol(ParameterSymbol):
    """A discrete variable before the event that is being handled."""

    __slots__ = ()

    @functools.lru_cache(maxsize=65536)  # noqa: B019
    def __new__(cls, path: str):
        symbol = ComponentSymbol.__new__(cls, f"pre({path})", real=True)
        symbol.path = path
        return symbol


class TimeSymbol(sympy.Symbol):
    """The independent variable."""

    __slots__ = ()

    def __new__(cls):
        return super().__new__(cls, "time", real=True)

    def __getnewargs_ex__(self):
        return (), {}


class _NotDifferentiatedBySymPy(ModelError, NotImplementedError):
    """SymPy itself tries to differentiate by time where it looks whether the conditions of nested `Piecewise` cover all
    real numbers, and goes on without the answer if that is not implemented."""


class EnvironmentTime(TimeSymbol):
    """Time as users write it, `ev.t`. SymPy would differentiate by it as if variables were constants."""

    __slots__ = ()

    @property
    def _diff_wrt(self):
        raise _NotDifferentiatedBySymPy(
            "`diff` by ev.t does not see that variables change in time: write der(x), der(x * y), …"
        )


ENVIRONMENT_TIME = EnvironmentTime()
TIME_LABEL = ("time",)


def symbol_label(symbol: sympy.Symbol) -> tuple:
    """The label of a symbol in expression graphs."""
    if isinstance(symbol, VariableSymbol):
        return ("variable", symbol.path, symbol.order)
    if isinstance(symbol, PreviousSymbol):
        return ("before", symbol.path)
    if isinstance(symbol, ParameterSymbol):
        return ("parameter of", symbol.path)
    return TIME_LABEL if isinstance(symbol, TimeSymbol) else ("symbol", symbol.name)


def seen_from_child(value: Any) -> Any:
    """An argument of a component that is being made: symbols in it, of the place where it is made, get `../` paths."""
    if isinstance(value, sympy.Basic | sympy.MatrixBase):  # a matrix that may be written to is no `Basic`
        outside: dict[sympy.Basic, sympy.Basic] = {}
        # Time is the same symbol everywhere, and gets no path.
        for s in value.free_symbols:
            if isinstance(s, VariableSymbol):
                outside[s] = VariableSymbol(f"../{s.path}", s.order)
            elif isinstance(s, RelationSymbol):
                raise ModelError(f"a relation that is an event stays in the component that wrote it: {value}")
            elif isinstance(s, ParameterSymbol):
                outside[s] = type(s)(f"../{s.path}")
        return value.xreplace(outside) if outside else value
    if type(value) in (list, tuple):
        return type(value)(seen_from_child(v) for v in value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):  # with names for its entries
        return type(value)(*map(seen_from_child, value))
    if type(value) is dict:
        return {k: seen_from_child(v) for k, v in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == object:
        out = np.empty(value.shape, object)
        for place, v in np.ndenumerate(value):
            out[place] = seen_from_child(v)
        return out
    return value


# Large models write the same few equations. By type, since 2, 2.0 and True are equal in Python, but not in an equation.
_remembered = functools.lru_cache(maxsize=4096, typed=True)(sympy.Eq)


SHADOWED = (
    "A variable that has the name of an attribute of every component, such as `name` or `output`, is written "
    'component["name"]'
)


def Eq(left: SupportsFloat, right: SupportsFloat) -> Condition:
    """The equation left = right: SymPy's `Eq`.

    **Raises:**

    - `ModelError` if a side is not an expression or a number.
    """
    try:
        return _remembered(left, right)
    except (TypeError, sympy.SympifyError):
        if any(getattr(side, "ndim", None) == 0 for side in (left, right)):  # arrays of one number cannot be hashed
            return _remembered(*(float(s) if getattr(s, "ndim", None) == 0 else s for s in (left, right)))
        wrong = next((side for side in (left, right) if not isinstance(side, sympy.Expr | int | float)), right)
        many = isinstance(wrong, list | tuple | sympy.MatrixBase) or getattr(wrong, "ndim", 0)
        mend = ": write one equation for each entry" if many else ""
        if isinstance(wrong, str) or callable(wrong):
            mend = f". {SHADOWED}"
        raise ModelError(
            f"the sides of an equation are expressions or numbers; got {wrong!r} of type {type(wrong).__name__}{mend}"
        ) from None


def der(expression: object) -> sympy.Expr:
    """The time derivative of a variable, or of an expression in variables, parameters and time.

    **Arguments:**

    - `expression`: a symbol returned by `Component.variable`, or any SymPy expression of such symbols. Calls
        nest: `der(der(x))` is the second derivative.

    **Returns:**

    A SymPy expression that can stand in any equation. Parameters do not change in time, so their derivative is zero.

    **Raises:**

    - `ModelError` if the expression has a symbol that no component declared, or is not an expression.
    """
    if isinstance(expression, tuple | list):
        raise ModelError(f"der takes one expression; got {expression}: write der of each entry")
    expression = sympy.sympify(expression)
    if not isinstance(expression, sympy.Expr):
        raise ModelError(f"der takes an expression in variables; got {expression}")
    if isinstance(expression, VariableSymbol):
        return VariableSymbol(expression.path, expression.order + 1)
    symbols = {symbol_label(s): s for s in symbols_of(expression)}
    moved = {}
    for label, symbol in symbols.items():
        if isinstance(symbol, VariableSymbol):
            above = VariableSymbol(symbol.path, symbol.order + 1)
            moved[label] = symbol_label(above)
            symbols = symbols | {symbol_label(above): above}
        elif not isinstance(symbol, ParameterSymbol | TimeSymbol):
            raise ModelError(
                f"der({shortened(expression)}): the symbol '{symbol}' was declared by no component. "
                "Use the symbols that `self.variable(...)` and `self.parameter(...)` return."
            )
    try:
        # By this package's graphs: SymPy's `diff` takes other variables for constants.
        slope = directional_derivative(read(expression, symbol_label, marks=True), raised(moved, TIME_LABEL))
    except UnsupportedExpression as error:
        raise ModelError(f"der({shortened(expression)}): {error}") from None
    return write(slope, symbols.__getitem__)
