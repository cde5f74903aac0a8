"""Laws that components of several domains share, as expressions; steps and pulses in time, whose edges are events."""

import sympy
from sympy import Piecewise, asinh, exp, frac, pi, sin, sqrt, tanh

from ..modeling import POSITIVE, Component, Value


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


# Waveforms declare their parameters in the component that they drive; `unit` is that of the value.


def sine(
    component: Component, amplitude: Value, frequency: Value, phase: Value, offset: Value, unit: str
) -> sympy.Expr:
    """offset + amplitude·sin(2π·frequency·t + phase)."""
    a = component.parameter("amplitude", amplitude, unit=unit)
    f = component.parameter("frequency", frequency, unit="Hz")
    shift = component.parameter("phase", phase, unit="rad")
    return component.parameter("offset", offset, unit=unit) + a * sin(2 * pi * f * component.ev.t + shift)


def step(component: Component, height: Value, start_time: Value, offset: Value, unit: str) -> sympy.Expr:
    """offset, and offset + height from `start_time` on."""
    h = component.parameter("height", height, unit=unit)
    begin = component.parameter("start_time", start_time, unit="s")
    risen = Piecewise((1, component.relation(component.ev.t >= begin)), (0, True))
    return component.parameter("offset", offset, unit=unit) + h * risen


def pulse(
    component: Component,
    height: Value,
    period: Value,
    width: Value,
    start_time: Value,
    offset: Value,
    unit: str,
) -> sympy.Expr:
    """offset + height in the first part `width` of every `period` from `start_time` on, else offset."""
    h = component.parameter("height", height, unit=unit)
    length = component.parameter("period", period, unit="s", bounds=POSITIVE)
    part = component.parameter("width", width, unit="1", bounds=(0.0, 1.0))
    cycle = (component.ev.t - component.parameter("start_time", start_time, unit="s")) / length
    on = Piecewise((1, component.relation((cycle >= 0) & (frac(cycle) < part))), (0, True))
    return component.parameter("offset", offset, unit=unit) + h * on
