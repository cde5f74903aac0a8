"""The table of functions that may stand in equations: how each is evaluated, differentiated, and kept finite.

A function's `safe` value is put in place of its argument in a branch that is not taken, so that neither the function
nor its derivative is infinite there; None if both are finite everywhere. Steps are constant between their jumps: their
derivative is zero.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.special as jsp
import numpy as np
import scipy.special as ssp
import sympy
from jax.custom_derivatives import SymbolicZero
from sympy.codegen import cfunctions

from ...base.aliases import Numeric
from .node import (
    ONE,
    ZERO,
    Node,
    add,
    as_float,
    compare,
    constant,
    divide,
    linear,
    make,
    multiply,
    number,
    power,
    scale,
    select,
)

TWO_OVER_ROOT_PI = 2 / np.sqrt(np.pi)
HALF = Fraction(1, 2)


@dataclasses.dataclass(frozen=True)
class Function:
    """A function of one or more arguments.

    `partials(*arguments)` gives its derivatives, a node for each argument.
    """

    name: str
    numpy: Callable[..., Numeric]
    jax: Callable[..., Numeric]
    partials: Callable[..., tuple[Node, ...]]
    sympy: Any
    safe: tuple[float | None, ...] = (None,)


def apply(name: str, *arguments: Node) -> Node:
    """The function of this name, evaluated if all its arguments are numbers."""
    values = [number(a) for a in arguments]
    if all(v is not None for v in values):
        with np.errstate(all="ignore"):
            found = float(TABLE[name].numpy(*(np.float64(as_float(v)) for v in values)))  # pyright: ignore
        # A whole value of exact arguments stays exact, as that of cos(0), so that terms beside it may cancel exactly.
        if all(isinstance(v, int | Fraction) for v in values) and found.is_integer() and abs(found) < 1e6:
            found = int(found)
        return constant(found)
    return make(name, arguments)


def _squared(u: Node) -> Node:
    return power(u, 2)


def _one_plus(c: int, u: Node) -> Node:
    return linear([(c, _squared(u))], 1)


def _gaussian(u: Node) -> Node:
    return apply("exp", scale(-1, _squared(u)))


def _zero(*arguments: Node) -> tuple[Node, ...]:
    return (ZERO,) * len(arguments)


def _unary(name, numpy, jax, slope, symbol, safe=None) -> Function:
    return Function(name, numpy, jax, lambda u: (slope(u),), symbol, (safe,))


def _with_slope(function, slope):
    """A function of JAX with a derivative other than JAX's own."""

    @jax.custom_jvp
    def found(x):
        return function(x)

    found.defjvps(lambda moved, _, x: slope(x) * moved)
    return found


@jax.custom_jvp
def real_power(base: Numeric, exponent: Numeric) -> Numeric:
    """The power in JAX. JAX's own second derivative at zero is 0·0⁻¹ where the exponent is one."""
    return jnp.power(base, exponent)


def _power_moved(primals, tangents):
    base, exponent = primals
    found, moved = real_power(base, exponent), []
    by_base, by_exponent = tangents
    if not isinstance(by_base, SymbolicZero):
        flat = exponent == 0
        slope = real_power(base, jnp.where(flat, 1.0, exponent - 1.0))
        moved.append(jnp.where(flat, 0.0, exponent * slope) * by_base)
    if not isinstance(by_exponent, SymbolicZero):
        # Where only the base moves, there is no logarithm of it, which may be negative.
        moved.append(jnp.log(jnp.where(base == 0, 1.0, base)) * found * by_exponent)
    return found, sum(moved, jnp.zeros_like(found))


real_power.defjvp(_power_moved, symbolic_zeros=True)


def _polygamma(special, n, x):
    return special.digamma(x) if n == 0 else special.polygamma(n, x)


def _polygamma_in_jax(n: int):
    """ψₙ, for negative x by ψₙ(x) = (−1)ⁿ ψₙ(1 − x) − π dⁿcot(πx)/dxⁿ (DLMF 5.15.6): JAX (0.10.2) sums a series that
    diverges there."""
    slope = np.polynomial.Polynomial([0.0, 1.0])  # of cot(πx), in powers of the cotangent
    for _ in range(n):
        slope = slope.deriv() * np.polynomial.Polynomial([-np.pi, 0.0, -np.pi])

    def function(x):
        negative = x < 0
        right = _polygamma(jsp, n, jnp.where(negative, 1 - x, x))
        # The period of the cotangent first: πx loses the digits of what x has beside a whole number.
        inside = jnp.where(negative, x - jnp.round(x), 0.25)
        cotangent = 1 / jnp.tan(jnp.pi * inside)
        left = (-1) ** n * right - np.pi * jnp.polyval(jnp.asarray(slope.coef[::-1], cotangent.dtype), cotangent)
        return jnp.where(negative, left, right)

    return function


# JAX's second derivatives of these are its own ψ₁.
_digamma = _polygamma_in_jax(0)
_gamma = _with_slope(jsp.gamma, lambda x: _gamma(x) * _digamma(x))
_gammaln = _with_slope(jsp.gammaln, _digamma)


# JAX's derivative of I₀ follows |x|: at zero it is 1 instead of 0.
_i0 = _with_slope(jsp.i0, lambda x: _i1(x))
_i1 = _with_slope(jsp.i1, lambda x: _i1_slope(x))


def _i1_slope(x):
    """As `_bessel_i1_slope`, in JAX."""
    square = x * x
    inside = square < 1
    near, far = jnp.where(inside, square, 0.0), jnp.where(inside, 1.0, x)
    series = functools.reduce(lambda total, c: total * near + float(c), reversed(_SERIES), 0.0)
    return jnp.where(inside, series, _i0(far) - _i1(far) / far)


_SERIES = [Fraction(2 * k + 1, 2 ** (2 * k + 1) * math.factorial(k) * math.factorial(k + 1)) for k in range(13)]


def _bessel_i1_slope(u: Node) -> Node:
    """I₁′ = I₀ − I₁/u; within |u| < 1 its series, as that quotient is 0/0 at zero, and cancels beside it.

    The first term left out is below 1e-25, so that the next derivatives keep their digits, too."""
    square, series = _squared(u), ZERO
    for c in reversed(_SERIES):
        series = linear([(1, multiply(square, series))], c)
    quotient = divide(apply("besseli1", u), u)
    return select(compare("less", square, ONE), series, linear([(1, apply("besseli0", u)), (-1, quotient)]))


def _larger(a: Node, b: Node) -> tuple[Node, Node]:
    condition = compare("less_equal", b, a)
    return select(condition, ONE, ZERO), select(condition, ZERO, ONE)


def _atan2_partials(y: Node, x: Node) -> tuple[Node, Node]:
    r2 = add(_squared(x), _squared(y))
    return divide(x, r2), scale(-1, divide(y, r2))


def _heaviside(xp):
    # What is not a number is no zero, and stays what it is.
    return lambda x, at_zero: xp.where(x > 0, 1.0, xp.where(x < 0, 0.0, xp.where(x == 0, at_zero, x)))


def _hypot(xp):
    """√(a² + b²). JAX gives it the derivative zero at the origin; the partial derivatives below have no value there."""

    def function(a, b):
        square = a * a + b * b
        # √0 has an infinite slope, and a gradient keeps ∞·0 of it, which is no number, though its branch is not taken.
        away = square != 0  # true of what is not a number, too
        return xp.where(away, xp.sqrt(xp.where(away, square, 1.0)), 0.0)

    return function


def _log_gamma(gammaln, xp):
    """log Γ(x), not a number for x < 0, where SymPy's is complex and `gammaln` returns log|Γ(x)|."""
    return lambda x: xp.where(x >= 0, gammaln(xp.where(x >= 0, x, 1.0)), xp.nan)


def _logistic(xp):
    """1/(1 + exp(−x)), with all derivatives finite and digits kept on both sides."""

    def function(x):
        # Either side takes the exponential that decays. The other one overflows, and leaves ∞/∞ in derivatives.
        positive = x > 0
        small = xp.exp(xp.where(positive, -x, x))
        return xp.where(positive, 1.0, small) / (1 + small)

    return function


def _sech(xp):
    def function(x):
        # Not −|x|: JAX takes the slope of |x| at 0 to be 0, which makes the second derivative there zero. It is −1.
        negative = xp.where(x > 0, -x, x)
        return 2 * xp.exp(negative) / (1 + xp.exp(2 * negative))

    return function


_rows = [
    _unary("exp", np.exp, jnp.exp, lambda u: apply("exp", u), sympy.exp, 0.0),
    _unary("expm1", np.expm1, jnp.expm1, lambda u: apply("exp", u), cfunctions.expm1, 0.0),
    _unary("log", np.log, jnp.log, lambda u: power(u, -1), sympy.log, 1.0),
    _unary("log1p", np.log1p, jnp.log1p, lambda u: power(linear([(1, u)], 1), -1), cfunctions.log1p, 0.0),
    _unary("sin", np.sin, jnp.sin, lambda u: apply("cos", u), sympy.sin),
    _unary("cos", np.cos, jnp.cos, lambda u: scale(-1, apply("sin", u)), sympy.cos),
    _unary("tan", np.tan, jnp.tan, lambda u: _one_plus(1, apply("tan", u)), sympy.tan, 0.0),
    _unary("asin", np.arcsin, jnp.arcsin, lambda u: power(_one_plus(-1, u), -HALF), sympy.asin, 0.0),
    _unary("acos", np.arccos, jnp.arccos, lambda u: scale(-1, power(_one_plus(-1, u), -HALF)), sympy.acos, 0.0),
    _unary("atan", np.arctan, jnp.arctan, lambda u: power(_one_plus(1, u), -1), sympy.atan),
    _unary("sinh", np.sinh, jnp.sinh, lambda u: apply("cosh", u), sympy.sinh, 0.0),
    _unary("cosh", np.cosh, jnp.cosh, lambda u: apply("sinh", u), sympy.cosh, 0.0),
    _unary("tanh", np.tanh, jnp.tanh, lambda u: _one_plus(-1, apply("tanh", u)), sympy.tanh),
    _unary(
        "logistic",
        _logistic(np),
        _logistic(jnp),
        lambda u: multiply(apply("logistic", u), apply("logistic", scale(-1, u))),
        lambda u: 1 / (1 + sympy.exp(-u)),
    ),
    _unary(
        "softplus",
        lambda x: np.logaddexp(x, 0.0),
        lambda x: jnp.logaddexp(x, 0.0),
        lambda u: apply("logistic", u),
        lambda u: sympy.log(1 + sympy.exp(u)),
    ),
    _unary(
        "sech", _sech(np), _sech(jnp), lambda u: scale(-1, multiply(apply("tanh", u), apply("sech", u))), sympy.sech
    ),
    _unary("asinh", np.arcsinh, jnp.arcsinh, lambda u: power(_one_plus(1, u), -HALF), sympy.asinh),
    _unary("acosh", np.arccosh, jnp.arccosh, lambda u: power(linear([(1, _squared(u))], -1), -HALF), sympy.acosh, 2.0),
    _unary("atanh", np.arctanh, jnp.arctanh, lambda u: power(_one_plus(-1, u), -1), sympy.atanh, 0.0),
    _unary("erf", ssp.erf, jsp.erf, lambda u: scale(TWO_OVER_ROOT_PI, _gaussian(u)), sympy.erf),
    _unary("erfc", ssp.erfc, jsp.erfc, lambda u: scale(-TWO_OVER_ROOT_PI, _gaussian(u)), sympy.erfc),
    _unary(
        "erfinv",
        ssp.erfinv,
        jsp.erfinv,
        lambda u: scale(1 / TWO_OVER_ROOT_PI, apply("exp", _squared(apply("erfinv", u)))),
        sympy.erfinv,
        0.0,
    ),
    _unary("gamma", ssp.gamma, _gamma, lambda u: multiply(apply("gamma", u), polygamma(0, u)), sympy.gamma, 1.0),
    _unary(
        "loggamma",
        _log_gamma(ssp.gammaln, np),
        _log_gamma(_gammaln, jnp),
        lambda u: polygamma(0, u),
        sympy.loggamma,
        1.0,
    ),
    _unary(
        "logabsgamma",
        ssp.gammaln,
        _gammaln,
        lambda u: polygamma(0, u),
        lambda u: sympy.log(sympy.Abs(sympy.gamma(u))),
        1.0,
    ),
    Function("gammasign", ssp.gammasgn, jsp.gammasgn, _zero, lambda u: sympy.sign(sympy.gamma(u))),
    _unary("besseli0", ssp.i0, _i0, lambda u: apply("besseli1", u), lambda u: sympy.besseli(0, u), 0.0),
    _unary(
        "besseli1",
        ssp.i1,
        _i1,
        _bessel_i1_slope,
        lambda u: sympy.besseli(1, u),
        1.0,
    ),
    _unary("abs", np.abs, jnp.abs, lambda u: apply("sign", u), sympy.Abs),
    Function("sign", np.sign, jnp.sign, _zero, sympy.sign),
    Function("floor", np.floor, jnp.floor, _zero, sympy.floor),
    Function("ceiling", np.ceil, jnp.ceil, _zero, sympy.ceiling),
    Function("heaviside", _heaviside(np), _heaviside(jnp), _zero, sympy.Heaviside, (None, None)),
    Function("max", np.maximum, jnp.maximum, _larger, sympy.Max, (None, None)),
    Function("min", np.minimum, jnp.minimum, lambda a, b: _larger(b, a), sympy.Min, (None, None)),
    Function("atan2", np.arctan2, jnp.arctan2, _atan2_partials, sympy.atan2, (1.0, 1.0)),
    Function(
        "hypot",
        _hypot(np),
        _hypot(jnp),
        lambda a, b: (divide(a, apply("hypot", a, b)), divide(b, apply("hypot", a, b))),
        cfunctions.hypot,
        (1.0, 1.0),
    ),
    Function(
        "mod", np.mod, jnp.mod, lambda a, b: (ONE, scale(-1, apply("floor", divide(a, b)))), sympy.Mod, (None, 1.0)
    ),
]


def polygamma(order: int, u: Node) -> Node:
    """The derivative of digamma of this order; a function of its own for each order."""
    return apply(f"{_POLYGAMMA}{order}", u)


_POLYGAMMA = "polygamma"


def _polygamma_row(name: str) -> Function:
    order = int(name.removeprefix(_POLYGAMMA))
    return Function(
        name,
        lambda x: _polygamma(ssp, order, x),
        _polygamma_in_jax(order),
        lambda x: (polygamma(order + 1, x),),
        lambda x: sympy.polygamma(order, x),
        (1.0,),
    )


class _Table(dict[str, Function]):
    """Functions by name. Polygamma functions, of which there is no last one, get their rows when they are looked up:
    also in a process that loads a model, which makes none of its nodes anew."""

    def __missing__(self, name: str) -> Function:
        if not _is_polygamma(name):
            raise KeyError(name)
        return self.setdefault(name, _polygamma_row(name))

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or (isinstance(name, str) and _is_polygamma(name))


def _is_polygamma(name: str) -> bool:
    return name.startswith(_POLYGAMMA) and name.removeprefix(_POLYGAMMA).isdecimal()


TABLE: dict[str, Function] = _Table({row.name: row for row in _rows})
