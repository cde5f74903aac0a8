"""Electrical machines: between circuits and shafts."""

from ...write import NONNEGATIVE, POSITIVE, Component, Electrical, Eq, EqnEnv, Rotational, Value, der
from ..rotational import Damper, FixedAngle, Inertia
from .passive import Inductor, Resistor
from .two_pin import TwoPin


class EMF(TwoPin):
    """The ideal conversion in a machine with permanent magnets: v = k·w, flange.tau = −k·i, w = der(flange.phi).

    `k` in volt second per radian, which is newton metre per ampere. The housing stands still.
    """

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0):
        super().__init__(ev, name)
        constant = self.parameter("k", k, unit="V*s/rad")
        voltage, current = self._two_pins()
        flange = self.port("flange", Rotational)
        w = self.variable("w", unit="rad/s")
        self.add_equations(Eq(w, der(flange.phi)), Eq(voltage, constant * w), Eq(flange.tau, -constant * current))


class DCMotor(Component):
    """A motor with permanent magnets, made of its parts: resistance `R` (ohm) and inductance `L` (henry) of the
    armature in series with an `EMF` of constant `k` (V·s/rad), rotor inertia `J` (kg·m²) and viscous friction `d`
    (N·m·s/rad).

    Given `initial_current` (ampere), `initial_angle` (radian) and `initial_speed` (rad/s) hold at the start. Variables
    are those of the parts: `motor.inductor.i`, `motor.rotor.w`.
    """

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        R: Value = 1.0,
        L: Value = 1e-3,
        k: Value = 0.1,
        J: Value = 1e-3,
        d: Value = 0.0,
        initial_current: Value | None = None,
        initial_angle: Value | None = None,
        initial_speed: Value | None = None,
    ):
        super().__init__(ev, name)
        p, n, flange = self.port("p", Electrical), self.port("n", Electrical), self.port("flange", Rotational)
        resistance = self.parameter("R", R, unit="Ohm", bounds=NONNEGATIVE)
        inductance = self.parameter("L", L, unit="H", bounds=POSITIVE)
        constant = self.parameter("k", k, unit="V*s/rad")
        inertia = self.parameter("J", J, unit="kg*m2", bounds=POSITIVE)
        friction = self.parameter("d", d, unit="N*m*s/rad", bounds=NONNEGATIVE)
        resistor = self.add(Resistor(ev, "resistor", R=resistance))
        inductor = self.add(Inductor(ev, "inductor", L=inductance, initial_current=initial_current))
        emf = self.add(EMF(ev, "emf", k=constant))
        rotor = self.add(Inertia(ev, "rotor", J=inertia, initial_angle=initial_angle, initial_speed=initial_speed))
        bearing, housing = self.add(Damper(ev, "bearing", d=friction)), self.add(FixedAngle(ev, "housing"))
        self.connect(p, resistor.p)
        self.connect(resistor.n, inductor.p)
        self.connect(inductor.n, emf.p)
        self.connect(emf.n, n)
        self.connect(emf.flange, rotor.flange_a)
        self.connect(rotor.flange_b, bearing.flange_b, flange)
        self.connect(bearing.flange_a, housing.flange)
