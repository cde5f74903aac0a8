"""Laws that components of several domains share, as expressions; steps and pulses in time, whose edges are events."""

from typing import Any

from sympy import Piecewise, asinh, exp, frac, pi, sin, sqrt, tanh

from ..modeling import Component


def penetration(s: Any, gap: Any, smooth: Any) -> tuple[Any, Any]:
    """A dead zone: (distance of `s` beyond ±gap/2, its derivative by `s`), with corners rounded over the length
    `smooth`."""
    above, below = s - gap / 2, -s - gap / 2
    root_above, root_below = sqrt(above**2 + smooth**2), sqrt(below**2 + smooth**2)
    depth = (above + root_above - below - root_below) / 2
    return depth, 1 + (above / root_above + below / root_below) / 2


def penetration_energy(s: Any, gap: Any, smooth: Any) -> Any:
    """The integral of the penetration over `s`."""
    total = 0
    for beyond in (s - gap / 2, -s - gap / 2):
        root = sqrt(beyond**2 + smooth**2)
        total += (beyond**2 + beyond * root + smooth**2 * asinh(beyond / smooth)) / 4
    return total


def stribeck(v: Any, sliding: Any, breakaway: Any, stribeck_speed: Any, viscous: Any, smooth: Any) -> Any:
    """Friction (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083, with tanh in place of the sign):
    [sliding + (breakaway − sliding)·exp(−(v/stribeck_speed)²)]·tanh(v/smooth) + viscous·v."""
    return (sliding + (breakaway - sliding) * exp(-((v / stribeck_speed) ** 2))) * tanh(v / smooth) + viscous * v


def sine(t: Any, amplitude: Any, frequency: Any, phase: Any) -> Any:
    """amplitude·sin(2π·frequency·t + phase)."""
    return amplitude * sin(2 * pi * frequency * t + phase)


def step(component: Component, start_time: Any) -> Any:
    """0, and 1 from `start_time` on."""
    return Piecewise((1, component.relation(component.ev.t >= start_time)), (0, True))


def pulse(component: Component, period: Any, width: Any, start_time: Any) -> Any:
    """1 in the first part `width` of every `period` from `start_time` on, else 0."""
    cycle = (component.ev.t - start_time) / period
    return Piecewise((1, component.relation((cycle >= 0) & (frac(cycle) < width))), (0, True))
