"""Between shafts, and between shafts and lines: no losses, no inertia."""

from sympy import pi

from ..write import POSITIVE, Component, Eq, EqnEnv, Rotational, Translational, Value


class Planetary(Component):
    """A planetary gear: (1 + ratio)·carrier.phi = sun.phi + ratio·ring.phi, ring.tau = ratio·sun.tau,
    carrier.tau = −(1 + ratio)·sun.tau, with `ratio` > 0 teeth of the ring for each of the sun (Willis 1841)."""

    def __init__(self, ev: EqnEnv, name: str, ratio: Value = 2.0):
        super().__init__(ev, name)
        n = self.parameter("ratio", ratio, unit="1", bounds=POSITIVE)
        sun, carrier, ring = (self.port(k, Rotational) for k in ("sun", "carrier", "ring"))
        self.add_equations(
            Eq((1 + n) * carrier.phi, sun.phi + n * ring.phi),
            Eq(ring.tau, n * sun.tau),
            Eq(carrier.tau, -(1 + n) * sun.tau),
        )


class RackAndPinion(Component):
    """A pinion on a rack, or a wheel that rolls: line.s = radius·shaft.phi, shaft.tau = −radius·line.f.

    `radius` > 0 in metre; line.s is counted from where the angle is zero.
    """

    def __init__(self, ev: EqnEnv, name: str, radius: Value = 0.1):
        super().__init__(ev, name)
        r = self.parameter("radius", radius, unit="m", bounds=POSITIVE)
        shaft, line = self.port("shaft", Rotational), self.port("line", Translational)
        self.add_equations(Eq(line.s, r * shaft.phi), Eq(shaft.tau, -r * line.f))


class LeadScrew(Component):
    """A screw in a nut: line.s = lead·shaft.phi/(2π), shaft.tau = −lead·line.f/(2π), `lead` > 0 in metre a turn."""

    def __init__(self, ev: EqnEnv, name: str, lead: Value = 0.005):
        super().__init__(ev, name)
        p = self.parameter("lead", lead, unit="m", bounds=POSITIVE)
        shaft, line = self.port("shaft", Rotational), self.port("line", Translational)
        self.add_equations(Eq(line.s, p * shaft.phi / (2 * pi)), Eq(shaft.tau, -p * line.f / (2 * pi)))


class Wheel(RackAndPinion):
    """A wheel that rolls without slip: line.s = radius·shaft.phi, shaft.tau = −radius·line.f, `radius` > 0 in metre."""
