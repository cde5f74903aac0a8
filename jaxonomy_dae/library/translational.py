"""Translational mechanics along a line.

Conventions: absolute position `s` in metre, force `f` in newton counted positive into the component at a flange, so a
mass obeys m·dv/dt = flange.f.
"""

from sympy import Piecewise

from ..write import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Translational, Value, assign, der
from . import one_axis
from .arguments import start_of
from .one_axis import AlongLine


class _Compliant(AlongLine, one_axis.Compliant):
    """Two flanges and one force that pulls them together: s_rel = flange_b.s − flange_a.s."""


class Mass(Component):
    """A sliding mass: m·dv/dt = flange.f, `m` > 0 in kilogram.

    A given `initial_position` (metre) or `initial_velocity` (metre per second) holds at the start; otherwise 0 is a
    guess.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        m: Value = 1.0,
        initial_position: Value | None = None,
        initial_velocity: Value | None = None,
    ):
        super().__init__(ev, name)
        m = self.parameter("m", m, unit="kg", bounds=POSITIVE)
        flange = self.port("flange", Translational)
        s = self.variable("s", **start_of(self, "initial_position", initial_position, "m"))
        v = self.variable("v", **start_of(self, "initial_velocity", initial_velocity, "m/s"))
        self.add_equations(Eq(s, flange.s), Eq(der(s), v), Eq(m * der(v), flange.f))
        self.declare_energy(m * v**2 / 2)


class Spring(_Compliant):
    """A linear spring that pulls its ends together: f = c·(flange_b.s − flange_a.s − length), `c` ≥ 0 in newton per
    metre."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, length: Value = 0.0):
        super().__init__(ev, name)
        self._linear(c, None, length)


class Damper(AlongLine, one_axis.Damper):
    """A linear damper: f = d·der(flange_b.s − flange_a.s), `d` ≥ 0 in newton second per metre."""


class Rod(Component):
    """A rigid massless rod: flange_b.s − flange_a.s = length (metre); `f` is the force that pulls its ends together."""

    def __init__(self, ev: EqnEnv, name: str, length: Value = 0.0):
        super().__init__(ev, name)
        distance = self.parameter("length", length, unit="m")
        a, b = self.port("flange_a", Translational), self.port("flange_b", Translational)
        f = self.variable("f", unit="N")
        self.add_equations(Eq(b.s - a.s, distance), Eq(b.f, f), Eq(a.f + b.f, 0))


class FixedPosition(AlongLine, one_axis.Fixed):
    """A flange held at the parameter `position` (metre)."""

    def __init__(self, ev: EqnEnv, name: str, position: Value = 0.0):
        super().__init__(ev, name)
        self._hold("position", position)


class SpringDamper(_Compliant):
    """A linear spring and damper side by side: f = c·(s_rel − length) + d·v_rel with v_rel = der(s_rel), where `c`,
    `d` ≥ 0."""

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, d: Value = 1.0, length: Value = 0.0):
        super().__init__(ev, name)
        self._linear(c, d, length)


class NonlinearSpring(_Compliant):
    """A spring that hardens (or softens) with the cube: f = c·e + c3·e³ with e = s_rel − length (Duffing 1918).

    `c` in N/m, `c3` in N/m3.
    """

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, c3: Value = 0.0, length: Value = 0.0):
        super().__init__(ev, name)
        self._cubic(c, c3, length)


class Backlash(AlongLine, one_axis.Backlash):
    """Play between two parts: nothing is transmitted while |s_rel| < gap/2; beyond, f = c·δ + d·dδ/dt with the
    penetration δ, whose corners are rounded over `smooth` (metre).

    `gap` ≥ 0 in metre, `c` ≥ 0 in N/m, `d` ≥ 0 in `N*s/m`.
    """


class ElasticStop(_Compliant):
    """A spring and a damper that push and do not pull: with the depth e = length − s_rel, f = 0 for e ≤ 0, and
    f = −c·e + d·v_rel for e > 0, where the damper's force is limited to ±c·e, so that f is continuous and never
    positive (the law of ElastoGap in the Modelica Standard Library 4).

    `c`, `d` ≥ 0; `length` in metre. The discrete variable `touching` is 1 or 0.
    """

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1e4, d: Value = 10.0, length: Value = 0.0):
        super().__init__(ev, name)
        stiffness = self.parameter("c", c, unit="N/m", bounds=NONNEGATIVE)
        damping = self.parameter("d", d, unit="N*s/m", bounds=NONNEGATIVE)
        least = self.parameter("length", length, unit="m")
        s, f = self._two_flanges()
        speed = self.variable("v_rel", unit="m/s")
        touching = self.discrete("touching", start=0, unit="1")
        # By the discrete variable, not by s < length: the branch then changes at events only, where `touching` says so.
        depth = Piecewise((least - s, Eq(touching, 1)), (0, True))
        pushed = stiffness * depth
        meets, parts = (self.relation(r) for r in (damping * speed < -pushed, damping * speed > pushed))
        brake = Piecewise((-pushed, meets), (pushed, parts), (damping * speed, True))
        self.add_equations(Eq(speed, der(s)), Eq(f, brake - pushed))
        self.when(s < least, assign(touching, 1), on=Eq(touching, 0), at_start=True)
        self.when(s >= least, assign(touching, 0), on=Eq(touching, 1), at_start=True)
        self.declare_energy(stiffness * depth**2 / 2)
        self.declare_dissipation(brake * speed)


class Friction(AlongLine, one_axis.Friction):
    """Dry and viscous friction between two parts that slide on each other, smooth in v = v_rel = der(s_rel):
    f = [sliding + (breakaway − sliding)·exp(−(v/stribeck_speed)²)]·tanh(v/smooth) + viscous·v
    (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083).

    `sliding`, `breakaway` ≥ 0 in newton, `viscous` ≥ 0 in `N*s/m`, `stribeck_speed`, `smooth` > 0 in
    metre per second. It does not stick: under a force below `breakaway` parts creep at a speed below `smooth`.
    """


class Force(AlongLine, one_axis.EffortSource):
    """A force on a flange, from outside: the input `f` (N), which is 0 unless `simulate` is given it."""


class PositionSource(AlongLine, one_axis.PositionSource):
    """A flange moved by the input `u`: flange.s = u (metre); what drives it must be differentiable in
    time as often as the model asks."""


class SpeedSource(AlongLine, one_axis.MovedAtSpeed):
    """A flange moved at the speed of the input `u` (metre per second), from `initial_position` (metre) on."""

    def __init__(self, ev: EqnEnv, name: str, initial_position: Value = 0.0):
        super().__init__(ev, name)
        self._move(initial_position)


class PositionSensor(AlongLine, one_axis.PositionSensor):
    """The output `y` is the position of a flange (metre); it takes no force."""


class SpeedSensor(AlongLine, one_axis.SpeedSensor):
    """The output `y` is the speed of a flange (metre per second); it takes no force."""


class ForceSensor(AlongLine, one_axis.EffortSensor):
    """Two flanges that move as one; the output `y` is the force into `flange_a` (newton)."""
