"""Parts that meet and part: stops, ropes, dog clutches. Nothing gives way: speeds jump, by impulses that conserve
momentum over all parts that are joined at that instant (Pfeiffer & Glocker 1996, "Multibody Dynamics with Unilateral
Contacts").
"""

from ..write import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Rotational, Value, assign, der
from .arguments import yes_or_no
from .one_axis import AlongLine, Compliant

# Metre: by how much parts may overlap just after they have let go. Far below the sizes of mechanisms, and far above the
# rounding of a length of one metre, 2e-16.
CLEARANCE = 1e-9
# Metre per second: parts that meet more slowly stay together. Without this, the bounces of a ball accumulate,
# infinitely many in a finite time.
REST_SPEED = 1e-3


class HardStop(AlongLine, Compliant):
    """A rigid stop between two flanges: s_rel = flange_b.s − flange_a.s does not fall below `length`.

    While s_rel > length nothing is transmitted; while the flanges touch, the force `f` ≥ 0 pushes them apart. Where
    they meet at a speed v, they part again at `restitution`·v (Newton 1687), unless that is not above `rest_speed`:
    then they stay, until f has fallen to zero. The discrete variable `touching` is 1 or 0.

    **Arguments:**

    - `length`: metre. `restitution`: from 0 to 1. `rest_speed` ≥ 0: metre per second.
    - `touching`: whether they touch at the initial time. Then s_rel = length and der(s_rel) = 0 must hold there.
    - `clearance` > 0: the allowed overlap of the flanges just after f has become zero (metre).
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        length: Value = 0.0,
        restitution: Value = 0.0,
        rest_speed: Value = REST_SPEED,
        touching: bool = False,
        clearance: Value = CLEARANCE,
    ):
        super().__init__(ev, name)
        least = self.parameter("length", length, unit="m")
        back = self.parameter("restitution", restitution, unit="1", bounds=(0.0, 1.0))
        slow = self.parameter("rest_speed", rest_speed, unit="m/s", bounds=NONNEGATIVE)
        tiny = self.parameter("clearance", clearance, unit="m", bounds=POSITIVE)
        s, f = self._two_flanges(pushes=True)
        start = yes_or_no(touching, name, "touching")
        self.complementary(
            s - least, f, "touching", order=2, restitution=back, rest_speed=slow, clearance=tiny, start=start
        )


class Rope(AlongLine, Compliant):
    """A massless rope that cannot be stretched, between two flanges: s_rel = flange_b.s − flange_a.s ≤ length.

    While s_rel < length it is slack; while it is taut, the force `f` ≥ 0 pulls its ends together. Where it becomes
    taut, the speed at which its ends part is taken away. The discrete variable `taut` is 1 or 0.

    **Arguments:**

    - `length`: metre. `taut`: whether it is taut at the initial time. Then s_rel = length and der(s_rel) = 0 must hold
        there.
    - `clearance` > 0: the allowed overstretch just after it has become slack (metre).
    """

    def __init__(
        self, ev: EqnEnv, name: str, length: Value = 1.0, taut: bool = False, clearance: Value = CLEARANCE
    ):  # fmt: skip
        super().__init__(ev, name)
        most = self.parameter("length", length, unit="m")
        tiny = self.parameter("clearance", clearance, unit="m", bounds=POSITIVE)
        s, f = self._two_flanges()
        start = yes_or_no(taut, name, "taut")
        self.complementary(most - s, f, "taut", order=2, clearance=tiny, start=start)


class DogClutch(Component):
    """A clutch whose teeth lock two shafts: they turn as one while it is engaged, and freely while it is not.

    It engages where the input `u` rises above 0.5: the speeds jump to one, by an impulse of the torque `tau` that flows
    from flange_a to flange_b. w_rel = der(flange_b.phi − flange_a.phi). The discrete variable `engaged` is 1 or 0.
    """

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        u = self.input("u", unit="1")
        w, tau = self.variable("w_rel", unit="rad/s"), self.variable("tau", unit="N*m")
        engaged = self.discrete("engaged", start=0, unit="1")
        self.add_equations(Eq(w, der(b.phi - a.phi)), Eq(b.tau, -tau), Eq(a.tau + b.tau, 0))
        self.either(Eq(engaged, 1), w, tau, order=1)
        self.when(u > 0.5, assign(engaged, 1), on=Eq(engaged, 0), at_start=True)
        self.when(u < 0.5, assign(engaged, 0), on=Eq(engaged, 1), at_start=True)
