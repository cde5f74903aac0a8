"""Translational mechanics along a line.

Conventions: absolute position `x` in metre, force `f` in newton counted positive into the component at a flange, so a
mass obeys M·dv/dt = flange.f.
"""

from ..modeling import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Translational, Value, der


class Mass(Component):
    """A sliding mass: M·dv/dt = flange.f, `M` > 0 in kilogram.

    A given `initial_position` (metre) or `initial_velocity` (metre per second) holds at the start; otherwise 0 is a
    guess.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        M: Value = 1.0,
        initial_position: Value | None = None,
        initial_velocity: Value | None = None,
    ):
        super().__init__(ev, name)
        m = self.parameter("M", M, unit="kg", bounds=POSITIVE)
        x0 = self.parameter("initial_position", initial_position or 0.0, unit="m")
        v0 = self.parameter("initial_velocity", initial_velocity or 0.0, unit="m/s")
        flange = self.port("flange", Translational)
        x = self.variable("x", start=x0, fixed=initial_position is not None, unit="m")
        v = self.variable("v", start=v0, fixed=initial_velocity is not None, unit="m/s")
        self.add_equations(Eq(x, flange.x), Eq(der(x), v), Eq(m * der(v), flange.f))


class Spring(Component):
    """A linear spring that pulls its ends together: f = K·(flange_b.x − flange_a.x − length), `K` ≥ 0 in newton per
    metre."""

    def __init__(self, ev: EqnEnv, name: str, K: Value = 1.0, length: Value = 0.0):
        super().__init__(ev, name)
        k = self.parameter("K", K, unit="N/m", bounds=NONNEGATIVE)
        rest = self.parameter("length", length, unit="m")
        a, b = self.port("flange_a", Translational), self.port("flange_b", Translational)
        s = self.variable("s", unit="m")
        f = self.variable("f", unit="N")
        self.add_equations(Eq(s, b.x - a.x), Eq(f, k * (s - rest)), Eq(b.f, f), Eq(a.f + b.f, 0))


class Damper(Component):
    """A linear damper: f = D·(flange_b.v − flange_a.v), `D` ≥ 0 in newton second per metre."""

    def __init__(self, ev: EqnEnv, name: str, D: Value = 1.0):
        super().__init__(ev, name)
        d = self.parameter("D", D, unit="N*s/m", bounds=NONNEGATIVE)
        a, b = self.port("flange_a", Translational), self.port("flange_b", Translational)
        s = self.variable("s", unit="m")
        v = self.variable("v", unit="m/s")
        f = self.variable("f", unit="N")
        self.add_equations(Eq(s, b.x - a.x), Eq(v, der(s)), Eq(f, d * v), Eq(b.f, f), Eq(a.f + b.f, 0))


class Rod(Component):
    """A rigid massless rod: flange_b.x − flange_a.x = length (metre); `f` is the force that pulls its ends together."""

    def __init__(self, ev: EqnEnv, name: str, length: Value = 0.0):
        super().__init__(ev, name)
        distance = self.parameter("length", length, unit="m")
        a, b = self.port("flange_a", Translational), self.port("flange_b", Translational)
        f = self.variable("f", unit="N")
        self.add_equations(Eq(b.x - a.x, distance), Eq(b.f, f), Eq(a.f + b.f, 0))


class FixedPosition(Component):
    """A flange held at the parameter `position` (metre)."""

    def __init__(self, ev: EqnEnv, name: str, position: Value = 0.0):
        super().__init__(ev, name)
        where = self.parameter("position", position, unit="m")
        flange = self.port("flange", Translational)
        self.add_equations(Eq(flange.x, where))
