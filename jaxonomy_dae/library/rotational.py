"""Rotational mechanics about one axis.

Conventions: absolute angle `phi` in radian, torque `tau` in newton metre counted positive into the component at a
flange, so an inertia obeys J·dw/dt = flange_a.tau + flange_b.tau.
"""

import sympy

from ..modeling import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Rotational, Value, der
from .laws import penetration, penetration_energy, stribeck


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
        self.declare_energy(inertia * w**2 / 2)


class _Compliant(Component):
    """Two flanges and one torque that turns them towards each other: phi_rel = flange_b.phi − flange_a.phi."""

    def _two_flanges(self) -> tuple[sympy.Symbol, sympy.Symbol]:
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        phi = self.variable("phi_rel", unit="rad")
        tau = self.variable("tau", unit="N*m")
        self.add_equations(Eq(phi, b.phi - a.phi), Eq(b.tau, tau), Eq(a.tau + b.tau, 0))
        return phi, tau


class Spring(_Compliant):
    """A linear spring: tau = c·(phi_rel − angle), `c` ≥ 0 in N·m/rad, `angle` in radian."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, angle: Value = 0.0):
        super().__init__(ev, name)
        stiffness = self.parameter("c", c, unit="N*m/rad", bounds=NONNEGATIVE)
        rest = self.parameter("angle", angle, unit="rad")
        phi, tau = self._two_flanges()
        self.add_equations(Eq(tau, stiffness * (phi - rest)))
        self.declare_energy(stiffness * (phi - rest) ** 2 / 2)


class Damper(_Compliant):
    """A linear damper: tau = d·w_rel with w_rel = der(phi_rel), `d` ≥ 0 in N·m·s/rad."""

    def __init__(self, ev: EqnEnv, name: str, d: Value = 1.0):
        super().__init__(ev, name)
        damping = self.parameter("d", d, unit="N*m*s/rad", bounds=NONNEGATIVE)
        phi, tau = self._two_flanges()
        w = self.variable("w_rel", unit="rad/s")
        self.add_equations(Eq(w, der(phi)), Eq(tau, damping * w))
        self.declare_dissipation(tau * w)


class IdealGear(Component):
    """A gear without losses or inertia: flange_a.phi = ratio·flange_b.phi, 0 = ratio·flange_a.tau + flange_b.tau."""

    def __init__(self, ev: EqnEnv, name: str, ratio: Value = 1.0):
        super().__init__(ev, name)
        n = self.parameter("ratio", ratio, unit="1")
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        self.add_equations(Eq(a.phi, n * b.phi), Eq(n * a.tau + b.tau, 0))


class Torque(Component):
    """A torque on a flange, from outside: the input `tau` (N·m), which is 0 unless `simulate` is given it."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        flange = self.port("flange", Rotational)
        tau = self.input("tau", default=0.0, unit="N*m")
        self.add_equations(Eq(flange.tau, -tau))
        self.declare_supply(tau * der(flange.phi))


class FixedAngle(Component):
    """A flange held at the parameter `angle` (radian)."""

    def __init__(self, ev: EqnEnv, name: str, angle: Value = 0.0):
        super().__init__(ev, name)
        where = self.parameter("angle", angle, unit="rad")
        flange = self.port("flange", Rotational)
        self.add_equations(Eq(flange.phi, where))


class SpringDamper(_Compliant):
    """A linear spring and damper side by side: tau = c·(phi_rel − angle) + d·w_rel with w_rel = der(phi_rel),
    `c`, `d` ≥ 0."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, d: Value = 1.0, angle: Value = 0.0):
        super().__init__(ev, name)
        stiffness = self.parameter("c", c, unit="N*m/rad", bounds=NONNEGATIVE)
        damping = self.parameter("d", d, unit="N*m*s/rad", bounds=NONNEGATIVE)
        relaxed = self.parameter("angle", angle, unit="rad")
        phi_rel, tau = self._two_flanges()
        speed = self.variable("w_rel", unit="rad/s")
        self.add_equations(Eq(speed, der(phi_rel)), Eq(tau, stiffness * (phi_rel - relaxed) + damping * speed))
        self.declare_energy(stiffness * (phi_rel - relaxed) ** 2 / 2)
        self.declare_dissipation(damping * speed**2)


class NonlinearSpring(_Compliant):
    """A spring that hardens (or softens) with the cube: tau = c·e + c3·e³ with e = phi_rel − angle (Duffing 1918).

    `c` in `N*m/rad`, `c3` in `N*m/rad3`.
    """

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, c3: Value = 0.0, angle: Value = 0.0):
        super().__init__(ev, name)
        linear = self.parameter("c", c, unit="N*m/rad")
        cubic = self.parameter("c3", c3, unit="N*m/rad3")
        relaxed = self.parameter("angle", angle, unit="rad")
        phi_rel, tau = self._two_flanges()
        e = phi_rel - relaxed
        self.add_equations(Eq(tau, linear * e + cubic * e**3))
        self.declare_energy(linear * e**2 / 2 + cubic * e**4 / 4)


class Backlash(_Compliant):
    """Play between two parts: nothing is transmitted while |phi_rel| < gap/2; beyond, tau = c·δ + d·dδ/dt with the
    penetration δ, whose corners are rounded over `smooth` (radian).

    `gap` ≥ 0 in radian, `c` ≥ 0 in `N*m/rad`, `d` ≥ 0 in `N*m*s/rad`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        gap: Value = 0.01,
        c: Value = 1e4,
        d: Value = 10.0,
        smooth: Value = 1e-4,
    ):
        super().__init__(ev, name)
        play = self.parameter("gap", gap, unit="rad", bounds=NONNEGATIVE)
        stiffness = self.parameter("c", c, unit="N*m/rad", bounds=NONNEGATIVE)
        damping = self.parameter("d", d, unit="N*m*s/rad", bounds=NONNEGATIVE)
        corner = self.parameter("smooth", smooth, unit="rad", bounds=POSITIVE)
        phi_rel, tau = self._two_flanges()
        speed = self.variable("w_rel", unit="rad/s")
        depth, slope = penetration(phi_rel, play, corner)
        self.add_equations(Eq(speed, der(phi_rel)), Eq(tau, stiffness * depth + damping * slope * speed))
        self.declare_energy(stiffness * penetration_energy(phi_rel, play, corner))
        self.declare_dissipation(damping * slope * speed**2)


class Friction(_Compliant):
    """Dry and viscous friction between two parts that slide on each other, smooth in w_rel = der(phi_rel):
    tau = [sliding + (breakaway − sliding)·exp(−(w_rel/stribeck_speed)²)]·tanh(w_rel/smooth) + viscous·w_rel
    (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083).

    `sliding`, `breakaway` ≥ 0 in newton metre, `viscous` ≥ 0 in `N*m*s/rad`, `stribeck_speed`, `smooth` > 0 in
    radian per second. It does not stick: under a torque below `breakaway` parts creep at a speed below `smooth`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        sliding: Value = 1.0,
        breakaway: Value = 1.5,
        stribeck_speed: Value = 0.1,
        viscous: Value = 0.0,
        smooth: Value = 1e-3,
    ):
        super().__init__(ev, name)
        coulomb = self.parameter("sliding", sliding, unit="N*m", bounds=NONNEGATIVE)
        static = self.parameter("breakaway", breakaway, unit="N*m", bounds=NONNEGATIVE)
        fades = self.parameter("stribeck_speed", stribeck_speed, unit="rad/s", bounds=POSITIVE)
        fluid = self.parameter("viscous", viscous, unit="N*m*s/rad", bounds=NONNEGATIVE)
        width = self.parameter("smooth", smooth, unit="rad/s", bounds=POSITIVE)
        phi_rel, tau = self._two_flanges()
        speed = self.variable("w_rel", unit="rad/s")
        self.add_equations(Eq(speed, der(phi_rel)), Eq(tau, stribeck(speed, coulomb, static, fades, fluid, width)))
        self.declare_dissipation(tau * speed)


class AngleSource(Component):
    """A flange moved by the input `u`: flange.phi = u (radian); what drives it must be differentiable in
    time as often as the model asks."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        flange = self.port("flange", Rotational)
        self.add_equations(Eq(flange.phi, self.input("u", unit="rad")))
        self.declare_supply(-flange.tau * der(flange.phi))


class SpeedSource(Component):
    """A flange moved at the speed of the input `u` (radian per second), from `initial_angle` (radian) on."""

    def __init__(self, ev: EqnEnv, name: str, initial_angle: Value = 0.0):
        super().__init__(ev, name)
        start = self.parameter("initial_angle", initial_angle, unit="rad")
        flange = self.port("flange", Rotational)
        where = self.variable("phi", start=start, fixed=True, unit="rad")
        self.add_equations(Eq(where, flange.phi), Eq(der(where), self.input("u", unit="rad/s")))
        self.declare_supply(-flange.tau * der(where))


class AngleSensor(Component):
    """The output `y` is the angle of a flange (radian); it takes no torque."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        flange = self.port("flange", Rotational)
        self.output("y", flange.phi, unit="rad")
        self.add_equations(Eq(flange.tau, 0))


class SpeedSensor(Component):
    """The output `y` is the speed of a flange (radian per second); it takes no torque."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        flange = self.port("flange", Rotational)
        self.output("y", der(flange.phi), unit="rad/s")
        self.add_equations(Eq(flange.tau, 0))


class TorqueSensor(Component):
    """Two flanges that move as one; the output `y` is the torque into `flange_a` (newton metre)."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        self.output("y", a.tau, unit="N*m")
        self.add_equations(Eq(a.phi, b.phi), Eq(a.tau + b.tau, 0))
