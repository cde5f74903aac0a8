"""Hydraulic components together, against closed forms and SciPy's solution of equations derived by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from component_references import checks, measured
from problems import compiled
from trajectories import trajectory

from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library import translational
from jaxonomy_dae.library.hydraulic import (
    Accumulator,
    Cylinder,
    FlowSensor,
    HydraulicCapacity,
    Inertance,
    LaminarPipe,
    MassFlowSource,
    Orifice,
    PressureSensor,
    PressureSource,
    Pump,
    Tank,
    TurbulentPipe,
    Valve,
)
from jaxonomy_dae.library.rotational import Inertia, Torque
from jaxonomy_dae.solvers import BDF

END = 10.0
TS = np.linspace(0.0, END, 21)
RHO, MU, ATMOSPHERE, G = 998.2, 1.002e-3, 101325.0, 9.80665
TOLERANCE = 1e-8  # of the largest value: a hundred errors of one step at rtol 1e-10, over a few hundred that decay


def assert_near(solution, name, expected, scale=None):
    measured(name, solution[name], expected, TOLERANCE * (np.abs(expected).max() if scale is None else scale), scale)


def integrated(field, start):
    return scipy.integrate.solve_ivp(field, (0, END), start, "DOP853", TS, rtol=1e-13, atol=1e-15).y


def laminar(D, L):
    return np.pi * D**4 * RHO / (128 * MU * L)


def opening(t):
    return 0.6 + 0.4 * jnp.cos(2 * t)


PUMPED = "SciPy's DOP853 of an accumulator behind a pump on a shaft"
PUSHED = "closed form of a piston behind a narrow pipe"


@pytest.mark.slow
@checks(
    {
        Tank: ("Torricelli's law: √level falls linearly", "tank.level", "gauge.p"),
        Orifice: ("Torricelli's law: √level falls linearly", "meter.m_flow"),
        FlowSensor: ("Torricelli's law: √level falls linearly", "meter.m_flow"),
        PressureSensor: ("Torricelli's law: √level falls linearly", "gauge.p"),
        PressureSource: ("exponential of a compliance behind a pipe", "hose.p"),
        MassFlowSource: ("exponential of a compliance behind a pipe", "hose.p"),
        HydraulicCapacity: ("exponential of a compliance behind a pipe", "hose.p"),
        LaminarPipe: ("exponential of a compliance behind a pipe", "leak.m_flow"),
        Inertance: ("closed form of a damped oscillation", "bag.p", "column.m_flow"),
        Valve: ("SciPy's DOP853 of a node between a valve and a pipe", "node.p", "valve.m_flow"),
        TurbulentPipe: ("SciPy's DOP853 of a node between a valve and a pipe", "tower.level", "pipe.m_flow"),
        Pump: (PUMPED, "pump.w", "pump.dp", "pump.m_flow"),
        Accumulator: (f"{PUMPED}; Boyle's law", "gas.V_fluid", "slow.fluid.p"),
        Cylinder: (PUSHED, "load.v", "piston.s", "piston.f"),
    },
    origin="a hundred errors of one step at rtol 1e-10, over a few hundred that decay",
)
def test_networks():
    ev = EqnEnv()
    air = PressureSource(ev, "air")
    connect = []

    # A tank runs empty through an orifice, with sensors in between.
    tank, orifice = Tank(ev, "tank", 0.05, 2.0), Orifice(ev, "orifice", 2e-3, dp_small=0.1)
    meter, gauge = FlowSensor(ev, "meter"), PressureSensor(ev, "gauge")
    connect += [(tank.fluid, meter.port_a, gauge.fluid), (meter.port_b, orifice.port_a), (orifice.port_b, air.fluid)]

    # A flow into a compliance that leaks through a narrow pipe.
    feed, hose = MassFlowSource(ev, "feed"), HydraulicCapacity(ev, "hose", 2.5e-7, 110e3)
    leak = LaminarPipe(ev, "leak", 0.01, 2.0)
    connect += [(feed.fluid, hose.fluid, leak.port_a), (leak.port_b, air.fluid)]

    # The same pipe, a column of fluid, and a compliance that oscillates with it.
    main, column = PressureSource(ev, "main", 150e3), Inertance(ev, "column", 20.0, 1e-4, 0.05)
    loss, bag = LaminarPipe(ev, "loss", 0.01, 2.0), HydraulicCapacity(ev, "bag", 1e-8, 120e3)
    connect += [(main.fluid, column.port_a), (column.port_b, loss.port_a), (loss.port_b, bag.fluid)]

    # A valve that moves and a rough pipe, between a source and a tank; both flows reverse.
    low, valve = PressureSource(ev, "low", 115e3), Valve(ev, "valve", dp_small=1e3)
    node, pipe = HydraulicCapacity(ev, "node", 1e-8, 145e3), TurbulentPipe(ev, "pipe", 0.01, 5.0, 0.03, dp_small=2e3)
    tower = Tank(ev, "tower", 1e-3, 3.0)
    connect += [(low.fluid, valve.port_a), (valve.port_b, node.fluid, pipe.port_a), (pipe.port_b, tower.fluid)]

    # A pump on a shaft fills a gas accumulator that leaks.
    motor, shaft = Torque(ev, "motor"), Inertia(ev, "shaft", 0.01, 0.0, 50.0)
    pump, gas = Pump(ev, "pump", 1e-6), Accumulator(ev, "gas", 1e-3, 1e6, 1.4, 5e-5)
    drip = LaminarPipe(ev, "drip", 2e-3, 2.0)
    connect += [(motor.flange, shaft.flange_a), (shaft.flange_b, pump.flange), (drip.port_b, air.fluid)]
    connect += [(pump.port_a, air.fluid), (pump.port_b, gas.fluid, drip.port_a)]

    # A flow into an isothermal accumulator.
    filling, slow = MassFlowSource(ev, "filling"), Accumulator(ev, "slow", 1e-3, 2e5, 1.0, 1e-4)
    connect += [(filling.fluid, slow.fluid)]

    # A piston that a pressure behind a narrow pipe pushes.
    supply, line = PressureSource(ev, "supply", 110e3), LaminarPipe(ev, "line", 0.01, 2.0)
    piston, load = Cylinder(ev, "piston", 1e-3), translational.Mass(ev, "load", 20.0, 0.0, 0.0)
    connect += [(supply.fluid, line.port_a), (line.port_b, piston.fluid), (piston.flange, load.flange)]

    names = [
        "tank.level", "gauge.p", "meter.m_flow", "hose.p", "leak.m_flow", "bag.p", "column.m_flow", "node.p",
        "tower.level", "valve.m_flow", "pipe.m_flow", "pump.w", "gas.V_fluid", "pump.dp", "pump.m_flow", "slow.fluid.p",
        "load.v", "piston.s", "piston.f",
    ]  # fmt: skip
    solution = trajectory(
        compiled(air, connect=connect), TS, names,
        {"feed.m_flow": 0.2, "valve.opening": opening, "motor.tau": 1.5, "filling.m_flow": 0.03}, rtol=1e-11,
    )  # fmt: skip

    # Torricelli: √h falls linearly. The regularisation changes flows by (0.1 Pa/5000 Pa)²/4 = 1e-10 of them.
    root = np.sqrt(2.0) - 0.6 * 2e-3 / 0.05 * np.sqrt(G / 2) * TS
    assert_near(solution, "tank.level", root**2)
    assert_near(solution, "gauge.p", ATMOSPHERE + RHO * G * root**2)
    assert_near(solution, "meter.m_flow", RHO * 0.6 * 2e-3 * np.sqrt(2 * G) * root)

    conductance = laminar(0.01, 2.0)
    final = ATMOSPHERE + 0.2 / conductance
    p = final + (110e3 - final) * np.exp(-conductance / (RHO * 2.5e-7) * TS)
    assert_near(solution, "hose.p", p)
    assert_near(solution, "leak.m_flow", conductance * (p - ATMOSPHERE))

    # (L/A)·m' = dp − m/conductance, rho·C·p' = m: underdamped, about the source's pressure.
    inertance, compliance = 20.0 / 1e-4, RHO * 1e-8
    a = 1 / (2 * conductance * inertance)
    w = np.sqrt(1 / (inertance * compliance) - a * a)
    c0, rate0 = 120e3 - 150e3, 0.05 / compliance
    c, s, e = np.cos(w * TS), np.sin(w * TS), np.exp(-a * TS)
    s0 = (rate0 + a * c0) / w
    flow = compliance * e * ((-a * c0 + w * s0) * c + (-a * s0 - w * c0) * s)
    assert_near(solution, "bag.p", 150e3 + e * (c0 * c + s0 * s))
    assert_near(solution, "column.m_flow", flow)

    def signed_root(dp, small):
        return dp / np.sqrt(np.hypot(dp, small))

    def flows(t, p, level):
        through = (0.6 + 0.4 * np.cos(2 * t)) * 1e-4 * 0.6 * np.sqrt(2 * RHO) * signed_root(115e3 - p, 1e3)
        area = np.pi * 0.01**2 / 4
        onwards = area * np.sqrt(2 * RHO * 0.01 / (0.03 * 5.0)) * signed_root(p - ATMOSPHERE - RHO * G * level, 2e3)
        return through, onwards

    def filled(t, y):
        through, onwards = flows(t, *y)
        return (through - onwards) / (RHO * 1e-8), onwards / (RHO * 1e-3)

    p, level = integrated(filled, [145e3, 3.0])
    through, onwards = flows(TS, p, level)
    assert through.min() < 0 < onwards.max() and onwards.min() < 0
    assert_near(solution, "node.p", p)
    assert_near(solution, "tower.level", level)
    # Near dp = 0 a flow is as exact as the pressures, times its slope.
    assert_near(solution, "valve.m_flow", through, scale=p.max() * 6e-5 * np.sqrt(2 * RHO / 1e3))
    assert_near(solution, "pipe.m_flow", onwards, scale=p.max() * 3e-5 * np.sqrt(2 * RHO / 2e3))

    drips = laminar(2e-3, 2.0)

    def pumped(t, y):
        speed, volume = y
        dp = 1e6 * (1e-3 / (1e-3 - volume)) ** 1.4 - ATMOSPHERE
        return (1.5 - 1e-6 * dp) / 0.01, 1e-6 * speed - drips * dp / RHO

    speed, volume = integrated(pumped, [50.0, 5e-5])
    assert_near(solution, "pump.w", speed)
    assert_near(solution, "gas.V_fluid", volume, scale=1e-3)
    assert_near(solution, "pump.dp", ATMOSPHERE - 1e6 * (1e-3 / (1e-3 - volume)) ** 1.4)
    assert_near(solution, "pump.m_flow", RHO * 1e-6 * speed)

    assert_near(solution, "slow.fluid.p", 2e5 * 1e-3 / (9e-4 - 0.03 / RHO * TS))

    # M·v' = A·(p_supply − p_ambient) − rho·A²·v/conductance.
    drag = RHO * 1e-3**2 / conductance
    reached, time = 1e-3 * (110e3 - ATMOSPHERE) / drag, 20.0 / drag
    e = np.exp(-TS / time)
    assert_near(solution, "load.v", reached * (1 - e))
    assert_near(solution, "piston.s", reached * (TS - time * (1 - e)))
    assert_near(solution, "piston.f", 20.0 * reached / time * e)


def test_stiff_transmission():
    # A pump drives a cylinder through fluid that neither yields nor leaks: a gear with w = (A/D)·v, of index 3.
    # (M + J·(A/D)²)·x'' + K·x = (A/D)·tau, from rest.
    J, D, A, M, K, tau = 1e-3, 1e-5, 1e-3, 5.0, 60.0, 0.08
    ev = EqnEnv()
    motor, shaft, air = Torque(ev, "motor"), Inertia(ev, "shaft", J, 0.0), PressureSource(ev, "air")
    pump, cylinder = Pump(ev, "pump", D), Cylinder(ev, "cylinder", A)
    load, spring = translational.Mass(ev, "load", M, 0.0, 0.0), translational.Spring(ev, "spring", K)
    wall = translational.FixedPosition(ev, "wall")
    system = compiled(
        motor,
        connect=[
            (motor.flange, shaft.flange_a), (shaft.flange_b, pump.flange), (air.fluid, pump.port_a),
            (pump.port_b, cylinder.fluid), (cylinder.flange, load.flange, spring.flange_b),
            (spring.flange_a, wall.flange),
        ],
    )  # fmt: skip
    # The fluid joins speeds, not positions: shaft and load have an angle and a position of their own.
    assert system.report.degrees_of_freedom == 3 and system.report.index == 3
    names = ["load.s", "shaft.phi", "cylinder.fluid.p", "pump.dp"]
    solution = trajectory(system, TS, names, {"motor.tau": tau}, rtol=1e-12)
    ratio = A / D
    w = np.sqrt(K / (M + J * ratio**2))
    x = ratio * tau / K * (1 - np.cos(w * TS))
    acceleration = ratio * tau / K * w**2 * np.cos(w * TS)
    assert_near(solution, "load.s", x)
    assert_near(solution, "shaft.phi", ratio * x)
    assert_near(solution, "cylinder.fluid.p", ATMOSPHERE + (M * acceleration + K * x) / A)
    np.testing.assert_allclose(solution["pump.dp"] * D, -(tau - J * ratio * acceleration), atol=TOLERANCE * tau)


@pytest.mark.slow
def test_valve_and_pipe_in_series():
    # Nothing yields between them, so the pressure there is the unknown of a nonlinear block. Conductances k of flows
    # k·√dp in series are 1/K² = 1/k1² + 1/k2², and √(difference of levels) falls linearly, as in Torricelli's law.
    wide, narrow, area = 0.05, 0.02, 1e-4
    ev = EqnEnv()
    upper, lower = Tank(ev, "upper", wide, 2.0), Tank(ev, "lower", narrow, 0.5)
    valve, pipe = Valve(ev, "valve", area, dp_small=0.1), TurbulentPipe(ev, "pipe", 0.01, dp_small=0.1)
    connect = [(upper.fluid, valve.port_a), (valve.port_b, pipe.port_a), (pipe.port_b, lower.fluid)]
    system = compiled(upper, connect=connect)

    ts = np.linspace(0.0, 50.0, 6)
    solution = simulate(system, 50.0, ts=ts, rtol=1e-9, atol=1e-11)
    k1 = area * 0.6 * np.sqrt(2 * RHO)
    k2 = np.pi * 0.01**2 / 4 * np.sqrt(2 * RHO * 0.01 / (0.02 * 1.0))
    K = 1 / np.hypot(1 / k1, 1 / k2)
    rate = np.sqrt(G / RHO) / 2 * (1 / wide + 1 / narrow)
    root = np.sqrt(1.5) - K * rate * ts
    lost = (1.5 - root**2) / (wide + narrow)
    # rtol 1e-9 in each of about 50 steps; the regularisation changes flows by less than (0.1 Pa/1000 Pa)²/4 = 3e-9.
    np.testing.assert_allclose(solution["upper.level"], 2.0 - narrow * lost, rtol=5e-8)
    np.testing.assert_allclose(solution["lower.level"], 0.5 + wide * lost, rtol=5e-8)
    np.testing.assert_allclose(solution["valve.m_flow"], K * np.sqrt(RHO * G) * root, rtol=5e-8)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, BDF()])
def test_tanks_come_to_rest(solver):
    """Differences of pressures fall to rounding errors of the pressures, and flows with them: they were told not to
    fulfil their equations, which have no terms but such differences."""
    ev = EqnEnv()
    upper, lower = Tank(ev, "upper", A=1.0, initial_level=1.0), Tank(ev, "lower", A=0.5, initial_level=0.2)
    pipe, orifice = TurbulentPipe(ev, "pipe", D=0.05, L=10.0), Orifice(ev, "orifice", A=1e-3)
    beside = LaminarPipe(ev, "beside", D=0.02, L=5.0)
    connect = [
        (upper.fluid, pipe.port_a, beside.port_a), (pipe.port_b, orifice.port_a),
        (orifice.port_b, lower.fluid, beside.port_b),
    ]  # fmt: skip
    system = compiled(upper, connect=connect)
    solution = simulate(system, 2e4, ts=[0.0, 1e3, 2e4], solver=solver)
    # What is left decays like exp(−t/300 s); rounding of 1e5 Pa is 1e-15 m of a level, that of flows adds up over time.
    level = (1.0 * 1.0 + 0.5 * 0.2) / 1.5
    np.testing.assert_allclose(solution["upper.level"][-1], level, atol=1e-9)
    np.testing.assert_allclose(solution["lower.level"][-1], level, atol=1e-9)
    assert abs(solution["pipe.m_flow"][-1]) < 1e-6
