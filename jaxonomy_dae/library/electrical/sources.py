"""Sources of voltage and current: constant, of time, of a signal, controlled."""

from typing import ClassVar

import sympy

from ...modeling import Eq, EqnEnv, Value
from ..laws import pulse, sine, step
from .two_pin import TwoPin, TwoPorts


class VoltageSource(TwoPin):
    """An ideal source: the voltage is the parameter `V` (volt), whatever the current."""

    def __init__(self, ev: EqnEnv, name: str, V: Value = 1.0):
        super().__init__(ev, name)
        V = self.parameter("V", V, unit="V")
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage, V))
        self.declare_supply(-voltage * current)


class CurrentSource(TwoPin):
    """An ideal source: the current from `p` to `n` through it is the parameter `I` (ampere), whatever the voltage."""

    def __init__(self, ev: EqnEnv, name: str, I: Value = 1.0):  # noqa: E741
        super().__init__(ev, name)
        source = self.parameter("I", I, unit="A")
        voltage, current = self._two_pins()
        self.add_equations(Eq(current, source))
        self.declare_supply(-voltage * current)


class SignalVoltage(TwoPin):
    """An ideal source: the voltage is the input `u` (volt)."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        u = self.input("u", unit="V")
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage, u))
        self.declare_supply(-voltage * current)


class SignalCurrent(TwoPin):
    """An ideal source: the current from `p` to `n` through it is the input `u` (ampere)."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        u = self.input("u", unit="A")
        voltage, current = self._two_pins()
        self.add_equations(Eq(current, u))
        self.declare_supply(-voltage * current)


class _OfTime(TwoPin):
    """A source whose voltage or current, as `unit` says, is an expression in time."""

    unit: ClassVar[str]

    def _drive(self, value: sympy.Expr) -> None:
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage if self.unit == "V" else current, value))
        self.declare_supply(-voltage * current)


class _Sine(_OfTime):
    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        amplitude: Value = 1.0,
        frequency: Value = 1.0,
        phase: Value = 0.0,
        offset: Value = 0.0,
    ):
        super().__init__(ev, name)
        self._drive(sine(self, amplitude, frequency, phase, offset, self.unit))


class _Step(_OfTime):
    def __init__(self, ev: EqnEnv, name: str, height: Value = 1.0, start_time: Value = 0.0, offset: Value = 0.0):
        super().__init__(ev, name)
        self._drive(step(self, height, start_time, offset, self.unit))


class _Pulse(_OfTime):
    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        height: Value = 1.0,
        period: Value = 1.0,
        width: Value = 0.5,
        start_time: Value = 0.0,
        offset: Value = 0.0,
    ):
        super().__init__(ev, name)
        self._drive(pulse(self, height, period, width, start_time, offset, self.unit))


class SineVoltage(_Sine):
    """v = offset + amplitude·sin(2π·frequency·t + phase), in volt, hertz and radian."""

    unit = "V"


class SineCurrent(_Sine):
    """i = offset + amplitude·sin(2π·frequency·t + phase), in ampere, hertz and radian."""

    unit = "A"


class StepVoltage(_Step):
    """v = offset, and offset + height from `start_time` (second) on, in volt. The step is an event."""

    unit = "V"


class StepCurrent(_Step):
    """i = offset, and offset + height from `start_time` (second) on, in ampere. The step is an event."""

    unit = "A"


class PulseVoltage(_Pulse):
    """v = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset, in volt. Its edges are events."""

    unit = "V"


class PulseCurrent(_Pulse):
    """i = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset, in ampere. Its edges are events."""

    unit = "A"


class VoltageControlledVoltage(TwoPorts):
    """v2 = gain·v1, i1 = 0."""

    def __init__(self, ev: EqnEnv, name: str, gain: Value = 1.0):
        super().__init__(ev, name)
        k = self.parameter("gain", gain, unit="1")
        v1, i1, v2, i2 = self._two_ports()
        self.add_equations(Eq(v2, k * v1), Eq(i1, 0))
        self.declare_supply(-v2 * i2)


class VoltageControlledCurrent(TwoPorts):
    """i2 = transconductance·v1 (siemens), i1 = 0; i2 flows from `p2` to `n2` through the source."""

    def __init__(self, ev: EqnEnv, name: str, transconductance: Value = 1.0):
        super().__init__(ev, name)
        k = self.parameter("transconductance", transconductance, unit="S")
        v1, i1, v2, i2 = self._two_ports()
        self.add_equations(Eq(i2, k * v1), Eq(i1, 0))
        self.declare_supply(-v2 * i2)


class CurrentControlledVoltage(TwoPorts):
    """v2 = transresistance·i1 (ohm), v1 = 0."""

    def __init__(self, ev: EqnEnv, name: str, transresistance: Value = 1.0):
        super().__init__(ev, name)
        k = self.parameter("transresistance", transresistance, unit="Ohm")
        v1, i1, v2, i2 = self._two_ports()
        self.add_equations(Eq(v2, k * i1), Eq(v1, 0))
        self.declare_supply(-v2 * i2)


class CurrentControlledCurrent(TwoPorts):
    """i2 = gain·i1, v1 = 0; i2 flows from `p2` to `n2` through the source."""

    def __init__(self, ev: EqnEnv, name: str, gain: Value = 1.0):
        super().__init__(ev, name)
        k = self.parameter("gain", gain, unit="1")
        v1, i1, v2, i2 = self._two_ports()
        self.add_equations(Eq(i2, k * i1), Eq(v1, 0))
        self.declare_supply(-v2 * i2)
