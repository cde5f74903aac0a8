"""Translational and rotational components, and transmissions, against closed forms and SciPy."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from component_references import checks, measured
from problems import compiled
from trajectories import trajectory

import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.transmissions import LeadScrew, Planetary, RackAndPinion, Wheel
from jaxonomy_dae.testing import assert_energy_balance

TS = np.linspace(0.0, 2.0, 9)
W = 3.0  # rad/s of prescribed motions


def oscillator(m, k, d, force, x0, v0):
    """m·x'' + d·x' + k·x = force, underdamped."""
    a, rest = d / (2 * m), force / k
    w = np.sqrt(k / m - a * a)
    c = x0 - rest
    return rest + np.exp(-a * TS) * (c * np.cos(w * TS) + (v0 + a * c) / w * np.sin(w * TS))


def oscillator_speed(m, k, d, force, x0, v0):
    """Its derivative."""
    a, rest = d / (2 * m), force / k
    w = np.sqrt(k / m - a * a)
    return np.exp(-a * TS) * (v0 * np.cos(w * TS) - (k / m * (x0 - rest) + a * v0) / w * np.sin(w * TS))


def integrated(slopes, start):
    return scipy.integrate.solve_ivp(slopes, (0.0, 2.0), start, "Radau", t_eval=TS, rtol=1e-10, atol=1e-12).y


def dead_zone(s, gap, smooth):
    def ramp(e):
        return (e + np.sqrt(e * e + smooth**2)) / 2, (1 + e / np.sqrt(e * e + smooth**2)) / 2

    (up, up_slope), (down, down_slope) = ramp(s - gap / 2), ramp(-s - gap / 2)
    return up - down, up_slope + down_slope


def friction(v, sliding, breakaway, fades, viscous, smooth):
    return (sliding + (breakaway - sliding) * np.exp(-((v / fades) ** 2))) * np.tanh(v / smooth) + viscous * v


@functools.cache
def model():
    """Everything side by side; what each must do at TS."""
    ev, parts, joined, expected, moved_by = EqnEnv(), [], [], {}, {}

    def add(kind, name, *args, **kwargs):
        parts.append(kind(ev, name, *args, **kwargs))
        return parts[-1]

    def join(*ends):
        joined.append(ends)

    for d, mass, mass_start in (
        (line, line.Mass, ("initial_position", "initial_velocity")),
        (rot, rot.Inertia, ("initial_angle", "initial_speed")),
    ):
        t = "t" if d is line else "r"
        fixed, push = (line.FixedPosition, line.Force) if d is line else (rot.FixedAngle, rot.Torque)
        position, speed = ("s", "v") if d is line else ("phi", "w")

        def body(name, m, x0, v0, mass=mass, mass_start=mass_start):
            part = add(mass, name, m, **dict(zip(mass_start, (x0, v0), strict=True)))
            return part, getattr(part, "flange" if mass is line.Mass else "flange_a")

        wall = add(fixed, f"{t}_wall").flange
        laws = {
            "soft": (d.SpringDamper, (40.0, 1.5), None),
            "hard": (d.NonlinearSpring, (3.0, 5.0), lambda s, v: 3.0 * s + 5.0 * s**3),
            "play": (
                d.Backlash, (0.4, 50.0, 0.5, 0.01),
                lambda s, v: 50.0 * dead_zone(s, 0.4, 0.01)[0] + 0.5 * dead_zone(s, 0.4, 0.01)[1] * v,
            ),
            "rub": (d.Friction, (0.8, 1.2, 0.3, 0.1, 0.05), lambda s, v: friction(v, 0.8, 1.2, 0.3, 0.1, 0.05)),
        }  # fmt: skip
        for name, (kind, values, law) in laws.items():
            part = add(kind, f"{t}_{name}", *values)
            moved, flange = body(f"{t}_{name}_m", 2.0, 0.3, 1.0)
            join(wall, part.flange_a)
            if law is None:  # pushed, and weighed
                scale = add(d.ForceSensor if d is line else d.TorqueSensor, f"{t}_scale")
                at, fast = (
                    add(d.PositionSensor if d is line else d.AngleSensor, f"{t}_at"),
                    add(d.SpeedSensor, f"{t}_fast"),
                )
                join(part.flange_b, scale.flange_a)
                join(scale.flange_b, flange, add(push, f"{t}_push").flange, at.flange, fast.flange)
                x = oscillator(2.0, 40.0, 1.5, 6.0, 0.3, 1.0)
                v = oscillator_speed(2.0, 40.0, 1.5, 6.0, 0.3, 1.0)
                # The scale lies between the spring, which pulls back, and the mass.
                expected |= {f"{moved.name}.{position}": x, f"{t}_at.y": x, f"{t}_fast.y": v}
                expected |= {f"{t}_scale.y": -(40.0 * x + 1.5 * v)}
            else:
                join(part.flange_b, flange)
                if name not in moved_by:  # the laws are the same on shafts
                    moved_by[name] = integrated(lambda _, s, law=law: [s[1], -law(*s) / 2.0], [0.3, 1.0])
                x, v = moved_by[name]
                expected |= {f"{moved.name}.{position}": x, f"{moved.name}.{speed}": v}
        source = add(d.PositionSource if d is line else d.AngleSource, f"{t}_moved")
        load, flange = (add(line.Mass, "t_load", 1.5), None) if d is line else (add(rot.Inertia, "r_load", 1.5), None)
        flange = load.flange if d is line else load.flange_a
        weigh = add(d.ForceSensor if d is line else d.TorqueSensor, f"{t}_weigh")
        join(source.flange, weigh.flange_a)
        join(weigh.flange_b, flange)
        expected[f"{t}_weigh.y"] = -1.5 * 0.2 * W**2 * np.sin(W * TS)
        drive = add(d.SpeedSource, f"{t}_drive", 0.7)
        meter = add(d.SpeedSensor, f"{t}_meter")
        join(drive.flange, meter.flange)
        expected |= {f"{t}_drive.{position}": 0.7 + (1 - np.cos(W * TS)) / W, f"{t}_meter.y": np.sin(W * TS)}

    # Two masses on a rod, between a spring, a damper and walls: one mass, pulled to a + length − k·…; the rod carries
    # what the first mass needs besides its spring.
    m1, m2, k, d, length, slack, left = 1.2, 0.8, 15.0, 0.6, 0.7, 0.25, -0.4
    first, second = add(line.Mass, "one", m1, 0.1, 0.5), add(line.Mass, "two", m2)
    bar, coil, oil = add(line.Rod, "bar", length), add(line.Spring, "coil", k, slack), add(line.Damper, "oil", d)
    west, east = add(line.FixedPosition, "west", left), add(line.FixedPosition, "east", 2.0)
    join(west.flange, coil.flange_a)
    join(coil.flange_b, first.flange, bar.flange_a)
    join(bar.flange_b, second.flange, oil.flange_a)
    join(oil.flange_b, east.flange)
    values = (m1 + m2, k, d, k * (left + slack), 0.1, 0.5)
    x, v = oscillator(*values), oscillator_speed(*values)
    pull, brake = k * (x - left - slack), -d * v
    carried = m1 * (brake - pull) / (m1 + m2) + pull  # m1·x'' = bar.f − pull
    expected |= {"one.s": x, "two.s": x + length, "coil.f": pull, "oil.f": brake, "bar.f": carried}

    # Sun driven by τ, inertias on all three: Lagrange's equations with the sun and the ring free.
    gear = add(Planetary, "gear", 3.0)
    rotors = [add(rot.Inertia, n, j, 0.0, 0.0) for n, j in (("sun", 0.5), ("ring", 2.0))]
    carrier, torque = add(rot.Inertia, "carrier", 1.0), add(rot.Torque, "torque")
    join(torque.flange, rotors[0].flange_a)
    join(rotors[0].flange_b, gear.sun)
    join(rotors[1].flange_a, gear.ring)
    join(carrier.flange_a, gear.carrier)
    share = np.array([1.0, 3.0]) / 4.0  # ∂carrier/∂(sun, ring)
    a = np.linalg.solve(np.diag([0.5, 2.0]) + np.outer(share, share), [1.2, 0.0])
    expected |= {"sun.phi": a[0] * TS**2 / 2, "ring.phi": a[1] * TS**2 / 2, "carrier.phi": share @ a * TS**2 / 2}

    for name, kind, value, ratio in (
        ("rack", RackAndPinion, 0.2, 0.2), ("screw", LeadScrew, 0.5, 0.5 / (2 * np.pi)), ("wheel", Wheel, 0.3, 0.3),
    ):  # fmt: skip
        part, shaft = add(kind, name, value), add(rot.Inertia, f"{name}_shaft", 0.1, 0.0, 0.0)
        sled, push = add(line.Mass, f"{name}_sled", 4.0), add(rot.Torque, f"{name}_torque")
        join(push.flange, shaft.flange_a)
        join(shaft.flange_b, part.shaft)
        join(part.line, sled.flange)
        expected[f"{name}_sled.s"] = ratio * 0.5 / (0.1 + ratio**2 * 4.0) * TS**2 / 2
    system = compiled(*parts, connect=joined)
    inputs = {"t_push.f": 6.0, "r_push.tau": 6.0, "torque.tau": 1.2}
    inputs |= {f"{n}_torque.tau": 0.5 for n in ("rack", "screw", "wheel")}
    inputs |= {f"{t}_moved.u": lambda t: 0.2 * jnp.sin(W * t) for t in "tr"}
    inputs |= {f"{t}_drive.u": lambda t: jnp.sin(W * t) for t in "tr"}
    return system, inputs, expected


OSCILLATION = "closed form of a damped oscillation"
RADAU = "SciPy's Radau of the law written anew"
DRIVEN = "the prescribed motion, and the force it takes"
LAGRANGE = "Lagrange's equations, solved by hand"


def pairs(t, d):
    """What is alike on lines and on shafts."""
    position, speed = ("s", "v") if t == "t" else ("phi", "w")
    moving, held, push, moved, at, scale = (
        (d.Mass, d.FixedPosition, d.Force, d.PositionSource, d.PositionSensor, d.ForceSensor)
        if t == "t"
        else (d.Inertia, d.FixedAngle, d.Torque, d.AngleSource, d.AngleSensor, d.TorqueSensor)
    )
    return {
        moving: (OSCILLATION, f"{t}_soft_m.{position}"),
        held: (OSCILLATION, f"{t}_soft_m.{position}"),
        push: (OSCILLATION, f"{t}_soft_m.{position}"),
        d.SpringDamper: (OSCILLATION, f"{t}_soft_m.{position}", f"{t}_scale.y"),
        at: (OSCILLATION, f"{t}_at.y"),
        d.SpeedSensor: (f"{OSCILLATION}; {DRIVEN}", f"{t}_fast.y", f"{t}_meter.y"),
        scale: (f"{OSCILLATION}; {DRIVEN}", f"{t}_scale.y", f"{t}_weigh.y"),
        moved: (DRIVEN, f"{t}_weigh.y"),
        d.SpeedSource: (DRIVEN, f"{t}_drive.{position}", f"{t}_meter.y"),
        d.NonlinearSpring: (RADAU, f"{t}_hard_m.{position}", f"{t}_hard_m.{speed}"),
        d.Backlash: (RADAU, f"{t}_play_m.{position}", f"{t}_play_m.{speed}"),
        d.Friction: (RADAU, f"{t}_rub_m.{position}", f"{t}_rub_m.{speed}"),
    }


@pytest.mark.slow
@checks(
    pairs("t", line)
    | pairs("r", rot)
    | {
        line.FixedPosition: (OSCILLATION, "one.s", "t_soft_m.s"),
        line.Spring: (OSCILLATION, "one.s", "coil.f"),
        line.Damper: (OSCILLATION, "one.s", "oil.f"),
        line.Rod: (f"{OSCILLATION}, with the force in the rod", "two.s", "bar.f"),
        Planetary: (LAGRANGE, "sun.phi", "ring.phi", "carrier.phi"),
        RackAndPinion: (LAGRANGE, "rack_sled.s"),
        LeadScrew: (LAGRANGE, "screw_sled.s"),
        Wheel: (LAGRANGE, "wheel_sled.s"),
    },
    origin="rtol 1e-9 for each of fewer than 500 steps, and 1e-10 of SciPy's",
)
def test_components_against_references():
    system, inputs, expected = model()
    found = trajectory(system, TS, list(expected), inputs)
    for name, true in expected.items():
        measured(name, found[name], true, 1e-6 * np.abs(true).max())


@pytest.mark.slow
def test_a_run_and_its_energy():
    """The same by `simulate`, and the account of every component's energy."""
    system, inputs, expected = model()
    solution = simulate(system, 2.0, ts=TS, rtol=1e-9, atol=1e-11, inputs=inputs)
    for name, true in expected.items():
        np.testing.assert_allclose(solution[name], true, rtol=0, atol=1e-6 * np.abs(true).max(), err_msg=name)
    assert_energy_balance(solution, rtol=1e-7)  # a hundred times the tolerance


@pytest.mark.slow
def test_gradients():
    system, inputs, expected = model()
    names = [n for n in system.parameters.names if "smooth" not in n]
    values = jnp.array([float(system.parameters[n]) for n in names])

    def end(v, adjoint=None):
        changed = system.with_parameters(dict(zip(names, v, strict=True)))
        solution = simulate(
            changed, 1.0, rtol=1e-7, atol=1e-9, inputs=inputs, adjoint=adjoint, ts=TS[4:5], solver=diffrax.Tsit5()
        )
        return sum(jnp.sum(solution[n]) for n in expected)

    reverse = jax.jit(jax.grad(end))(values)
    forward = jax.jit(jax.jacfwd(lambda v: end(v, diffrax.ForwardMode())))(values)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-8 * np.abs(forward).max())
