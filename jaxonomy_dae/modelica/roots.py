"""Roots of functions that a Modelica text asks for: an unknown of the model and the equation that determines it."""

import functools
import sys
from collections.abc import Callable, Sequence
from typing import Any

import scipy.optimize
import sympy

from ..base.errors import ModelError
from ..write.component import Component
from .builtin import FUNCTIONS
from .values import Value, both, chosen

ROOT = "Modelica.Math.Nonlinear.solveOneNonlinearEquation"


def root(
    component: Component, guards: Sequence[Value], f: Callable[[Value], Value], low: Value, high: Value, *_: Value
) -> Value:
    """The root of f between two numbers where f has opposite signs.

    Outside of the interval, f is continued by a line that leads away from zero, so that no other root is found, and f
    is not evaluated where it may have no value. Where a condition around the call does not hold, the unknown rests in
    the middle of the interval.
    """
    if not isinstance(low, int | float) or not isinstance(high, int | float):
        raise ModelError("the interval of a root is given by numbers")
    low, high = float(min(low, high)), float(max(low, high))
    ends = f(low), f(high)
    if all(isinstance(end, int | float) for end in ends):
        if ends[0] * ends[1] > 0:
            raise ModelError(f"the function is {ends[0]:g} at {low:g} and {ends[1]:g} at {high:g}: it has one sign")
        found: Any = scipy.optimize.brentq(f, low, high, xtol=sys.float_info.min)  # to rounding
        return float(found)
    middle = (low + high) / 2
    count = sum(name.startswith(":root[") for name in component.variables)
    u = component.variable(f":root[{count}]", start=middle, nominal=high - low)
    inside = FUNCTIONS["max"](low, FUNCTIONS["min"](u, high))
    residual = f(inside) + (ends[1] - ends[0]) / (high - low) * (u - inside)
    if guards:
        residual = chosen(functools.reduce(both, guards), residual, u - middle, quiet=True)
    component.add_equations(sympy.Eq(0, residual, evaluate=False))
    return u
