"""Thermal components together, against closed forms and SciPy's solution of equations derived by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from component_references import checks, measured
from problems import compiled
from trajectories import trajectory

from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.thermal import (
    Convection,
    FixedTemperature,
    HeatCapacitor,
    HeatFlowSensor,
    HeatFlowSource,
    Radiation,
    TemperatureSensor,
    TemperatureSource,
    ThermalConductor,
    Wall,
)

END = 7200.0
TS = np.linspace(0.0, END, 25)


def outside(t):
    return 285.0 + 12.0 * jnp.sin(2 * jnp.pi * t / 3000.0)


def wall_temperatures(r, c, inside, starts):
    """T_1, T_2, … of a wall of layers between `outside` and a constant temperature, by DOP853 at rtol 1e-12."""
    links = [r[0] / 2, *(np.add(r[:-1], r[1:]) / 2), r[-1] / 2]

    def field(t, T):
        along = np.array([285.0 + 12.0 * np.sin(2 * np.pi * t / 3000.0), *T, inside])
        flows = -np.diff(along) / links
        return -np.diff(flows) / c

    return scipy.integrate.solve_ivp(field, (0, END), starts, "DOP853", TS, rtol=1e-12, atol=1e-10).y


def radiating_time(T, T0, around, rate):
    """The time at which T' = −rate·(T⁴ − around⁴) has come from T0 to T, by partial fractions."""

    def primitive(T):
        return np.log((T + around) / (T - around)) + 2 * np.arctan(T / around)

    return (primitive(T) - primitive(T0)) / (4 * around**3 * rate)


@pytest.mark.slow
@checks(
    {
        HeatCapacitor: ("exponential of Newton's cooling", "probe.T"),
        Convection: ("exponential of Newton's cooling", "meter.Q_flow"),
        FixedTemperature: ("exponential of Newton's cooling", "probe.T"),
        HeatFlowSource: ("exponential of Newton's cooling", "probe.T"),
        HeatFlowSensor: ("exponential of Newton's cooling", "meter.Q_flow"),
        TemperatureSensor: ("exponential of Newton's cooling", "probe.T"),
        Radiation: (
            "T' = −k·(T⁴ − T₀⁴) by partial fractions, and T⁻³ towards absolute zero",
            "ball.T", "star.T", "shine.Q_flow",
        ),
        Wall: ("SciPy's DOP853 of the layers' equations", "wall.capacitor.T", "into.Q_flow"),
        TemperatureSource: ("SciPy's DOP853 of the layers' equations", "wall.capacitor.T"),
        ThermalConductor: ("SciPy's DOP853 of the layers' equations", "wall.capacitor.T", "into.Q_flow"),
    },
    origin="rtol 1e-10 of at most 900 K is 1e-7 K in a step, and errors decay: ten of them; flows: times conductances",
)  # fmt: skip
def test_networks():
    ev = EqnEnv()
    # A heated body that air cools, with sensors in between.
    heater, body = HeatFlowSource(ev, "heater"), HeatCapacitor(ev, "body", 800.0, 350.0)
    skin, air = Convection(ev, "skin", 12.0, 0.05), FixedTemperature(ev, "air")
    meter, probe = HeatFlowSensor(ev, "meter"), TemperatureSensor(ev, "probe")
    # A body that radiates, and one that radiates to absolute zero.
    ball, glow = HeatCapacitor(ev, "ball", 2000.0, 900.0), Radiation(ev, "glow", 0.8, 0.02)
    around = FixedTemperature(ev, "around", 300.0)
    star, shine = HeatCapacitor(ev, "star", 500.0, 700.0), Radiation(ev, "shine", 0.6, 0.03)
    space = FixedTemperature(ev, "space", 0.0)
    # A wall between changing weather and a room.
    r, c, starts = [0.02, 0.5, 0.1], [3e3, 8e2, 5e3], [284.0, 288.0, 292.0]
    weather, wall = TemperatureSource(ev, "weather"), Wall(ev, "wall", r, c, starts)
    into, room = HeatFlowSensor(ev, "into"), FixedTemperature(ev, "room", 294.0)
    system = compiled(
        heater, ball, star, weather,
        connect=[
            (heater.heat, body.heat, meter.port_a, probe.heat), (meter.port_b, skin.port_a), (skin.port_b, air.heat),
            (ball.heat, glow.port_a), (glow.port_b, around.heat),
            (star.heat, shine.port_b), (shine.port_a, space.heat),
            (weather.heat, wall.port_a), (wall.port_b, into.port_a), (into.port_b, room.heat),
        ],
    )  # fmt: skip
    assert system.report.degrees_of_freedom == 6
    walls = [f"wall.capacitor{k}.T" for k in (1, 2, 3)]
    solution = trajectory(
        system, TS, ["probe.T", "meter.Q_flow", "ball.T", "star.T", "shine.Q_flow", "into.Q_flow", *walls],
        {"heater.Q_flow": 30.0, "weather.T": outside},
    )  # fmt: skip
    # rtol 1e-10 of at most 900 K is 1e-7 K in a step, and errors decay: ten of them. Flows: times their conductances.
    tolerance = 1e-6
    conductance, final = 12.0 * 0.05, 293.15 + 30.0 / (12.0 * 0.05)
    expected = final + (350.0 - final) * np.exp(-conductance / 800.0 * TS)
    measured("probe.T", solution["probe.T"], expected, tolerance)
    measured("meter.Q_flow", solution["meter.Q_flow"], conductance * (expected - 293.15), tolerance)

    rate = 0.8 * 5.670374419e-8 * 0.02 / 2000.0
    T = np.asarray(solution["ball.T"])
    error = (radiating_time(T, 900.0, 300.0, rate) - TS) * rate * (T**4 - 300.0**4)  # time off, times the slope
    measured("ball.T", error, 0, tolerance, scale=900.0)
    assert 300.0 < T[-1] < 650.0

    rate = 0.6 * 5.670374419e-8 * 0.03 / 500.0
    expected = (700.0**-3 + 3 * rate * TS) ** (-1 / 3)
    measured("star.T", solution["star.T"], expected, tolerance)
    measured("shine.Q_flow", solution["shine.Q_flow"], -rate * 500.0 * expected**4, tolerance * rate * 500 * 4 * 700**3)

    expected = wall_temperatures(r, c, 294.0, starts)
    found = np.array([solution[name] for name in walls])
    measured("wall.capacitor.T", found, expected, tolerance)
    measured("into.Q_flow", solution["into.Q_flow"], (expected[2] - 294.0) / (r[2] / 2), tolerance / (r[2] / 2))


SIGMA = 5.670374419e-8


def shielded():
    """A shield between two bodies, mounted on a third."""
    ev = EqnEnv()
    bodies = [HeatCapacitor(ev, f"body{k}", C, T) for k, (C, T) in enumerate([(100.0, 280.0), (50.0, 340.0)])]
    left, right = Radiation(ev, "left", 0.9, 1.0), Radiation(ev, "right", 0.4, 0.7)
    mount, frame = ThermalConductor(ev, "mount", 0.5), HeatCapacitor(ev, "frame", 80.0, 310.0)
    return compiled(
        *bodies, mount, frame,
        connect=[
            (bodies[0].heat, left.port_a), (left.port_b, right.port_a, mount.port_a), (right.port_b, bodies[1].heat),
            (mount.port_b, frame.heat),
        ],
    )  # fmt: skip


def shield_flows(shield, T):
    """From the left, to the right, to the frame."""
    from_left = 0.9 * SIGMA * (T[0] ** 4 - shield**4)
    to_right = 0.4 * 0.7 * SIGMA * (shield**4 - T[1] ** 4)
    return from_left, to_right, 0.5 * (shield - T[2])


def shield_temperature(T):
    def balance(shield):
        from_left, to_right, to_frame = shield_flows(shield, T)
        return from_left - to_right - to_frame

    return scipy.optimize.brentq(balance, 1.0, 1e3, xtol=1e-12)


@pytest.mark.slow
def test_temperatures_that_radiation_determines():
    """A shield between two bodies: of the roots of a fourth power only the one above zero is a temperature."""
    system, bodies = shielded(), ["body0.T", "body1.T", "frame.T"]

    @jax.jit
    @jax.vmap
    def between(T):
        start = system.initialize(initial=dict(zip(bodies, T, strict=True)))
        return system.observe("left.port_b.T", 0.0, start)

    at = np.array([[280.0, 340.0, 310.0], [900.0, 3.0, 20.0], [30.0, 250.0, 600.0], [5.0, 5.0, 5.0]])
    np.testing.assert_allclose(between(at), [shield_temperature(T) for T in at], rtol=1e-11)


@pytest.mark.slow
def test_a_run_with_temperatures_that_radiation_determines():
    solution = simulate(shielded(), 200.0, ts=[0.0, 50.0, 200.0], rtol=1e-10, atol=1e-9)

    def field(t, T):
        from_left, to_right, to_frame = shield_flows(shield_temperature(T), T)
        return np.array([-from_left, to_right, to_frame]) / [100.0, 50.0, 80.0]

    true = scipy.integrate.solve_ivp(
        field, (0.0, 200.0), [280.0, 340.0, 310.0], "DOP853", t_eval=[0.0, 50.0, 200.0], rtol=1e-11, atol=1e-9
    ).y
    # rtol 1e-10 of 340 K is 3e-8 K in a step, and errors decay: ten of them.
    for k, name in enumerate(("body0.T", "body1.T", "frame.T")):
        np.testing.assert_allclose(solution[name], true[k], atol=3e-7)
    np.testing.assert_allclose(solution["left.port_b.T"], [shield_temperature(T) for T in true.T], atol=3e-7)
