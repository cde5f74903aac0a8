"""A pendulum in Cartesian coordinates, in one component."""

from sympy import cos, sin

from ...write import POSITIVE, Component, Eq, EqnEnv, Value, der


class PlanarPendulum(Component):
    """A point mass on a rigid massless link of length L, pivoted at the origin.

        dx/dt = vx,   m·dvx/dt = −2·lam·x + m·g_x
        dy/dt = vy,   m·dvy/dt = −2·lam·y + m·g_y
        0 = x² + y² − L²

    `lam` is the Lagrange multiplier of the link's constraint (newton per metre): the link pulls with 2·lam·L.

    **Arguments:**

    - `m` > 0: mass (kilogram). `L` > 0: length (metre). `g_x`, `g_y`: gravity's components (metre per second squared).
    - `initial_theta`: angle at the start from the +x axis, counter-clockwise (radian).
    - `initial_omega`: angular velocity at the start (radian per second).
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        m: Value = 1.0,
        L: Value = 1.0,
        g_x: Value = 0.0,
        g_y: Value = -9.81,
        initial_theta: Value = 0.0,
        initial_omega: Value = 0.0,
    ):
        super().__init__(ev, name)
        mass = self.parameter("m", m, unit="kg", bounds=POSITIVE)
        length = self.parameter("L", L, unit="m", bounds=POSITIVE)
        gx = self.parameter("g_x", g_x, unit="m/s2")
        gy = self.parameter("g_y", g_y, unit="m/s2")
        theta = self.parameter("initial_theta", initial_theta, unit="rad")
        omega = self.parameter("initial_omega", initial_omega, unit="rad/s")
        x = self.variable("x", start=length * cos(theta), fixed=True, unit="m")
        y = self.variable("y", start=length * sin(theta), fixed=True, unit="m")
        vx = self.variable("vx", start=-length * omega * sin(theta), fixed=True, unit="m/s")
        vy = self.variable("vy", start=length * omega * cos(theta), fixed=True, unit="m/s")
        lam = self.variable("lam", unit="N/m")
        self.add_equations(
            Eq(der(x), vx),
            Eq(der(y), vy),
            # 2·(x, y) is the gradient of the constraint x² + y² − L².
            Eq(mass * der(vx), -2 * lam * x + mass * gx),
            Eq(mass * der(vy), -2 * lam * y + mass * gy),
            Eq(x**2 + y**2, length**2),
        )
        self.declare_energy(mass * (vx**2 + vy**2) / 2, -mass * (gx * x + gy * y))
