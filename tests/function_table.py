"""Functions that may stand in equations: in SymPy, in mpmath, and a point where they are smooth."""

import mpmath as mp
import sympy
from sympy import Rational
from sympy.codegen import cfunctions


def _piecewise(x):
    return sympy.Piecewise((x**2, x > 1), (sympy.sqrt(1 - x), True))


def _nested(x):
    inner = sympy.Piecewise((x, x < 0), (x**3, True))
    return sympy.Piecewise((sympy.log(x), (inner > 0) & (x < 5)), (1 / (x - 0.5), True))


FUNCTIONS = {
    "sign": (sympy.sign, mp.sign, -0.7),
    "Abs": (lambda x: sympy.Abs(x) * x, lambda x: abs(x) * x, -0.7),
    "Max": (lambda x: sympy.Max(x, 0.2, x**3), lambda x: max(x, mp.mpf(0.2), x**3), 0.6),
    "Min": (lambda x: sympy.Min(x**2, 0.2), lambda x: min(x**2, mp.mpf(0.2)), 0.3),
    "Piecewise, second branch": (_piecewise, lambda x: mp.sqrt(1 - x), 0.4),
    "Piecewise, first branch": (_piecewise, lambda x: x**2, 1.6),
    "Piecewise, nested": (_nested, mp.log, 0.5),
    "Heaviside": (lambda x: x**2 * sympy.Heaviside(x), lambda x: x**2, 0.7),
    "floor": (lambda x: x**2 + sympy.floor(x), lambda x: x**2 + mp.floor(x), 1.4),
    "ceiling": (lambda x: x**2 * sympy.ceiling(x), lambda x: x**2 * mp.ceil(x), -1.4),
    "frac": (lambda x: sympy.frac(x) ** 3, lambda x: (x - mp.floor(x)) ** 3, 2.3),
    "Mod": (lambda x: sympy.Mod(x, 0.4) ** 3, lambda x: mp.fmod(x, mp.mpf(0.4)) ** 3, 1.1),
    "atan2": (lambda x: sympy.atan2(x, x**2 - 2), lambda x: mp.atan2(x, x**2 - 2), 0.8),
    "hypot": (lambda x: cfunctions.hypot(x, 2), lambda x: mp.sqrt(x**2 + 4), 0.8),
    "sqrt": (sympy.sqrt, mp.sqrt, 0.8),
    "cbrt": (sympy.cbrt, mp.cbrt, 0.8),
    "real_root": (lambda x: sympy.real_root(x, 3), lambda x: mp.sign(x) * mp.cbrt(abs(x)), -0.8),
    "power 1.7": (lambda x: x**1.7, lambda x: x ** mp.mpf(1.7), 0.8),
    "power -5/2": (lambda x: x ** Rational(-5, 2), lambda x: x ** (-mp.mpf(5) / 2), 0.8),
    "x**x": (lambda x: x**x, lambda x: x**x, 0.8),
    "2**x": (lambda x: 2**x, lambda x: 2**x, 0.8),
    "exp": (sympy.exp, mp.exp, 0.8),
    "log": (sympy.log, mp.log, 0.8),
    "log10": (lambda x: sympy.log(x, 10), mp.log10, 0.8),
    "expm1": (cfunctions.expm1, mp.expm1, 0.01),
    "log1p": (cfunctions.log1p, mp.log1p, 0.01),
    "sin": (sympy.sin, mp.sin, 0.8),
    "cos": (sympy.cos, mp.cos, 0.8),
    "tan": (sympy.tan, mp.tan, 0.8),
    "cot": (sympy.cot, mp.cot, 0.8),
    "sec": (sympy.sec, mp.sec, 0.8),
    "csc": (sympy.csc, mp.csc, 0.8),
    "asin": (sympy.asin, mp.asin, 0.4),
    "acos": (sympy.acos, mp.acos, 0.4),
    "atan": (sympy.atan, mp.atan, 0.4),
    "acot": (sympy.acot, mp.acot, 0.4),
    "sinh": (sympy.sinh, mp.sinh, 0.8),
    "cosh": (sympy.cosh, mp.cosh, 0.8),
    "tanh": (sympy.tanh, mp.tanh, 0.8),
    "coth": (sympy.coth, mp.coth, 0.8),
    "sech": (sympy.sech, mp.sech, 0.8),
    "logistic": (lambda x: 3 / (2 + sympy.exp(-x)), lambda x: 3 / (2 + mp.exp(-x)), 0.8),
    "softplus": (lambda x: sympy.log(3 + sympy.exp(2 * x)), lambda x: mp.log(3 + mp.exp(2 * x)), 0.8),
    "log of a sum of exponentials": (
        lambda x: sympy.log(sympy.exp(x) + 2 * sympy.exp(-x)),
        lambda x: mp.log(mp.exp(x) + 2 * mp.exp(-x)),
        0.8,
    ),
    "root of 1 + exp": (lambda x: (1 + sympy.exp(x)) ** 0.4, lambda x: (1 + mp.exp(x)) ** mp.mpf(0.4), 0.8),
    "root of cosh": (lambda x: 1 / sympy.sqrt(sympy.cosh(x)), lambda x: 1 / mp.sqrt(mp.cosh(x)), 0.8),
    "asinh": (sympy.asinh, mp.asinh, 0.8),
    "acosh": (sympy.acosh, mp.acosh, 1.8),
    "atanh": (sympy.atanh, mp.atanh, 0.4),
    "sinc": (sympy.sinc, mp.sinc, 0.8),
    "sinc, near zero": (sympy.sinc, mp.sinc, 1e-3),
    "erf": (sympy.erf, mp.erf, 0.8),
    "erfc": (sympy.erfc, mp.erfc, 0.8),
    "gamma": (sympy.gamma, mp.gamma, 1.8),
    "loggamma": (sympy.loggamma, mp.loggamma, 1.8),
    "factorial": (sympy.factorial, mp.factorial, 1.8),
    "digamma": (sympy.digamma, mp.digamma, 1.8),
    "beta": (lambda x: sympy.beta(x, 2.5), lambda x: mp.beta(x, 2.5), 1.8),
    "beta below zero": (lambda x: sympy.beta(x - 2.2, 2), lambda x: mp.beta(x - 2.2, 2), 1.8),
    "besseli": (lambda x: sympy.besseli(0, x), lambda x: mp.besseli(0, x), 0.8),
}
