"""Controllers: inputs `setpoint` and `measured`, output `y`."""

from sympy import Expr, Max, Min, S, Symbol

from ...write import POSITIVE, Component, Eq, EqnEnv, Value, der, smooth
from ..arguments import in_order


class PI(Component):
    """y = v = k·(e + x), Ti·dx/dt = e with e = setpoint − measured, `Ti` > 0 in second; x starts at `initial_x`.

    With `low` or `high`, y = v only between them, and back-calculation keeps the integral from winding up, as in `PID`:
    Ti·dx/dt = e + (Ti/Tt)·(y − v)/k. `Tt` > 0 in second is `Ti` if left out.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        k: Value = 1.0,
        Ti: Value = 1.0,
        initial_x: Value = 0.0,
        low: Value | None = None,
        high: Value | None = None,
        Tt: Value | None = None,
    ):
        super().__init__(ev, name)
        gain, reset = self.parameter("k", k), self.parameter("Ti", Ti, unit="s", bounds=POSITIVE)
        setpoint, measured = self.input("setpoint"), self.input("measured")
        x = self.variable("x", start=self.parameter("initial_x", initial_x), fixed=True)
        error = setpoint - measured
        if low is None and high is None:
            self.add_equations(Eq(reset * der(x), error))
            self.output("y", gain * (error + x))
            return
        track = self.parameter("Tt", reset if Tt is None else Tt, unit="s", bounds=POSITIVE)
        v = self.output("v", gain * (error + x))
        y = self.output("y", _limited(self, v, low, high))
        self.add_equations(Eq(reset * der(x), error + reset / track * (y - v) / gain))


def _limited(component: Component, v: Symbol, low: Value | None, high: Value | None) -> Expr:
    """v, but not below `low` nor above `high`, which become parameters."""
    limited = v
    if low is not None:
        limited = Max(limited, component.parameter("low", low))
    if high is not None:
        limited = Min(limited, component.parameter("high", high))
    if low is not None and high is not None:
        in_order(component, "low", "high")
    return smooth(limited) * S.One


class PID(Component):
    """A controller with limited output and back-calculation against windup (Åström & Hägglund 2006, chapter 3):

        v = k·(b·setpoint − measured) + i + d
        y = v, but not below `low` nor above `high`
        di/dt = k·(setpoint − measured)/Ti + (y − v)/Tt
        d = −k·N·(measured − smooth), (Td/N)·d(smooth)/dt = measured − smooth

    `Ti`, `Td`, `Tt` > 0 in second, `b` the weight of the setpoint, `N` the largest gain of the derivative. The integral
    starts at `initial_i`, the derivative at zero.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        k: Value = 1.0,
        Ti: Value = 1.0,
        Td: Value = 0.1,
        Tt: Value = 1.0,
        N: Value = 10.0,
        b: Value = 1.0,
        low: Value | None = None,
        high: Value | None = None,
        initial_i: Value = 0.0,
    ):
        super().__init__(ev, name)
        gain, weight = self.parameter("k", k), self.parameter("b", b, unit="1")
        reset, rate, track = (
            self.parameter(p, v, unit="s", bounds=POSITIVE) for p, v in (("Ti", Ti), ("Td", Td), ("Tt", Tt))
        )
        most = self.parameter("N", N, unit="1", bounds=POSITIVE)
        setpoint, measured = self.input("setpoint"), self.input("measured")
        i = self.variable("i", start=self.parameter("initial_i", initial_i), fixed=True)
        d = self.variable("d", start=0.0, fixed=True)
        smooth = self.variable("smooth")  # the measured value behind the filter
        v = self.output("v", gain * (weight * setpoint - measured) + i + d)
        y = self.output("y", _limited(self, v, low, high))
        self.add_equations(
            Eq(der(i), gain * (setpoint - measured) / reset + (y - v) / track),
            Eq(rate / most * der(smooth), measured - smooth),
            Eq(d, -gain * most * (measured - smooth)),
        )
