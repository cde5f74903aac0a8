"""How a fit goes on: a line for each step, or a call of the user's own."""

import dataclasses
import math
import sys
import time
from collections.abc import Callable

from ..base.errors import ModelError

RECENT = 4  # steps by which the rest is extrapolated


@dataclasses.dataclass(frozen=True)
class Progress:
    """One step of a fit, for `Problem.fit(progress=...)`.

    - `step`: how many steps were taken; `cost`: what is minimised.
    - `chi2`: the sum of squared residuals in units of the noise, for each sample: about one at the end.
    - `remaining`: the length of the step that is left, in radii of the confidence region; a fit ends at a thousandth.
    - `elapsed`: seconds since the fit began; `left`: seconds to its end if it goes on as in the last steps, NaN if
        that cannot be told.
    """

    step: int
    cost: float
    chi2: float
    remaining: float
    elapsed: float
    left: float

    def __str__(self):
        rest = f"about {self.left:.0f} s left" if math.isfinite(self.left) else "end not in sight"
        return (
            f"step {self.step}: cost {self.cost:.6g}, χ²/n {self.chi2:.4g}, {self.remaining:.2g} σ to go, "
            f"{self.elapsed:.0f} s, {rest}"
        )


class Watch:
    """Reports steps to a function, with times."""

    def __init__(self, report: Callable[[Progress], object], end: float):
        self.report, self.end, self.began = report, end, time.perf_counter()
        self._seen: list[tuple[float, float]] = []  # seconds, and ln of what remains

    def __call__(self, step: int, cost: float, chi2: float, remaining: float) -> None:
        now = time.perf_counter() - self.began
        if step == 0:
            self._seen.clear()  # another start, or a longer part of the time
        self._seen = [*self._seen[-RECENT:], (now, math.log(max(remaining, 1e-300)))]
        (first, before), (last, here) = self._seen[0], self._seen[-1]
        falls = (before - here) / (last - first) if last > first else 0.0
        left = max(here - math.log(self.end), 0.0) / falls if falls > 0 else math.nan
        self.report(Progress(step, cost, chi2, remaining, now, left))


def reporter(given: object, end: float) -> Watch | None:
    """The watch of a fit that ends where no more than `end` remains: None, True for lines of text, or a function."""
    if given is None or given is False:
        return None
    if given is not True and not callable(given):
        raise ModelError(f"progress is True, or a function of a learning.Progress; got {given!r}")
    return Watch(_print if given is True else given, end)


def _print(progress: Progress) -> None:
    print(progress, file=sys.stderr, flush=True)
