"""Hydraulic and mechanical systems of library components, with the default solver, against closed forms and SciPy."""

import numpy as np
import planar_models as planar
import pytest
import scipy.optimize
from bench import Bench
from multibody_reference import GROUND, Mechanism
from problems import GRAVITY, compiled
from reference_systems import ReferenceSystem, check_gradient, check_solution, driven, integrated, linear
from testset.problem import load
from trajectories import check_trajectory

import jaxonomy_dae.library.hydraulic as hy
import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library.transmissions import Planetary


def root(dp, small):
    """The regularised root of the library's orifices, dp/(dp² + small²)^(1/4)."""
    return dp / np.sqrt(np.hypot(dp, small))


# --- two tanks and a manifold --------------------------------------------------------------------------------------


def tanks():
    """Two tanks drain through orifices into a manifold without volume, and from there through a third."""

    def make():
        ev = EqnEnv()
        high, low = hy.Tank(ev, "high", 0.5, 3.0), hy.Tank(ev, "low", 0.8, 0.5)
        first, second = hy.Orifice(ev, "first", 2e-3, 0.6), hy.Orifice(ev, "second", 3e-3, 0.62)
        last, air = hy.Orifice(ev, "last", 1.5e-3, 0.65), hy.PressureSource(ev, "air")
        return compiled(
            high, low, first, second, last, air,
            connect=[
                (high.fluid, first.port_a), (low.fluid, second.port_a), (last.port_b, air.fluid),
                (first.port_b, second.port_b, last.port_a),
            ],
        )  # fmt: skip

    def expected(p):
        def flow(name, dp):
            through = p[f"{name}.A"] * p[f"{name}.Cd"] * np.sqrt(2 * p[f"{name}.rho"])
            return through * root(dp, p[f"{name}.dp_small"])

        def pressure(name, level):  # over the surroundings'
            return p[f"{name}.p_ambient"] - p["air.p"] + p[f"{name}.rho"] * p[f"{name}.g"] * level

        def slope(name, dp):
            small = p[f"{name}.dp_small"]
            return flow(name, 1.0) / root(1.0, small) * (dp**2 / 2 + small**2) / (dp**2 + small**2) ** 1.25

        def slopes(t, y):  # the balance of the manifold, differentiated
            a, b, m = pressure("high", y[0]), pressure("low", y[1]), y[2]
            rates = [
                -flow("first", a - m) / (p["high.rho"] * p["high.A"]),
                -flow("second", b - m) / (p["low.rho"] * p["low.A"]),
            ]
            by_high, by_low = slope("first", a - m), slope("second", b - m)
            from_high, from_low = (p[f"{k}.rho"] * p[f"{k}.g"] * r for k, r in zip(("high", "low"), rates, strict=True))
            return [*rates, (by_high * from_high + by_low * from_low) / (by_high + by_low + slope("last", m))]

        start = [p["high.initial_level"], p["low.initial_level"]]
        a, b = pressure("high", start[0]), pressure("low", start[1])
        within = scipy.optimize.brentq(
            lambda m: flow("first", a - m) + flow("second", b - m) - flow("last", m), -1e3, max(a, b) + 1e3, rtol=1e-15
        )
        *levels, m = integrated(slopes, [*start, within], TS_TANKS)
        assert levels[1].max() > 1.01 * levels[1][0]  # the higher tank feeds the lower one
        return {"high.level": levels[0], "low.level": levels[1], "last.port_a.p": m + p["air.p"], "last.dp": m}

    return ReferenceSystem(make, expected, TS_TANKS, "low.level")


TS_TANKS = np.linspace(0.0, 200.0, 9)

# --- a hydraulic lift ----------------------------------------------------------------------------------------------

OPENED = (np.array([0.0, 0.1, 0.3, 0.8, 1.0]), np.array([0.0, 0.0, 1.0, 1.0, 0.2]))  # s, the valve's opening
WEIGHT = -400.0 * 9.81


def lift():
    """A valve lets oil into a cylinder, which lifts a mass against its weight and a damper."""

    def make():
        ev = EqnEnv()
        supply, valve = hy.PressureSource(ev, "supply", 8e6, 860.0), hy.Valve(ev, "valve", 4e-6, 0.7, 860.0, 1e4)
        chamber = hy.HydraulicCapacity(ev, "chamber", 2e-12, 3.6e6, 860.0)
        cylinder = hy.Cylinder(ev, "cylinder", 1e-3, 860.0)
        mass, damper = tr.Mass(ev, "mass", 400.0, 0.2, 0.0), tr.Damper(ev, "damper", 2e3)
        weight, base = tr.Force(ev, "weight"), tr.FixedPosition(ev, "base")
        return compiled(
            supply, valve, chamber, cylinder, mass, damper, weight, base,
            connect=[
                (supply.fluid, valve.port_a), (valve.port_b, chamber.fluid, cylinder.fluid),
                (cylinder.flange, mass.flange, damper.flange_b, weight.flange), (base.flange, damper.flange_a),
            ],
        )  # fmt: skip

    def expected(p):
        def fed(t, pressure):
            through = p["valve.A"] * p["valve.Cd"] * np.sqrt(2 * p["valve.rho"])
            return np.interp(t, *OPENED) * through * root(p["supply.p"] - pressure, p["valve.dp_small"])

        def slopes(t, y):
            pressure, x, v = y
            area = p["cylinder.A"]
            stored = fed(t, pressure) - p["cylinder.rho"] * area * v
            force = area * (pressure - p["cylinder.p_ambient"]) + WEIGHT - p["damper.d"] * v
            return [stored / (p["chamber.rho"] * p["chamber.C"]), v, force / p["mass.m"]]

        start = [p["chamber.initial_pressure"], p["mass.initial_position"], p["mass.initial_velocity"]]
        pressure, x, v = integrated(slopes, start, TS_LIFT, ends=OPENED[0])
        assert x[-1] - x[0] > 0.1
        return {"chamber.p": pressure, "mass.s": x, "mass.v": v, "valve.m_flow": fed(TS_LIFT, pressure)}

    return ReferenceSystem(
        make, expected, TS_LIFT, "mass.s", {"valve.opening": OPENED, "weight.f": WEIGHT}
    )  # fmt: skip


TS_LIFT = np.linspace(0.0, 1.0, 11)

# --- a quarter of a car --------------------------------------------------------------------------------------------

ALONG = 0.05 * np.arange(21)  # s
ROAD = 0.01 * np.array([
    0.0, 0.2, 0.9, 1.6, 1.2, 0.1, -0.8, -1.5, -1.1, -0.3, 0.2, 1.1, 2.3, 2.0, 1.4, 0.6, 0.3, -0.4, -0.2, 0.1, 0.0,
])  # fmt: skip


def quarter_car():
    """Body, spring and damper, wheel, and a tyre with damping on a measured road."""

    def make():
        ev = EqnEnv()
        body, wheel = tr.Mass(ev, "body", 320.0, 0.0, 0.0), tr.Mass(ev, "wheel", 40.0, 0.0, 0.0)
        strut, tyre = tr.SpringDamper(ev, "strut", 2.2e4, 1.6e3, 0.0), tr.SpringDamper(ev, "tyre", 1.8e5, 150.0)
        road = tr.PositionSource(ev, "road")
        return compiled(
            body, wheel, strut, tyre, road,
            connect=[
                (road.flange, tyre.flange_a), (tyre.flange_b, wheel.flange, strut.flange_a),
                (strut.flange_b, body.flange),
            ],
        )  # fmt: skip

    def expected(p):
        M, m, k, d, K, D = (
            p[n] for n in ("body.m", "wheel.m", "strut.c", "strut.d", "tyre.c", "tyre.d")
        )  # fmt: skip
        a = np.array([
            [0.0, 1.0, 0.0, 0.0],
            [-k / M, -d / M, k / M, d / M],
            [0.0, 0.0, 0.0, 1.0],
            [k / m, d / m, -(k + K) / m, -(d + D) / m],
        ])  # fmt: skip
        relaxed = k * p["strut.length"]
        b = np.array([
            [0.0, 0.0, 0.0], [0.0, 0.0, relaxed / M], [0.0, 0.0, 0.0],
            [K / m, D / m, (K * p["tyre.length"] - relaxed) / m],
        ])  # fmt: skip
        start = [p[f"{part}.initial_{what}"] for part in ("body", "wheel") for what in ("position", "velocity")]
        x, v, y, w = driven(a, start, b, ALONG, ROAD, TS_CAR)
        force = k * (x - y - p["strut.length"]) + d * (v - w)
        return {"body.s": x, "body.v": v, "wheel.s": y, "wheel.v": w, "strut.f": force}

    return ReferenceSystem(make, expected, TS_CAR, "body.s", {"road.u": (ALONG, ROAD)})


TS_CAR = np.array([0.0, 0.13, 0.25, 0.42, 0.5, 0.77, 1.0])

# --- a planetary drive ---------------------------------------------------------------------------------------------

DRIVING = 4.0  # N·m


def planetary():
    """A torque on the sun, a ring that a spring and a damper hold, a load with friction on the carrier."""

    def make():
        ev = EqnEnv()
        gear, torque = Planetary(ev, "gear", 2.6), rot.Torque(ev, "torque")
        sun, ring = rot.Inertia(ev, "sun", 0.02, 0.0, 1.0), rot.Inertia(ev, "ring", 0.15, 0.05, 0.0)
        carrier, friction = rot.Inertia(ev, "carrier", 0.4), rot.Damper(ev, "friction", 0.3)
        hold, base = rot.SpringDamper(ev, "hold", 60.0, 0.8, 0.01), rot.FixedAngle(ev, "base", 0.02)
        return compiled(
            gear, torque, sun, ring, carrier, friction, hold, base,
            connect=[
                (torque.flange, sun.flange_a), (sun.flange_b, gear.sun), (gear.ring, ring.flange_a),
                (ring.flange_b, hold.flange_b), (hold.flange_a, base.flange, friction.flange_a),
                (gear.carrier, carrier.flange_a), (carrier.flange_b, friction.flange_b),
            ],
        )  # fmt: skip

    def expected(p):
        n = p["gear.ratio"]
        turn = np.array([1.0, n]) / (1 + n)  # the carrier's angle by those of sun and ring
        mass = np.diag([p["sun.J"], p["ring.J"]]) + p["carrier.J"] * np.outer(turn, turn)
        damping = np.diag([0.0, p["hold.d"]]) + p["friction.d"] * np.outer(turn, turn)
        stiffness = np.diag([0.0, p["hold.c"]])
        a = np.block([
            [np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)],
        ])  # fmt: skip
        relaxed = p["hold.c"] * (p["base.angle"] + p["hold.angle"])
        b = np.concatenate([np.zeros(2), np.linalg.solve(mass, [DRIVING, relaxed])])
        start = [p[f"{part}.initial_{what}"] for what in ("angle", "speed") for part in ("sun", "ring")]
        y = linear(a, start, b, TS_GEAR)
        speeds = a[2:] @ y + b[2:, None]
        torque = p["sun.J"] * speeds[0] - DRIVING  # what the gear takes from the sun's shaft, turned round
        return {
            "sun.w": y[2], "ring.phi": y[1], "carrier.phi": turn @ y[:2], "carrier.w": turn @ y[2:],
            "gear.sun.tau": -torque,
        }  # fmt: skip

    return ReferenceSystem(make, expected, TS_GEAR, "carrier.w", {"torque.tau": DRIVING})


TS_GEAR = np.linspace(0.0, 1.0, 9)

# --- pendulums in a row --------------------------------------------------------------------------------------------

TS_PENDULUM = np.linspace(0.0, 1.0, 6)


def rods(p, names):
    """Mass, inertia, gravity and the vector of uniform rods."""
    vector = np.array([p[f"{n}.rx"] + 1j * p[f"{n}.ry"] for n in names])
    mass = np.array([p[f"{n}.m"] for n in names])
    gravity = np.array([p[f"{n}.g_x"] + 1j * p[f"{n}.g_y"] for n in names])
    return mass, mass * np.abs(vector) ** 2 / 12, gravity, vector


def at(p, world):
    """A place on the ground."""
    return GROUND, p[f"{world}.x"] + 1j * p[f"{world}.y"]


def chain(p, names, pins):
    """Angles and speeds of rods in a row on the ground's `world`, whose pins start as given."""
    mass, inertia, gravity, vector = rods(p, names)
    n = len(names)
    ends = [at(p, "world"), *((k, vector[k]) for k in range(n - 1))]
    mechanism = Mechanism(mass, inertia, gravity, vector / 2, [(ends[k], (k, 0.0)) for k in range(n)])
    angles = p["world.phi"] + np.cumsum([p[f"{j}.initial_angle"] for j in pins])
    speeds = np.cumsum([p[f"{j}.initial_speed"] for j in pins])
    q, v = mechanism.start(angles, list(zip(np.eye(n), angles, strict=True)), speeds)
    return mechanism.solve(q, v, TS_PENDULUM)[:2]


def double_pendulum():
    """Two uniform rods on pins, from rest."""

    def expected(p):
        q, w = chain(p, ("a", "b"), ("j1", "j2"))
        return {"j1.phi": q[0] - p["world.phi"], "j2.phi": q[1] - q[0], "j2.omega": w[1] - w[0]}

    def make():
        return planar.double_pendulum("auto")

    return ReferenceSystem(make, expected, TS_PENDULUM, "j2.phi")


def triple_pendulum():
    """Three uniform rods on pins, from rest."""

    def make():
        b = Bench()
        end = b(pl.World, "world").frame
        for k, (angle, length, mass) in enumerate([(0.3, 1.0, 1.0), (0.5, 0.8, 0.5), (-0.4, 0.6, 0.7)], 1):
            pin = b(pl.Revolute, f"j{k}", initial_angle=angle, initial_speed=0.0)
            rod = b(pl.MassiveLink, f"rod{k}", length, m=mass)
            b.chain(end, pin.frame_a, pin.frame_b, rod.frame_a)
            end = rod.frame_b
        return b.compile()

    def expected(p):
        q, w = chain(p, [f"rod{k}" for k in (1, 2, 3)], [f"j{k}" for k in (1, 2, 3)])
        return {
            "j1.phi": q[0] - p["world.phi"], "j2.phi": q[1] - q[0], "j3.phi": q[2] - q[1], "rod3.body.omega": w[2],
        }  # fmt: skip

    return ReferenceSystem(make, expected, TS_PENDULUM, "j3.phi")


def test_the_reference_of_the_triple_pendulum():
    """Lagrange's equations of the rods' angles from the x axis give the same as those with multipliers."""
    m, length, start = np.array([1.0, 0.5, 0.7]), np.array([1.0, 0.8, 0.6]), np.cumsum([0.3, 0.5, -0.4])
    # How far along rod j the centre of rod k hangs.
    arm = np.tril(np.tile(length, (3, 1)), -1) + np.diag(length / 2)
    coupling = np.einsum("k,ki,kj->ij", m, arm, arm)

    def slopes(t, y):
        q, u = y[:3], y[3:]
        between = q[:, None] - q
        mass = coupling * np.cos(between) + np.diag(m * length**2 / 12)
        force = -(coupling * np.sin(between)) @ u**2 - GRAVITY * m @ arm * np.cos(q)
        return np.concatenate([u, np.linalg.solve(mass, force)])

    true = integrated(slopes, [*start, 0.0, 0.0, 0.0], TS_PENDULUM)
    p = {"world.x": 0.0, "world.y": 0.0, "world.phi": 0.0}
    for k in range(3):
        p |= {f"r{k}.rx": length[k], f"r{k}.ry": 0.0, f"r{k}.m": m[k], f"r{k}.g_x": 0.0, f"r{k}.g_y": -GRAVITY}
        p |= {f"j{k}.initial_angle": [0.3, 0.5, -0.4][k], f"j{k}.initial_speed": 0.0}
    found = chain(p, ["r0", "r1", "r2"], ["j0", "j1", "j2"])
    # Both are integrated to 1e-12, for each of fewer than 1,000 steps.
    np.testing.assert_allclose(np.concatenate(found), true, rtol=0, atol=1e-9)


# --- closed loops --------------------------------------------------------------------------------------------------


def four_bar():
    """A crank that turns fully, a coupler and a rocker, all uniform rods."""

    def expected(p):
        mass, inertia, gravity, vector = rods(p, ("crank", "coupler", "rocker"))
        ends = [
            (at(p, "west"), (0, 0.0)), ((0, vector[0]), (1, 0.0)), ((1, vector[1]), (2, vector[2])),
            (at(p, "east"), (2, 0.0)),
        ]  # fmt: skip
        mechanism = Mechanism(mass, inertia, gravity, vector / 2, ends)
        start = p["west.phi"] + p["j1.initial_angle"]
        guess = [start, p["coupler.body.initial_angle"], p["rocker.body.initial_angle"]]
        q, v = mechanism.start(guess, [(np.eye(3)[0], start)], [p["j1.initial_speed"]])
        q, w, centre = mechanism.solve(q, v, TS_LOOP)
        return {
            "j1.phi": q[0] - p["west.phi"], "j1.omega": w[0], "j4.phi": q[2] - p["east.phi"],
            "coupler.body.x": centre[1].real,
        }  # fmt: skip

    return ReferenceSystem(planar.four_bar, expected, TS_LOOP, "j4.phi")


TS_LOOP = np.linspace(0.0, 0.6, 5)
SPEED = 3.0  # rad/s


def slider_crank():
    """A crank turned at a constant speed, a coupler without mass, and a slider on a spring: nothing is left to
    integrate."""

    def make():
        b = Bench()
        world, slider, motor = b(pl.World, "world"), b(pl.Body, "slider", 2.5), b(rot.AngleSource, "motor")
        crank, coupler = b(pl.Link, "crank", 0.4), b(pl.Link, "coupler", 1.1)
        pins = [b(pl.Revolute, "drive"), b(pl.Revolute, "elbow"), b(pl.Revolute, "wrist", guess_angle=0.2)]
        guide = b(pl.Prismatic, "guide", 0.3, guess_position=1.4)
        coil, base = b(tr.SpringDamper, "coil", 15.0, 2.0, 0.9), b(tr.FixedPosition, "base")
        b.chain(world.frame, pins[0].frame_a, pins[0].frame_b, crank.frame_a, crank.frame_b, pins[1].frame_a,
                pins[1].frame_b, coupler.frame_a, coupler.frame_b, pins[2].frame_a, world.frame, guide.frame_a,
                motor.flange, pins[0].flange, base.flange, coil.flange_a, coil.flange_b, guide.flange)  # fmt: skip
        b.join(pins[2].frame_b, slider.frame, guide.frame_b)
        return b.compile()

    def expected(p):
        """s = c·cos θ + √(l² − c²·sin²θ), θ the crank's angle from the guide; the motor's power is that of the slider's
        inertia, its weight, and the spring and damper."""
        crank, coupler = (p[f"{n}.rx"] + 1j * p[f"{n}.ry"] for n in ("crank", "coupler"))
        c, long = abs(crank), abs(coupler)
        theta = SPEED * TS_CRANK + 0.5 + np.angle(crank) - p["guide.angle"]
        sine, cosine = np.sin(theta), np.cos(theta)
        root = np.sqrt(long**2 - (c * sine) ** 2)
        s = c * cosine + root
        v = SPEED * (-c * sine - c**2 * sine * cosine / root)
        a = SPEED**2 * (
            -c * cosine - c**2 * (cosine**2 - sine**2) / root - c**4 * (sine * cosine) ** 2 / root**3
        )  # fmt: skip
        axis = p["world.phi"] + p["guide.angle"]
        weight = p["slider.m"] * (p["slider.g_x"] * np.cos(axis) + p["slider.g_y"] * np.sin(axis))
        pull = p["coil.c"] * (s - p["base.position"] - p["coil.length"]) + p["coil.d"] * v
        force = p["slider.m"] * a - weight + pull
        return {
            "guide.s": s, "guide.v": v, "motor.flange.tau": -force * v / SPEED,
            "slider.x": p["world.x"] + s * np.cos(axis),
        }  # fmt: skip

    return ReferenceSystem(
        make, expected, TS_CRANK, "motor.flange.tau", {"motor.u": lambda t: SPEED * t + 0.5}, tolerance=1e-11
    )  # fmt: skip


TS_CRANK = np.linspace(0.0, 2.0, 9)


def andrews():
    """Andrews' squeezing mechanism of bodies and pins. Its motion is compared with the published one in
    test_library_planar; here the reference has all of its parameters."""
    facts = load("andrews")
    torque = facts["parameters"]["mom"]

    def expected(p):
        names = [f"K{k}" for k in range(1, 8)]
        along = np.array([p[f"{n}.rx"] + 1j * p[f"{n}.ry"] for n in names])
        o, a, b = at(p, "O"), at(p, "A"), at(p, "B")
        pins = [
            (o, (0, 0.0)), ((0, along[0]), (1, 0.0)), (b, (2, 0.0)), ((4, along[4]), (3, 0.0)), (a, (4, 0.0)),
            ((6, along[6]), (5, 0.0)), (a, (6, 0.0)), ((1, along[1]), (2, along[2])), ((1, along[1]), (3, along[3])),
            ((1, along[1]), (5, along[5])),
        ]  # fmt: skip
        mechanism = Mechanism(
            np.array([p[f"{n}.m"] for n in names]),
            np.array([p[f"{n}.J"] for n in names]),
            np.array([p[f"{n}.g_x"] + 1j * p[f"{n}.g_y"] for n in names]),
            np.array([p[f"{n}.cx"] + 1j * p[f"{n}.cy"] for n in names]),
            pins,
            {0: torque},
            (at(p, "C"), (2, p["D.rx"] + 1j * p["D.ry"]), p["spring.c"], p["spring.d"], p["spring.length"]),
        )
        guess = [p[f"{n}.body.initial_angle"] for n in names]
        between = np.array([-1.0, 1.0, 0, 0, 0, 0, 0])
        q, v = mechanism.start(guess, [(between, p["Theta.initial_angle"])], [p["Theta.initial_speed"]])
        q, w, _ = mechanism.solve(q, v, TS_ANDREWS)
        return {
            "beta.phi": q[0] - p["O.phi"], "gamma.phi": q[2] - p["B.phi"], "Theta.omega": w[1] - w[0],
            "epsilon.omega": w[6],
        }  # fmt: skip

    return ReferenceSystem(
        lambda: planar.squeezing_mechanism(facts), expected, TS_ANDREWS, "gamma.phi", {"torque.tau": torque}, size=0.01
    )  # fmt: skip


TS_ANDREWS = np.linspace(0.0, 0.01, 3)


# --- all of them ---------------------------------------------------------------------------------------------------

SYSTEMS = [
    tanks, lift, quarter_car, planetary, double_pendulum, triple_pendulum, four_bar, slider_crank, andrews,
]  # fmt: skip


def test_the_field_of_the_planetary_drive():
    check_trajectory(planetary)


# test_library_planar runs the double pendulum and Andrews' mechanism; benchmarks.systems runs all.
@pytest.mark.slow
@pytest.mark.parametrize("reference", [tanks, lift, quarter_car, planetary, four_bar, slider_crank])
def test_solution(reference):
    check_solution(reference, energy=reference is four_bar)


@pytest.mark.slow
@pytest.mark.parametrize("reference", [lift, quarter_car, planetary, double_pendulum, four_bar])
def test_gradient(reference):
    check_gradient(reference, modes=reference is double_pendulum)
