"""What one solver did with one problem at one tolerance."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Outcome:
    """End values by the model's names, counts (-1 where the solver does not tell), and seconds.

    `first` is the first call, with whatever is compiled then; `steady` the best of the repeated ones.
    """

    values: dict[str, float] = field(default_factory=dict)
    steps: int = -1
    rejected: int = -1
    jacobians: int = -1
    factorisations: int = -1
    first: float = math.nan
    steady: float = math.nan
    failure: str = ""


def timed(call: Callable, repeat: int) -> tuple[object, float, float]:
    """The result of `call`, the seconds of its first run, and of the best of `repeat` more."""
    start = time.perf_counter()
    result = call()
    first = time.perf_counter() - start
    best = math.inf
    for _ in range(repeat):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return result, first, best


def best_of(seconds: float, budget: float = 1.0, most: int = 20) -> int:
    """How many repetitions a budget of seconds allows, at least two."""
    return max(2, min(most, int(budget / max(seconds, 1e-6))))
