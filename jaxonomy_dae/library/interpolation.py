"""Interpolation between points: checks of the points, and the interpolant as an expression.

An expression is evaluated for all components of one kind at once, however many there are, and its values may be
parameters. Tables of signals (`signal.tables`) interpolate in the same way, as functions with arrays of their own.
"""

import functools
from collections.abc import Sequence

import numpy as np
import sympy
from sympy import Max, Min, sympify

from ..base.errors import ModelError
from ..write import Value, smooth

KINDS = ("linear", "cubic")


def interpolated(u: Value, x: np.ndarray, values: Sequence[Value], kind: str) -> tuple[sympy.Expr, sympy.Expr]:
    """The interpolant of `values` at the increasing points `x`, and its integral over `u` from the first point.

    Kinds are those of `signal.Table1D`; with 'cubic', the slope at the end of a piece is that of its chord. Outside of
    the points the last piece goes on.
    """
    return _interpolated(u, tuple(x.tolist()), tuple(map(sympify, values)), kind)  # in Python, 2 and 2.0 are equal


@functools.lru_cache(maxsize=64)  # the cells of a pack have the same expression; SymPy takes 20 ms to make it
def _interpolated(
    u: Value, x: tuple[float, ...], values: tuple[Value, ...], kind: str
) -> tuple[sympy.Expr, sympy.Expr]:
    last = len(x) - 2
    value, integral = values[0], values[0] * (u - x[0])
    before: Value | None = None
    for k, a in enumerate(x[:-1]):
        width = x[k + 1] - a
        rise = values[k + 1] - values[k]
        chord = rise / width
        inside = u - a if k == 0 else Max(u - a, 0)
        beyond = 0 if k == last else Max(u - a - width, 0)
        if k < last:
            inside = Min(inside, width)
        bend = 0 if kind == "linear" or before is None else (chord - before) / width
        slope = chord if kind == "linear" or before is None else before
        # slope·s + 2·bend·s² − bend·s³/width has the value `rise` and the slope `chord` at s = width.
        value += slope * inside + 2 * bend * inside**2 - bend / width * inside**3
        integral += slope * inside**2 / 2 + 2 * bend * inside**3 / 3 - bend / width * inside**4 / 4 + rise * beyond
        before = chord
    # No events at the points: steps that end at each kink would cost more than the kinks do.
    return smooth(value), smooth(integral)


def known_kind(kind: str, name: str) -> str:
    """The kind of interpolation.

    **Raises:**

    - `ModelError` if it is unknown.
    """
    if kind not in KINDS:
        raise ModelError(f"'{name}': kind must be one of {', '.join(KINDS)}; got {kind!r}")
    return kind
