"""The ground, and ideal elements without storage: transformer, gyrator, amplifier."""

from ...write import Component, Electrical, Eq, EqnEnv, Value
from .two_pin import TwoPorts


class Ground(Component):
    """The node of zero potential: p.v = 0."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        p = self.port("p", Electrical)
        self.add_equations(Eq(p.v, 0))


class IdealTransformer(TwoPorts):
    """v1 = n·v2, i2 = −n·i1, with `n` turns on side 1 for each on side 2; no power is lost."""

    def __init__(self, ev: EqnEnv, name: str, n: Value = 1.0):
        super().__init__(ev, name)
        ratio = self.parameter("n", n, unit="1")
        v1, i1, v2, i2 = self._two_ports()
        self.add_equations(Eq(v1, ratio * v2), Eq(i2, -ratio * i1))


class Gyrator(TwoPorts):
    """i1 = G·v2, i2 = −G·v1, `G` in siemens; no power is lost (Tellegen 1948, Philips Res. Rep. 3:81)."""

    def __init__(self, ev: EqnEnv, name: str, G: Value = 1.0):
        super().__init__(ev, name)
        conductance = self.parameter("G", G, unit="S")
        v1, i1, v2, i2 = self._two_ports()
        self.add_equations(Eq(i1, conductance * v2), Eq(i2, -conductance * v1))


class IdealOpAmp(Component):
    """An operational amplifier of infinite gain: no voltage between its inputs `plus` and `minus`, no current into
    them, and whatever potential and current at `out` the circuit around it needs (a nullor)."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        plus, minus = self.port("plus", Electrical), self.port("minus", Electrical)
        out = self.port("out", Electrical)
        self.add_equations(Eq(plus.v, minus.v), Eq(plus.i, 0), Eq(minus.i, 0))
        self.declare_supply(-out.v * out.i)
