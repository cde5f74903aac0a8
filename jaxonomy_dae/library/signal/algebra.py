"""Blocks without memory: inputs `u` (or `u1`, `u2`, …), output `y`."""

from collections.abc import Sequence

import numpy as np
from sympy import Max, Min

from ...base.errors import ModelError
from ...write import NONNEGATIVE, Component, EqnEnv, Value, smooth
from ..arguments import count, in_order, row


class Gain(Component):
    """y = k·u."""

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0):
        super().__init__(ev, name)
        self.output("y", self.parameter("k", k) * self.input("u"))


class Sum(Component):
    """y = k1·u1 + k2·u2 + …, as many inputs as there are `gains`: `Sum(ev, "error", (1, -1))` is a difference."""

    def __init__(self, ev: EqnEnv, name: str, gains: Sequence[Value] | np.ndarray = (1.0, 1.0)):
        super().__init__(ev, name)
        gains = row(gains, name, "gains")
        if not gains:
            raise ModelError(f"'{name}': gains must name at least one input")
        terms = [self.parameter(f"k{j}", k) * self.input(f"u{j}") for j, k in enumerate(gains, 1)]
        self.output("y", sum(terms[1:], terms[0]))


class Product(Component):
    """y = u1·u2·… with `n` inputs."""

    def __init__(self, ev: EqnEnv, name: str, n: int = 2):
        super().__init__(ev, name)
        product = self.input("u1")
        for j in range(2, count(n, name, "n") + 1):
            product = product * self.input(f"u{j}")
        self.output("y", product)


class Saturation(Component):
    """y = u, but not below `low` nor above `high`."""

    def __init__(self, ev: EqnEnv, name: str, low: Value = -1.0, high: Value = 1.0):
        super().__init__(ev, name)
        least, most = self.parameter("low", low), self.parameter("high", high)
        in_order(self, "low", "high")
        # No events at the limits, where the output is continuous.
        self.output("y", smooth(Min(Max(self.input("u"), least), most)))


class DeadZone(Component):
    """y = 0 within ±`width`, beyond it u − width or u + width."""

    def __init__(self, ev: EqnEnv, name: str, width: Value = 1.0):
        super().__init__(ev, name)
        half = self.parameter("width", width, bounds=NONNEGATIVE)
        u = self.input("u")
        self.output("y", u - smooth(Min(Max(u, -half), half)))
