"""Modelica's tables: interpolation that the Modelica library calls in C.

A table with a constant argument is a number; with another one it is a `Piecewise` polynomial, so that a table over time
has its corners at times known beforehand.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy.interpolate
import sympy

from ..base.errors import ModelError
from ..write.automatic_events import smooth
from ..write.choices import by_conditions
from .operations import RELATIONS
from .values import Value, chosen, either

# The literals of Modelica.Blocks.Types.Smoothness and Extrapolation.
LINEAR, AKIMA, CONSTANT, FRITSCH_BUTLAND, STEFFEN, MODIFIED_AKIMA = 1, 2, 3, 4, 5, 6
HOLD, LAST_TWO, PERIODIC, NONE = 1, 2, 3, 4
NEVER = 1e60  # a time event that does not come: corners of a table over time are found from its Piecewise


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of abscissa and values. A table over time is shifted by `shift`. It is zero before `start`: the output of
    Modelica.Blocks.Sources.CombiTimeTable is its offset there. Entries that are parameters make an array of objects."""

    rows: np.ndarray
    columns: list[int]
    smoothness: int
    extrapolation: int
    start: float = -np.inf
    shift: float = 0.0

    def outside(self, u: sympy.Expr) -> Value:
        """The condition under which the table has no value at `u`; False if it has one everywhere."""
        if self.extrapolation != NONE:
            return False
        first, last = (_plain(x + self.shift) for x in (self.rows[0, 0], self.rows[-1, 0]))
        return either(RELATIONS["<"](u, first), RELATIONS[">"](u, last))

    def value(self, column: int, u: Value, events: bool) -> Value:
        """The value at `u` of the given one of the columns, counted from 1."""
        found = self._interpolated(column, u, events)
        if self.start <= -NEVER or not np.isfinite(self.start):
            return found
        return chosen(u < float(self.start), 0.0, found, quiet=not events)

    def _interpolated(self, column: int, u: Value, events: bool) -> Value:
        x = self.rows[:, 0] + self.shift
        y = self.rows[:, int(self.columns[int(column) - 1]) - 1]
        if len(x) == 1:
            return _plain(y[0])
        # Where entries are parameters no interval is known now: even a number is looked up by a choice.
        if self.rows.dtype == object:
            if self.smoothness not in (LINEAR, CONSTANT):
                raise ModelError("the entries of a smooth table are numbers")
            u = sympy.sympify(u)
        if self.extrapolation == PERIODIC:
            period = _plain(x[-1] - x[0])
            u = x[0] + (sympy.Mod(u - x[0], period) if isinstance(u, sympy.Expr) else (u - x[0]) % period)
        pieces = self._pieces(x, y)
        if isinstance(u, int | float):
            k = max(int(np.searchsorted(x, u, side="right")) - 1, 0)
            k, beyond = min(k, len(pieces) - 1), not x[0] <= u < x[-1]
            if self.extrapolation == NONE and not x[0] <= u <= x[-1]:
                raise ModelError(f"the table is read at {u:g}, outside of [{x[0]:g}, {x[-1]:g}], without extrapolation")
            return float(self._ends(pieces, x, y, u)[0 if u < x[0] else 1]) if beyond else float(pieces[k](u))
        low, high = self._ends(pieces, x, y, u)
        branches = [(low, u < _plain(x[0]))]
        branches += [(p(u), u < _plain(x[k + 1])) for k, p in enumerate(pieces) if _is_wide(x[k + 1] - x[k])]
        out = by_conditions(*branches, (high, sympy.true))
        return out if events else smooth(out)

    def _ends(self, pieces: list[Callable], x: np.ndarray, y: np.ndarray, u: Value) -> tuple[Value, Value]:
        """The values before the first and after the last abscissa."""
        if self.extrapolation == LAST_TWO and self.smoothness == CONSTANT:
            return _plain(y[0]), _plain(y[-1])
        if self.extrapolation in (LAST_TWO, PERIODIC):
            return _line(pieces[0], x[0], y[0], u), _line(pieces[-1], x[-1], y[-1], u)
        return _plain(y[0]), _plain(y[-1])

    def _pieces(self, x: np.ndarray, y: np.ndarray) -> list[Callable[[Value], Value]]:
        """A polynomial for each interval."""
        if self.smoothness == CONSTANT:
            return [_polynomial((_plain(v),), 0.0) for v in y[:-1]]
        if self.smoothness == LINEAR or len(x) == 2:
            slopes = [dy / dx if _is_wide(dx) else 0.0 for dx, dy in zip(np.diff(x), np.diff(y), strict=True)]
            return [_polynomial((_plain(s), _plain(v)), _plain(a)) for s, v, a in zip(slopes, y, x, strict=False)]
        if (np.diff(x) <= 0).any():
            raise ModelError("a smooth table needs rising abscissae")
        if self.smoothness in (AKIMA, MODIFIED_AKIMA):
            method = "akima" if self.smoothness == AKIMA else "makima"
            found = scipy.interpolate.Akima1DInterpolator(x, y, method=method)
        else:
            slopes = _monotone_slopes(x, y, self.smoothness)
            found = scipy.interpolate.CubicHermiteSpline(x, y, slopes)
        return [_polynomial(tuple(map(float, c)), float(a)) for c, a in zip(found.c.T, x, strict=False)]


def _monotone_slopes(x: np.ndarray, y: np.ndarray, smoothness: int) -> np.ndarray:
    """Derivatives at the points of a monotone cubic: those of Fritsch and Butland (1984) or of Steffen (1990) inside,
    and at both ends the slope of the chord, as Modelica's tables take it."""
    h, y = np.diff(x), y.astype(float)
    s = np.diff(y) / h
    before, after, h0, h1 = s[:-1], s[1:], h[:-1], h[1:]
    with np.errstate(divide="ignore", invalid="ignore"):  # where a slope is zero, the derivative is
        if smoothness == FRITSCH_BUTLAND:
            inner = 3 * (h0 + h1) / ((h0 + 2 * h1) / before + (2 * h0 + h1) / after)
        else:
            mean = (before * h1 + after * h0) / (h0 + h1)
            inner = np.sign(mean) * np.minimum(np.abs(mean), 2 * np.minimum(np.abs(before), np.abs(after)))
    return np.concatenate([s[:1], np.where(before * after > 0, inner, 0.0), s[-1:]])


def _plain(value: Value) -> Value:
    return value if isinstance(value, sympy.Expr) else float(value)


def _is_wide(interval: Value) -> bool:
    """False for the interval between two rows of one abscissa, where a table jumps."""
    return isinstance(interval, sympy.Expr) or interval > 0


def _polynomial(coefficients: tuple[Value, ...], at: Value) -> Callable[[Value], Value]:
    def value(u: Value) -> Value:
        out: Value = coefficients[0]
        for c in coefficients[1:]:
            out = out * (u - at) + c
        return sympy.Float(out) if isinstance(out, float) and isinstance(u, sympy.Expr) else out

    return value


def _line(piece: Callable[[Value], Value], x: float, y: float, u: Value) -> Value:
    """The tangent of a polynomial at an end of its interval."""
    t = sympy.Symbol("t")
    slope = sympy.diff(sympy.sympify(piece(t)), t)
    return _plain(y) + _plain(slope.subs(t, _plain(x))) * (u - _plain(x))


def _numbers(table: Value, name: str, file: str) -> np.ndarray:
    if file not in ("NoName", ""):
        raise ModelError(f"the table '{name}' is in the file '{file}', which is not read")
    rows = np.array(table, object)
    return rows if any(isinstance(v, sympy.Expr) for v in rows.flat) else rows.astype(float)


def table_1d(
    name: str, file: str, table: Value, columns: list[int], smoothness: int = LINEAR, extrapolation: int = LAST_TWO,
    *_: Value,
) -> Table:  # fmt: skip
    return Table(_numbers(table, name, file), columns, smoothness, extrapolation)


def time_table(
    name: str, file: str, table: Value, start: float, columns: list[int], smoothness: int = LINEAR,
    extrapolation: int = LAST_TWO, shift: float = 0.0, *_: Value,
) -> Table:  # fmt: skip
    return Table(_numbers(table, name, file), columns, smoothness, extrapolation, start, shift)


SMOOTHNESS = {  # of tables: the place of this argument, counted from 0
    "Modelica.Blocks.Types.ExternalCombiTable1D": 4,
    "Modelica.Blocks.Types.ExternalCombiTimeTable": 5,
}
_OF_1D, _OF_TIME = ("ModelicaStandardTables_CombiTable1D_", "ModelicaStandardTables_CombiTimeTable_")
# The functions of the Modelica library that call those in C; for a value, three that differ in their derivatives.
_CALLERS = {
    "getTable1DValue": f"{_OF_1D}getValue",
    "getTable1DValueNoDer": f"{_OF_1D}getValue",
    "getTable1DValueNoDer2": f"{_OF_1D}getValue",
    "getTable1DAbscissaUmin": f"{_OF_1D}minimumAbscissa",
    "getTable1DAbscissaUmax": f"{_OF_1D}maximumAbscissa",
    "getTimeTableValue": f"{_OF_TIME}getValue",
    "getTimeTableValueNoDer": f"{_OF_TIME}getValue",
    "getTimeTableValueNoDer2": f"{_OF_TIME}getValue",
    "getTimeTableTmin": f"{_OF_TIME}minimumTime",
    "getTimeTableTmax": f"{_OF_TIME}maximumTime",
    "getNextTimeEvent": f"{_OF_TIME}nextTimeEvent",
}
EXTERNALS: dict[str, Callable[..., Value]] = {
    "Modelica.Blocks.Types.ExternalCombiTable1D": table_1d,
    "Modelica.Blocks.Types.ExternalCombiTimeTable": time_table,
    "ModelicaStandardTables_CombiTable1D_getValue": lambda table, column, u: table.value(column, u, False),
    "ModelicaStandardTables_CombiTable1D_minimumAbscissa": lambda table: _plain(table.rows[0, 0]),
    "ModelicaStandardTables_CombiTable1D_maximumAbscissa": lambda table: _plain(table.rows[-1, 0]),
    "ModelicaStandardTables_CombiTimeTable_getValue": lambda table, column, t, *_: table.value(column, t, True),
    "ModelicaStandardTables_CombiTimeTable_minimumTime": lambda table: _plain(table.rows[0, 0]),
    "ModelicaStandardTables_CombiTimeTable_maximumTime": lambda table: _plain(table.rows[-1, 0]),
    "ModelicaStandardTables_CombiTimeTable_nextTimeEvent": lambda *_: NEVER,
    "ModelicaInternal_print": lambda *_: None,
    "ModelicaStreams_closeFile": lambda *_: None,
}
EXTERNALS |= {caller: EXTERNALS[called] for caller, called in _CALLERS.items()}
GET_VALUE = [name for name in EXTERNALS if _CALLERS.get(name, name).endswith("_getValue")]
