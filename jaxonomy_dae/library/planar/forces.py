"""Forces and torques on frames."""

from sympy import sqrt

from ...write import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Planar, Value, der
from ..arguments import yes_or_no
from .joints import TwoFrames


class SpringDamper(TwoFrames):
    """A linear spring and damper side by side, along the line between two frames (Haug 1989, section 6.2).

        s = √(dx² + dy²),   dx = frame_b.x − frame_a.x,   dy = frame_b.y − frame_a.y,   v = ds/dt
        f = c·(s − length) + d·v
        frame_b.fx = f·dx/s,   frame_b.fy = f·dy/s,   0 = frame_a.f + frame_b.f

    `f` pulls the frames together; no torque acts on either. The frames must not meet: the line between them has no
    direction at s = 0.

    **Arguments:**

    - `c` ≥ 0: stiffness (newton per metre). `d` ≥ 0: damping (newton second per metre).
    - `length` ≥ 0: at which the spring is relaxed (metre).
    """

    def __init__(self, ev: EqnEnv, name: str, c: Value = 1.0, d: Value = 0.0, length: Value = 0.0):
        super().__init__(ev, name)
        stiffness = self.parameter("c", c, unit="N/m", bounds=NONNEGATIVE)
        damping = self.parameter("d", d, unit="N*s/m", bounds=NONNEGATIVE)
        relaxed = self.parameter("length", length, unit="m", bounds=NONNEGATIVE)
        a, b = self._two_frames()
        dx, dy = self.variable("dx", unit="m"), self.variable("dy", unit="m")
        s, v = self.variable("s", unit="m"), self.variable("v", unit="m/s")
        f = self.variable("f", unit="N")
        self.add_equations(
            Eq(dx, b.x - a.x),
            Eq(dy, b.y - a.y),
            Eq(s, sqrt(dx**2 + dy**2)),
            Eq(v, (dx * der(dx) + dy * der(dy)) / s),
            Eq(f, stiffness * (s - relaxed) + damping * v),
            Eq(b.fx, f * dx / s),
            Eq(b.fy, f * dy / s),
        )
        self._without_torque()
        self.declare_energy(stiffness * (s - relaxed) ** 2 / 2)
        self.declare_dissipation(damping * v**2)


class String(TwoFrames):
    """A massless string that cannot be stretched, between two frames that it keeps no further apart than its length.

        dx = frame_b.x − frame_a.x,   dy = frame_b.y − frame_a.y,   s = √(dx² + dy²) ≤ length
        frame_b.fx = f·dx/length,   frame_b.fy = f·dy/length,   0 = frame_a.f + frame_b.f

    While s < length it is slack, and f = 0; its ends may meet. While it is taut, s = length, and the force `f` ≥ 0
    pulls its ends together. Where it becomes taut, the speed at which its ends part is taken away, by an impulse
    (Pfeiffer & Glocker 1996, "Multibody Dynamics with Unilateral Contacts", chapter 8). The discrete variable `taut` is
    1 or 0.

    **Arguments:**

    - `length` > 0: metre.
    - `taut`: whether it is taut at the initial time. Then s = length and ds/dt = 0 must hold there.
    - `clearance` > 0: the allowed overstretch just after it has become slack (metre).
    """

    def __init__(
        self, ev: EqnEnv, name: str, length: Value = 1.0, taut: bool = False, clearance: Value = 1e-9
    ):  # fmt: skip
        super().__init__(ev, name)
        longest = self.parameter("length", length, unit="m", bounds=POSITIVE)
        tiny = self.parameter("clearance", clearance, unit="m", bounds=POSITIVE)
        a, b = self._two_frames()
        f = self.variable("f", unit="N")
        dx, dy = b.x - a.x, b.y - a.y
        self.output("s", sqrt(dx**2 + dy**2), unit="m")
        self.add_equations(Eq(b.fx, f * dx / longest), Eq(b.fy, f * dy / longest), Eq(a.tau, 0), Eq(b.tau, 0))
        self.add_equations(Eq(a.fx + b.fx, 0), Eq(a.fy + b.fy, 0))
        start = yes_or_no(taut, name, "taut")
        # In the first order near the length this is length − s, which has no derivative where the ends meet.
        slack = (longest**2 - dx**2 - dy**2) / (2 * longest)
        self.complementary(slack, f, "taut", order=2, clearance=tiny, start=start)


class Force(Component):
    """A force on a frame, from outside, along the world's axes: frame.fx = −fx, frame.fy = −fy, frame.tau = 0.

    The inputs `fx`, `fy` (newton) are 0 unless `simulate` is given them.
    """

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        frame = self.port("frame", Planar)
        fx, fy = (self.input(k, default=0.0, unit="N") for k in ("fx", "fy"))
        self.add_equations(Eq(frame.fx, -fx), Eq(frame.fy, -fy), Eq(frame.tau, 0))
        self.declare_supply(fx * der(frame.x), fy * der(frame.y))


class Torque(Component):
    """A torque on a frame, from outside: frame.tau = −tau, frame.fx = frame.fy = 0.

    The input `tau` (newton metre) is 0 unless `simulate` is given it.
    """

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        frame = self.port("frame", Planar)
        tau = self.input("tau", default=0.0, unit="N*m")
        self.add_equations(Eq(frame.tau, -tau), Eq(frame.fx, 0), Eq(frame.fy, 0))
        self.declare_supply(tau * der(frame.phi))
