"""Types and numbers of JAX, written in C99."""

import math
from typing import Any

import numpy as np

from ..base.errors import ModelError

# Booleans are bytes, as in JAX's arrays, so that an array of them can be handed to C.
_NAMES = {
    "float64": "double", "float32": "float", "bool": "unsigned char", "int64": "int64_t", "int32": "int32_t",
    "int16": "int16_t", "int8": "int8_t", "uint64": "uint64_t", "uint32": "uint32_t", "uint16": "uint16_t",
    "uint8": "uint8_t",
}  # fmt: skip
_LIMITS = {
    "int64": ("INT64_MIN", "INT64_MAX"), "int32": ("INT32_MIN", "INT32_MAX"), "int16": ("INT16_MIN", "INT16_MAX"),
    "int8": ("INT8_MIN", "INT8_MAX"), "uint64": ("0", "UINT64_MAX"), "uint32": ("0", "UINT32_MAX"),
    "uint16": ("0", "UINT16_MAX"), "uint8": ("0", "UINT8_MAX"),
}  # fmt: skip


def c_type(dtype: Any) -> str:
    """The C type of an array's entries.

    **Raises:**

    - `ModelError` for a type without one, such as complex numbers and random keys.
    """
    found = _NAMES.get(str(dtype))
    if found is None:
        raise ModelError(
            f"C code has no numbers of type {dtype}: write this part of the model in float64, float32, integers or "
            "booleans"
        )
    return found


def is_float(dtype: Any) -> bool:
    return np.dtype(dtype).kind == "f"


def is_bool(dtype: Any) -> bool:
    return np.dtype(dtype).kind == "b"


def limits(dtype: Any) -> tuple[str, str]:
    """The least and the greatest integer of a type, as macros of `stdint.h`."""
    return _LIMITS[str(np.dtype(dtype))]


def number(value: Any, dtype: Any) -> str:
    """A number as a constant of this type; floats in the fewest digits that give the same bits back."""
    dtype = np.dtype(dtype)
    if is_bool(dtype):
        return "1" if value else "0"
    if is_float(dtype):
        x = dtype.type(value)
        if math.isnan(x):
            return "NAN" if dtype == np.float64 else "(float)NAN"
        if math.isinf(x):
            text = "INFINITY" if dtype == np.float64 else "(float)INFINITY"
        else:
            text = str(abs(x))
            text = text if any(c in text for c in ".e") else text + ".0"
            text += "f" if dtype == np.float32 else ""
        return f"(-{text})" if math.copysign(1.0, x) < 0 else text
    i = int(value)
    low, _ = limits(dtype)
    if dtype.kind == "i" and i == np.iinfo(dtype).min:
        return low  # its digits would be those of a number that the type does not have, negated
    macro = {"int64": "INT64_C", "uint64": "UINT64_C", "uint32": "UINT32_C"}.get(str(dtype))
    text = str(abs(i)) if macro is None else f"{macro}({abs(i)})"
    return f"(-{text})" if i < 0 else text
