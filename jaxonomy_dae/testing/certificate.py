"""What a check found."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True, repr=False)
class Certificate:
    """The printable result of a check.

    - `claim`: the statement.
    - `checked`: the checked cases and their number.
    - `error`: the largest error; `allowed`: its limit.
    - `where`: the place of the largest error.
    - `notes`: further remarks.
    """

    claim: str
    checked: str
    error: float
    allowed: float
    where: str
    notes: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """True if the error is finite and not above the limit."""
        # A comparison with NaN is false, and so is its negation: an error that is not a number must fail.
        return math.isfinite(self.error) and self.error <= self.allowed

    def __repr__(self):
        lines = [
            f"{'passed' if self.holds else 'failed'}: {self.claim}",
            f"  checked: {self.checked}",
            f"  largest error: {self.error:.3g} ({self.allowed:.3g} is allowed){self.where and ', ' + self.where}",
        ]
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])

    def asserted(self) -> "Certificate":
        """Returns itself if it holds.

        **Raises:**

        - `AssertionError` with the text of the certificate.
        """
        if not self.holds:
            raise AssertionError(repr(self))
        return self
