"""Semiconductors."""

from sympy import Min, exp

from ...modeling import POSITIVE, Eq, EqnEnv, Value, smooth
from .two_pin import TwoPin

# exp(40) is 2.4e17, with the default Is a current of 2e8 A: the diode has long been destroyed, and the straight line
# that goes on from there cannot overflow.
LARGEST_EXPONENT = 40.0


class Diode(TwoPin):
    """i = Is·(exp(v/Vt) − 1) + v/R, from `p` to `n` (Shockley 1949, Bell Syst. Tech. J. 28:435).

    `Is` > 0 the saturation current in ampere, `Vt` > 0 the thermal voltage times the ideality factor in volt, `R` > 0 a
    resistance in parallel in ohm. Beyond v = 40·Vt, where currents have long destroyed it, the exponential goes on as
    its tangent.
    """

    def __init__(self, ev: EqnEnv, name: str, Is: Value = 1e-9, Vt: Value = 0.04, R: Value = 1e8):
        super().__init__(ev, name)
        saturation = self.parameter("Is", Is, unit="A", bounds=POSITIVE)
        thermal = self.parameter("Vt", Vt, unit="V", bounds=POSITIVE)
        leak = self.parameter("R", R, unit="Ohm", bounds=POSITIVE)
        voltage, current = self._two_pins()
        x = voltage / thermal
        below = smooth(Min(x, LARGEST_EXPONENT))
        self.add_equations(Eq(current, saturation * (exp(below) * (1 + x - below) - 1) + voltage / leak))
        self.declare_dissipation(voltage * current)
