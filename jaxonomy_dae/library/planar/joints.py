"""Joints between two frames, with a flange for what drives or brakes them, and the balance that all pairs share."""

import sympy
from sympy import cos, sin

from ...write import Component, Eq, EqnEnv, Planar, Rotational, Translational, Value, der
from ...write.ports import Port
from ..arguments import start_of


class TwoFrames(Component):
    """Two frames without mass between them: what enters at one leaves at the other."""

    def _two_frames(self) -> tuple[Port, Port]:
        return self.port("frame_a", Planar), self.port("frame_b", Planar)

    def _balance(self, dx: Value = 0, dy: Value = 0) -> None:
        """The forces and the torques about frame_a sum to zero, with frame_b at (dx, dy) from it in world axes."""
        a, b = self.ports["frame_a"], self.ports["frame_b"]
        lever = sympy.sympify(dx) * b.fy - sympy.sympify(dy) * b.fx
        self.add_equations(Eq(a.fx + b.fx, 0), Eq(a.fy + b.fy, 0), Eq(a.tau + b.tau + lever, 0))

    def _without_torque(self) -> None:
        """The forces sum to zero, and no torque acts on either frame."""
        a, b = self.ports["frame_a"], self.ports["frame_b"]
        self.add_equations(Eq(a.fx + b.fx, 0), Eq(a.fy + b.fy, 0), Eq(a.tau, 0), Eq(b.tau, 0))


class Revolute(TwoFrames):
    """A pin: two frames at one point, free to turn (Haug 1989, section 3.3).

        frame_b.x = frame_a.x,   frame_b.y = frame_a.y,   frame_b.phi = frame_a.phi + phi,   dphi/dt = omega
        0 = frame_a.f + frame_b.f,   0 = frame_a.tau + frame_b.tau
        flange.phi = phi,   frame_b.tau = −flange.tau

    What is connected to `flange` turns frame_b against frame_a: a motor, or a spring and a damper from the flange to a
    `rotational.FixedAngle`. An inertia there turns with the angle `phi`, relative to frame_a. Left unconnected, the pin
    is free.

    **Arguments:**

    - `initial_angle` (radian), `initial_speed` (radian per second): they hold at the start where they are given.
    - `guess_angle` (radian): where the search for a start begins if `initial_angle` is not given. In a closed loop it
        chooses among the positions in which the loop fits together. Without either the angle has no start, and there is
        no parameter `initial_angle`: nothing that was not said outweighs what was.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        initial_angle: Value | None = None,
        initial_speed: Value | None = None,
        guess_angle: Value | None = None,
    ):
        super().__init__(ev, name)
        a, b = self._two_frames()
        flange = self.port("flange", Rotational)
        phi = self.variable("phi", **start_of(self, "initial_angle", initial_angle, "rad", guess_angle))
        omega = self.variable("omega", **start_of(self, "initial_speed", initial_speed, "rad/s"))
        self.add_equations(
            Eq(b.x, a.x),
            Eq(b.y, a.y),
            Eq(b.phi, a.phi + phi),
            Eq(der(phi), omega),
            Eq(flange.phi, phi),
            Eq(b.tau, -flange.tau),
        )
        self._balance()


class Prismatic(TwoFrames):
    """A slide: frame_b moves along an axis that is fixed in frame_a, and does not turn (Haug 1989, section 3.3).

        dx = s·cos(frame_a.phi + angle),   dy = s·sin(frame_a.phi + angle),   ds/dt = v
        frame_b.x = frame_a.x + dx,   frame_b.y = frame_a.y + dy,   frame_b.phi = frame_a.phi
        0 = frame_a.f + frame_b.f,   0 = frame_a.tau + frame_b.tau + dx·frame_b.fy − dy·frame_b.fx
        flange.s = s,   frame_b.fx·cos(frame_a.phi + angle) + frame_b.fy·sin(frame_a.phi + angle) = −flange.f

    What is connected to `flange` pushes frame_b away from frame_a: a source of force, or a spring and a damper from the
    flange to a `translational.FixedPosition`. Left unconnected, the slide is free.

    **Arguments:**

    - `angle`: of the axis in frame_a (radian).
    - `initial_position` (metre), `initial_velocity` (metre per second): they hold at the start where they are given.
    - `guess_position` (metre): where the search for a start begins if `initial_position` is not given.
        Without either the position has no start, and there is no parameter `initial_position`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        angle: Value = 0.0,
        initial_position: Value | None = None,
        initial_velocity: Value | None = None,
        guess_position: Value | None = None,
    ):
        super().__init__(ev, name)
        inclination = self.parameter("angle", angle, unit="rad")
        a, b = self._two_frames()
        flange = self.port("flange", Translational)
        s = self.variable("s", **start_of(self, "initial_position", initial_position, "m", guess_position))
        v = self.variable("v", **start_of(self, "initial_velocity", initial_velocity, "m/s"))
        along_x, along_y = cos(a.phi + inclination), sin(a.phi + inclination)
        self.add_equations(
            Eq(b.x, a.x + s * along_x),
            Eq(b.y, a.y + s * along_y),
            Eq(b.phi, a.phi),
            Eq(der(s), v),
            Eq(flange.s, s),
            Eq(b.fx * along_x + b.fy * along_y, -flange.f),
        )
        self._balance(s * along_x, s * along_y)
