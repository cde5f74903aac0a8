"""Reads SymPy expressions into graphs."""

import math
from collections.abc import Callable, Hashable, Sequence
from fractions import Fraction

import sympy
from sympy.codegen import cfunctions

from .functions import TABLE, apply, polygamma
from .node import (
    FALSE,
    ONE,
    TRUE,
    Node,
    add,
    both,
    compare,
    constant,
    divide,
    either,
    leaf,
    linear,
    multiply,
    negate,
    power,
    select,
)
from .smooth import Smooth, marked
from .without_overflow import logarithm, logarithm_of_one_plus, product, raised

MOST_FACTORIAL = 170  # whose factorial double precision holds


class UnsupportedExpression(Exception):
    """An expression contains a part that cannot be evaluated. The message is a sentence that names it."""


def atoms_of(expression: sympy.Basic) -> set:
    """The symbols and numbers of an expression, found in time linear in its size."""
    # By identity: `expression.atoms` walks a shared part as often as it occurs.
    seen: set[int] = set()
    out = set()
    stack = [expression]
    while stack:
        e = stack.pop()
        if id(e) in seen:
            continue
        seen.add(id(e))
        if e.args:
            stack.extend(e.args)
        else:
            out.add(e)
    return out


def symbols_of(expression: sympy.Basic) -> set[sympy.Symbol]:
    """The symbols of an expression."""
    return {a for a in atoms_of(expression) if isinstance(a, sympy.Symbol)}


def read(expression: sympy.Basic, label: Callable[[sympy.Symbol], Hashable], marks: bool = False) -> Node:
    """The graph of a SymPy expression; a symbol becomes the leaf `label(symbol)`. What is marked as smooth is so in the
    graph only if `marks` are asked for.

    **Raises:**

    - `UnsupportedExpression` naming what cannot be evaluated.
    """
    # Identities may be keys, since the expression holds its parts. Equality would compare whole trees.
    known: dict[int, Node] = {}
    stack: list[tuple[sympy.Basic, bool]] = [(expression, False)]
    while stack:
        e, finished = stack.pop()
        if id(e) in known:
            continue
        inside = parts_of(e)
        if finished or not inside:
            if isinstance(e, sympy.Symbol):
                known[id(e)] = leaf(label(e))
            elif isinstance(e, Smooth):
                known[id(e)] = marked(known[id(inside[0])]) if marks else known[id(inside[0])]
            else:
                known[id(e)] = _read(e, [known[id(a)] for a in inside])
        else:
            stack.append((e, True))
            stack.extend((a, False) for a in inside if id(a) not in known)
    return known[id(expression)]


def parts_of(e: sympy.Basic) -> Sequence[sympy.Basic]:
    """The expressions from which a SymPy expression is computed.

    **Raises:**

    - `UnsupportedExpression` for integrals and the like, which have no value at a point.
    """
    if isinstance(e, sympy.Piecewise):
        return [part for pair in e.args for part in pair.args]
    if isinstance(e, sympy.Integral | sympy.Sum | sympy.Product | sympy.Derivative | sympy.Subs):
        raise UnsupportedExpression(f"{type(e).__name__} cannot be evaluated: write out its value")
    return e.args


def _read(e: sympy.Basic, inside: list[Node]) -> Node:
    if isinstance(e, sympy.Integer):
        return constant(int(e))
    if isinstance(e, sympy.Rational):
        return constant(Fraction(int(e.p), int(e.q)))
    if e is sympy.zoo or e is sympy.nan:
        raise UnsupportedExpression(f"it contains {e}, the result of a division by zero")
    if e is sympy.oo or e is -sympy.oo:
        raise UnsupportedExpression(f"it contains {e}, which is not a finite number")
    if e is sympy.I:
        raise UnsupportedExpression("it contains the imaginary unit I, but equations are between real numbers")
    if isinstance(e, sympy.Number | sympy.NumberSymbol):
        return constant(float(e))
    if e == sympy.true:
        return TRUE
    if e == sympy.false:
        return FALSE
    kind = type(e)
    if kind in _WRITTEN:
        return _WRITTEN[kind](*inside)
    if kind in _NAMED:
        return apply(_NAMED[kind], *inside)
    if isinstance(e, sympy.besseli) and e.args[0] in (0, 1):
        return apply(f"besseli{e.args[0]}", inside[1])
    if isinstance(e, sympy.polygamma) and isinstance(e.args[0], sympy.Integer):
        return polygamma(int(e.args[0]), inside[1])
    if isinstance(e, sympy.core.function.AppliedUndef):
        raise UnsupportedExpression(
            f"{e.func} is a function without a definition: declare a variable, or put a JAX function into the "
            "equations with self.function(...)"
        )
    raise UnsupportedExpression(
        f"the function {kind.__name__} cannot be evaluated in JAX: put a JAX function into the equations with "
        "self.function(...)"
    )


def _reciprocal(name: str) -> Callable[[Node], Node]:
    return lambda u: power(apply(name, u), -1)


def _of_reciprocal(name: str) -> Callable[[Node], Node]:
    return lambda u: apply(name, power(u, -1))


def _folded(name: str) -> Callable[..., Node]:
    def fold(*arguments: Node) -> Node:
        total = arguments[0]
        for argument in arguments[1:]:
            total = apply(name, total, argument)
        return total

    return fold


def _piecewise(*parts: Node) -> Node:
    # SymPy's value where none of the conditions holds.
    value = constant(float("nan"))
    for branch, condition in reversed(list(zip(parts[::2], parts[1::2], strict=True))):
        value = select(condition, branch, value)
    return value


def _log(u: Node, base: Node | None = None) -> Node:
    return logarithm(u) if base is None else divide(logarithm(u), apply("log", base))


def _factorial(u: Node) -> Node:
    return apply("gamma", linear([(1, u)], 1))


def _beta(a: Node, b: Node | None = None) -> Node:
    """Γ(a)·Γ(b)/Γ(a + b), by logarithms so that large arguments do not overflow; signs apart."""
    b = a if b is None else b
    powers = ((1, a), (1, b), (-1, add(a, b)))
    size = apply("exp", linear([(power, apply("logabsgamma", u)) for power, u in powers]))
    return multiply(*(apply("gammasign", u) for _, u in powers), size)


def _binomial(n: Node, k: Node) -> Node:
    over = linear([(1, n), (-1, k)])
    whole = divide(_factorial(n), multiply(_factorial(k), _factorial(over)))
    # 171! overflows. Before that, factorials keep more digits than their logarithms, and are zeros and poles where
    # binomial coefficients have them.
    parts = multiply(linear([(1, n)], 1), _beta(linear([(1, over)], 1), linear([(1, k)], 1)))
    return select(compare("less", n, constant(MOST_FACTORIAL)), whole, power(parts, -1))


def _arccotangent(u: Node) -> Node:
    """atan(1/u); within ±1 as a right angle less atan(u), which has a derivative at zero, too."""
    right_angle = select(compare("less", u, constant(0)), constant(-math.pi / 2), constant(math.pi / 2))
    near = linear([(1, right_angle), (-1, apply("atan", u))])
    return select(compare("less", apply("abs", u), ONE), near, apply("atan", power(u, -1)))


def _frac(u: Node) -> Node:
    return linear([(1, u), (-1, apply("floor", u))])


def _sinc(u: Node) -> Node:
    """sin(u)/u, by its series where the quotient and its derivatives cancel."""
    square = power(u, 2)
    # Terms to u²⁴/25! leave 1e-28 of the value at u = 1, and hardly more of the first derivatives.
    series = ONE
    for k in range(12, 0, -1):
        series = linear([(Fraction(-1, 2 * k * (2 * k + 1)), multiply(square, series))], 1)
    return select(compare("less", square, ONE), series, divide(apply("sin", u), u))


def _exclusive_or(*conditions: Node) -> Node:
    total = FALSE
    for c in conditions:
        total = either(both(total, negate(c)), both(negate(total), c))
    return total


def _log_to(base: int) -> Callable[[Node], Node]:
    return lambda u: divide(apply("log", u), apply("log", constant(base)))


_WRITTEN: dict[object, Callable[..., Node]] = {
    sympy.Add: add,
    sympy.Mul: product,
    sympy.Pow: raised,
    sympy.log: _log,
    cfunctions.log1p: logarithm_of_one_plus,
    sympy.Max: _folded("max"),
    sympy.Min: _folded("min"),
    sympy.Piecewise: _piecewise,
    sympy.Heaviside: lambda u, at_zero: apply("heaviside", u, at_zero),
    sympy.frac: _frac,
    sympy.sinc: _sinc,
    sympy.factorial: _factorial,
    sympy.beta: _beta,
    sympy.binomial: _binomial,
    sympy.erf2: lambda a, b: linear([(1, apply("erf", b)), (-1, apply("erf", a))]),
    sympy.erfcinv: lambda u: apply("erfinv", linear([(-1, u)], 1)),
    sympy.digamma: lambda u: polygamma(0, u),
    sympy.trigamma: lambda u: polygamma(1, u),
    sympy.cot: _reciprocal("tan"),
    sympy.sec: _reciprocal("cos"),
    sympy.csc: _reciprocal("sin"),
    sympy.coth: _reciprocal("tanh"),
    sympy.csch: _reciprocal("sinh"),
    sympy.acot: _arccotangent,
    sympy.asec: _of_reciprocal("acos"),
    sympy.acsc: _of_reciprocal("asin"),
    sympy.acoth: _of_reciprocal("atanh"),
    sympy.asech: _of_reciprocal("acosh"),
    sympy.acsch: _of_reciprocal("asinh"),
    sympy.And: both,
    sympy.Or: either,
    sympy.Not: negate,
    sympy.Xor: _exclusive_or,
    sympy.ITE: lambda c, a, b: either(both(c, a), both(negate(c), b)),
    sympy.Lt: lambda a, b: compare("less", a, b),
    sympy.Gt: lambda a, b: compare("less", b, a),
    sympy.Le: lambda a, b: compare("less_equal", a, b),
    sympy.Ge: lambda a, b: compare("less_equal", b, a),
    sympy.Eq: lambda a, b: compare("equal", a, b),
    sympy.Ne: lambda a, b: negate(compare("equal", a, b)),
    # All that can be read is real.
    sympy.re: lambda u: u,
    sympy.conjugate: lambda u: u,
    sympy.KroneckerDelta: lambda a, b: select(compare("equal", a, b), ONE, constant(0)),
    cfunctions.exp2: lambda u: power(constant(2), u),
    cfunctions.log2: _log_to(2),
    cfunctions.log10: _log_to(10),
    cfunctions.Sqrt: lambda u: power(u, Fraction(1, 2)),
    cfunctions.Cbrt: lambda u: power(u, Fraction(1, 3)),
    cfunctions.fma: lambda a, b, c: add(multiply(a, b), c),
}

# Functions of the table that SymPy has under a class of their own; those in `_WRITTEN` are read in another way.
_NAMED = {function.sympy: name for name, function in TABLE.items() if isinstance(function.sympy, type)}
