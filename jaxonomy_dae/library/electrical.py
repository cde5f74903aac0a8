"""Electrical components.

Conventions: potential `v` in volt, current `i` in ampere counted positive into a pin. A two-pin component has
`v = p.v − n.v`, and `i` flows from `p` to `n`.
"""

import sympy

from ..modeling import POSITIVE, Component, Electrical, Eq, EqnEnv, Value, der


class _TwoPin(Component):
    """Two pins and one current: v = p.v − n.v, i = p.i = −n.i."""

    def _two_pins(self, v: dict | None = None, i: dict | None = None) -> tuple[sympy.Symbol, sympy.Symbol]:
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        voltage = self.variable("v", unit="V", **(v or {}))
        current = self.variable("i", unit="A", **(i or {}))
        self.add_equations(Eq(voltage, p.v - n.v), Eq(current, p.i), Eq(p.i + n.i, 0))
        return voltage, current


class VoltageSource(_TwoPin):
    """An ideal source: the voltage is the parameter `V` (volt), whatever the current."""

    def __init__(self, ev: EqnEnv, name: str, v: Value = 1.0):
        super().__init__(ev, name)
        source = self.parameter("V", v, unit="V")
        voltage, _ = self._two_pins()
        self.add_equations(Eq(voltage, source))


class CurrentSource(_TwoPin):
    """An ideal source: the current from `p` to `n` through it is the parameter `I` (ampere), whatever the voltage."""

    def __init__(self, ev: EqnEnv, name: str, i: Value = 1.0):
        super().__init__(ev, name)
        source = self.parameter("I", i, unit="A")
        _, current = self._two_pins()
        self.add_equations(Eq(current, source))


class Resistor(_TwoPin):
    """v = R·i, `R` in ohm; a negative one feeds energy in."""

    def __init__(self, ev: EqnEnv, name: str, R: Value = 1.0):
        super().__init__(ev, name)
        r = self.parameter("R", R, unit="Ohm")
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage, r * current))


class Capacitor(_TwoPin):
    """C·dv/dt = i, `C` > 0 in farad. A given `initial_voltage` (volt) holds at the start; otherwise 0 is a guess."""

    def __init__(self, ev: EqnEnv, name: str, C: Value = 1.0, initial_voltage: Value | None = None):
        super().__init__(ev, name)
        c = self.parameter("C", C, unit="F", bounds=POSITIVE)
        v0 = self.parameter("initial_voltage", initial_voltage or 0.0, unit="V")
        voltage, current = self._two_pins(v=dict(start=v0, fixed=initial_voltage is not None))
        self.add_equations(Eq(c * der(voltage), current))


class Inductor(_TwoPin):
    """L·di/dt = v, `L` > 0 in henry. A given `initial_current` (ampere) holds at the start; otherwise 0 is a guess."""

    def __init__(self, ev: EqnEnv, name: str, L: Value = 1.0, initial_current: Value | None = None):
        super().__init__(ev, name)
        inductance = self.parameter("L", L, unit="H", bounds=POSITIVE)
        i0 = self.parameter("initial_current", initial_current or 0.0, unit="A")
        voltage, current = self._two_pins(i=dict(start=i0, fixed=initial_current is not None))
        self.add_equations(Eq(inductance * der(current), voltage))


class Ground(Component):
    """The node of zero potential: p.v = 0."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        p = self.port("p", Electrical)
        self.add_equations(Eq(p.v, 0))
