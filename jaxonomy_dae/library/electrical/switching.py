"""Components that switch: their equations change at events, which are found and differentiated exactly."""

import sympy
from sympy import And

from ...write import NONNEGATIVE, Eq, EqnEnv, Value, assign
from ..arguments import yes_or_no
from .two_pin import TwoPin


class Switch(TwoPin):
    """An ideal switch with a resistance `Ron` while closed and a conductance `Goff` while open (ohm, siemens, ≥ 0):
    v = Ron·i or i = Goff·v. It is closed while the input `u` is above `threshold`; the discrete variable `closed` is 1
    or 0.

    With Ron = 0 and Goff = 0 it is ideal, and no loop of closed switches and voltage sources, and no part that only
    open switches hold, can be solved for its currents and voltages.
    """

    def __init__(self, ev: EqnEnv, name: str, Ron: Value = 0.0, Goff: Value = 0.0, threshold: Value = 0.5):
        super().__init__(ev, name)
        on = self.parameter("Ron", Ron, unit="Ohm", bounds=NONNEGATIVE)
        off = self.parameter("Goff", Goff, unit="S", bounds=NONNEGATIVE)
        level = self.parameter("threshold", threshold)
        u = self.input("u")
        closed = self.discrete("closed", start=0, unit="1")
        v, i = self._two_pins()
        self.either(Eq(closed, 1), v - on * i, i - off * v)
        self.declare_dissipation(v * i)
        # Both are strict: a signal that rests at the threshold switches nothing.
        self.when(u > level, assign(closed, 1), on=Eq(closed, 0), at_start=True)
        self.when(u < level, assign(closed, 0), on=Eq(closed, 1), at_start=True)


class TimedSwitch(TwoPin):
    """An ideal switch that closes at `time` (second), or opens if `opens`: v = Ron·i while closed, i = Goff·v while
    open (ohm, siemens, ≥ 0). The time of switching is a parameter, and what follows is differentiable by it."""

    def __init__(
        self, ev: EqnEnv, name: str, time: Value = 1.0, opens: bool = False, Ron: Value = 0.0, Goff: Value = 0.0
    ):
        super().__init__(ev, name)
        instant = self.parameter("time", time, unit="s")
        on = self.parameter("Ron", Ron, unit="Ohm", bounds=NONNEGATIVE)
        off = self.parameter("Goff", Goff, unit="S", bounds=NONNEGATIVE)
        closed = self.discrete("closed", start=yes_or_no(opens, name, "opens"), unit="1")
        v, i = self._two_pins()
        self.either(Eq(closed, 1), v - on * i, i - off * v)
        self.declare_dissipation(v * i)
        self.when(ev.t >= instant, assign(closed, int(not opens)), on=Eq(closed, int(opens)), at_start=True)


class _Straight(TwoPin):
    def _branches(self, Ron: Value, Goff: Value, Vknee: Value) -> tuple[sympy.Expr, sympy.Expr]:
        """Two expressions, never negative, of which one is zero: the first while the diode conducts, the second while
        it blocks."""
        on = self.parameter("Ron", Ron, unit="Ohm", bounds=NONNEGATIVE)
        off = self.parameter("Goff", Goff, unit="S", bounds=NONNEGATIVE)
        knee = self.parameter("Vknee", Vknee, unit="V", bounds=NONNEGATIVE)
        v, i = self._two_pins()
        self.declare_dissipation(v * i)
        return knee + on * (i - off * knee) - v, i - off * v


class IdealDiode(_Straight):
    """A diode with two straight branches (Cellier & Kofman 2006, Continuous System Simulation, chapter 9).

    While it conducts, v = Vknee + Ron·(i − Goff·Vknee); while it blocks, i = Goff·v, with v ≤ Vknee. `Ron` in ohm,
    `Goff` in siemens, `Vknee` in volt, ≥ 0; all zero is the ideal diode. The discrete variable `active` is 1 while it
    conducts. Parts of a circuit that only blocking diodes hold have no potential: give these a small `Goff`.
    """

    def __init__(self, ev: EqnEnv, name: str, Ron: Value = 0.0, Goff: Value = 0.0, Vknee: Value = 0.0):
        super().__init__(ev, name)
        self.complementary(*self._branches(Ron, Goff, Vknee))


class IdealThyristor(_Straight):
    """A diode that blocks until the input `fire` is above 0.5 while v exceeds Vknee, and conducts until the current
    has gone; parameters as of `IdealDiode`."""

    def __init__(self, ev: EqnEnv, name: str, Ron: Value = 0.0, Goff: Value = 0.0, Vknee: Value = 0.0):
        super().__init__(ev, name)
        fire = self.input("fire", unit="1")
        drop, current = self._branches(Ron, Goff, Vknee)
        active = self.discrete("active", start=0, unit="1")
        self.either(Eq(active, 1), drop, current)
        self.when(And(drop < 0, fire > 0.5), assign(active, 1), on=Eq(active, 0), at_start=True)
        self.when(current <= 0, assign(active, 0), on=Eq(active, 1), at_start=True)


class JoiningSwitch(TwoPin):
    """An ideal switch between nodes whose voltages capacitors hold: v = 0 while it is closed, i = 0 while it is open.

    Where it closes, voltages jump to one by a pulse of the current, and charge is conserved. For that, capacitors and
    voltage sources must determine the voltage across the open switch; anywhere else use `Switch`. It is closed while
    the input `u` is above `threshold`; the discrete variable `closed` is 1 or 0.
    """

    def __init__(self, ev: EqnEnv, name: str, threshold: Value = 0.5):
        super().__init__(ev, name)
        level = self.parameter("threshold", threshold)
        u = self.input("u")
        closed = self.discrete("closed", start=0, unit="1")
        v, i = self._two_pins()
        self.either(Eq(closed, 1), v, i, order=1)
        self.when(u > level, assign(closed, 1), on=Eq(closed, 0), at_start=True)
        self.when(u < level, assign(closed, 0), on=Eq(closed, 1), at_start=True)
