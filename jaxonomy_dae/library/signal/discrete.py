"""Blocks that act at instants: sampled controllers, and relays. Inputs are `u`, outputs `y`."""

import math
from collections.abc import Sequence

import sympy

from ...base.errors import ModelError
from ...write import POSITIVE, Component, Eq, EqnEnv, Value, assign, pre
from ..arguments import coefficients, count, in_order, yes_or_no


class SampleHold(Component):
    """y is the input `u` as it was at the last of the instants 0, period, 2·period, … (second); before the first of
    them in a run it is `initial_y`."""

    def __init__(self, ev: EqnEnv, name: str, period: Value = 0.1, initial_y: Value = 0.0):
        super().__init__(ev, name)
        T = self.parameter("period", period, unit="s", bounds=POSITIVE)
        start = self.parameter("initial_y", initial_y)
        u, y = self.input("u"), self.variable("y")
        held = self.discrete("held", start=start)
        self.add_equations(Eq(y, held))
        self.when(self.sampled(T), assign(held, u))


class DiscretePI(Component):
    """A sampled controller: every `period` (second), y = kp·u + I with I the sum of ki·period·u so far, bounded by
    `low` and `high` where they are given; the sum waits while y is beyond a bound and ki·u drives it further. Gains may
    be negative. y is 0 before the first tick."""

    def __init__(
        self, ev: EqnEnv, name: str, kp: Value = 1.0, ki: Value = 1.0, period: Value = 0.1,
        low: Value | None = None, high: Value | None = None,
    ):  # fmt: skip
        super().__init__(ev, name)
        proportional, integral = self.parameter("kp", kp), self.parameter("ki", ki)
        T = self.parameter("period", period, unit="s", bounds=POSITIVE)
        u, y = self.input("u"), self.variable("y")
        held, total = self.discrete("held"), self.discrete("total")
        wished, grows = proportional * u + pre(total), integral * u
        bounded, free = wished, sympy.true
        low, high = _finite(low, -math.inf), _finite(high, math.inf)
        if high is not None:
            top = self.parameter("high", high)
            bounded, free = sympy.Min(bounded, top), sympy.And(free, sympy.Or(wished <= top, grows <= 0))
        if low is not None:
            bottom = self.parameter("low", low)
            bounded, free = sympy.Max(bounded, bottom), sympy.And(free, sympy.Or(wished >= bottom, grows >= 0))
        if high is not None and low is not None:
            in_order(self, "low", "high")
        self.add_equations(Eq(y, held))
        step = sympy.Piecewise((T * grows, free), (0, True))
        self.when(self.sampled(T), assign(held, bounded), assign(total, pre(total) + step))


def _finite(bound: Value | None, none: float) -> Value | None:
    """The bound; None for the infinite one that does not bound anything."""
    return None if isinstance(bound, float | sympy.Basic) and bound == none else bound


class DiscreteTransferFunction(Component):
    """y = (b₀ + b₁·z⁻¹ + … ) / (1 + a₁·z⁻¹ + …) · u every `period` (second), from rest.

    **Arguments:**

    - `numerator`, `denominator`: coefficients of falling powers of z, the first of the denominator not zero; no more in
        the numerator than in the denominator.
    """

    def __init__(
        self, ev: EqnEnv, name: str, numerator: Sequence[float], denominator: Sequence[float], period: Value = 0.1
    ):
        super().__init__(ev, name)
        below, above = coefficients(denominator, name, "denominator"), coefficients(numerator, name, "numerator")
        denominator, numerator = below.tolist(), above.tolist()
        n = len(denominator) - 1
        if n < 0 or denominator[0] == 0 or not 0 < len(numerator) <= n + 1:
            raise ModelError(
                f"'{name}': the denominator begins with a number that is not zero and has at least as many as the "
                f"numerator; got {list(numerator)} over {list(denominator)}"
            )
        a = [float(c) / float(denominator[0]) for c in denominator]
        b = [0.0] * (n + 1 - len(numerator)) + [float(c) / float(denominator[0]) for c in numerator]
        T = self.parameter("period", period, unit="s", bounds=POSITIVE)
        u, y = self.input("u"), self.variable("y")
        held = self.discrete("held")
        self.add_equations(Eq(y, held))
        # Transposed direct form II (Oppenheim & Schafer 2010, section 6.3).
        memory = [self.discrete(f"x{k}") for k in range(1, n + 1)]
        out = b[0] * u + (pre(memory[0]) if n else 0)
        kept = [
            assign(memory[k], b[k + 1] * u - a[k + 1] * out + (pre(memory[k + 1]) if k + 1 < n else 0))
            for k in range(n)
        ]
        self.when(self.sampled(T), assign(held, out), *kept)


class SampledDelay(Component):
    """Every `period` (second), y becomes what the input `u` was `samples` ticks ago; until a run has had as many, it is
    `initial_y`."""

    def __init__(self, ev: EqnEnv, name: str, samples: int = 1, period: Value = 0.1, initial_y: Value = 0.0):
        super().__init__(ev, name)
        samples = count(samples, name, "samples")
        T = self.parameter("period", period, unit="s", bounds=POSITIVE)
        start = self.parameter("initial_y", initial_y)
        u, y = self.input("u"), self.variable("y")
        # One more than samples of delay: x0 is the sample of this tick.
        line = [self.discrete(f"x{k}", start=start) for k in range(samples + 1)]
        self.add_equations(Eq(y, line[-1]))
        # All move at once: `pre` reads the line as it was before the tick.
        moved = [assign(later, pre(before)) for before, later in zip(line, line[1:], strict=False)]
        self.when(self.sampled(T), assign(line[0], u), *moved)


class Hysteresis(Component):
    """A relay: y becomes `high` where the input `u` rises above `upper`, and `low` where it falls below `lower`.

    The discrete variable `on` is 1 or 0; `initially_on` says which it is while `u` lies between.
    """

    def __init__(
        self, ev: EqnEnv, name: str, lower: Value = 0.0, upper: Value = 1.0, low: Value = 0.0, high: Value = 1.0,
        initially_on: bool = False,
    ):  # fmt: skip
        super().__init__(ev, name)
        down, up = self.parameter("lower", lower), self.parameter("upper", upper)
        in_order(self, "lower", "upper")
        least, most = self.parameter("low", low), self.parameter("high", high)
        u, y = self.input("u"), self.variable("y")
        on = self.discrete("on", start=yes_or_no(initially_on, name, "initially_on"), unit="1")
        self.add_equations(Eq(y, least + (most - least) * on))
        self.when(u > up, assign(on, 1), at_start=True)
        self.when(u < down, assign(on, 0), at_start=True)


class PulseWidth(Component):
    """Pulse-width modulation: every `period` (second), y = `height` for the part `u` of it (the input as it is at its
    beginning, between 0 and 1), and 0 for the rest."""

    def __init__(self, ev: EqnEnv, name: str, period: Value = 0.1, height: Value = 1.0):
        super().__init__(ev, name)
        T = self.parameter("period", period, unit="s", bounds=POSITIVE)
        amplitude = self.parameter("height", height)
        u, y = self.input("u", unit="1"), self.variable("y")
        on, until = self.discrete("on", unit="1"), self.discrete("until", start=-1.0, unit="s")
        self.add_equations(Eq(y, amplitude * on))
        share = sympy.Min(sympy.Max(u, 0), 1)
        self.when(self.sampled(T), assign(until, ev.t + T * share), assign(on, sympy.Piecewise((1, u > 0), (0, True))))
        self.when(ev.t >= until, assign(on, 0), on=Eq(on, 1))


class Counter(Component):
    """y counts how often the input `u` has risen above `threshold`."""

    def __init__(self, ev: EqnEnv, name: str, threshold: Value = 0.5):
        super().__init__(ev, name)
        level = self.parameter("threshold", threshold)
        u, y = self.input("u"), self.variable("y", unit="1")
        count = self.discrete("count", unit="1")
        self.add_equations(Eq(y, count))
        # Not at the start: an input that begins above the threshold has not risen.
        self.when(u > level, assign(count, pre(count) + 1))
