"""Sensors of frames; they take no force and no torque."""

from sympy import cos, sin

from ...write import Component, Eq, EqnEnv, Planar, der
from .joints import TwoFrames


class AbsoluteSensor(Component):
    """Outputs in the world's axes: `x`, `y` (metre) and `phi` (radian) of a frame, `vx`, `vy` (metre per second) and
    `omega` (radian per second), their derivatives."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        frame = self.port("frame", Planar)
        self.output("x", frame.x, unit="m")
        self.output("y", frame.y, unit="m")
        self.output("phi", frame.phi, unit="rad")
        self.output("vx", der(frame.x), unit="m/s")
        self.output("vy", der(frame.y), unit="m/s")
        self.output("omega", der(frame.phi), unit="rad/s")
        self.add_equations(Eq(frame.fx, 0), Eq(frame.fy, 0), Eq(frame.tau, 0))


class RelativeSensor(TwoFrames):
    """Outputs seen from frame_a: `x`, `y` (metre) of frame_b along the axes of frame_a, `phi` (radian), `vx`, `vy`
    (metre per second) and `omega` (radian per second), their derivatives.

        x = dx·cos α + dy·sin α,   y = dy·cos α − dx·sin α,   phi = frame_b.phi − α

    with dx = frame_b.x − frame_a.x, dy = frame_b.y − frame_a.y and α = frame_a.phi.
    """

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        a, b = self._two_frames()
        dx, dy = b.x - a.x, b.y - a.y
        x = self.output("x", dx * cos(a.phi) + dy * sin(a.phi), unit="m")
        y = self.output("y", dy * cos(a.phi) - dx * sin(a.phi), unit="m")
        phi = self.output("phi", b.phi - a.phi, unit="rad")
        self.output("vx", der(x), unit="m/s")
        self.output("vy", der(y), unit="m/s")
        self.output("omega", der(phi), unit="rad/s")
        for frame in (a, b):
            self.add_equations(Eq(frame.fx, 0), Eq(frame.fy, 0), Eq(frame.tau, 0))
