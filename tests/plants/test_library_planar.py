"""Planar mechanics against closed forms, and against SciPy's solution of reduced equations derived by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from bench import Bench
from component_references import checks, measured
from planar_models import double_pendulum, four_bar, squeezing_mechanism
from problems import GRAVITY, angle_solution, elliptic_angle
from testset.problem import load
from trajectories import trajectory

import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import InitializationError, simulate
from jaxonomy_dae.testing import assert_energy_balance

TS = np.linspace(0.0, 2.0, 9)
TIGHT = dict(rtol=1e-9, atol=1e-11)
# rtol 1e-9 for each of fewer than 500 steps; SciPy's references carry 1e-10 or better.
MEASURED = 5e-7


def integrated(slopes, start, ts=TS):
    """SciPy's DOP853."""
    return scipy.integrate.solve_ivp(slopes, (ts[0], ts[-1]), start, "DOP853", t_eval=ts, rtol=1e-11, atol=1e-12).y


def damped(m, k, d, force, x0, v0):
    """m·x'' + d·x' + k·x = force, underdamped."""
    a, rest = d / (2 * m), force / k
    w = np.sqrt(k / m - a * a)
    c = x0 - rest
    return rest + np.exp(-a * TS) * (c * np.cos(w * TS) + (v0 + a * c) / w * np.sin(w * TS))


# --- single components, side by side in one model ------------------------------------------------------------------


@functools.cache
def components():
    """The model, its inputs, and what each of its variables must be at TS."""
    b, expected, inputs = Bench(), {}, {}
    world = b(pl.World, "world", 0.3, -0.2, 0.4)
    x0, y0, turned = 0.3, -0.2, 0.4

    # A point mass on a link without mass: the angle equation, and the force in the link from the radial balance.
    pin = b(pl.Revolute, "pin", initial_angle=-1.2 - turned, initial_speed=0.5)
    link, bob = b(pl.Link, "link", 1.3), b(pl.Body, "bob", 0.7, 0.0)
    b.chain(world.frame, pin.frame_a, pin.frame_b, link.frame_a, link.frame_b, bob.frame)
    swing = angle_solution(-1.2, 0.5, TS, L=1.3, m=0.7)
    theta = np.unwrap(np.arctan2(swing.y, swing.x))
    expected |= {
        "pin.phi": theta - turned,
        "pin.omega": (swing.x * swing.vy - swing.y * swing.vx) / 1.3**2,
        "bob.x": x0 + swing.x,
        "bob.y": y0 + swing.y,
        "bob.vx": swing.vx,
        "bob.frame.fx": -2 * swing.lam * swing.x,
        "bob.frame.fy": -2 * swing.lam * swing.y,
    }

    # A uniform rod released at rest: the inertia about its end is m·L²/3, so it swings like a point at 2L/3.
    hinge, rod = b(pl.Revolute, "hinge", initial_angle=0.3 - turned, initial_speed=0.0), b(pl.MassiveLink, "rod", 1.5)
    b.chain(world.frame, hinge.frame_a, hinge.frame_b, rod.frame_a)
    expected |= {"rod.body.phi": elliptic_angle(0.3, TS, L=1.0)}

    # A torsion spring and damper at a pin: (I + m·c²)·phi'' + d·phi' + k·(phi − rest) = 0 without gravity.
    wrist = b(pl.Revolute, "wrist", initial_angle=0.6, initial_speed=-1.0)
    hand = b(pl.MassiveLink, "hand", 1.0, m=2.0, J=0.5, cx=0.4, cy=-0.3, g_y=0.0)
    coil, wall = b(rot.SpringDamper, "coil", 5.0, 0.4, 0.2), b(rot.FixedAngle, "wall")
    b.chain(world.frame, wrist.frame_a, wrist.frame_b, hand.frame_a, wall.flange, coil.flange_a)
    b.join(coil.flange_b, wrist.flange)
    expected |= {"wrist.phi": damped(0.5 + 2.0 * 0.25, 5.0, 0.4, 5.0 * 0.2, 0.6, -1.0)}

    # A slide on an incline, with a spring, a damper and a force along it; the incline carries the rest.
    slope = turned + 0.25
    slide, sled = (
        b(pl.Prismatic, "slide", 0.25, initial_position=0.5, initial_velocity=0.2),
        b(pl.Body, "sled", 1.6, 0.3),
    )
    free, falling = (
        b(pl.Prismatic, "free", 0.25, initial_position=0.0, initial_velocity=1.0),
        b(pl.Body, "falling", 0.8),
    )
    buffer, stop = b(line.SpringDamper, "buffer", 12.0, 0.9), b(line.FixedPosition, "stop")
    push = b(line.Force, "push")
    b.chain(world.frame, slide.frame_a, slide.frame_b, sled.frame, stop.flange, buffer.flange_a)
    b.join(buffer.flange_b, slide.flange, push.flange)
    b.chain(world.frame, free.frame_a, free.frame_b, falling.frame)
    inputs |= {"push.f": 3.0}
    s = damped(1.6, 12.0, 0.9, 3.0 - 1.6 * GRAVITY * np.sin(slope), 0.5, 0.2)
    fallen = TS - GRAVITY * np.sin(slope) * TS**2 / 2
    weight = 0.8 * GRAVITY * np.cos(slope)
    expected |= {
        "slide.s": s,
        "sled.x": x0 + s * np.cos(slope),
        "sled.y": y0 + s * np.sin(slope),
        "sled.phi": np.full_like(TS, turned),
        "free.s": fallen,
        "free.frame_b.fx": weight * np.sin(slope) * np.ones_like(TS),
        "free.frame_b.fy": -weight * np.cos(slope) * np.ones_like(TS),
        "free.frame_a.tau": weight * fallen,
    }

    # Two bodies on a spring and damper: distance r and direction of the line, and the common drift.
    m, n, c, d, rest = 1.2, 0.8, 9.0, 0.3, 0.6
    left = b(pl.Body, "left", m, 0.1, g_y=0.0, initial_x=0.0, initial_y=0.0, initial_vx=0.1, initial_vy=-0.3,
             initial_angle=0.0, initial_speed=0.7)  # fmt: skip
    right = b(pl.Body, "right", n, 0.1, g_y=0.0, initial_x=1.0, initial_y=0.0, initial_vx=0.4, initial_vy=0.9,
              initial_angle=0.0, initial_speed=0.0)  # fmt: skip
    rope = b(pl.SpringDamper, "rope", c, d, rest)
    b.chain(left.frame, rope.frame_a, rope.frame_b, right.frame)
    reduced, spin = m * n / (m + n), 1.2  # the line turns at 1.2 rad/s at the start: r²·dα/dt is conserved

    def two_bodies(t, state):
        r, v, _ = state
        return [v, spin**2 / r**3 - (c * (r - rest) + d * v) / reduced, spin / r**2]

    r, v, alpha = integrated(two_bodies, [1.0, 0.3, 0.0])
    centre_x, centre_y = (n * 1.0 + (m * 0.1 + n * 0.4) * TS) / (m + n), (-m * 0.3 + n * 0.9) * TS / (m + n)
    expected |= {
        "rope.s": r,
        "rope.v": v,
        "rope.f": c * (r - rest) + d * v,
        "left.x": centre_x - n / (m + n) * r * np.cos(alpha),
        "left.y": centre_y - n / (m + n) * r * np.sin(alpha),
        "right.x": centre_x + m / (m + n) * r * np.cos(alpha),
        "left.phi": 0.7 * TS,
    }

    # A force and a torque on a free body; a force at the end of a lever on a pinned one.
    puck = b(pl.Body, "puck", 2.0, 0.4, g_x=0.5, initial_x=1.0, initial_y=2.0, initial_angle=0.1, initial_vx=-1.0,
             initial_vy=0.0, initial_speed=0.0)  # fmt: skip
    force, torque = b(pl.Force, "force"), b(pl.Torque, "torque")
    b.join(puck.frame, force.frame, torque.frame)
    inputs |= {"force.fx": 3.0, "force.fy": -1.0, "torque.tau": lambda t: 0.2 * t}
    axle, wheel = b(pl.Revolute, "axle", initial_angle=0.0, initial_speed=0.0), b(pl.Body, "wheel", 1.0, 0.5, g_y=0.0)
    arm, pull = b(pl.Link, "arm", 0.6, -0.2), b(pl.Force, "pull")
    b.chain(world.frame, axle.frame_a, arm.frame_b, pull.frame)
    b.join(axle.frame_b, wheel.frame, arm.frame_a)
    inputs |= {"pull.fx": 1.5, "pull.fy": 0.8}

    def lever(t, state):
        phi = state[0]
        at_x, at_y = 0.6 * np.cos(phi) + 0.2 * np.sin(phi), 0.6 * np.sin(phi) - 0.2 * np.cos(phi)
        return [state[1], (at_x * 0.8 - at_y * 1.5) / 0.5]

    phi, omega = integrated(lever, [turned, 0.0])
    expected |= {
        "puck.x": 1.0 - TS + (3.0 / 2.0 + 0.5) * TS**2 / 2,
        "puck.y": 2.0 + (-1.0 / 2.0 - GRAVITY) * TS**2 / 2,
        "puck.phi": 0.1 + 0.2 / 0.4 * TS**3 / 6,
        "wheel.phi": phi,
        "axle.omega": omega,
    }

    # Sensors on two arms that turn as prescribed.
    ends = []
    for name, length, motion in (("one", 0.9, lambda t: 0.8 * t), ("two", 0.5, lambda t: jnp.sin(t))):
        shaft, turn, reach = (
            b(pl.Revolute, f"{name}_pin"),
            b(rot.AngleSource, f"{name}_angle"),
            b(pl.Link, name, length),
        )
        b.chain(world.frame, shaft.frame_a, turn.flange, shaft.flange, shaft.frame_b, reach.frame_a)
        inputs[f"{name}_angle.u"] = motion
        ends.append(reach.frame_b)
    # At the end of the first, a detour: 0.3 along a line at 0.4 with axes turned by 0.7 there, and back.
    there, back = (
        b(pl.Link, "there", 0.3 * np.cos(0.4), 0.3 * np.sin(0.4), 0.7),
        b(pl.Link, "back", -0.3 * np.cos(0.3), 0.3 * np.sin(0.3), -0.7),
    )
    b.chain(ends[0], there.frame_a, there.frame_b, back.frame_a)
    ends[0] = back.frame_b
    seen, between = b(pl.AbsoluteSensor, "seen"), b(pl.RelativeSensor, "between")
    b.join(seen.frame, between.frame_a, ends[0])
    b.join(between.frame_b, ends[1])
    one, two = turned + 0.8 * TS, turned + np.sin(TS)
    gap, speed = two - one, np.cos(TS) - 0.8
    expected |= {
        "seen.x": x0 + 0.9 * np.cos(one),
        "seen.y": y0 + 0.9 * np.sin(one),
        "seen.phi": one,
        "seen.vx": -0.9 * 0.8 * np.sin(one),
        "seen.vy": 0.9 * 0.8 * np.cos(one),
        "seen.omega": np.full_like(TS, 0.8),
        "between.x": 0.5 * np.cos(gap) - 0.9,
        "between.y": 0.5 * np.sin(gap),
        "between.phi": gap,
        "between.vx": -0.5 * np.sin(gap) * speed,
        "between.vy": 0.5 * np.cos(gap) * speed,
        "between.omega": speed,
    }
    return b.compile(), inputs, expected


SWING = "the angle equation of a pendulum, and the radial balance"
SLOPE = "closed forms of a slide on an incline"
PUSHED = "polynomials in time of a free body"
TURNED = "trigonometry of two arms that turn as prescribed"


@pytest.mark.slow
@checks(
    {
        pl.World: (SWING, "bob.x", "bob.y", "pin.phi"),
        pl.Body: (
            f"{SWING}; {PUSHED}", "bob.x", "bob.y", "bob.vx", "bob.frame.fx", "bob.frame.fy", "puck.x", "puck.phi",
        ),
        pl.Link: (f"{SWING}; arms that turn as prescribed", "bob.x", "bob.y", "bob.frame.fx", "bob.frame.fy", "seen.x"),
        pl.MassiveLink: ("Jacobi's elliptic functions of a rod, and a damped oscillation", "rod.body.phi", "wrist.phi"),
        pl.Revolute: (f"{SWING}; a damped oscillation", "pin.phi", "pin.omega", "wrist.phi"),
        pl.Prismatic: (
            SLOPE, "slide.s", "sled.x", "sled.y", "free.s", "free.frame_b.fx", "free.frame_b.fy", "free.frame_a.tau",
        ),
        pl.SpringDamper: ("SciPy's DOP853 of two bodies' distance", "rope.s", "rope.v", "rope.f", "left.x", "right.x"),
        pl.Force: (f"{PUSHED}, and of a lever", "puck.x", "puck.y", "wheel.phi", "axle.omega"),
        pl.Torque: (PUSHED, "puck.phi"),
        pl.AbsoluteSensor: (TURNED, *(f"seen.{k}" for k in ("x", "y", "phi", "vx", "vy", "omega"))),
        pl.RelativeSensor: (TURNED, *(f"between.{k}" for k in ("x", "y", "phi", "vx", "vy", "omega"))),
    },
    origin="rtol 1e-9 for each of fewer than 500 steps",
)  # fmt: skip
def test_components_against_references():
    system, inputs, expected = components()
    solution = simulate(system, 2.0, ts=TS, inputs=inputs, **TIGHT)
    for name, true in expected.items():
        measured(name, solution[name], true, MEASURED * np.abs(true).max())


@pytest.mark.slow
def test_energy_of_components():
    system, inputs, _ = components()
    # As many times as above: the same program.
    solution = simulate(system, 1.0, ts=np.linspace(0.0, 1.0, len(TS)), inputs=inputs, **TIGHT)
    assert_energy_balance(solution, rtol=1e-7)  # a hundred times the tolerance


# --- double pendulum -----------------------------------------------------------------------------------------------

RODS = {"a.m": 1.0, "a.rx": 1.0, "b.m": 0.5, "b.rx": 0.8, "j1.initial_angle": 0.3, "j2.initial_angle": 0.5}


def double_reference(ts, values):
    """Lagrange's equations of two uniform rods in their angles from the x axis; (angle, angle, speed, speed)."""
    m1, l1, m2, l2, start1, start2 = values
    j1, j2, arm = m1 * l1**2 / 3 + m2 * l1**2, m2 * l2**2 / 3, m2 * l1 * l2 / 2

    def slopes(t, state):
        p, q, u, v = state
        mass = [[j1, arm * np.cos(p - q)], [arm * np.cos(p - q), j2]]
        force = [
            -arm * np.sin(p - q) * v * v - (m1 / 2 + m2) * GRAVITY * l1 * np.cos(p),
            arm * np.sin(p - q) * u * u - m2 * GRAVITY * l2 / 2 * np.cos(q),
        ]
        return [u, v, *np.linalg.solve(mass, force)]

    return integrated(slopes, [start1, start1 + start2, 0.0, 0.0], ts)


def energy(solution, bodies, values):
    """Kinetic and potential energy of uniform rods, from masses and lengths."""
    total = 0.0
    for name in bodies:
        m, length = values[f"{name}.m"], values[f"{name}.rx"]
        vx, vy, w, y = (solution[f"{name}.body.{v}"] for v in ("vx", "vy", "omega", "y"))
        total += m / 2 * (vx**2 + vy**2) + m * length**2 / 24 * w**2 + m * GRAVITY * y
    return total


def compare_double_pendulum(solution):
    """Angles and speeds at TS with Lagrange's equations, and the energy at all times."""
    p, q, u, v = double_reference(TS, RODS.values())
    for name, true in {"j1.phi": p, "j2.phi": q - p, "j1.omega": u, "j2.omega": v - u}.items():
        found = solution[name][: len(TS)]  # later, the motion is chaotic: neighbours part
        np.testing.assert_allclose(found, true, rtol=0, atol=MEASURED * np.abs(true).max(), err_msg=name)
    total = np.asarray(energy(solution, "ab", RODS))
    # Of what is exchanged; 1e-9 for each of fewer than 5,000 steps.
    np.testing.assert_allclose(total, total[0], rtol=0, atol=5e-6 * GRAVITY * np.ptp(solution["a.body.y"]))


LONG = np.concatenate([TS, np.linspace(2.5, 20.0, 36)])


def test_double_pendulum():
    system = double_pendulum("dummy_derivatives")
    assert set(system.states) == {"a.body.phi", "a.body.omega", "b.body.phi", "b.body.omega"}
    names = [f"j{k}.{v}" for k in (1, 2) for v in ("phi", "omega")]
    names += [f"{rod}.body.{v}" for rod in "ab" for v in ("vx", "vy", "omega", "y")]
    compare_double_pendulum(trajectory(system, TS, names))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["auto", "dummy_derivatives"])
def test_runs_of_a_double_pendulum(mode):
    compare_double_pendulum(simulate(double_pendulum(mode), 20.0, ts=LONG, **TIGHT))


# --- four-bar linkage ----------------------------------------------------------------------------------------------

BARS = {"crank.m": 1.0, "crank.rx": 0.8, "coupler.m": 0.6, "coupler.rx": 1.9, "rocker.m": 1.5, "rocker.rx": 1.5,
        "east.x": 2.0, "j1.initial_angle": 1.0, "j1.initial_speed": 5.0}  # fmt: skip


def loop(phi, crank, coupler, rocker, ground):
    """The angles of coupler and rocker, and their derivatives by the crank's angle, of an open four-bar loop: two
    circles meet, above the line between their centres."""
    x, y = ground - crank * np.cos(phi), -crank * np.sin(phi)  # from the crank's end to the rocker's pin
    span = np.hypot(x, y)
    at = np.arctan2(y, x) + np.arccos((coupler**2 + span**2 - rocker**2) / (2 * coupler * span))
    end_x, end_y = coupler * np.cos(at) - x, coupler * np.sin(at) - y
    swing = np.arctan2(end_y, end_x)
    # crank·e'(phi) + coupler·e'(at)·at' = rocker·e'(swing)·swing', along the rocker and along the coupler.
    slope_at = -crank * np.sin(phi - swing) / (coupler * np.sin(at - swing))
    slope_swing = crank * np.sin(phi - at) / (rocker * np.sin(swing - at))
    return at, swing, slope_at, slope_swing


def four_bar_reference(ts, values):
    """The crank's angle and speed: J(phi)·phi'' + J'(phi)·phi'²/2 + U'(phi) = 0, with the loop solved in closed form
    and J', U' by central differences of order six."""
    m1, l1, m2, l2, m3, l3, ground, start, speed = values
    weights, h = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60, 2e-3

    def inertia_and_potential(phi):
        at, swing, da, ds = loop(phi, l1, l2, l3, ground)
        vx, vy = -l1 * np.sin(phi) - l2 / 2 * np.sin(at) * da, l1 * np.cos(phi) + l2 / 2 * np.cos(at) * da
        inertia = m1 * l1**2 / 3 + m2 * (vx**2 + vy**2 + (l2 * da) ** 2 / 12) + m3 * (l3 * ds) ** 2 / 3
        height = m1 * l1 / 2 * np.sin(phi) + m2 * (l1 * np.sin(phi) + l2 / 2 * np.sin(at)) + m3 * l3 / 2 * np.sin(swing)
        return inertia, GRAVITY * height

    def slopes(t, state):
        phi, w = state
        inertia, potential = inertia_and_potential(phi + h * np.arange(-3, 4))
        return [w, -(weights @ inertia / h * w * w / 2 + weights @ potential / h) / inertia[3]]

    return integrated(slopes, [start, speed], ts)


@pytest.mark.slow
def test_four_bar_linkage():
    solution = simulate(four_bar(), 2.0, ts=TS, **TIGHT)
    phi, speed = four_bar_reference(TS, BARS.values())
    # Differences of order six with a step of 2e-3 leave 1e-13 of truncation and 1e-13 of rounding.
    np.testing.assert_allclose(solution["j1.phi"], phi, rtol=0, atol=MEASURED * np.abs(phi).max())
    np.testing.assert_allclose(solution["j1.omega"], speed, rtol=0, atol=MEASURED * np.abs(speed).max())
    at, swing, da, ds = loop(np.asarray(solution["crank.body.phi"]), 0.8, 1.9, 1.5, 2.0)
    w = np.asarray(solution["crank.body.omega"])
    for name, true in {"coupler.body.phi": at, "rocker.body.phi": swing, "coupler.body.omega": da * w,
                       "j4.omega": ds * w, "j2.phi": at - solution["crank.body.phi"]}.items():  # fmt: skip
        # Positions and speeds are projected onto the loop at saved times, to rounding.
        np.testing.assert_allclose(solution[name], true, rtol=0, atol=1e-12 * np.abs(true).max(), err_msg=name)
    total = np.asarray(energy(solution, ("crank", "coupler", "rocker"), BARS))
    np.testing.assert_allclose(total, total[0], rtol=MEASURED)


@pytest.mark.slow
def test_guesses_choose_the_position_of_a_loop():
    crossed = four_bar(coupler_at=-1.2, rocker_at=-2.3)
    names = ["coupler.body.phi", "rocker.body.phi"]
    # The mirror image of the open position in the line from the crank's end to the rocker's pin.
    at, swing, *_ = loop(1.0, 0.8, 1.9, 1.5, 2.0)
    line_angle = np.arctan2(-0.8 * np.sin(1.0), 2.0 - 0.8 * np.cos(1.0))
    observe = jax.jit(lambda system, x: system.observe(names, 0.0, x))
    for system, true in ((four_bar(), [at, swing]), (crossed, [2 * line_angle - at, 2 * line_angle - swing])):
        np.testing.assert_allclose(observe(system, system.initialize()), true, rtol=0, atol=1e-12)


# --- Andrews' squeezing mechanism ----------------------------------------------------------------------------------


ANGLES = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")


@pytest.mark.slow
def test_andrews_mechanism_of_bodies_and_pins():
    facts = load("andrews")
    system, inputs = squeezing_mechanism(facts), {"torque.tau": facts["parameters"]["mom"]}
    names = [f"{n}.phi" for n in ANGLES] + [f"{n}.omega" for n in ANGLES]
    start = system.observe(names, 0.0, system.initialize(inputs=inputs), inputs)
    # Starts are found to rounding: 1e-12 of angles of about 1.
    np.testing.assert_allclose(start, facts["initial"]["y0"][:14], rtol=0, atol=1e-11)
    solution = simulate(system, 0.03, ts=[0.03], rtol=1e-10, atol=1e-13, inputs=inputs)
    found = np.array([solution[n][0] for n in names])
    # Published to 9.6 digits of positions and 7.3 of speeds, of vectors of 16 and 1,400.
    np.testing.assert_allclose(found[:7], facts["reference"]["y"][:7], rtol=0, atol=4e-9)
    np.testing.assert_allclose(found[7:], facts["reference"]["y"][7:14], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_two_pins_between_two_bodies():
    """The force along the line between the pins is not determined."""
    b = Bench()
    world, hinge = b(pl.World, "world"), b(pl.Revolute, "hinge")
    one, other = b(pl.MassiveLink, "one"), b(pl.MassiveLink, "other")
    near, far = b(pl.Revolute, "near"), b(pl.Revolute, "far")
    b.chain(world.frame, hinge.frame_a, one.frame_b, far.frame_a, far.frame_b, other.frame_b)
    b.join(hinge.frame_b, one.frame_a, near.frame_a)
    b.join(near.frame_b, other.frame_a)
    with pytest.raises(InitializationError, match="singular"):
        b.compile().initialize()
