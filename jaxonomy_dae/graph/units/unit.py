"""Units as exponents of base quantities and a factor, and their algebra."""

import dataclasses
import math
from collections.abc import Iterable
from fractions import Fraction

Dimension = tuple[tuple[str, Fraction], ...]
SAME = 1e-9  # relative difference of two factors that are equal


@dataclasses.dataclass(frozen=True)
class Unit:
    """A value x in this unit is `scale`·x + `zero` in SI base units.

    `dimension` has pairs (symbol of an SI base unit, exponent), in the order of symbols; it is empty for numbers and
    angles. `zero` is not 0 for temperatures on a scale of their own, such as degC. `text` is what was declared.
    """

    dimension: Dimension = ()
    scale: float = 1.0
    zero: float = 0.0
    text: str = dataclasses.field(default="", compare=False)

    def __str__(self):
        return self.text or _written(self)


NUMBER = Unit(text="1")
SECOND = Unit((("s", Fraction(1)),), text="s")
JOULE = Unit((("kg", Fraction(1)), ("m", Fraction(2)), ("s", Fraction(-2))), text="J")
WATT = Unit((("kg", Fraction(1)), ("m", Fraction(2)), ("s", Fraction(-3))), text="W")


def dimension_of(exponents: Iterable[tuple[str, Fraction]]) -> Dimension:
    """The dimension in its normal form; exponents of one symbol are added."""
    total: dict[str, Fraction] = {}
    for symbol, exponent in exponents:
        total[symbol] = total.get(symbol, Fraction(0)) + exponent
    return tuple(sorted((s, e) for s, e in total.items() if e))


def product(factors: Iterable[tuple[Unit, Fraction]]) -> Unit:
    """Π unit^exponent."""
    factors = list(factors)
    dimension = dimension_of((s, e * power) for unit, power in factors for s, e in unit.dimension)
    return Unit(dimension, math.prod(unit.scale ** float(power) for unit, power in factors))


def rate(unit: Unit, order: int) -> Unit:
    """The unit of the derivative of this order by time."""
    if not order:
        return unit
    found = product([(unit, Fraction(1)), (SECOND, Fraction(-order))])
    power = "" if order == 1 else str(order)
    is_simple = unit.text not in ("", "1") and not unit.zero and not set(unit.text) & set("/ ^-")
    # A unit that is a quotient or has a zero of its own is written in SI symbols: "m/s/s" would be read wrongly.
    return dataclasses.replace(found, text=f"{unit.text}/s{power}" if is_simple else "")


def interval(unit: Unit) -> Unit:
    """The unit of a difference of two values."""
    return Unit(unit.dimension, unit.scale) if unit.zero else unit


def is_close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=SAME)


def _si(text: str, **exponents: int) -> tuple[Dimension, str]:
    return dimension_of((s, Fraction(e)) for s, e in exponents.items()), text


NAMES = dict(
    [
        _si("N", kg=1, m=1, s=-2),
        _si("Pa", kg=1, m=-1, s=-2),
        _si("J", kg=1, m=2, s=-2),
        _si("W", kg=1, m=2, s=-3),
        _si("C", A=1, s=1),
        _si("V", kg=1, m=2, s=-3, A=-1),
        _si("Ohm", kg=1, m=2, s=-3, A=-2),
        _si("S", kg=-1, m=-2, s=3, A=2),
        _si("F", kg=-1, m=-2, s=4, A=2),
        _si("H", kg=1, m=2, s=-2, A=-2),
        _si("Wb", kg=1, m=2, s=-2, A=-1),
        _si("N/m", kg=1, s=-2),
        _si("W/K", kg=1, m=2, s=-3, K=-1),
        _si("J/K", kg=1, m=2, s=-2, K=-1),
    ]
)


def _written(unit: Unit) -> str:
    """The unit in SI symbols, with the factor where it is not 1."""
    text = NAMES.get(unit.dimension)
    if text is None:
        above = [_power(s, e) for s, e in unit.dimension if e > 0]
        below = [_power(s, -e) for s, e in unit.dimension if e < 0]
        under = f"({'*'.join(below)})" if len(below) > 1 else "".join(below)
        text = ("*".join(above) or "1") + (f"/{under}" if below else "")
    return text if is_close(unit.scale, 1.0) else f"{unit.scale:.6g} {text}".removesuffix(" 1")


def _power(symbol: str, exponent: Fraction) -> str:
    if exponent == 1:
        return symbol
    return f"{symbol}{exponent}" if exponent.denominator == 1 else f"{symbol}^({exponent})"
