"""Sources of voltage and current: constant, of time, of a signal, controlled."""

import sympy

from ...write import Eq, EqnEnv, Value
from .. import waveforms
from .two_pin import TwoPin, TwoPorts


class _Source(TwoPin, waveforms.Driven):
    """A source whose voltage or current, as `unit` says, is an expression."""

    def _drive(self, value: sympy.Expr) -> None:
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage if self.unit == "V" else current, value))
        self.declare_supply(-voltage * current)


class _Voltage(_Source):
    unit = "V"


class _Current(_Source):
    unit = "A"


class VoltageSource(_Voltage):
    """An ideal source: the voltage is the parameter `V` (volt), whatever the current."""

    def __init__(self, ev: EqnEnv, name: str, V: Value = 1.0):
        super().__init__(ev, name)
        self._drive(self.parameter("V", V, unit="V"))


class CurrentSource(_Current):
    """An ideal source: the current from `p` to `n` through it is the parameter `I` (ampere), whatever the voltage."""

    def __init__(self, ev: EqnEnv, name: str, I: Value = 1.0):  # noqa: E741
        super().__init__(ev, name)
        self._drive(self.parameter("I", I, unit="A"))


class SignalVoltage(_Voltage):
    """An ideal source: the voltage is the input `u` (volt)."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        self._drive(self.input("u", unit="V"))


class SignalCurrent(_Current):
    """An ideal source: the current from `p` to `n` through it is the input `u` (ampere)."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        self._drive(self.input("u", unit="A"))


class SineVoltage(_Voltage, waveforms.Sine):
    """v = offset + amplitude·sin(2π·frequency·t + phase), in volt, hertz and radian."""


class SineCurrent(_Current, waveforms.Sine):
    """i = offset + amplitude·sin(2π·frequency·t + phase), in ampere, hertz and radian."""


class StepVoltage(_Voltage, waveforms.Step):
    """v = offset, and offset + height from `start_time` (second) on, in volt. The step is an event."""


class StepCurrent(_Current, waveforms.Step):
    """i = offset, and offset + height from `start_time` (second) on, in ampere. The step is an event."""


class PulseVoltage(_Voltage, waveforms.Pulse):
    """v = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset, in volt. Its edges are events."""


class PulseCurrent(_Current, waveforms.Pulse):
    """i = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset, in ampere. Its edges are events."""


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
