"""Events beside nonlinear blocks: every quantity that is seen comes out of a block of two to four equations.

The blocks are those of `events`, y + c·y³ = right, taken apart into equations that only together have a solution. Rates
and conditions read y, events write what y was, and discrete variables stand in the block.
"""

import numpy as np
from sympy import Symbol

from jaxonomy_dae import Component

from .case import Case
from .events import Draft, Style, case_of, drawn
from .hybrid import Delicate, Reading


class TakenApart(Style):
    """Readings as blocks."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    def reading(self, component: Component, y: Symbol, cubic, right) -> list:
        name = str(y)
        if not cubic:
            return super().reading(component, y, cubic, right)
        square, cube = (component.variable(f"{name}_{part}") for part in ("square", "cube"))
        kind = int(self.rng.integers(3))
        if kind == 0:  # two equations
            return [square - cubic * y**2, y + square * y - right, cube - y]
        if kind == 1:  # three, in a circle
            return [square - y**2, cube - square * y, y + cubic * cube - right]
        # Two, of which neither holds without the other; `square` is y + ¼·cube.
        return [square - y - 0.25 * cube, cube - (square - 0.25 * cube) ** 3, y - right + cubic * cube]


class _Beside(Draft):
    """All that is seen comes out of a block, and rates read it."""

    def seen(self, x: Symbol):
        y, cubic = Symbol(self.label()), self.uniform(0.1, 1.0)
        gain = self.uniform(0.2, 0.9)
        switched = 1 + gain * self.any(self.discretes) if self.discretes and self.rng.random() < 0.4 else 1
        # What a discrete variable multiplies is no state: else conditions would jump with it.
        part = 0.3 * self.any(self.states) * switched if self.states and self.rng.random() < 0.5 else 0
        self.readings[y] = Reading(cubic, x + cubic * x**3 + part if self.rng.random() < 0.5 else x + cubic * x + part)
        return y

    def began(self) -> None:
        for x in list(self.states):
            self.rates[x] -= self.uniform(0.1, 0.6) * self.seen(x)


def make(seed: int) -> Case:
    """One to seven states with one to four events, and blocks; what two methods need not agree about is drawn again."""
    rng = np.random.default_rng([seed, 20])
    while True:
        system, end = drawn(rng, _Beside)
        if not 1 <= len(system.rules) + len(system.clocks) + len(system.relations) <= 4:
            continue
        try:
            return case_of(rng, system, end, TakenApart(rng))
        except Delicate:
            continue
