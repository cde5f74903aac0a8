"""A drive train with a rigid gear, from rotational components: index 3."""

from types import SimpleNamespace

import numpy as np
import scipy.linalg
import sympy

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, Rotational
from jaxonomy_dae.library.rotational import Damper, FixedAngle, IdealGear, Inertia, Spring

from .index_one import IndexOne
from .problem import Problem, Table, load


class SineTorque(Component):
    """A torque amp·sin(2π·f·t) from outside on a flange."""

    def __init__(self, ev: EqnEnv, name: str, amp: float, f: float):
        super().__init__(ev, name)
        amplitude, frequency = self.parameter("amp", amp, unit="N*m"), self.parameter("f", f, unit="Hz")
        flange = self.port("flange", Rotational)
        self.add_equations(flange.tau + amplitude * sympy.sin(2 * sympy.pi * frequency * ev.t))


def _diagram() -> tuple[EqnEnv, AcausalDiagram]:
    p = SimpleNamespace(**load("msl_rotational_first")["parameters"])
    ev, diagram = EqnEnv(), AcausalDiagram()
    torque, fixed = SineTorque(ev, "torque", p.amp, p.f), FixedAngle(ev, "fixed")
    inertia1 = Inertia(ev, "inertia1", p.J1)
    inertia2 = Inertia(ev, "inertia2", p.J2, initial_angle=0.0, initial_speed=0.0)
    inertia3 = Inertia(ev, "inertia3", p.J3, initial_angle=0.0, initial_speed=0.0)
    gear, spring, damper = IdealGear(ev, "gear", p.ratio), Spring(ev, "spring", p.c), Damper(ev, "damper", p.d)
    diagram.connect(torque.flange, inertia1.flange_a)
    diagram.connect(inertia1.flange_b, gear.flange_a)
    diagram.connect(gear.flange_b, inertia2.flange_a)
    diagram.connect(inertia2.flange_b, spring.flange_a, damper.flange_a)
    diagram.connect(spring.flange_b, inertia3.flange_a)
    diagram.connect(damper.flange_b, fixed.flange)
    return ev, diagram


NAMES = ("inertia2.phi", "inertia2.w", "inertia3.phi", "inertia3.w")
PUBLISHED = ("damper.phi_rel", "damper.w_rel", "inertia3.phi", "inertia3.w")


def drive_train_exact(ts) -> np.ndarray:
    """(phi2, w2, phi3, w3) at the times `ts`, shape `(len(ts), 4)`.

    inertia1 reflected through the gear: (J2 + ratio²·J1)·phi2'' = ratio·tau(t) − c·(phi2 − phi3) − d·w2,
    J3·phi3'' = c·(phi2 − phi3). The sine is the output of an oscillator, so that the whole is linear with constant
    coefficients, solved by the matrix exponential.
    """
    p = SimpleNamespace(**load("msl_rotational_first")["parameters"])
    inertia, omega = p.J2 + p.ratio**2 * p.J1, 2 * np.pi * p.f
    a = np.zeros((6, 6))
    a[0, 1] = a[2, 3] = 1.0
    a[1] = np.array([-p.c, -p.d, p.c, 0.0, p.ratio * p.amp, 0.0]) / inertia
    a[3] = np.array([p.c, 0.0, -p.c, 0.0, 0.0, 0.0]) / p.J3
    a[4, 5], a[5, 4] = omega, -omega  # (sin, cos)
    start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    return np.array([(scipy.linalg.expm(a * t) @ start)[:4] for t in ts])


def _right_side(t, y, p, m):
    """The published equations with the gear differentiated twice: index 1."""
    phi1, w1, phi2, w2, phi3, w3, a1, a2, a3, tau_a, tau_b, tau_s, tau_d = (y[k] for k in range(13))
    return [
        w1,
        a1,
        w2,
        a2,
        w3,
        a3,
        p.J1 * a1 - p.amp * m.sin(2 * m.pi * p.f * t) + tau_a,
        p.J2 * a2 - tau_b + tau_s + tau_d,
        p.J3 * a3 - tau_s,
        a1 - p.ratio * a2,
        p.ratio * tau_a - tau_b,
        tau_s - p.c * (phi2 - phi3),
        tau_d - p.d * w2,
    ]


def msl_rotational_first() -> Problem:
    """Linear, not stiff, 5 Hz forcing of a 76 rad/s oscillation."""
    facts = load("msl_rotational_first")
    end = facts["time"]["t_end"]
    rows = np.array(facts["reference_trajectory"]["rows"])
    exact = dict(zip(NAMES, drive_train_exact([end])[0].tolist(), strict=True))
    values = [-exact["inertia2.phi"], -exact["inertia2.w"], exact["inertia3.phi"], exact["inertia3.w"]]
    # In units of the oscillation between the inertias: angles of 0.1 rad, speeds of omega times that.
    p = SimpleNamespace(**facts["parameters"])
    size, omega = 0.1, float(np.sqrt(p.c * (1 / p.J3 + 1 / (p.J2 + p.ratio**2 * p.J1))))
    unknowns = (
        "inertia1.phi", "inertia1.w", "damper.phi_rel", "damper.w_rel", "inertia3.phi", "inertia3.w", "inertia1.a",
        "inertia2.a", "inertia3.a", "gear.flange_a.tau", "gear.flange_b.tau", "spring.tau", "damper.tau",
    )  # fmt: skip
    negative = ("damper.phi_rel", "damper.w_rel", "gear.flange_b.tau", "spring.tau", "damper.tau")
    return Problem(
        name="msl_rotational_first",
        build=_diagram,
        reference=dict(zip(PUBLISHED, values, strict=True)),
        scale=dict(zip(PUBLISHED, (size, omega * size, size, omega * size), strict=True)),
        digits=12.0,
        origin="exact: matrix exponential of the reduced system",
        t1=end,
        index_one=lambda: IndexOne(
            _right_side,
            np.array([1.0] * 6 + [0.0] * 7),
            np.zeros(13),
            facts["parameters"],
            tuple("-" + n if n in negative else n for n in unknowns),
        ),
        given=False,
        atol=0.1,
        published=dict(zip(PUBLISHED, facts["reference"]["values"], strict=True)),
        published_digits=2.9,
        table=Table(rows[:, 0], dict(zip(PUBLISHED, rows[:, 1:].T, strict=True)), digits=2.5),
    )
