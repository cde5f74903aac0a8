"""Resistors, capacitors, inductors, diodes and what is made of them."""

from sympy import Min, exp

from ...base.errors import ModelError
from ...write import NONNEGATIVE, POSITIVE, Component, Electrical, Eq, EqnEnv, Thermal, Value, der, smooth
from ..arguments import start_of
from .two_pin import TwoPin, TwoPorts


class Resistor(TwoPin):
    """v = R·i, `R` in ohm; a negative one feeds energy in."""

    def __init__(self, ev: EqnEnv, name: str, R: Value = 1.0):
        super().__init__(ev, name)
        r = self.parameter("R", R, unit="Ohm")
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage, r * current))
        self.declare_dissipation(voltage * current)


class HeatedResistor(TwoPin):
    """A resistor that changes with its temperature and heats what it touches: v = R·(1 + alpha·(T − T_ref))·i, the heat
    v·i leaves at the port `heat`.

    `R` > 0 in ohm at `T_ref` (kelvin), `alpha` in 1/kelvin, `T` the temperature of the port. `T_ref` is a guess of it:
    beside radiation there may be solutions below zero kelvin, too.
    """

    def __init__(self, ev: EqnEnv, name: str, R: Value = 1.0, alpha: Value = 0.0, T_ref: Value = 293.15):
        super().__init__(ev, name)
        r = self.parameter("R", R, unit="Ohm", bounds=POSITIVE)
        slope = self.parameter("alpha", alpha, unit="1/K")
        reference = self.parameter("T_ref", T_ref, unit="K")
        voltage, current = self._two_pins()
        heat = self.port("heat", Thermal)
        T = self.variable("T", start=reference, unit="K")
        self.add_equations(
            Eq(T, heat.T),
            Eq(voltage, r * (1 + slope * (T - reference)) * current),
            Eq(heat.Q_flow, -voltage * current),
        )


class Capacitor(TwoPin):
    """C·dv/dt = i, `C` > 0 in farad. A given `initial_voltage` (volt) holds at the start; otherwise 0 is a guess."""

    def __init__(self, ev: EqnEnv, name: str, C: Value = 1.0, initial_voltage: Value | None = None):
        super().__init__(ev, name)
        c = self.parameter("C", C, unit="F", bounds=POSITIVE)
        voltage, current = self._two_pins(v=start_of(self, "initial_voltage", initial_voltage, "V"))
        self.add_equations(Eq(c * der(voltage), current))
        self.declare_energy(c * voltage**2 / 2)


class Inductor(TwoPin):
    """L·di/dt = v, `L` > 0 in henry. A given `initial_current` (ampere) holds at the start; otherwise 0 is a guess."""

    def __init__(self, ev: EqnEnv, name: str, L: Value = 1.0, initial_current: Value | None = None):
        super().__init__(ev, name)
        inductance = self.parameter("L", L, unit="H", bounds=POSITIVE)
        voltage, current = self._two_pins(i=start_of(self, "initial_current", initial_current, "A"))
        self.add_equations(Eq(inductance * der(current), voltage))
        self.declare_energy(inductance * current**2 / 2)


class MutualInductor(TwoPorts):
    """Two coupled coils: v1 = L1·di1/dt + M·di2/dt, v2 = M·di1/dt + L2·di2/dt.

    `L1`, `L2` > 0 and the mutual inductance `M` in henry, M² < L1·L2: else the coils would store negative energy. Given
    initial currents (ampere) hold at the start.

    **Raises:**

    - `ModelError` for numbers with M² ≥ L1·L2.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        L1: Value = 1.0,
        L2: Value = 1.0,
        M: Value = 0.5,
        initial_current1: Value | None = None,
        initial_current2: Value | None = None,
    ):
        super().__init__(ev, name)
        first = self.parameter("L1", L1, unit="H", bounds=POSITIVE)
        second = self.parameter("L2", L2, unit="H", bounds=POSITIVE)
        mutual = self.parameter("M", M, unit="H")
        own1, own2, shared = (self.parameters[k].value for k in ("L1", "L2", "M"))
        if isinstance(own1, float) and isinstance(own2, float) and isinstance(shared, float):
            if shared**2 >= own1 * own2:
                raise ModelError(
                    f"'{name}': M² must be below L1·L2; got M={shared:g} with L1={own1:g} and L2={own2:g}: for coils "
                    "that share all of their flux, take IdealTransformer, with an Inductor beside one of its sides"
                )
        given = ("1", initial_current1), ("2", initial_current2)
        starts = {f"i{k}": start_of(self, f"initial_current{k}", start, "A") for k, start in given}
        v1, i1, v2, i2 = self._two_ports(**starts)
        self.add_equations(Eq(v1, first * der(i1) + mutual * der(i2)), Eq(v2, mutual * der(i1) + second * der(i2)))
        self.declare_energy(first * i1**2 / 2, mutual * i1 * i2, second * i2**2 / 2)


class Potentiometer(Component):
    """A resistor with a slider: `R`·position between `n` and `slider`, R·(1 − position) between `slider` and `p`.

    `R` > 0 in ohm; the input `position` lies between 0 (at `n`) and 1 (at `p`), and is 0.5 unless it is given.
    """

    def __init__(self, ev: EqnEnv, name: str, R: Value = 1.0):
        super().__init__(ev, name)
        r = self.parameter("R", R, unit="Ohm", bounds=POSITIVE)
        position = self.input("position", default=0.5, unit="1")
        p, slider, n = (self.port(k, Electrical) for k in ("p", "slider", "n"))
        self.add_equations(
            Eq(p.v - slider.v, r * (1 - position) * p.i),
            Eq(n.v - slider.v, r * position * n.i),
            Eq(p.i + slider.i + n.i, 0),
        )
        self.declare_dissipation((p.v - slider.v) * p.i, (n.v - slider.v) * n.i)


class Memristor(TwoPin):
    """A resistor whose resistance follows the charge that has passed: v = (Ron·w + Roff·(1 − w))·i, dw/dt = k·i.

    `Ron`, `Roff` ≥ 0 in ohm, the drift `k` in 1/(A·s); `w` is the doped part, between 0 and 1 if the charge is small
    enough, and starts at `initial_w`. Linear drift: Strukov, Snider, Stewart & Williams (2008), Nature 453:80, eqs. 5
    and 6.
    """

    def __init__(
        self, ev: EqnEnv, name: str, Ron: Value = 100.0, Roff: Value = 16e3, k: Value = 1e4, initial_w: Value = 0.1
    ):
        super().__init__(ev, name)
        on = self.parameter("Ron", Ron, unit="Ohm", bounds=NONNEGATIVE)
        off = self.parameter("Roff", Roff, unit="Ohm", bounds=NONNEGATIVE)
        drift = self.parameter("k", k, unit="1/(A*s)")
        w0 = self.parameter("initial_w", initial_w, unit="1")
        w = self.variable("w", start=w0, fixed=True, unit="1")
        voltage, current = self._two_pins()
        self.add_equations(Eq(voltage, (on * w + off * (1 - w)) * current), Eq(der(w), drift * current))
        self.declare_dissipation(voltage * current)


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
        # Far below zero the exponential has no slope, and a block of diodes without a leak would be singular.
        leak = self.parameter("R", R, unit="Ohm", bounds=POSITIVE)
        voltage, current = self._two_pins()
        x = voltage / thermal
        below = smooth(Min(x, LARGEST_EXPONENT))
        self.add_equations(Eq(current, saturation * (exp(below) * (1 + x - below) - 1) + voltage / leak))
        self.declare_dissipation(voltage * current)
