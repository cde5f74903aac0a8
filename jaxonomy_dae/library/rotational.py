"""Rotational mechanics about one axis.

Conventions: absolute angle `phi` in radian, torque `tau` in newton metre counted positive into the component at a
flange, so an inertia obeys J·dw/dt = flange_a.tau + flange_b.tau.
"""

import sympy

from ..modeling import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Rotational, Value, der


class Inertia(Component):
    """A rotating inertia with a shaft on both sides: J·dw/dt = flange_a.tau + flange_b.tau, `J` > 0 in kg·m².

    A given `initial_angle` (radian) or `initial_speed` (radian per second) holds at the start; otherwise 0 is a guess.
    The acceleration `a` is a variable too.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        J: Value = 1.0,
        initial_angle: Value | None = None,
        initial_speed: Value | None = None,
    ):
        super().__init__(ev, name)
        inertia = self.parameter("J", J, unit="kg*m2", bounds=POSITIVE)
        phi0 = self.parameter("initial_angle", initial_angle or 0.0, unit="rad")
        w0 = self.parameter("initial_speed", initial_speed or 0.0, unit="rad/s")
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        phi = self.variable("phi", start=phi0, fixed=initial_angle is not None, unit="rad")
        w = self.variable("w", start=w0, fixed=initial_speed is not None, unit="rad/s")
        acceleration = self.variable("a", unit="rad/s2")
        self.add_equations(
            Eq(phi, a.phi),
            Eq(phi, b.phi),
            Eq(der(phi), w),
            Eq(der(w), acceleration),
            Eq(inertia * acceleration, a.tau + b.tau),
        )


class _Compliant(Component):
    """Two flanges and one torque that turns them towards each other: phi_rel = flange_b.phi − flange_a.phi."""

    def _two_flanges(self) -> tuple[sympy.Symbol, sympy.Symbol]:
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        phi = self.variable("phi_rel", unit="rad")
        tau = self.variable("tau", unit="N*m")
        self.add_equations(Eq(phi, b.phi - a.phi), Eq(b.tau, tau), Eq(a.tau + b.tau, 0))
        return phi, tau


class Spring(_Compliant):
    """A linear spring: tau = c·(phi_rel − phi_rel0), `c` ≥ 0 in N·m/rad, `phi_rel0` in radian."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, phi_rel0: Value = 0.0):
        super().__init__(ev, name)
        stiffness = self.parameter("c", c, unit="N*m/rad", bounds=NONNEGATIVE)
        rest = self.parameter("phi_rel0", phi_rel0, unit="rad")
        phi, tau = self._two_flanges()
        self.add_equations(Eq(tau, stiffness * (phi - rest)))


class Damper(_Compliant):
    """A linear damper: tau = d·w_rel with w_rel = der(phi_rel), `d` ≥ 0 in N·m·s/rad."""

    def __init__(self, ev: EqnEnv, name: str, d: Value = 1.0):
        super().__init__(ev, name)
        damping = self.parameter("d", d, unit="N*m*s/rad", bounds=NONNEGATIVE)
        phi, tau = self._two_flanges()
        w = self.variable("w_rel", unit="rad/s")
        self.add_equations(Eq(w, der(phi)), Eq(tau, damping * w))


class IdealGear(Component):
    """A gear without losses or inertia: flange_a.phi = ratio·flange_b.phi, 0 = ratio·flange_a.tau + flange_b.tau."""

    def __init__(self, ev: EqnEnv, name: str, ratio: Value = 1.0):
        super().__init__(ev, name)
        n = self.parameter("ratio", ratio)
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        self.add_equations(Eq(a.phi, n * b.phi), Eq(n * a.tau + b.tau, 0))


class Torque(Component):
    """A torque on a flange, from outside: the input `tau` (N·m), which is 0 unless `simulate` is given it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        flange = self.port("flange", Rotational)
        tau = self.input("tau", default=0.0, unit="N*m")
        self.add_equations(Eq(flange.tau, -tau))


class FixedAngle(Component):
    """A flange held at the parameter `angle` (radian)."""

    def __init__(self, ev: EqnEnv, name: str, angle: Value = 0.0):
        super().__init__(ev, name)
        where = self.parameter("angle", angle, unit="rad")
        flange = self.port("flange", Rotational)
        self.add_equations(Eq(flange.phi, where))
