"""Laws that components of several domains share, as expressions."""

import sympy
from sympy import asinh, exp, sqrt, tanh

from ..modeling import Value


def penetration(s: Value, gap: Value, smooth: Value) -> tuple[sympy.Expr, sympy.Expr]:
    """A dead zone: (distance of `s` beyond ±gap/2, its derivative by `s`), with corners rounded over the length
    `smooth`."""
    above, below = s - gap / 2, -s - gap / 2
    root_above, root_below = sqrt(above**2 + smooth**2), sqrt(below**2 + smooth**2)
    depth = (above + root_above - below - root_below) / 2
    return depth, 1 + (above / root_above + below / root_below) / 2


def penetration_energy(s: Value, gap: Value, smooth: Value) -> sympy.Expr:
    """The integral of the penetration over `s`."""
    total = 0
    for beyond in (s - gap / 2, -s - gap / 2):
        root = sqrt(beyond**2 + smooth**2)
        total += (beyond**2 + beyond * root + smooth**2 * asinh(beyond / smooth)) / 4
    return total


def stribeck(
    v: Value, sliding: Value, breakaway: Value, stribeck_speed: Value, viscous: Value, smooth: Value
) -> sympy.Expr:
    """Friction (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083, with tanh in place of the sign):
    [sliding + (breakaway − sliding)·exp(−(v/stribeck_speed)²)]·tanh(v/smooth) + viscous·v."""
    return (sliding + (breakaway - sliding) * exp(-((v / stribeck_speed) ** 2))) * tanh(v / smooth) + viscous * v
