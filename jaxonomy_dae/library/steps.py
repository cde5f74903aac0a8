"""Steps and pulses in time, whose edges are events."""

from typing import Any

from sympy import Piecewise, floor

from ..modeling import Component


def step(component: Component, start_time: Any) -> Any:
    """0, and 1 from `start_time` on."""
    return Piecewise((1, component.relation(component.ev.t >= start_time)), (0, True))


def pulse(component: Component, period: Any, width: Any, start_time: Any) -> Any:
    """1 in the first part `width` of every `period` from `start_time` on, else 0."""
    cycle = (component.ev.t - start_time) / period
    up, down = component.sampled(period, start_time), component.sampled(period, start_time + width * period)
    edges = (up, Piecewise((1, width > 0), (0, True)), down, Piecewise((0, width < 1), (1, True)))
    return Piecewise((1, component.relation((cycle >= 0) & (cycle - floor(cycle) < width), edges)), (0, True))
