"""Primitives that compute each entry of an array from the entries at the same place, as expressions in C."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .c_types import c_type, is_bool, is_float, limits, number


@dataclasses.dataclass(frozen=True)
class Cell:
    """An entry that is computed: the entries it reads as expressions, their types, its own type, and the parameters of
    the primitive."""

    given: Sequence[str]
    types: Sequence[np.dtype]
    out: np.dtype
    params: Mapping[str, Any]

    @property
    def suffix(self) -> str:
        """What the names of functions for single precision end in."""
        return "f" if self.types[0] == np.float32 else ""

    def call(self, name: str) -> str:
        """A function of `math.h`."""
        return f"{name}{self.suffix}({', '.join(self.given)})"

    def own(self, name: str) -> str:
        """A function of `HELPERS`, which has one form for each type."""
        return f"jx_{name}_{_tag(self.types[0])}({', '.join(self.given)})"


def _tag(dtype: Any) -> str:
    return {"float64": "d", "float32": "f"}.get(str(dtype), str(dtype))


def _infix(operator: str) -> Callable[[Cell], str]:
    def write(cell: Cell) -> str:
        a, b = cell.given
        text = f"({a} {operator} {b})"
        # Small integers are computed as `int`, signed ones would overflow: both wrap around in JAX.
        if np.dtype(cell.out).kind in "iu" and operator in "+-*":
            unsigned = "uint64_t" if np.dtype(cell.out).itemsize == 8 else "uint32_t"
            return f"({c_type(cell.out)})(({unsigned}){a} {operator} ({unsigned}){b})"
        return text

    return write


def _compared(operator: str) -> Callable[[Cell], str]:
    return lambda cell: f"({cell.given[0]} {operator} {cell.given[1]})"


def _math(name: str) -> Callable[[Cell], str]:
    return lambda cell: cell.call(name)


def _own(name: str) -> Callable[[Cell], str]:
    return lambda cell: cell.own(name)


def _floats_or(of_floats: Callable[[Cell], str], of_integers: Callable[[Cell], str]) -> Callable[[Cell], str]:
    return lambda cell: of_floats(cell) if is_float(cell.types[0]) else of_integers(cell)


def _bitwise(logical: str, bitwise: str) -> Callable[[Cell], str]:
    def write(cell: Cell) -> str:
        operator = logical if is_bool(cell.types[0]) else bitwise
        return f"({c_type(cell.out)})({f' {operator} '.join(cell.given)})"

    return write


def _not(cell: Cell) -> str:
    return f"(!{cell.given[0]})" if is_bool(cell.types[0]) else f"({c_type(cell.out)})(~{cell.given[0]})"


def _negative(cell: Cell) -> str:
    if is_float(cell.out):
        return f"(-{cell.given[0]})"
    unsigned = "uint64_t" if np.dtype(cell.out).itemsize == 8 else "uint32_t"
    return f"({c_type(cell.out)})(0 - ({unsigned}){cell.given[0]})"


def _absolute(cell: Cell) -> str:
    if is_float(cell.out):
        return cell.call("fabs")
    x = cell.given[0]
    return x if np.dtype(cell.out).kind == "u" else f"({x} < 0 ? {_negative(cell)} : {x})"


def _sign_of_integer(cell: Cell) -> str:
    x = cell.given[0]
    return f"({x} > 0)" if np.dtype(cell.out).kind == "u" else f"(({x} > 0) - ({x} < 0))"


def _divided(cell: Cell) -> str:
    a, b = cell.given
    least = limits(cell.out)[0]
    # What the processor would trap on: JAX gives −1 for a division by zero, and the number itself for least/−1.
    if np.dtype(cell.out).kind == "u":
        return f"({b} == 0 ? {limits(cell.out)[1]} : {a} / {b})"
    return f"({b} == 0 ? -1 : {b} == -1 && {a} == {least} ? {a} : {a} / {b})"


def _remainder(cell: Cell) -> str:
    a, b = cell.given
    return (
        f"({b} == 0 ? {a} : {a} % {b})"
        if np.dtype(cell.out).kind == "u"
        else f"({b} == 0 ? {a} : {b} == -1 ? 0 : {a} % {b})"
    )


def _extreme(operator: str) -> Callable[[Cell], str]:
    def of_integers(cell: Cell) -> str:
        a, b = cell.given
        return f"({a} {operator} {b} ? {a} : {b})"

    return of_integers


def _integer_power(cell: Cell) -> str:
    """Squares and products, as JAX multiplies."""
    (x,), y = cell.given, int(cell.params["y"])
    if y == 0:
        return number(1, cell.out)
    if y in (1, 2, 3) and x.isidentifier():
        return {1: x, 2: f"({x} * {x})", 3: f"({x} * ({x} * {x}))"}[y]
    power = f"jx_power_{_tag(cell.types[0])}({x}, {abs(y)})"
    return power if y > 0 else f"({number(1, cell.out)} / {power})"


def _rounded(cell: Cell) -> str:
    return cell.call("round" if int(cell.params["rounding_method"]) == 0 else "rint")


def _logistic(cell: Cell) -> str:
    one = number(1, cell.out)
    return f"({one} / ({one} + exp{cell.suffix}(-{cell.given[0]})))"


def _converted(cell: Cell) -> str:
    (x,), (old,), new = cell.given, cell.types, np.dtype(cell.out)
    if is_bool(new):
        return f"({x} != 0)"
    if is_float(old) and not is_float(new):
        return f"jx_{_tag(old)}_to_{new}({x})"
    return x if old == new else f"({c_type(new)}){x}"


def _selected(cell: Cell) -> str:
    which, *cases = cell.given
    if is_bool(cell.types[0]):
        return f"({which} ? {cases[1]} : {cases[0]})"
    text = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        text = f"({which} <= {k} ? {cases[k]} : {text})"
    return text


def _clamped(cell: Cell) -> str:
    low, x, high = cell.given
    inner = Cell([x, low], cell.types, cell.out, {})
    if not is_float(cell.out):
        return _extreme("<")(Cell([_extreme(">")(inner), high], cell.types, cell.out, {}))
    return Cell([inner.own("max"), high], cell.types, cell.out, {}).own("min")


def _reduced(cell: Cell) -> str:
    """Rounds to fewer binary digits; the range stays."""
    kept, own = int(cell.params["mantissa_bits"]), np.finfo(cell.out)
    if int(cell.params["exponent_bits"]) != own.nexp:
        raise NotImplementedError
    return cell.given[0] if kept >= own.nmant else f"jx_rounded_{_tag(cell.out)}({cell.given[0]}, {own.nmant - kept})"


def _shifted(operator: str, signed: bool) -> Callable[[Cell], str]:
    def write(cell: Cell) -> str:
        (a, b), bits = cell.given, 8 * np.dtype(cell.out).itemsize
        unsigned = f"uint{bits}_t"
        own = c_type(cell.out) if signed else unsigned
        beyond = f"({a} < 0 ? -1 : 0)" if signed and np.dtype(cell.out).kind == "i" else "0"
        return f"(({unsigned}){b} >= {bits} ? {beyond} : ({c_type(cell.out)})(({own}){a} {operator} {b}))"

    return write


ELEMENTWISE: dict[str, Callable[[Cell], str]] = {
    "add": _infix("+"), "add_any": _infix("+"), "sub": _infix("-"), "mul": _infix("*"),
    "div": _floats_or(_infix("/"), _divided), "rem": _floats_or(_math("fmod"), _remainder),
    "max": _floats_or(_own("max"), _extreme(">")), "min": _floats_or(_own("min"), _extreme("<")),
    "neg": _negative, "abs": _absolute, "sign": _floats_or(_own("sign"), _sign_of_integer),
    "eq": _compared("=="), "ne": _compared("!="), "lt": _compared("<"), "le": _compared("<="), "gt": _compared(">"),
    "ge": _compared(">="),
    "and": _bitwise("&&", "&"), "or": _bitwise("||", "|"), "xor": _bitwise("!=", "^"), "not": _not,
    "shift_left": _shifted("<<", False), "shift_right_logical": _shifted(">>", False),
    "shift_right_arithmetic": _shifted(">>", True),
    "exp": _math("exp"), "exp2": _math("exp2"), "log": _math("log"), "expm1": _math("expm1"), "log1p": _math("log1p"),
    "sin": _math("sin"), "cos": _math("cos"), "tan": _math("tan"), "asin": _math("asin"), "acos": _math("acos"),
    "atan": _math("atan"), "atan2": _math("atan2"), "sinh": _math("sinh"), "cosh": _math("cosh"),
    "tanh": _math("tanh"), "asinh": _math("asinh"), "acosh": _math("acosh"), "atanh": _math("atanh"),
    "sqrt": _math("sqrt"), "cbrt": _math("cbrt"), "erf": _math("erf"), "erfc": _math("erfc"), "pow": _own("pow"),
    "floor": _math("floor"), "ceil": _math("ceil"), "round": _rounded, "nextafter": _math("nextafter"),
    "rsqrt": lambda cell: f"({number(1, cell.out)} / {cell.call('sqrt')})",
    "square": lambda cell: f"jx_power_{_tag(cell.types[0])}({cell.given[0]}, 2)",
    "logistic": _logistic, "integer_pow": _integer_power,
    "is_finite": lambda cell: f"(isfinite({cell.given[0]}) ? 1 : 0)",
    "convert_element_type": _converted, "select_n": _selected, "clamp": _clamped,
    "reduce_precision": _reduced, "copy": lambda cell: cell.given[0], "stop_gradient": lambda cell: cell.given[0],
    "name": lambda cell: cell.given[0],
}  # fmt: skip


def _of_floats(text: str) -> dict[str, str]:
    """A helper's text for both precisions: T is the type, S the suffix of functions, G the tag."""
    out = {}
    for tag, name, suffix in (("d", "double", ""), ("f", "float", "f")):
        code = text.replace("$T", name).replace("$S", suffix).replace("$G", tag)
        out[code.split("(")[0].split()[-1]] = code
    return out


# Functions that expressions call, by name. A program has those that it needs. Extremes take up not-a-number, and count
# −0 as less than +0, as in JAX; `pow` of C is 1 for pow(1, nan) and pow(nan, 0), as in JAX.
HELPERS: dict[str, str] = {
    **_of_floats(
        "static $T jx_max_$G($T a, $T b) {\n"
        "  if (a != a) return a;\n  if (b != b) return b;\n"
        "  return a > b ? a : a < b ? b : signbit(a) ? b : a;\n}\n"
    ),
    **_of_floats(
        "static $T jx_min_$G($T a, $T b) {\n"
        "  if (a != a) return a;\n  if (b != b) return b;\n"
        "  return a < b ? a : a > b ? b : signbit(a) ? a : b;\n}\n"
    ),
    **_of_floats("static $T jx_sign_$G($T x) { return x > 0 ? 1 : x < 0 ? -1 : x; }\n"),
    # To nearest, ties to even: what is cut off is added to the bits as an integer, which carries into the exponent.
    **{
        f"jx_rounded_{tag}": (
            f"static {name} jx_rounded_{tag}({name} x, int cut) {{\n"
            f"  {bits} b;\n  if (x != x) return x;\n  memcpy(&b, &x, sizeof b);\n"
            f"  b += ((({bits})1 << (cut - 1)) - 1) + (b >> cut & 1);\n  b &= ~((({bits})1 << cut) - 1);\n"
            "  memcpy(&x, &b, sizeof x);\n  return x;\n}\n"
        )
        for tag, name, bits in (("d", "double", "uint64_t"), ("f", "float", "uint32_t"))
    },
    **_of_floats("static $T jx_pow_$G($T x, $T y) { return pow$S(x, y); }\n"),
    **{
        f"jx_power_{tag}": (
            f"static {name} jx_power_{tag}({name} x, int n) {{\n"
            f"  {name} power = 1;\n  int first = 1;\n"
            "  for (;;) {\n"
            f"    if (n & 1) {{ power = first ? x : ({name})(power * x); first = 0; }}\n"
            f"    n >>= 1;\n    if (n == 0) return power;\n    x = ({name})(x * x);\n  }}\n}}\n"
        )
        for tag, name in (("d", "double"), ("f", "float"), ("int64", "int64_t"), ("int32", "int32_t"))
    },
    **{
        f"jx_{tag}_to_{new}": (
            f"static {c_type(new)} jx_{tag}_to_{new}({name} x) {{\n"
            f"  if (x != x) return 0;\n  if (x <= ({name}){limits(new)[0]}) return {limits(new)[0]};\n"
            f"  if (x >= ({name}){limits(new)[1]}) return {limits(new)[1]};\n  return ({c_type(new)})x;\n}}\n"
        )
        for tag, name in (("d", "double"), ("f", "float"))
        for new in ("int64", "int32", "int16", "int8", "uint64", "uint32", "uint16", "uint8")
    },
}
