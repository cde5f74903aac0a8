"""Laws that components of more than one domain share, as expressions."""

from typing import Any

from sympy import exp, sqrt, tanh


def penetration(s: Any, gap: Any, smooth: Any) -> tuple[Any, Any]:
    """How far `s` is beyond ±gap/2, and the derivative of that with respect to `s`: a dead zone whose corners are
    rounded over the length `smooth`."""
    above, below = s - gap / 2, -s - gap / 2
    root_above, root_below = sqrt(above**2 + smooth**2), sqrt(below**2 + smooth**2)
    depth = (above + root_above - below - root_below) / 2
    return depth, 1 + (above / root_above + below / root_below) / 2


def stribeck(v: Any, sliding: Any, breakaway: Any, stribeck_speed: Any, viscous: Any, smooth: Any) -> Any:
    """Friction (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083, with tanh in place of the sign):
    [sliding + (breakaway − sliding)·exp(−(v/stribeck_speed)²)]·tanh(v/smooth) + viscous·v."""
    return (sliding + (breakaway - sliding) * exp(-((v / stribeck_speed) ** 2))) * tanh(v / smooth) + viscous * v
