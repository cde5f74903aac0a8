"""Numbers a user gives: what can stand for one, and what cannot."""

import math
import numbers
from typing import Any

import numpy as np

from ..errors import ModelError


def real_number(value: Any, where: str, hint: str = "") -> float:
    """The finite real number `value`; `where` names it in errors.

    **Raises:**

    - `ModelError` for strings, complex numbers, arrays of several numbers, tracers, and what is not finite.
    """
    given: Any = value
    text = ""
    if isinstance(value, str):
        text = f"; got the string {value!r}: write {value} without quotes"
    elif _is_complex(value) or (isinstance(value, numbers.Complex) and not isinstance(value, numbers.Real)):
        text = f"; got the complex number {value}: write its real and imaginary part as two parameters"
    if text:
        raise ModelError(f"{where} must be a real number{text}")
    try:
        number = float(given)
    except (TypeError, ValueError):
        raise ModelError(f"{where} must be a number; got {type(value).__name__}{hint}") from None
    if not math.isfinite(number):
        raise ModelError(f"{where} must be finite; got {number}")
    return number


def _is_complex(value: Any) -> bool:
    return np.issubdtype(getattr(value, "dtype", np.float64), np.complexfloating)
