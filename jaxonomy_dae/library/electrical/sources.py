"""Sources of voltage and current: constant, of time, of a signal, controlled."""

from ...modeling import POSITIVE, Eq, EqnEnv, Value
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
    """A source whose value is an expression in time."""

    def _drive(self, quantity: str, value):
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage if quantity == "v" else current, value))
        self.declare_supply(-voltage * current)

    def _sine(self, amplitude: Value, frequency: Value, phase: Value, offset: Value, unit: str):
        a = self.parameter("amplitude", amplitude, unit=unit)
        f = self.parameter("frequency", frequency, unit="Hz")
        shift = self.parameter("phase", phase, unit="rad")
        return self.parameter("offset", offset, unit=unit) + sine(self.ev.t, a, f, shift)

    def _step(self, height: Value, start_time: Value, offset: Value, unit: str):
        h = self.parameter("height", height, unit=unit)
        t0 = self.parameter("start_time", start_time, unit="s")
        return self.parameter("offset", offset, unit=unit) + h * step(self, t0)

    def _pulse(self, height: Value, period: Value, width: Value, start_time: Value, offset: Value, unit: str):
        h = self.parameter("height", height, unit=unit)
        length = self.parameter("period", period, unit="s", bounds=POSITIVE)
        part = self.parameter("width", width, unit="1", bounds=(0.0, 1.0))
        t0 = self.parameter("start_time", start_time, unit="s")
        return self.parameter("offset", offset, unit=unit) + h * pulse(self, length, part, t0)


class SineVoltage(_OfTime):
    """v = offset + amplitude·sin(2π·frequency·t + phase), in volt, hertz and radian."""

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
        self._drive("v", self._sine(amplitude, frequency, phase, offset, "V"))


class SineCurrent(_OfTime):
    """i = offset + amplitude·sin(2π·frequency·t + phase), in ampere, hertz and radian."""

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
        self._drive("i", self._sine(amplitude, frequency, phase, offset, "A"))


class StepVoltage(_OfTime):
    """v = offset, and offset + height from `start_time` (second) on, in volt. The step is an event."""

    def __init__(self, ev: EqnEnv, name: str, height: Value = 1.0, start_time: Value = 0.0, offset: Value = 0.0):
        super().__init__(ev, name)
        self._drive("v", self._step(height, start_time, offset, "V"))


class StepCurrent(_OfTime):
    """i = offset, and offset + height from `start_time` (second) on, in ampere. The step is an event."""

    def __init__(self, ev: EqnEnv, name: str, height: Value = 1.0, start_time: Value = 0.0, offset: Value = 0.0):
        super().__init__(ev, name)
        self._drive("i", self._step(height, start_time, offset, "A"))


class PulseVoltage(_OfTime):
    """v = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset, in volt. Its edges are events."""

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
        self._drive("v", self._pulse(height, period, width, start_time, offset, "V"))


class PulseCurrent(_OfTime):
    """i = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset, in ampere. Its edges are events."""

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
        self._drive("i", self._pulse(height, period, width, start_time, offset, "A"))


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
