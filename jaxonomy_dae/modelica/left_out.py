"""Functions of the Modelica library that OpenModelica calls by name without writing their definitions into the text."""

import math
import sys
from collections.abc import Callable

import numpy as np
import scipy.special
import sympy

from ..base.errors import ModelError
from .builtin import FUNCTIONS, flattened, matrix_product, of_numbers, total, transposed
from .operations import ARITHMETIC, RELATIONS
from .random_numbers import initial_state
from .values import Record, Value, chosen, entrywise

ZERO_CELSIUS = 273.15  # in kelvin


def _dot(a: list, b: list) -> Value:
    return total([x * y for x, y in zip(a, b, strict=True)])


def _length(v: list) -> Value:
    return FUNCTIONS["sqrt"](_dot(v, v))


def _normalized(v: list, eps: float = 100 * sys.float_info.epsilon) -> Value:
    """The unit vector along `v`; a vector below `eps` is divided by `eps`."""
    size = _length(v)
    # Quiet, as everything inside of a function: there relations are no events.
    divisor = chosen(RELATIONS[">="](size, eps), size, eps, quiet=True)
    return entrywise(lambda x: ARITHMETIC["/"](x, divisor), v)


def _planar_rotation(axis: list, angle: Value) -> list:
    """The matrix that resolves a vector in a frame turned about a unit axis (Rodrigues)."""
    cos, sin = FUNCTIONS["cos"](angle), FUNCTIONS["sin"](angle)
    skew = FUNCTIONS["skew"](axis)
    return [
        [axis[i] * axis[j] + ((1 if i == j else 0) - axis[i] * axis[j]) * cos - skew[i][j] * sin for j in range(3)]
        for i in range(3)
    ]


def _planar_rotation_angle(axis: list, before: list, after: list) -> Value:
    """The angle by which a frame turns about a unit axis if `before`, resolved in it, becomes `after`."""
    y = -1 * _dot(FUNCTIONS["cross"](axis, before), after)
    return FUNCTIONS["atan2"](y, _dot(before, after) - _dot(axis, before) * _dot(axis, after))


def _orientation(phases: int) -> list[float]:
    """The angles of the phases of a symmetric winding: an even number of phases is two halves, shifted by pi / m."""
    if phases == 2:
        return [0.0, math.pi / 2]
    if phases % 2:
        return [2 * math.pi * k / phases for k in range(phases)]
    half = _orientation(phases // 2)
    return [*half, *(angle - math.pi / phases for angle in half)]


def _low_pass(real: list, constant: list, linear: list, frequency: Value) -> list:
    """Coefficients of a filter with its cut-off at `frequency`, from those of one with its cut-off at 1 rad/s."""
    w = 2 * math.pi * frequency
    return [[c * w for c in real], [c * w**2 for c in constant], [c * w for c in linear]]


def _least_squares(a: list, b: list, *_: Value, **__: Value) -> list:
    """The x of least |a x - b|, and of least |x| where there are several."""
    if not all(isinstance(v, int | float) for v in [*flattened(a), *flattened(b)]):
        raise ModelError("least squares need numbers")
    return np.linalg.lstsq(np.array(a, float), np.array(b, float), rcond=None)[0].tolist()


def _normal_cumulative(x: Value, mean: Value = 0.0, deviation: Value = 1.0) -> Value:
    erf = of_numbers(math.erf, sympy.erf)
    return (1 + erf((x - mean) / (deviation * math.sqrt(2)))) / 2


def time_table_coefficients(
    table: list, offset: Value, start: Value, time: Value, last: Value, eps: float, shift: Value
) -> list:
    """What Modelica.Blocks.Sources.TimeTable asks for at its events: y = a time + b until the next event, the time of
    that event, and the row at the end of the present interval."""
    x, y = ([row[k] for row in table] for k in (0, 1))
    if not all(isinstance(v, int | float) for v in flattened(table)):
        raise ModelError("a time table needs numbers")
    margin = eps * FUNCTIONS["abs"](time)
    if len(table) < 2:
        return [0.0, offset + y[0], time - margin, last]

    def row(k: int, event: Value) -> list:
        """The results with row k (from 1) at the end of the interval."""
        k = max(k, 2)
        dt = x[k - 1] - x[k - 2]
        if dt <= eps * abs(x[k - 1]):
            return [0.0, offset + y[k - 1], event, k]
        a = (y[k - 1] - y[k - 2]) / dt
        return [a, offset + y[k - 2] - a * (x[k - 2] + shift), event, k]

    out: Value = row(len(table), time - margin)
    for k in range(len(table) - 1, 0, -1):
        earlier = RELATIONS["<"](time + margin - shift, x[k - 1])
        out = chosen(earlier, row(k, shift + x[k - 1]), out, quiet=True)
    return chosen(RELATIONS["<"](time + margin, start), [0.0, offset, start, last], out, quiet=True)


TIME_TABLE = "Modelica.Blocks.Sources.TimeTable.getInterpolationCoefficients"
LEFT_OUT: dict[str, Callable[..., Value]] = {
    "Modelica.Math.Vectors.length": _length,
    "Modelica.Math.Vectors.normalize": _normalized,
    "Modelica.Mechanics.MultiBody.Frames.TransformationMatrices.planarRotation": _planar_rotation,
    "Modelica.Mechanics.MultiBody.Frames.TransformationMatrices.resolve1": lambda t, v: matrix_product(
        transposed(t), v
    ),
    "Modelica.Mechanics.MultiBody.Frames.TransformationMatrices.resolve2": matrix_product,
    "Modelica.Mechanics.MultiBody.Frames.planarRotationAngle": _planar_rotation_angle,
    "Modelica.Electrical.Polyphase.Functions.symmetricOrientation": _orientation,
    "Modelica.Blocks.Continuous.Internal.Filter.coefficients.lowPass": _low_pass,
    "Modelica.Units.Conversions.from_degC": lambda t: entrywise(lambda x: x + ZERO_CELSIUS, t),
    "Modelica.Units.Conversions.to_degC": lambda t: entrywise(lambda x: x - ZERO_CELSIUS, t),
    "Modelica.Units.Conversions.from_deg": lambda a: entrywise(lambda x: x * math.pi / 180, a),
    "Modelica.Units.Conversions.to_deg": lambda a: entrywise(lambda x: x * 180 / math.pi, a),
    "Modelica.Units.Conversions.to_bar": lambda p: entrywise(lambda x: x / 1e5, p),
    "Modelica.Units.Conversions.from_bar": lambda p: entrywise(lambda x: x * 1e5, p),
    "Complex.\\'constructor\\'.fromReal": lambda re, im=0.0: Record(re=re, im=im),
    "Modelica.Math.Random.Generators.Xorshift64star.initialState": initial_state,
    "Modelica.Math.Distributions.Normal.cumulative": _normal_cumulative,
    "Modelica.Math.Special.erfInv": of_numbers(scipy.special.erfinv, sympy.erfinv),
    "Modelica.Math.Matrices.leastSquares": _least_squares,
    "Modelica.Utilities.Strings.substring": lambda text, first, last: text[first - 1 : last],
    TIME_TABLE.rpartition(".")[2]: time_table_coefficients,
}
