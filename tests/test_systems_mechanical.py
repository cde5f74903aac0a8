"""Hydraulic and mechanical systems of library components, with the default solver, against closed forms and SciPy."""

import numpy as np
import pytest
import scipy.optimize
import test_library_planar as planar
from problems import compiled
from reference_systems import MEASURED, ReferenceSystem, check_gradient, check_solution, driven, integrated, linear

import jaxonomy_dae.library.hydraulic as hy
import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.transmissions import Planetary
from jaxonomy_dae.testing import assert_energy_balance


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
            force = area * (pressure - p["cylinder.p_ambient"]) + WEIGHT - p["damper.D"] * v
            return [stored / (p["chamber.rho"] * p["chamber.C"]), v, force / p["mass.M"]]

        start = [p["chamber.initial_pressure"], p["mass.initial_position"], p["mass.initial_velocity"]]
        pressure, x, v = integrated(slopes, start, TS_LIFT, ends=OPENED[0])
        assert x[-1] - x[0] > 0.1
        return {"chamber.p": pressure, "mass.x": x, "mass.v": v, "valve.m_flow": fed(TS_LIFT, pressure)}

    return ReferenceSystem(
        make, expected, TS_LIFT, "mass.x", {"valve.opening": OPENED, "weight.f": WEIGHT}
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
            p[n] for n in ("body.M", "wheel.M", "strut.K", "strut.D", "tyre.K", "tyre.D")
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
        return {"body.x": x, "body.v": v, "wheel.x": y, "wheel.v": w, "strut.f": force}

    return ReferenceSystem(make, expected, TS_CAR, "body.x", {"road.u": (ALONG, ROAD)})


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
        relaxed = p["hold.c"] * (p["base.angle"] + p["hold.phi_rel0"])
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

# --- three pendulums in a row --------------------------------------------------------------------------------------

TS_PENDULUM = np.linspace(0.0, 1.0, 6)


def triple_pendulum():
    """Three uniform rods on pins, from rest."""

    def make():
        b = planar.Bench()
        end = b(pl.World, "world").frame
        for k, (angle, length, mass) in enumerate([(0.3, 1.0, 1.0), (0.5, 0.8, 0.5), (-0.4, 0.6, 0.7)], 1):
            pin = b(pl.Revolute, f"j{k}", initial_phi=angle, initial_omega=0.0)
            rod = b(pl.MassiveLink, f"rod{k}", length, m=mass)
            b.chain(end, pin.frame_a, pin.frame_b, rod.frame_a)
            end = rod.frame_b
        return b.compile()

    def expected(p):
        """Lagrange's equations of the rods' angles from the x axis."""
        m = np.array([p[f"rod{k}.m"] for k in (1, 2, 3)])
        length = np.array([p[f"rod{k}.rx"] for k in (1, 2, 3)])
        # How far along rod j the centre of rod k hangs.
        arm = np.tril(np.tile(length, (3, 1)), -1) + np.diag(length / 2)
        coupling = np.einsum("k,ki,kj->ij", m, arm, arm)
        gravity = planar.GRAVITY * m @ arm

        def slopes(t, y):
            q, u = y[:3], y[3:]
            between = q[:, None] - q
            mass = coupling * np.cos(between) + np.diag(m * length**2 / 12)
            force = -(coupling * np.sin(between)) @ u**2 - gravity * np.cos(q)
            return np.concatenate([u, np.linalg.solve(mass, force)])

        starts = np.cumsum([p[f"j{k}.initial_phi"] for k in (1, 2, 3)])
        y = integrated(slopes, [*starts, 0.0, 0.0, 0.0], TS_PENDULUM)
        return {
            "j1.phi": y[0], "j2.phi": y[1] - y[0], "j3.phi": y[2] - y[1], "rod3.body.omega": y[5],
        }  # fmt: skip

    # Gravity has parameters in each rod, of which the reference knows one value.
    return ReferenceSystem(make, expected, TS_PENDULUM, "j3.phi", differences=None)


# --- all of them ---------------------------------------------------------------------------------------------------

SYSTEMS = [tanks, lift, quarter_car, planetary, triple_pendulum]


def with_slow(*slow):
    return [pytest.param(s, marks=pytest.mark.slow) if s in slow else s for s in SYSTEMS]


@pytest.mark.parametrize("reference", with_slow(tanks, triple_pendulum))
def test_solution(reference):
    check_solution(reference)


@pytest.mark.parametrize("reference", with_slow(tanks, triple_pendulum, lift, quarter_car))
def test_gradient(reference):
    check_gradient(reference)


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: planar.double_pendulum("auto"), planar.four_bar], ids=["double", "four_bar"])
def test_energy_of_linkages(make):
    """Their motion is checked in test_library_planar."""
    solution = simulate(make(), 1.0, ts=TS_PENDULUM, **planar.TIGHT)
    assert_energy_balance(solution, rtol=MEASURED)


@pytest.mark.slow
def test_energy_of_planar_components():
    system, inputs, _ = planar.components()
    solution = simulate(system, 1.0, ts=TS_PENDULUM, inputs=inputs, **planar.TIGHT)
    assert_energy_balance(solution, rtol=MEASURED)
