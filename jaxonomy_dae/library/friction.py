"""Dry friction that sticks: three modes of motion and one of none, for clutches, brakes and sliding parts.

Modes: 0 stuck, 1 and −1 sliding forward and backward, 2 free, without normal force. While parts stick, the friction is
whatever keeps their relative acceleration zero (Otter, Elmqvist & Mattsson 1999, "Hybrid modeling in Modelica based on
the synchronous data flow principle"; here the branch is an equation of its own, and the mode a discrete variable).
"""

import sympy
from sympy import Abs, And, Max, Min, Ne, Piecewise, sign
from sympy.logic.boolalg import Boolean

from ..base.errors import ModelError
from ..write import (
    NONNEGATIVE,
    POSITIVE,
    Component,
    Eq,
    EqnEnv,
    Rotational,
    Translational,
    Value,
    assign,
    der,
    smooth,
)
from .arguments import in_order
from .one_axis import AboutAxis, Compliant

STANDSTILL = 1e-6  # m/s or rad/s: slower parts that are pressed together stick at once
# Stuck parts accelerate by so much per friction. This is below any rounding in SI units, and a normal number in single
# precision. It determines the friction of parts that a source moves: zero while they rest, and beyond any breakaway
# once they start.
COMPLIANCE = 1e-30


def stick_slip(
    component: Component, speed: Value, friction: Value, sliding: Value, breakaway: Value, pressed: Value | None = None
) -> None:
    """Adds the friction between two parts to a component; below the speed of its parameter `standstill`, parts that are
    pressed together stick at once. Parts whose motion a source prescribes do not feel the friction: it is zero while
    they rest, and slides the way they go otherwise.

    **Arguments:**

    - `speed`: the relative speed, a variable; `friction`: the force that opposes it, a variable.
    - `sliding`: the friction while the parts slide, ≥ 0; zero where they are not pressed together.
    - `breakaway`: the largest friction while they stick, ≥ sliding.
    - `pressed`: what is positive while the parts are pressed together; None if they always are.
    """
    mode = component.discrete("mode", start=2, unit="1")
    if str(speed) not in component.variables:
        raise ModelError(
            f"stick_slip: speed is a variable of component '{component.name}'; got {speed}: write a variable for it, "
            "and an equation that says what it is"
        )
    speed_unit = component.variables[str(speed)].unit
    still = component.parameter("standstill", STANDSTILL, unit=speed_unit, bounds=POSITIVE)
    per = {"m/s": "1/kg", "rad/s": "rad/(kg*m*m)"}.get(speed_unit, "")  # of other speeds, units are not checked
    compliance = component.parameter("compliance", COMPLIANCE, unit=per, bounds=POSITIVE)
    # Parts that are always pressed together are held until the initial speed has said which way they slide: without
    # any friction, nothing would determine what lies between two of them in a row.
    stuck: Boolean = Eq(mode, 0)
    held = stuck if pressed is not None else Ne(Abs(mode), 1)
    branch = Piecewise((0, Eq(mode, 2)), (mode * sliding, True))
    component.either(held, compliance * friction - der(speed), friction - branch)
    direction = Piecewise((1, speed > still), (-1, speed < -still), (0, True))
    moving = Eq(Abs(mode), 1)
    if pressed is None:
        component.when(Eq(mode, 2), assign(mode, direction), at_start=True)
        component.when(mode * speed <= 0, assign(mode, 0), on=moving)
    else:
        component.when(pressed <= 0, assign(mode, 2), on=Ne(mode, 2), at_start=True)
        component.when(pressed > 0, assign(mode, direction), on=Eq(mode, 2), at_start=True)
        component.when(And(mode * speed < 0, pressed > 0), assign(mode, 0), on=moving)
    # Not more than twice the breakaway, so that friction that no source lets hold leaves the guard its size.
    component.when(smooth(Min(Abs(friction), 2 * breakaway)) >= breakaway, assign(mode, sign(friction)), on=stuck)
    # A source that jumps to a speed, as an interpolated position does, moves parts without acceleration.
    component.when(Abs(speed) > still, assign(mode, sign(speed)), on=stuck)


class _Pressed(Component):
    """Shafts on which a normal force presses."""

    def _pressed(self, mu: Value, fn_max: Value, cgeo: Value, peak: Value) -> tuple[sympy.Expr, sympy.Expr]:
        """(the friction under the whole normal force while shafts slide, how many times that they hold)."""
        coefficient = self.parameter("mu", mu, unit="1", bounds=NONNEGATIVE)
        largest = self.parameter("fn_max", fn_max, unit="N", bounds=NONNEGATIVE)
        geometry = self.parameter("cgeo", cgeo, unit="m", bounds=NONNEGATIVE)
        ratio = self.parameter("peak", peak, unit="1", bounds=(1.0, float("inf")))
        return coefficient * geometry * largest, ratio


class Clutch(_Pressed, AboutAxis, Compliant):
    """Two shafts pressed together: the input `u` is the normal force as a part of `fn_max`.

    While they slide, tau = mode·mu·cgeo·fn with fn = fn_max·max(u, 0); they stick until |tau| reaches `peak` times this
    torque; w_rel = der(flange_b.phi − flange_a.phi). `mu`, `fn_max` (newton), `cgeo` (metre) ≥ 0; `peak` ≥ 1. Shafts
    that are pressed together at a speed below the parameter `standstill` (rad/s) stick at once.
    """

    def __init__(
        self, ev: EqnEnv, name: str, mu: Value = 0.5, fn_max: Value = 1.0, cgeo: Value = 1.0, peak: Value = 1.0
    ):
        super().__init__(ev, name)
        most, ratio = self._pressed(mu, fn_max, cgeo, peak)
        phi, tau = self._two_flanges()
        w = self._relative_speed(phi)
        u = self.input("u", unit="1")
        slipping = self.variable("slipping", unit="N*m")
        self.add_equations(Eq(slipping, most * smooth(Max(u, 0))))
        stick_slip(self, w, tau, slipping, ratio * slipping, pressed=u)
        self.declare_dissipation(tau * w)


class Brake(_Pressed):
    """A shaft pressed against the ground: as `Clutch`, with the shaft's own speed `w`."""

    def __init__(
        self, ev: EqnEnv, name: str, mu: Value = 0.5, fn_max: Value = 1.0, cgeo: Value = 1.0, peak: Value = 1.0
    ):
        super().__init__(ev, name)
        most, ratio = self._pressed(mu, fn_max, cgeo, peak)
        flange = self.port("flange", Rotational)
        u = self.input("u", unit="1")
        w = self.variable("w", unit="rad/s")
        slipping = self.variable("slipping", unit="N*m")
        self.add_equations(Eq(w, der(flange.phi)), Eq(slipping, most * smooth(Max(u, 0))))
        stick_slip(self, w, flange.tau, slipping, ratio * slipping, pressed=u)
        self.declare_dissipation(flange.tau * w)


class StickingFriction(Component):
    """Dry friction between two sliding parts that sticks: f opposes v_rel = der(flange_b.s − flange_a.s) with the
    force `sliding` (newton, > 0), and holds the parts together up to `breakaway` ≥ sliding, which is `sliding` if left
    out."""

    def __init__(self, ev: EqnEnv, name: str, sliding: Value = 1.0, breakaway: Value | None = None):
        super().__init__(ev, name)
        coulomb = self.parameter("sliding", sliding, unit="N", bounds=POSITIVE)
        static = self.parameter("breakaway", coulomb if breakaway is None else breakaway, unit="N", bounds=POSITIVE)
        in_order(self, "sliding", "breakaway")
        a, b = self.port("flange_a", Translational), self.port("flange_b", Translational)
        v = self.variable("v_rel", unit="m/s")
        f = self.variable("f", unit="N")
        self.add_equations(Eq(v, der(b.s - a.s)), Eq(b.f, f), Eq(a.f + b.f, 0))
        stick_slip(self, v, f, coulomb, static)
        self.declare_dissipation(f * v)


class OneWayClutch(_Pressed):
    """A freewheel, and a clutch beside it: flange_b may run faster than flange_a, never slower.

    While they are locked, w_rel = 0 with a torque tau from a to b that is not below −peak·slipping; while
    w_rel = der(flange_b.phi − flange_a.phi) ≥ 0 is free, tau = −slipping, with slipping = mu·cgeo·fn_max·max(u, 0). The
    input `u` is 0 if nothing drives it, and then there is no friction. The discrete variable `locked` is 1 or 0. If
    flange_b is slower than flange_a at the initial time, an impulse makes them equally fast at once; angular momentum
    is conserved.

    `mu`, `fn_max` (newton), `cgeo` (metre) ≥ 0; `peak` ≥ 1.
    """

    def __init__(
        self, ev: EqnEnv, name: str, mu: Value = 0.5, fn_max: Value = 1.0, cgeo: Value = 1.0, peak: Value = 1.0
    ):
        super().__init__(ev, name)
        most, ratio = self._pressed(mu, fn_max, cgeo, peak)
        a, b = self.port("flange_a", Rotational), self.port("flange_b", Rotational)
        u = self.input("u", default=0.0, unit="1")
        w = self.variable("w_rel", unit="rad/s")
        tau = self.variable("tau", unit="N*m")
        slipping = self.variable("slipping", unit="N*m")
        locked = self.discrete("locked", start=0, unit="1")
        self.add_equations(
            Eq(w, der(b.phi - a.phi)), Eq(b.tau, -tau), Eq(a.tau + b.tau, 0), Eq(slipping, most * smooth(Max(u, 0)))
        )
        self.either(Eq(locked, 1), w, tau + slipping, order=1)
        self.when(w <= 0, assign(locked, 1), on=Eq(locked, 0), at_start=True)
        self.when(tau <= -ratio * slipping, assign(locked, 0), on=Eq(locked, 1), at_start=True)
        self.declare_dissipation(-tau * w)
