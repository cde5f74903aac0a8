"""Rotational mechanics about one axis.

Conventions: absolute angle `phi` in radian, torque `tau` in newton metre counted positive into the component at a
flange, so an inertia obeys J·dw/dt = flange_a.tau + flange_b.tau.
"""

from ..write import POSITIVE, Component, Eq, EqnEnv, Rotational, Value, der
from . import one_axis
from .arguments import start_of
from .one_axis import AboutAxis


class _Compliant(AboutAxis, one_axis.Compliant):
    """Two flanges and one torque that turns them towards each other: phi_rel = flange_b.phi − flange_a.phi."""


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
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        phi = self.variable("phi", **start_of(self, "initial_angle", initial_angle, "rad"))
        w = self.variable("w", **start_of(self, "initial_speed", initial_speed, "rad/s"))
        acceleration = self.variable("a", unit="rad/s2")
        self.add_equations(
            Eq(phi, a.phi),
            Eq(phi, b.phi),
            Eq(der(phi), w),
            Eq(der(w), acceleration),
            Eq(inertia * acceleration, a.tau + b.tau),
        )
        self.declare_energy(inertia * w**2 / 2)


class Spring(_Compliant):
    """A linear spring: tau = c·(phi_rel − angle), `c` ≥ 0 in N·m/rad, `angle` in radian."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, angle: Value = 0.0):
        super().__init__(ev, name)
        self._linear(c, None, angle)


class Damper(AboutAxis, one_axis.Damper):
    """A linear damper: tau = d·w_rel with w_rel = der(phi_rel), `d` ≥ 0 in N·m·s/rad."""


class IdealGear(Component):
    """A gear without losses or inertia: flange_a.phi = ratio·flange_b.phi, 0 = ratio·flange_a.tau + flange_b.tau."""

    def __init__(self, ev: EqnEnv, name: str, ratio: Value = 1.0):
        super().__init__(ev, name)
        n = self.parameter("ratio", ratio, unit="1")
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        self.add_equations(Eq(a.phi, n * b.phi), Eq(n * a.tau + b.tau, 0))


class Torque(AboutAxis, one_axis.EffortSource):
    """A torque on a flange, from outside: the input `tau` (N·m), which is 0 unless `simulate` is given it."""


class FixedAngle(AboutAxis, one_axis.Fixed):
    """A flange held at the parameter `angle` (radian)."""

    def __init__(self, ev: EqnEnv, name: str, angle: Value = 0.0):
        super().__init__(ev, name)
        self._hold("angle", angle)


class SpringDamper(_Compliant):
    """A linear spring and damper side by side: tau = c·(phi_rel − angle) + d·w_rel with w_rel = der(phi_rel),
    `c`, `d` ≥ 0."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, d: Value = 1.0, angle: Value = 0.0):
        super().__init__(ev, name)
        self._linear(c, d, angle)


class NonlinearSpring(_Compliant):
    """A spring that hardens (or softens) with the cube: tau = c·e + c3·e³ with e = phi_rel − angle (Duffing 1918).

    `c` in `N*m/rad`, `c3` in `N*m/rad3`.
    """

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, c3: Value = 0.0, angle: Value = 0.0):
        super().__init__(ev, name)
        self._cubic(c, c3, angle)


class Backlash(AboutAxis, one_axis.Backlash):
    """Play between two parts: nothing is transmitted while |phi_rel| < gap/2; beyond, tau = c·δ + d·dδ/dt with the
    penetration δ, whose corners are rounded over `smooth` (radian).

    `gap` ≥ 0 in radian, `c` ≥ 0 in `N*m/rad`, `d` ≥ 0 in `N*m*s/rad`.
    """


class Friction(AboutAxis, one_axis.Friction):
    """Dry and viscous friction between two parts that slide on each other, smooth in w_rel = der(phi_rel):
    tau = [sliding + (breakaway − sliding)·exp(−(w_rel/stribeck_speed)²)]·tanh(w_rel/smooth) + viscous·w_rel
    (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083).

    `sliding`, `breakaway` ≥ 0 in newton metre, `viscous` ≥ 0 in `N*m*s/rad`, `stribeck_speed`, `smooth` > 0 in
    radian per second. It does not stick: under a torque below `breakaway` parts creep at a speed below `smooth`.
    """


class AngleSource(AboutAxis, one_axis.PositionSource):
    """A flange moved by the input `u`: flange.phi = u (radian); what drives it must be differentiable in
    time as often as the model asks."""


class SpeedSource(AboutAxis, one_axis.MovedAtSpeed):
    """A flange moved at the speed of the input `u` (radian per second), from `initial_angle` (radian) on."""

    def __init__(self, ev: EqnEnv, name: str, initial_angle: Value = 0.0):
        super().__init__(ev, name)
        self._move(initial_angle)


class AngleSensor(AboutAxis, one_axis.PositionSensor):
    """The output `y` is the angle of a flange (radian); it takes no torque."""


class SpeedSensor(AboutAxis, one_axis.SpeedSensor):
    """The output `y` is the speed of a flange (radian per second); it takes no torque."""


class TorqueSensor(AboutAxis, one_axis.EffortSensor):
    """Two flanges that move as one; the output `y` is the torque into `flange_a` (newton metre)."""
