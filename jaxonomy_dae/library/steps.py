"""Steps and pulses in time, whose edges are events."""

from typing import Any

from sympy import Piecewise, frac

from ..modeling import Component


def step(component: Component, start_time: Any) -> Any:
    """0, and 1 from `start_time` on."""
    return Piecewise((1, component.relation(component.ev.t >= start_time)), (0, True))


def pulse(component: Component, period: Any, width: Any, start_time: Any) -> Any:
    """1 in the first part `width` of every `period` from `start_time` on, else 0."""
    cycle = (component.ev.t - start_time) / period
    return Piecewise((1, component.relation((cycle >= 0) & (frac(cycle) < width))), (0, True))
