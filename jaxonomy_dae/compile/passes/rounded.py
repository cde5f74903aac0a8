"""Numbers that are known to their roundings.

A coefficient in a unit is rounded, and so is what becomes of it in an elimination. With the bound of its error beside
it, a number says whether it is zero: 1e-3·3.6·x − 0.0036·x is, and 1e-15·x beside 1e9·y is not.
"""

import dataclasses

import numpy as np

from ...base.tolerances import EPS


@dataclasses.dataclass(frozen=True, slots=True)
class Rounded:
    """A value and a bound of its error, or several at once; false where all of them may be zero."""

    value: float | np.ndarray
    error: float | np.ndarray

    def __bool__(self) -> bool:
        # An entry counts if it is seen at one sample: a function of parameters that vanishes at some of them is not
        # zero.
        seen = abs(self.value) > self.error
        return seen if isinstance(seen, bool) else bool(np.any(seen))

    @property
    def may_vanish(self) -> bool:
        """True if one of the values may be zero."""
        return bool(np.any(abs(self.value) <= self.error))

    def __neg__(self) -> "Rounded":
        return Rounded(-self.value, self.error)

    def __add__(self, other: "Rounded") -> "Rounded":
        value = self.value + other.value
        return Rounded(value, self.error + other.error + EPS * abs(value))

    def __sub__(self, other: "Rounded") -> "Rounded":
        return self + -other

    def __mul__(self, other: "Rounded") -> "Rounded":
        value = self.value * other.value
        error = abs(self.value) * other.error + abs(other.value) * self.error + self.error * other.error
        return Rounded(value, error + EPS * abs(value))

    def __truediv__(self, other: "Rounded") -> "Rounded":
        """By a number that is not zero."""
        value = self.value / other.value
        # The divisor is seen to be other than zero, so this is positive; it may be small, and the error large, which
        # says that the quotient has no digits.
        least = abs(other.value) - other.error
        return Rounded(value, (self.error + abs(value) * other.error) / least + EPS * abs(value))
