"""Functions of time that drive a component: a signal, a voltage or a current. Steps and edges are events."""

from typing import ClassVar

import sympy
from sympy import Piecewise, frac, pi, sin

from ..write import POSITIVE, Component, EqnEnv, Value


class Driven(Component):
    """A component that an expression in time drives; `unit` is that of its value."""

    unit: ClassVar[str] = ""

    def _drive(self, value: sympy.Expr) -> None:
        raise NotImplementedError


class Sine(Driven):
    def __init__(
        self, ev: EqnEnv, name: str, amplitude: Value = 1.0, frequency: Value = 1.0, phase: Value = 0.0,
        offset: Value = 0.0,
    ):  # fmt: skip
        super().__init__(ev, name)
        a = self.parameter("amplitude", amplitude, unit=self.unit)
        f = self.parameter("frequency", frequency, unit="Hz")
        shift = self.parameter("phase", phase, unit="rad")
        self._drive(self.parameter("offset", offset, unit=self.unit) + a * sin(2 * pi * f * ev.t + shift))


class Step(Driven):
    def __init__(self, ev: EqnEnv, name: str, height: Value = 1.0, start_time: Value = 0.0, offset: Value = 0.0):
        super().__init__(ev, name)
        h = self.parameter("height", height, unit=self.unit)
        begin = self.parameter("start_time", start_time, unit="s")
        risen = Piecewise((1, self.relation(ev.t >= begin)), (0, True))
        self._drive(self.parameter("offset", offset, unit=self.unit) + h * risen)


class Pulse(Driven):
    def __init__(
        self, ev: EqnEnv, name: str, height: Value = 1.0, period: Value = 1.0, width: Value = 0.5,
        start_time: Value = 0.0, offset: Value = 0.0,
    ):  # fmt: skip
        super().__init__(ev, name)
        h = self.parameter("height", height, unit=self.unit)
        length = self.parameter("period", period, unit="s", bounds=POSITIVE)
        part = self.parameter("width", width, unit="1", bounds=(0.0, 1.0))
        cycle = (ev.t - self.parameter("start_time", start_time, unit="s")) / length
        on = Piecewise((1, self.relation((cycle >= 0) & (frac(cycle) < part))), (0, True))
        self._drive(self.parameter("offset", offset, unit=self.unit) + h * on)
