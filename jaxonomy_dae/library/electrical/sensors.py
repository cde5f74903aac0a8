"""Ideal meters: they take no power from the circuit."""

from ...write import Component, Electrical, Eq, EqnEnv
from .two_pin import TwoPin


class VoltageSensor(TwoPin):
    """The output `y` is the voltage between `p` and `n` (volt); no current flows."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        voltage, current = self._two_pins()
        self.output("y", voltage, unit="V")
        self.add_equations(Eq(current, 0))


class CurrentSensor(TwoPin):
    """The output `y` is the current from `p` to `n` (ampere); no voltage drops."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        voltage, current = self._two_pins()
        self.output("y", current, unit="A")
        self.add_equations(Eq(voltage, 0))


class PowerSensor(Component):
    """The output `y` = (pv.v − nv.v)·pc.i is the power (watt) of what lies behind it: the current flows from `pc` to
    `nc` without a drop, `pv` and `nv` measure the voltage without a current."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        pc, nc, pv, nv = (self.port(k, Electrical) for k in ("pc", "nc", "pv", "nv"))
        self.output("y", (pv.v - nv.v) * pc.i, unit="W")
        self.add_equations(Eq(pc.v, nc.v), Eq(pc.i + nc.i, 0), Eq(pv.i, 0), Eq(nv.i, 0))
