"""Brakes, clutches and friction that sticks against closed forms and SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from component_references import checks, measured
from problems import compiled
from switched_runs import EXACT, ORIGIN, SMOOTH, TIGHT, events, ran
from sympy import cos, sin

import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import Component, Eq, EqnEnv, Rotational, Translational, simulate
from jaxonomy_dae.library.friction import Brake, Clutch, OneWayClutch, StickingFriction


@pytest.mark.slow
@checks({Brake: ("parabola of the angle, and its derivative by mu", "J.w", "J.phi", "events", "slope")}, origin=ORIGIN)
def test_a_brake():
    """w falls at the rate r = mu·cgeo·fn_max·u/J, to rest at w₀/r after the angle w₀²/2r: dphi/dmu = −phi/mu."""
    ev = EqnEnv()
    inertia = rot.Inertia(ev, "J", 2.0, initial_angle=0.0, initial_speed=3.0)
    brake = Brake(ev, "brake", mu=0.4, fn_max=10.0, cgeo=1.5)
    system = compiled(inertia, brake, connect=[(inertia.flange_b, brake.flange)])
    rate = 0.4 * 10 * 1.5 * 0.5 / 2

    def run(mu):
        changed = system.with_parameters({"brake.mu": mu})
        return simulate(changed, 3.0, ts=jnp.array([1.0, 2.5, 3.0]), inputs={"brake.u": 0.5}, **TIGHT)

    solution = run(0.4)
    measured("J.w", solution["J.w"], [3 - rate, 0, 0], SMOOTH)
    measured("J.phi", solution["J.phi"], [3 - rate / 2, 4.5 / rate, 4.5 / rate], SMOOTH)
    measured("events", events(solution), [3 / rate], SMOOTH)
    np.testing.assert_array_equal(solution["brake.mode"], [1, 0, 0])
    slope = jax.jit(jax.grad(lambda mu: run(mu)["J.phi"][-1]))(0.4)
    measured("slope", slope, -4.5 / rate / 0.4, SMOOTH * 4.5 / rate / 0.4)


# A mass behind a spring whose end moves at a constant speed: kg, N/m, m/s, N, N.
MASS, STIFFNESS, SPEED, SLIDING, BREAKAWAY = 1.0, 4.0, 0.5, 1.0, 2.0
# A driven inertia, the one behind a freewheel, and its damper: kg·m², kg·m², N·m·s.
INERTIA, BEHIND, DAMPING = 1.0, 0.5, 0.3
FREE = np.linspace(0.0, 12.0, 25)


def den_hartog():
    """(times, when it breaks loose and sticks, positions)"""
    m, k, V, sliding, breakaway = MASS, STIFFNESS, SPEED, SLIDING, BREAKAWAY
    # In s since it broke loose at t₁, with the spring stretched by e = Fs/k: m·x'' = k·(e + V·s − x) − Fd.
    w, b = np.sqrt(k / m), (breakaway - sliding) / k
    t1 = breakaway / (k * V)
    # x = V·s + b − b·cos(ws) − V/w·sin(ws), and x' = V − V·cos(ws) + b·w·sin(ws) = 0 at ws = 2·(π − atan(b·w/V)).
    slip = 2 * (np.pi - np.arctan(b * w / V)) / w
    # Where it comes to rest the spring is as much too short as it was too long: Fd − (Fs − Fd).
    wait = 2 * (breakaway - sliding) / (k * V)
    s = np.array([0.3, 0.9]) * slip
    ts = np.concatenate([[0.5 * t1], t1 + s, [t1 + slip + 0.5 * wait], t1 + slip + wait + s])
    x = V * s + b - b * np.cos(w * s) - V / w * np.sin(w * s)
    moved = V * slip + 2 * b
    return ts, [t1, t1 + slip, t1 + slip + wait], np.array([0, *x, moved, *(moved + x)])


@functools.cache
def rubbing():
    """Stick and slip, and a freewheel, in one run of 12 s."""
    ev = EqnEnv()
    mass = line.Mass(ev, "m", MASS, initial_position=0.0, initial_velocity=0.0)
    pull, spring = line.SpeedSource(ev, "pull"), line.Spring(ev, "s", STIFFNESS)
    wall, friction = line.FixedPosition(ev, "wall"), StickingFriction(ev, "f", SLIDING, BREAKAWAY)
    torque = rot.Torque(ev, "drive")
    first = rot.Inertia(ev, "a", INERTIA, initial_angle=0.0, initial_speed=0.0)
    second = rot.Inertia(ev, "b", BEHIND, initial_angle=0.0, initial_speed=0.2)
    wheel, damper, ground = OneWayClutch(ev, "c"), rot.Damper(ev, "d", DAMPING), rot.FixedAngle(ev, "g")
    system = compiled(
        mass, pull, spring, wall, friction, torque, first, second, wheel, damper, ground,
        connect=[
            (pull.flange, spring.flange_a), (spring.flange_b, mass.flange, friction.flange_b),
            (wall.flange, friction.flange_a),
            (torque.flange, first.flange_a), (first.flange_b, wheel.flange_a), (wheel.flange_b, second.flange_a),
            (second.flange_b, damper.flange_a), (damper.flange_b, ground.flange),
        ],
    )  # fmt: skip
    ts = np.unique([*den_hartog()[0], *FREE])
    names, inputs = ["m.s", "f.mode", "a.w", "b.w", "c.tau", "c.w_rel"], {"pull.u": SPEED, "drive.tau": jnp.sin}
    return ran(system, 12.0, ts, names, {}, inputs)


class Yoke(Component):
    """A scotch yoke: s = r·sin(φ)."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.port("a", Rotational), self.port("b", Translational)
        r = self.parameter("r", 0.1)
        self.add_equations(Eq(b.s, r * sin(a.phi)), Eq(a.tau + r * cos(a.phi) * b.f, 0))


@pytest.mark.slow
def test_friction_beyond_a_dead_centre():
    """Where a yoke turns back its speed is zero, and its crank goes on. J·w²/2 is less by F times the way of the yoke,
    r·(2 − sin φ) behind the first dead centre, whatever F is."""
    ev = EqnEnv()
    crank, yoke = rot.Inertia(ev, "crank", 0.02, initial_angle=0.0, initial_speed=20.0), Yoke(ev, "yoke")
    wall, friction = line.FixedPosition(ev, "wall"), StickingFriction(ev, "f", 5.0)
    system = compiled(
        crank, yoke, wall, friction,
        connect=[(crank.flange_b, yoke.a), (yoke.b, friction.flange_b), (friction.flange_a, wall.flange)],
    )  # fmt: skip

    @jax.value_and_grad
    def energy(force):
        run = simulate(system.with_parameters({"f.sliding": force}), 0.25, ts=jnp.array([0.25]), **TIGHT)
        phi, w = run[["crank.phi", "crank.w"]][0]
        return 0.01 * w**2 + force * 0.1 * (2 - jnp.sin(phi))

    value, slope = energy(5.0)
    assert float(value) == pytest.approx(4.0, rel=SMOOTH)
    assert abs(float(slope)) < SMOOTH


@pytest.mark.slow
@checks(
    {StickingFriction: ("Den Hartog's closed form of stick and slip", "m.s", "events")},
    origin=ORIGIN,
)
def test_stick_and_slip():
    """A mass behind a spring whose end moves at the speed V: it sticks until k·V·t = Fs, and slips as
    x = V·s + b + A·cos(ws + p) until its speed is zero again (Den Hartog 1956, Mechanical Vibrations, section 7.6)."""
    ts, times, s = den_hartog()
    run = rubbing()
    measured("events", run.events("f")[:3], times, SMOOTH)
    measured("m.s", run.values("m.s", ts), s, SMOOTH)
    np.testing.assert_array_equal(run.values("f.mode", ts), [0, 1, 1, 0, 1, 1])


@pytest.mark.slow
def test_friction_does_not_hold_a_prescribed_motion():
    """Kind: a mode that cannot hold what it is to hold. The friction of parts that are moved by a source had the wrong
    sign where they turned back: sticking and breaking away followed each other without end. Friction has the sign of
    the speed, whichever flange moves."""
    ev = EqnEnv()
    wall, shift = line.FixedPosition(ev, "wall"), line.PositionSource(ev, "shift")
    one, other = StickingFriction(ev, "one", SLIDING, BREAKAWAY), StickingFriction(ev, "other", SLIDING, BREAKAWAY)
    turn, shaft, gear = rot.AngleSource(ev, "turn"), rot.Inertia(ev, "shaft", INERTIA), rot.IdealGear(ev, "gear", -3.0)
    brake = Brake(ev, "brake", mu=0.4, fn_max=10.0, cgeo=1.5, peak=1.5)
    system = compiled(
        wall, shift, one, other, turn, shaft, gear, brake,
        connect=[
            (wall.flange, one.flange_a, other.flange_b), (shift.flange, one.flange_b, other.flange_a),
            (turn.flange, shaft.flange_a), (shaft.flange_b, gear.flange_a), (gear.flange_b, brake.flange),
        ],
    )  # fmt: skip
    # Not at 0.25 and 0.75, where both turn back.
    ts = jnp.array([0.1, 0.24, 0.26, 0.6, 0.74, 0.76, 1.0])
    inputs = {"shift.u": lambda t: 0.1 * jnp.sin(2 * np.pi * t), "turn.u": lambda t: 0.2 * jnp.sin(2 * np.pi * t)}
    solution = simulate(system, 1.0, ts=ts, inputs={**inputs, "brake.u": 1.0})
    sign = np.sign(np.cos(2 * np.pi * np.asarray(ts)))
    np.testing.assert_array_equal(np.sign(solution["brake.w"]), np.sign(solution["brake.flange.tau"]))
    np.testing.assert_allclose(np.abs(solution["brake.flange.tau"]), 6.0, rtol=1e-12)
    np.testing.assert_allclose(solution["one.f"], SLIDING * sign, rtol=1e-12)
    np.testing.assert_allclose(solution["other.f"], -SLIDING * sign, rtol=1e-12)


@pytest.mark.slow
def test_a_freewheel_that_begins_by_slipping_the_wrong_way():
    """J·w is conserved where flange_b catches up at once: it stayed slower by 10 rad/s, "locked"."""
    ev = EqnEnv()
    wheel, a, b = OneWayClutch(ev, "c"), rot.Inertia(ev, "a", 1.0), rot.Inertia(ev, "b", 2.0)
    system = compiled(a, wheel, b, connect=[(a.flange_b, wheel.flange_a), (wheel.flange_b, b.flange_a)])
    still = {"a.phi": 0.0, "b.phi": 0.0, "b.w": 0.0}
    solution = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), initial={"a.w": 10.0, **still})
    np.testing.assert_allclose(solution[["a.w", "b.w", "c.w_rel"]], [[10 / 3, 10 / 3, 0.0]] * 2, atol=1e-9)
    np.testing.assert_array_equal(solution["c.locked"], [1, 1])
    faster = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), initial={"a.w": -10.0, **still})
    np.testing.assert_allclose(faster[["a.w", "b.w"]], [[-10.0, 0.0]] * 2, atol=1e-9)


@pytest.mark.slow
@checks({OneWayClutch: ("SciPy's DOP853 from switch to switch", "a.w", "b.w", "events")}, origin=ORIGIN)
def test_a_freewheel():
    """A driven inertia and one that coasts behind a damper, J·w' = sin t and J₂·w' = −d·w while it runs free; SciPy
    from switch to switch."""
    J, J2, d = INERTIA, BEHIND, DAMPING
    ts = FREE

    def slopes(locked):
        def f(t, x):
            a, b = (np.sin(t) / J, -d * x[1] / J2)
            if locked:
                a = b = (np.sin(t) - d * x[1]) / (J + J2)
            return [a, b]

        return f

    def guard(locked):  # falls where the wheel locks, or comes free
        return lambda t, x: slopes(True)(t, x)[1] * J2 + d * x[1] if locked else x[1] - x[0]

    t, x, locked, rows, switched = 0.0, [0.0, 0.2], False, [], []
    while t < ts[-1]:
        event = guard(locked)
        event.terminal, event.direction = True, -1.0
        run = scipy.integrate.solve_ivp(
            slopes(locked), (t, ts[-1]), x, "DOP853", dense_output=True, events=event, max_step=0.1, **EXACT
        )
        rows.append(run.sol(ts[(ts >= t) & ((ts < run.t[-1]) | (run.status == 0))]))
        t, x, locked = run.t[-1], run.y[:, -1], not locked
        if run.status:
            switched.append(t)
    found = rubbing()
    measured("events", found.events("c"), switched, SMOOTH)
    for name, true in zip(("a.w", "b.w"), np.concatenate(rows, axis=1), strict=True):
        measured(name, found.values(name, ts), true, SMOOTH)
    # It pushes one way only, and never runs backwards.
    assert np.min(found.values("c.tau", ts)) > -1e-9 and np.min(found.values("c.w_rel", ts)) > -1e-9


@pytest.mark.slow
def test_a_clutch_that_locks():
    """Inertias of 1 and 2 kg·m² at 10 and 0 rad/s, 3 N·m on the first one and a slip torque of 8 N·m between them: they
    turn together from 10/9 s on, as 19/3 rad/s at t = 3."""
    ev = EqnEnv()
    driven = rot.Inertia(ev, "J1", 1.0, initial_angle=0.0, initial_speed=10.0)
    load = rot.Inertia(ev, "J2", 2.0, initial_angle=0.0, initial_speed=0.0)
    clutch, torque = Clutch(ev, "c", mu=0.5, fn_max=16.0), rot.Torque(ev, "drive")
    system = compiled(
        driven, load, clutch, torque,
        connect=[
            (torque.flange, driven.flange_a), (driven.flange_b, clutch.flange_a), (clutch.flange_b, load.flange_a)
        ],
    )  # fmt: skip
    end = np.array([3.0])
    run = ran(system, 3.0, end, ["J1.w", "J2.w", "J1.phi"], {"c.mu": 0.5}, {"c.u": 1.0, "drive.tau": 3.0})
    np.testing.assert_allclose(run.events("c"), [10 / 9], rtol=0, atol=SMOOTH)
    np.testing.assert_allclose([run.values(f"J{k}.w", end)[0] for k in (1, 2)], 19 / 3, rtol=SMOOTH)
    np.testing.assert_allclose(run.values("J1.phi", end), 18.2037037037037, rtol=SMOOTH)
    np.testing.assert_allclose(run.slopes("J1.phi", "c.mu", end) / 16.0, -0.617283950617284, rtol=SMOOTH)


COUPLED = [
    0.4, 0.70962147469375, 0.79166235915482, 0.83110850613765, 0.9, 0.90685019279788, 1.0002958598946, 1.1439674924732,
    1.25,
]  # fmt: skip
TURNED = 7.4861190991143


@functools.cache
def clutches():
    ev = EqnEnv()
    J = [rot.Inertia(ev, f"J{k}", 1.0, initial_angle=0.0, initial_speed=10.0 * (k == 1)) for k in range(1, 5)]
    c = [Clutch(ev, f"c{k}", mu=0.5, fn_max=20.0, peak=1.1) for k in range(1, 4)]
    torque = rot.Torque(ev, "drive")
    joined = [(torque.flange, J[0].flange_a)]
    for k in range(3):
        joined += [(J[k].flange_b, c[k].flange_a), (c[k].flange_b, J[k + 1].flange_a)]
    return compiled(torque, *J, *c, connect=joined)


def coupled(mu, **options):
    inputs = {
        "drive.tau": lambda t: 10 * jnp.sin(2 * jnp.pi * 5 * t),
        "c1.u": lambda t: jnp.sin(2 * jnp.pi * 0.2 * t + jnp.pi / 2),
        "c2.u": lambda t: jnp.where(t < 0.4, 0.0, 1.0),
        "c3.u": lambda t: jnp.where(t < 0.9, 0.0, 1.0),
    }
    return simulate(
        clutches().with_parameters({"c1.mu": mu}), 1.5, ts=jnp.array([1.5]), inputs=inputs,
        jump_ts=jnp.array([0.4, 0.9]), **TIGHT, **options,
    )  # fmt: skip


@pytest.mark.slow
@checks(
    {Clutch: ("closed form of CoupledClutches, in extended precision", "events", "J1.phi")},
    origin=ORIGIN,
)
def test_coupled_clutches():
    """CoupledClutches of the Modelica Standard Library, against its closed form in extended precision; a Modelica
    tool's published event times are off by up to 4e-6 s."""
    solution = coupled(0.5)
    measured("events", events(solution), COUPLED, SMOOTH)
    measured("J1.phi", solution["J1.phi"][-1], TURNED, SMOOTH)


@pytest.mark.slow
def test_dry_frictions_in_a_row_of_which_the_weaker_slides():
    """Nothing has mass between them; the model was said to be singular. 2 m/s under 1 N end after 2 s and 2 m."""
    ev = EqnEnv()
    mass, wall = line.Mass(ev, "m", initial_position=0.0, initial_velocity=2.0), line.FixedPosition(ev, "wall")
    weak, strong = StickingFriction(ev, "weak", 1.0), StickingFriction(ev, "strong", 2.0)
    ends = (wall.flange, strong.flange_a), (strong.flange_b, weak.flange_a), (weak.flange_b, mass.flange)
    system = compiled(mass, wall, weak, strong, connect=ends)

    def rests(sliding):
        given = system.with_parameters({"weak.sliding": sliding})
        return simulate(given, 3.0, initial={"strong.v_rel": 0.0})["m.s"][-1]

    np.testing.assert_allclose(jax.value_and_grad(rests)(1.0), [2.0, -2.0], rtol=1e-7)
