"""Mechanics with one coordinate, written once: rotation about an axis and translation along a line differ in their
names and units only (`Axis`). `rotational` and `translational` give each class its domain and its documentation."""

from dataclasses import dataclass
from typing import ClassVar

import sympy
from sympy import asinh, exp, sqrt, tanh

from ..write import NONNEGATIVE, POSITIVE, Component, Eq, EqnEnv, Rotational, Translational, Value, der
from ..write.ports import Domain


@dataclass(frozen=True)
class Axis:
    """A domain with one coordinate and one effort, and the names that the domain itself does not tell."""

    domain: Domain
    speed: str
    rest: str  # parameter: a spring's relaxed extension
    initial: str  # parameter: the coordinate at the start

    @property
    def position(self) -> str:
        return self.domain.across[0][0]

    @property
    def effort(self) -> str:
        return self.domain.through[0][0]

    @property
    def position_unit(self) -> str:
        return self.domain.across[0][1]

    @property
    def effort_unit(self) -> str:
        return self.domain.through[0][1]

    @property
    def speed_unit(self) -> str:
        return f"{self.position_unit}/s"

    @property
    def stiffness_unit(self) -> str:
        return f"{self.effort_unit}/{self.position_unit}"

    @property
    def damping_unit(self) -> str:
        return f"{self.effort_unit}*s/{self.position_unit}"


ROTATION = Axis(Rotational, "w", "angle", "initial_angle")
TRANSLATION = Axis(Translational, "v", "length", "initial_position")


class AboutAxis:
    axis: ClassVar[Axis] = ROTATION


class AlongLine:
    axis: ClassVar[Axis] = TRANSLATION


class OnAxis(Component):
    """A component whose flanges belong to the domain of `axis`."""

    axis: ClassVar[Axis]

    def _flange(self, name: str = "flange") -> tuple[sympy.Symbol, sympy.Symbol]:
        """Adds a flange; returns its coordinate and the effort into the component."""
        port = self.port(name, self.axis.domain)
        return getattr(port, self.axis.position), getattr(port, self.axis.effort)


class Compliant(OnAxis):
    """Two flanges and one effort that pulls them together."""

    def _two_flanges(self, pushes: bool = False) -> tuple[sympy.Symbol, sympy.Symbol]:
        """Adds the flanges; returns their distance, b − a, and the effort, which pulls them together or `pushes` them
        apart."""
        (a, into_a), (b, into_b) = self._flange("flange_a"), self._flange("flange_b")
        distance = self.variable(f"{self.axis.position}_rel", unit=self.axis.position_unit)
        effort = self.variable(self.axis.effort, unit=self.axis.effort_unit)
        self.add_equations(Eq(distance, b - a), Eq(into_b, -effort if pushes else effort), Eq(into_a + into_b, 0))
        return distance, effort

    def _relative_speed(self, distance: sympy.Symbol) -> sympy.Symbol:
        speed = self.variable(f"{self.axis.speed}_rel", unit=self.axis.speed_unit)
        self.add_equations(Eq(speed, der(distance)))
        return speed

    def _linear(self, c: Value | None, d: Value | None, rest: Value = 0.0) -> None:
        """effort = c·(distance − rest) + d·(relative speed), without the part whose coefficient is None."""
        distance, effort = self._two_flanges()
        total: sympy.Expr = sympy.Integer(0)
        if c is not None:
            stiffness = self.parameter("c", c, unit=self.axis.stiffness_unit, bounds=NONNEGATIVE)
            extension = distance - self.parameter(self.axis.rest, rest, unit=self.axis.position_unit)
            total += stiffness * extension
            self.declare_energy(stiffness * extension**2 / 2)
        if d is not None:
            damping = self.parameter("d", d, unit=self.axis.damping_unit, bounds=NONNEGATIVE)
            speed = self._relative_speed(distance)
            total += damping * speed
            self.declare_dissipation(damping * speed**2)
        self.add_equations(Eq(effort, total))

    def _cubic(self, c: Value, c3: Value, rest: Value) -> None:
        """effort = c·e + c3·e³ with e = distance − rest."""
        linear = self.parameter("c", c, unit=self.axis.stiffness_unit)
        cubic = self.parameter("c3", c3, unit=f"{self.axis.stiffness_unit}3")
        relaxed = self.parameter(self.axis.rest, rest, unit=self.axis.position_unit)
        distance, effort = self._two_flanges()
        e = distance - relaxed
        self.add_equations(Eq(effort, linear * e + cubic * e**3))
        self.declare_energy(linear * e**2 / 2 + cubic * e**4 / 4)


def penetration(s: Value, gap: Value, smooth: Value) -> tuple[sympy.Expr, sympy.Expr]:
    """A dead zone: (distance of `s` beyond ±gap/2, its derivative by `s`), with corners rounded over the length
    `smooth`."""
    above, below = s - gap / 2, -s - gap / 2
    # (x + √(x² + smooth²))/2 tends to x above zero and to nothing below: the corner max(x, 0), rounded.
    root_above, root_below = sqrt(above**2 + smooth**2), sqrt(below**2 + smooth**2)
    depth = (above + root_above - below - root_below) / 2
    return depth, 1 + (above / root_above + below / root_below) / 2


def penetration_energy(s: Value, gap: Value, smooth: Value) -> sympy.Expr:
    """The integral of the penetration over `s`."""
    total = 0
    for beyond in (s - gap / 2, -s - gap / 2):
        root = sqrt(beyond**2 + smooth**2)
        total += (beyond**2 + beyond * root + smooth**2 * asinh(beyond / smooth)) / 4
    return total


def stribeck(
    v: Value, sliding: Value, breakaway: Value, stribeck_speed: Value, viscous: Value, smooth: Value
) -> sympy.Expr:
    """Friction (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, Automatica 30:1083, with tanh in place of the sign):
    [sliding + (breakaway − sliding)·exp(−(v/stribeck_speed)²)]·tanh(v/smooth) + viscous·v."""
    return (sliding + (breakaway - sliding) * exp(-((v / stribeck_speed) ** 2))) * tanh(v / smooth) + viscous * v


class Damper(Compliant):
    def __init__(self, ev: EqnEnv, name: str, d: Value = 1.0):
        super().__init__(ev, name)
        self._linear(None, d)


class Backlash(Compliant):
    def __init__(self, ev: EqnEnv, name: str, gap: Value = 0.01, c: Value = 1e4, d: Value = 10.0, smooth: Value = 1e-4):
        super().__init__(ev, name)
        play = self.parameter("gap", gap, unit=self.axis.position_unit, bounds=NONNEGATIVE)
        stiffness = self.parameter("c", c, unit=self.axis.stiffness_unit, bounds=NONNEGATIVE)
        damping = self.parameter("d", d, unit=self.axis.damping_unit, bounds=NONNEGATIVE)
        corner = self.parameter("smooth", smooth, unit=self.axis.position_unit, bounds=POSITIVE)
        distance, effort = self._two_flanges()
        speed = self._relative_speed(distance)
        depth, slope = penetration(distance, play, corner)
        self.add_equations(Eq(effort, stiffness * depth + damping * slope * speed))
        self.declare_energy(stiffness * penetration_energy(distance, play, corner))
        self.declare_dissipation(damping * slope * speed**2)


class Friction(Compliant):
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
        coulomb = self.parameter("sliding", sliding, unit=self.axis.effort_unit, bounds=NONNEGATIVE)
        static = self.parameter("breakaway", breakaway, unit=self.axis.effort_unit, bounds=NONNEGATIVE)
        fades = self.parameter("stribeck_speed", stribeck_speed, unit=self.axis.speed_unit, bounds=POSITIVE)
        fluid = self.parameter("viscous", viscous, unit=self.axis.damping_unit, bounds=NONNEGATIVE)
        width = self.parameter("smooth", smooth, unit=self.axis.speed_unit, bounds=POSITIVE)
        distance, effort = self._two_flanges()
        speed = self._relative_speed(distance)
        self.add_equations(Eq(effort, stribeck(speed, coulomb, static, fades, fluid, width)))
        self.declare_dissipation(effort * speed)


class EffortSource(OnAxis):
    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        position, effort = self._flange()
        given = self.input(self.axis.effort, default=0.0, unit=self.axis.effort_unit)
        self.add_equations(Eq(effort, -given))
        self.declare_supply(given * der(position))


class PositionSource(OnAxis):
    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        position, effort = self._flange()
        self.add_equations(Eq(position, self.input("u", unit=self.axis.position_unit)))
        self.declare_supply(-effort * der(position))


class Fixed(OnAxis):
    """A flange held in its place."""

    def _hold(self, parameter: str, value: Value) -> None:
        position, _ = self._flange()
        self.add_equations(Eq(position, self.parameter(parameter, value, unit=self.axis.position_unit)))


class MovedAtSpeed(OnAxis):
    """A flange moved at the speed of the input `u`."""

    def _move(self, initial: Value) -> None:
        start = self.parameter(self.axis.initial, initial, unit=self.axis.position_unit)
        position, effort = self._flange()
        # A speed leaves the position open: it is a state with a start of its own.
        where = self.variable(self.axis.position, start=start, fixed=True, unit=self.axis.position_unit)
        self.add_equations(Eq(where, position), Eq(der(where), self.input("u", unit=self.axis.speed_unit)))
        self.declare_supply(-effort * der(where))


class PositionSensor(OnAxis):
    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        position, effort = self._flange()
        self.output("y", position, unit=self.axis.position_unit)
        self.add_equations(Eq(effort, 0))


class SpeedSensor(OnAxis):
    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        position, effort = self._flange()
        self.output("y", der(position), unit=self.axis.speed_unit)
        self.add_equations(Eq(effort, 0))


class EffortSensor(OnAxis):
    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        (a, into_a), (b, into_b) = self._flange("flange_a"), self._flange("flange_b")
        self.output("y", into_a, unit=self.axis.effort_unit)
        self.add_equations(Eq(a, b), Eq(into_a + into_b, 0))
