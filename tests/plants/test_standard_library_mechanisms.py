"""Three-dimensional mechanisms of the Modelica Standard Library 4.1.0: joints, forces and sensors.

Each stands in a plant with our own parts, beside its equations in SciPy; slopes are those of central differences.
`MODELICA_LIBRARY` names the folder of the library; without it the tests are skipped.
"""

import functools

import numpy as np
import pytest
import scipy.integrate
import sympy as sp
from device_library import standard_library
from open_classes import along_by_differences, run_along

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.library import rotational, translational
from jaxonomy_dae.library.signal import Constant
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow
BODIES = "Mechanics.MultiBody"
G = 9.80665


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def solved(slope, start, ts, rtol=1e-11, atol=1e-12):
    run = scipy.integrate.solve_ivp(slope, (0.0, ts[-1]), start, "DOP853", t_eval=ts, rtol=rtol, atol=atol)
    assert run.success
    return run.y


def turning(axis, angle):
    """The matrix that turns vectors about an axis."""
    c, s = sp.cos(angle), sp.sin(angle)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}[axis]
    return sp.Matrix(rows)


@functools.cache
def universal_pendulum():
    """The accelerations of a body on a universal joint, which a spring to (0.6, -0.3, 0.2) pulls at its end
    (0, -0.8, 0) and a torque about the world's axes turns: by the equations of Lagrange."""
    a, b, v, w, m, x, y, z, I11, I22, I33, c, *torque = sp.symbols("a b v w m x y z I11 I22 I33 c tx ty tz")
    T = turning("x", a) * turning("y", b)
    q, rates = sp.Matrix([a, b]), sp.Matrix([v, w])
    at = T * sp.Matrix([x, y, z])
    # Of the angular velocity, whose cross product is T' T^T.
    W = (T.diff(a) * v + T.diff(b) * w) * T.T
    omega = sp.Matrix([W[2, 1], W[0, 2], W[1, 0]])
    inside = T.T * omega
    moving = at.jacobian(q) * rates
    kinetic = m * moving.dot(moving) / 2 + (I11 * inside[0] ** 2 + I22 * inside[1] ** 2 + I33 * inside[2] ** 2) / 2
    apart = T * sp.Matrix([0, -sp.Rational(8, 10), 0]) - sp.Matrix([0.6, -0.3, 0.2])
    length = sp.sqrt(apart.dot(apart))
    potential = m * G * at[1] + c * (length - sp.Rational(1, 2)) ** 2 / 2
    momentum = sp.Matrix([kinetic]).jacobian(rates)
    right = sp.Matrix([kinetic - potential]).jacobian(q) - (momentum.jacobian(q) * rates).T
    right += (omega.jacobian(rates).T * sp.Matrix(torque)).T
    known = a, b, v, w, m, x, y, z, I11, I22, I33, c, *torque
    return sp.lambdify(known, [momentum.jacobian(rates), right.T, at, length], cse=True)


class Plant:
    """A diagram with a world, and parts of the library in it."""

    def __init__(self, library):
        self.library, self.ev, self.d = library, EqnEnv(), AcausalDiagram()
        self.world = self.part("World", "world", structure={"enableAnimation": False})

    def part(self, path, name, *, start=None, structure=None, **values):
        Class = self.library.component(f"Modelica.{BODIES}.{path}", **(structure or {}))
        x = Class(self.ev, name, **values, **({"start": start} if start else {}))
        self.d.add(x)
        return x

    def system(self, wanted):
        system = AcausalCompiler(self.ev, self.d, state_selection="dummy_derivatives", prefer_states=wanted)()
        assert sorted(system.states) == sorted(wanted)
        return system


def agrees(plant, wanted, names, values, ts, reference):
    """Values beside those of `reference(*values)`, a row for each name, and their derivatives along all parameters."""
    found, along = run_along(plant.system(wanted), values, ts, names)
    np.testing.assert_allclose(found, reference(*values.values()), atol=2e-7)
    np.testing.assert_allclose(along, along_by_differences(reference, values), rtol=1e-4, atol=1e-5)


def test_a_body_on_a_universal_joint(library):
    """A spring to a post of the world pulls at the body's end, and a torque of ours about the world's axes turns it.
    Sensors tell its angles, its place and its distance."""
    plant = Plant(library)
    part, d = plant.part, plant.d
    universal = part("Joints.Universal", "universal", start={"phi_a": 0.4, "phi_b": -0.3, "w_a": 0.5, "w_b": 1.0})
    bob = part("Parts.Body", "bob", m=1.3, r_CM=[0.1, -0.5, 0.2], I_11=0.05, I_22=0.03, I_33=0.04)
    end, post = (part("Parts.FixedTranslation", n, r=r) for n, r in (("end", [0, -0.8, 0]), ("post", [0.6, -0.3, 0.2])))
    spring = part("Forces.Spring", "spring", c=30.0, s_unstretched=0.5)
    twist = part("Forces.WorldTorque", "twist")
    angles = part("Sensors.RelativeAngles", "angles")
    place, away = part("Sensors.AbsolutePosition", "place"), part("Sensors.Distance", "away")
    d.connect(plant.world.frame_b, universal.frame_a, post.frame_a, angles.frame_a, away.frame_a)
    d.connect(universal.frame_b, bob.frame_a, end.frame_a, twist.frame_b, angles.frame_b)
    d.connect(post.frame_b, spring.frame_a)
    d.connect(end.frame_b, spring.frame_b, place.frame_a, away.frame_b)
    torque = np.array([0.3, -0.2, 0.5])
    for i in range(3):
        signal = Constant(plant.ev, f"t{i}", torque[i])
        d.add(signal)
        d.connect(signal, "y", twist, f"torque[{i + 1}]")

    def reference(m, I22, c, tz):
        known = m, 0.1, -0.5, 0.2, 0.05, I22, 0.04, c, *torque[:2], tz

        def swinging(t, x):
            M, right, *_ = universal_pendulum()(*x, *known)
            return [*x[2:], *np.linalg.solve(M, right.ravel())]

        x = solved(swinging, [0.4, -0.3, 0.5, 1.0], ts)
        ends = np.array([np.array((turning("x", a) * turning("y", b))[:, 1], float) * -0.8 for a, b in x[:2].T])
        return np.array([x[0], x[1], ends[:, 1], np.linalg.norm(ends, axis=1)])

    ts = np.array([0.3, 0.6, 1.0])
    wanted = ["universal.phi_a", "universal.w_a", "universal.phi_b", "universal.w_b"]
    names = ["angles.angles[1]", "angles.angles[2]", "place.r[2]", "away.distance"]
    values = {"bob.m": 1.3, "bob.I_22": 0.03, "spring.c": 30.0, "t2.k": 0.5}
    agrees(plant, wanted, names, values, ts, reference)


def test_a_slide_and_an_arm_with_a_rotor(library):
    """A body slides on our spring and damper; its bearing takes its weight and its inertia. A line force of our damper
    brakes the end of an arm, which carries a rotor on a tilted axis that our torque drives: its bearing takes what the
    library's equations say."""
    plant = Plant(library)
    part, d, ev = plant.part, plant.d, plant.ev
    slide = part(
        "Joints.Prismatic", "slide", start={"s": 0.2, "v": 0.0},
        structure={"useAxisFlange": True, "n": [0.0, 1.0, 0.0]},
    )  # fmt: skip
    force = part("Sensors.CutForce", "force")
    block = part("Parts.PointMass", "block", m=2.0)
    held = translational.SpringDamper(ev, "held", c=80.0, d=3.0)
    floor = translational.FixedPosition(ev, "floor", 0.0)
    joint = part("Joints.Revolute", "joint", start={"phi": 0.2, "w": 3.0})
    arm, tip, anchor = (
        part("Parts.Body", "arm", m=0.9, r_CM=[0.3, 0.0, 0.0], I_33=0.06),
        part("Parts.FixedTranslation", "tip", r=[0.6, 0.0, 0.0]),
        part("Parts.FixedTranslation", "anchor", r=[0.0, 1.0, 0.0]),
    )
    rotor = part("Parts.Rotor1D", "rotor", J=0.05, n=[0.6, 0.0, 0.8], start={"phi": 0.0, "w": 0.0})
    line = part("Forces.LineForceWithMass", "line")
    damper, drive = translational.Damper(ev, "damper", d=0.7), rotational.Torque(ev, "drive")
    level = Constant(ev, "level", 0.1)
    d.add(held, floor, damper, drive, level)
    d.connect(plant.world.frame_b, slide.frame_a, joint.frame_a, anchor.frame_a)
    d.connect(slide.frame_b, force.frame_a)
    d.connect(force.frame_b, block.frame_a)
    d.connect(floor.flange, held.flange_a)
    d.connect(held.flange_b, slide.axis)
    d.connect(joint.frame_b, arm.frame_a, tip.frame_a, rotor.frame_a)
    d.connect(anchor.frame_b, line.frame_a)
    d.connect(tip.frame_b, line.frame_b)
    d.connect(line.flange_a, damper.flange_a)
    d.connect(line.flange_b, damper.flange_b)
    d.connect(level.y, drive.tau)
    d.connect(drive.flange, rotor.flange_a)

    def reference(mass, damping, arm, braking, J):
        s, v = solved(lambda t, x: [x[1], -G - (80.0 * x[0] + damping * x[1]) / mass], [0.2, 0.0], ts)

        def turned(t, x):
            at = 0.6 * np.exp(1j * x[0]) - 1j
            along = (0.6 * 1j * np.exp(1j * x[0]) * np.conj(at)).real / abs(at)  # the length's change for one rad
            moment = -arm * G * 0.3 * np.cos(x[0]) - braking * along**2 * x[1]
            a = moment / (0.06 + arm * 0.09 - 0.64 * J)
            return [x[1], a, 0.1 / J - 0.8 * a]

        phi, _, w = solved(turned, [0.2, 3.0, 0.0], ts)
        return np.array([s, -(80.0 * s + damping * v), phi, w])

    ts = np.array([0.3, 0.6, 1.0])
    names = ["slide.s", "force.force[2]", "joint.phi", "rotor.w"]
    wanted = ["slide.s", "slide.v", "joint.phi", "joint.w", "rotor.phi", "rotor.w"]
    values = {"block.m": 2.0, "held.d": 3.0, "arm.m": 0.9, "damper.d": 0.7, "rotor.J": 0.05}
    agrees(plant, wanted, names, values, ts, reference)
