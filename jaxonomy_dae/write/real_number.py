"""Numbers a user gives: what can stand for one, and what cannot."""

import decimal
import fractions
import math
import numbers
from typing import Any

import numpy as np
import sympy

from ..base.errors import ModelError


def real_number(value: object, where: str, hint: str = "") -> float:
    """The finite real number `value`; `where` names it in errors.

    **Raises:**

    - `ModelError` for strings, complex numbers, arrays of several numbers, tracers, and what is not finite; `hint` says
        what to do with arrays and tracers.
    """
    given: Any = value
    text = ""
    # `float` would read texts of numbers, and NumPy would cut off imaginary parts with a warning.
    if isinstance(value, str):
        text = f"; got the string {value!r}" + (f": write {value} without quotes" if _is_numeral(value) else "")
    elif _is_complex(value):
        text = f"; got the complex number {value}: write its real and imaginary part as two parameters"
    if text:
        raise ModelError(f"{where} must be a real number{text}")
    try:
        number = float(given)
    except OverflowError:  # an integer beyond them
        raise ModelError(f"{where} must be finite; got a number beyond 1e308") from None
    except (TypeError, ValueError):
        raise ModelError(f"{where} must be a number; got {type(value).__name__}{hint * _is_array(value)}") from None
    if not math.isfinite(number):
        raise ModelError(f"{where} must be finite; got {number}")
    return number


def is_unknown_to_jax(value: object) -> bool:
    """True for numbers that JAX does not read, such as those of SymPy, and for texts."""
    return isinstance(value, str | sympy.Basic | fractions.Fraction | decimal.Decimal)


def _is_numeral(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_complex(value: object) -> bool:
    if isinstance(value, sympy.Expr):
        return bool(value.has(sympy.I))
    if isinstance(value, numbers.Complex):
        return not isinstance(value, numbers.Real)
    return np.issubdtype(getattr(value, "dtype", np.float64), np.complexfloating)


def _is_array(value: object) -> bool:
    return hasattr(value, "dtype") or isinstance(value, list | tuple)
