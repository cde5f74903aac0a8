"""What texts of units mean. Pint reads them; it comes with the extra `units`."""

import functools
import re
from fractions import Fraction
from typing import Any

from ...base.optional import optional_module
from .unit import Unit, dimension_of, is_close

BASE = {
    "[length]": "m", "[mass]": "kg", "[time]": "s", "[current]": "A", "[temperature]": "K", "[substance]": "mol",
    "[luminosity]": "cd",
}  # fmt: skip
# Spellings that engineers use and Pint reads as something else, or not at all.
SPELLINGS = {"Ohm": "ohm", "Nm": "N*m", "Nms": "N*m*s", "rev": "revolution", "var": "VA"}
PREFIXES = "pnumkMGT"  # that may stand before these: Pint's kNm is a thousand metres of yarn over a kilogram
LEGAL = re.compile(r"[\w\s*/^().·%°²³¹⁰⁴-⁹⁻Ωµ-]+")
# The e of a number such as 1e3 is no unit, and has no exponent.
EXPONENT = re.compile(r"(?<=[A-Za-zΩµ°])(?<!\d[eE])(-?\d+)")


class UnknownUnit(ValueError):
    """A text that is not a unit; `str` says why not."""


# Pint reads its file of definitions when a registry is made, which takes long.
@functools.lru_cache(maxsize=1)
def _registry() -> Any:
    return optional_module("pint", "units", "check_units=True needs Pint").UnitRegistry()


@functools.lru_cache(maxsize=4096)
def read_unit(text: str) -> Unit | None:
    """The unit that a text means: 'm/s', 'N*m', 'kg/(m*s)', 'm2', 'mm', 'degC', '1' for a number. None if it is empty:
    the unit is not known.

    **Raises:**

    - `UnknownUnit` for any other text.
    - `ImportError` without Pint, which names the extra.
    """
    registry = _registry()
    if not text:
        return None
    spelled = re.sub(r"[A-Za-z]+", lambda word: _spelled(word[0]), text)
    why = "it cannot be read"
    if LEGAL.fullmatch(text):
        # As it stands first: a unit's own name may contain a digit, as cmH2O does.
        for spelling in (spelled, EXPONENT.sub(r"**\1", spelled)):  # powers need no sign of their own: m2, s-1
            try:
                return _linear(registry, registry.parse_units(spelling), text)
            except UnknownUnit:
                raise
            except Exception as error:  # malformed texts raise whatever Pint's parser stumbles over
                unknown = getattr(error, "unit_names", None)
                why = f"'{unknown[0] if isinstance(unknown, tuple) else unknown}' is not known" if unknown else why
    raise UnknownUnit(why)


def _spelled(word: str) -> str:
    """A word of a unit as Pint spells it."""
    if word[0] in PREFIXES and word[1:] in SPELLINGS:
        return word[0] + SPELLINGS[word[1:]]
    return SPELLINGS.get(word, word)


def _linear(registry: Any, unit: Any, text: str) -> Unit:
    # Values of 0, 1 and 2 tell a zero and a factor, and that there is nothing else.
    found = [registry.Quantity(float(x), unit).to_base_units() for x in range(3)]
    zero, one, two = (float(q.magnitude) for q in found)
    if not is_close(two - one, one - zero):
        raise UnknownUnit("a logarithmic scale has no place in equations")
    exponents = (
        (BASE.get(str(name), str(name).strip("[]")), Fraction(e).limit_denominator(1000))
        for name, e in found[1].dimensionality.items()
    )
    return Unit(dimension_of(exponents), one - zero, zero, text)
