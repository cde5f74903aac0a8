"""The end of a search by its user: a time limit, or an interrupt from the keyboard."""

import math
import time

from ..base.errors import ModelError
from .priors import is_finite


class Clock:
    """Says when a search has to end. It counts from its construction, compilation included; `reason` is why it ended,
    and "" before."""

    def __init__(self, timeout: float | None = None):
        if timeout is not None and not (is_finite(timeout) and timeout > 0):
            raise ModelError(f"timeout is a number of seconds > 0, or None for no limit; got {timeout!r}")
        self.limit = math.inf if timeout is None else float(timeout)
        self._began, self.reason = time.perf_counter(), ""

    @property
    def is_over(self) -> bool:
        """True if no further step is to be taken."""
        elapsed = self.elapsed
        if not self.reason and elapsed > self.limit:
            self.reason = f"stopped by timeout={self.limit:g}, {elapsed:.3g} s after the beginning"
        return bool(self.reason)

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self._began

    def interrupt(self) -> None:
        """Ends the search: the user pressed Ctrl-C."""
        self.reason = "interrupted"

    def after(self, steps: int) -> str:
        """Why a search ended after so many steps."""
        return f"{self.reason}, {f'after {steps} steps' if steps else 'before the first step'}"
