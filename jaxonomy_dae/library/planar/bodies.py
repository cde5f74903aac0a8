"""What moves and what holds: the world, bodies, and rigid links between frames."""

from sympy import cos, sin

from ...write import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Planar, Value, der
from ..arguments import start_of
from .joints import TwoFrames


class World(Component):
    """A frame that does not move.

        frame.x = x,   frame.y = y,   frame.phi = phi

    It takes any force and torque. Several worlds are as many points of one ground (Haug 1989, section 3.2).

    **Arguments:**

    - `x`, `y`: where it is (metre). `phi`: its angle (radian).
    """

    def __init__(self, ev: EqnEnv, name: str, x: Value = 0.0, y: Value = 0.0, phi: Value = 0.0):
        super().__init__(ev, name)
        x0, y0 = self.parameter("x", x, unit="m"), self.parameter("y", y, unit="m")
        angle = self.parameter("phi", phi, unit="rad")
        frame = self.port("frame", Planar)
        self.add_equations(Eq(frame.x, x0), Eq(frame.y, y0), Eq(frame.phi, angle))


class Body(Component):
    """A rigid body, with its frame at the centre of mass: Newton's and Euler's equations (Haug 1989, section 6.1).

        dx/dt = vx,       m·dvx/dt = frame.fx + m·g_x
        dy/dt = vy,       m·dvy/dt = frame.fy + m·g_y
        dphi/dt = omega,  J·domega/dt = frame.tau

    where x, y and phi are those of the frame.

    **Arguments:**

    - `m` > 0: mass (kilogram). `J` ≥ 0: moment of inertia about the centre of mass (kg·m²). It may be zero where the
        body cannot turn freely, as at the end of a link.
    - `g_x`, `g_y`: gravity's components (metre per second squared).
    - `initial_x`, `initial_y` (metre), `initial_angle` (radian), `initial_vx`, `initial_vy` (metre per second),
        `initial_speed` (radian per second): they hold at the start where they are given.
    - `guess_x`, `guess_y`, `guess_angle`: where the search for a start begins for what is not given; the parameters
        `initial_x`, … are then the guesses. A closed loop has several positions in which it fits together, and the
        guesses choose among them. A position or angle with neither has no start, and no such parameter.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        m: Value = 1.0,
        J: Value = 1.0,
        g_x: Value = 0.0,
        g_y: Value = -9.81,
        initial_x: Value | None = None,
        initial_y: Value | None = None,
        initial_angle: Value | None = None,
        initial_vx: Value | None = None,
        initial_vy: Value | None = None,
        initial_speed: Value | None = None,
        guess_x: Value | None = None,
        guess_y: Value | None = None,
        guess_angle: Value | None = None,
    ):
        super().__init__(ev, name)
        mass = self.parameter("m", m, unit="kg", bounds=POSITIVE)
        inertia = self.parameter("J", J, unit="kg*m2", bounds=NONNEGATIVE)
        gx, gy = self.parameter("g_x", g_x, unit="m/s2"), self.parameter("g_y", g_y, unit="m/s2")
        frame = self.port("frame", Planar)

        def state(name: str, unit: str, initial: Value | None, guess: Value | None = 0.0, word: str | None = None):
            return self.variable(name, **start_of(self, f"initial_{word or name}", initial, unit, guess))

        x, vx = state("x", "m", initial_x, guess_x), state("vx", "m/s", initial_vx)
        y, vy = state("y", "m", initial_y, guess_y), state("vy", "m/s", initial_vy)
        phi = state("phi", "rad", initial_angle, guess_angle, "angle")
        omega = state("omega", "rad/s", initial_speed, word="speed")
        self.add_equations(
            Eq(x, frame.x),
            Eq(y, frame.y),
            Eq(phi, frame.phi),
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(der(phi), omega),
            Eq(mass * der(vx), frame.fx + mass * gx),
            Eq(mass * der(vy), frame.fy + mass * gy),
            Eq(inertia * der(omega), frame.tau),
        )
        self.declare_energy(mass * (vx**2 + vy**2) / 2, inertia * omega**2 / 2, -mass * (gx * x + gy * y))


class Link(TwoFrames):
    """A rigid link without mass: frame_b is fixed in frame_a at the offset (rx, ry), and turned by the angle `phi`.

        dx = rx·cos(frame_a.phi) − ry·sin(frame_a.phi),   frame_b.x = frame_a.x + dx
        dy = rx·sin(frame_a.phi) + ry·cos(frame_a.phi),   frame_b.y = frame_a.y + dy,   frame_b.phi = frame_a.phi + phi
        0 = frame_a.f + frame_b.f,   0 = frame_a.tau + frame_b.tau + dx·frame_b.fy − dy·frame_b.fx

    (Haug 1989, section 2.4, for the place of a point of a body.)

    **Arguments:**

    - `rx`, `ry`: from frame_a to frame_b along the axes of frame_a (metre).
    - `phi`: from the axes of frame_a to those of frame_b (radian); 0 if left out, and then not a parameter.
    """

    def __init__(self, ev: EqnEnv, name: str, rx: Value = 1.0, ry: Value = 0.0, phi: Value | None = None):
        super().__init__(ev, name)
        ahead, aside = self.parameter("rx", rx, unit="m"), self.parameter("ry", ry, unit="m")
        # Without a parameter the angles of both frames are one variable, and alias elimination takes the other out.
        turned = 0 if phi is None else self.parameter("phi", phi, unit="rad")
        a, b = self._two_frames()
        dx = ahead * cos(a.phi) - aside * sin(a.phi)
        dy = ahead * sin(a.phi) + aside * cos(a.phi)
        self.add_equations(Eq(b.x, a.x + dx), Eq(b.y, a.y + dy), Eq(b.phi, a.phi + turned))
        self._balance(dx, dy)


class MassiveLink(Component):
    """A rigid link with mass, made of a `Link` from frame_a to the centre of mass, a `Body` there, and a `Link` from it
    to frame_b.

    Variables are those of the parts: `rod.body.phi`, `rod.body.omega`.

    **Arguments:**

    - `rx`, `ry`: from frame_a to frame_b along the axes of frame_a (metre).
    - `m` > 0: mass (kilogram).
    - `J` ≥ 0: moment of inertia about the centre of mass (kg·m²); that of a thin uniform rod, m·(rx² + ry²)/12, if left
        out.
    - `cx`, `cy`: from frame_a to the centre of mass along the axes of frame_a (metre); half of `rx`, `ry` if left out.
    - `g_x`, `g_y`: gravity's components (metre per second squared).
    - `initial_angle` (radian), `initial_speed` (radian per second): they hold at the start where they are given.
    - `guess_x`, `guess_y` (metre, of the centre of mass), `guess_angle` (radian): where the search for a start begins.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        rx: Value = 1.0,
        ry: Value = 0.0,
        m: Value = 1.0,
        J: Value | None = None,
        cx: Value | None = None,
        cy: Value | None = None,
        g_x: Value = 0.0,
        g_y: Value = -9.81,
        initial_angle: Value | None = None,
        initial_speed: Value | None = None,
        guess_x: Value | None = None,
        guess_y: Value | None = None,
        guess_angle: Value | None = None,
    ):
        super().__init__(ev, name)
        frame_a, frame_b = self.port("frame_a", Planar), self.port("frame_b", Planar)
        ahead, aside = self.parameter("rx", rx, unit="m"), self.parameter("ry", ry, unit="m")
        mass = self.parameter("m", m, unit="kg", bounds=POSITIVE)
        thin_rod = mass * (ahead**2 + aside**2) / 12
        inertia = self.parameter("J", thin_rod if J is None else J, unit="kg*m2", bounds=NONNEGATIVE)
        x = self.parameter("cx", ahead / 2 if cx is None else cx, unit="m")
        y = self.parameter("cy", aside / 2 if cy is None else cy, unit="m")
        gx, gy = self.parameter("g_x", g_x, unit="m/s2"), self.parameter("g_y", g_y, unit="m/s2")
        body = self.add(
            Body(
                ev, "body", mass, inertia, gx, gy,
                initial_angle=initial_angle, initial_speed=initial_speed,
                guess_x=guess_x, guess_y=guess_y, guess_angle=guess_angle,
            )
        )  # fmt: skip
        near, far = self.add(Link(ev, "near", x, y)), self.add(Link(ev, "far", ahead - x, aside - y))
        self.connect(frame_a, near.frame_a)
        self.connect(near.frame_b, body.frame, far.frame_a)
        self.connect(far.frame_b, frame_b)
