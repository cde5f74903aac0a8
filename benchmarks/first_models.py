"""Twelve models as a user writes them, to measure what comes before their first number.

Each entry builds a model with the library, says how long it runs, which variable is read, and by which parameter its
end is differentiated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from sympy import Max, Min, Piecewise, exp, sqrt

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.hydraulic as hy
import jaxonomy_dae.library.planar as pl
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as signal
import jaxonomy_dae.library.thermal as thermal
import jaxonomy_dae.library.translational as tr
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, assign, der
from jaxonomy_dae.library.friction import StickingFriction

SAVED = 101  # times of each run


class Model(NamedTuple):
    """How to build a model, the end of its run, the variable to read, the parameter to differentiate by, and further
    arguments of `simulate`."""

    build: Callable[[], AcausalCompiler]
    t1: float
    reads: str
    by: str
    options: dict[str, Any] = {}


def compiler(ev: EqnEnv, *parts: Component, connect: list[tuple[Any, ...]]) -> AcausalCompiler:
    diagram = AcausalDiagram()
    diagram.add(*parts)
    for ports in connect:
        diagram.connect(*ports)
    return AcausalCompiler(ev, diagram)


def rod_on_a_pin() -> AcausalCompiler:
    ev = EqnEnv()
    world, pin = pl.World(ev, "world"), pl.Revolute(ev, "pin", initial_angle=0.5, initial_speed=0.0)
    rod = pl.MassiveLink(ev, "rod", 1.0)
    return compiler(ev, world, pin, rod, connect=[(world.frame, pin.frame_a), (pin.frame_b, rod.frame_a)])


def four_bar() -> AcausalCompiler:
    """A crank that turns fully, its coupler and a rocker; guesses choose the open position."""
    ev = EqnEnv()
    west, east = pl.World(ev, "west"), pl.World(ev, "east", 2.0)
    crank = pl.MassiveLink(ev, "crank", 0.8)
    coupler = pl.MassiveLink(ev, "coupler", 1.9, m=0.6, guess_angle=0.3)
    rocker = pl.MassiveLink(ev, "rocker", 1.5, m=1.5, guess_angle=1.7)
    pins = [
        pl.Revolute(ev, "j1", initial_angle=1.0, initial_speed=5.0), *(pl.Revolute(ev, f"j{k}") for k in (2, 3, 4))
    ]  # fmt: skip
    return compiler(
        ev, west, east, crank, coupler, rocker, *pins,
        connect=[
            (west.frame, pins[0].frame_a), (pins[0].frame_b, crank.frame_a), (crank.frame_b, pins[1].frame_a),
            (pins[1].frame_b, coupler.frame_a), (coupler.frame_b, pins[2].frame_a), (pins[2].frame_b, rocker.frame_b),
            (east.frame, pins[3].frame_a), (pins[3].frame_b, rocker.frame_a),
        ],
    )  # fmt: skip


def buck_converter() -> AcausalCompiler:
    """100 periods of 1 ms: a switch, a diode, and a coil whose current stops in the first ones."""
    ev = EqnEnv()
    width, share = signal.PulseWidth(ev, "width", period=1e-3), signal.Constant(ev, "share", k=0.4)
    switch, diode = el.Switch(ev, "switch", Goff=1e-9), el.IdealDiode(ev, "diode", Goff=1e-9)
    source, coil = el.VoltageSource(ev, "source", 24.0), el.Inductor(ev, "coil", 1e-3, initial_current=0.0)
    tank, load = el.Capacitor(ev, "tank", 1e-4, initial_voltage=0.0), el.Resistor(ev, "load", 5.0)
    ground = el.Ground(ev, "ground")
    return compiler(
        ev, width, share, switch, diode, source, coil, tank, load, ground,
        connect=[
            (share.y, width.u), (width.y, switch.u), (source.p, switch.p), (switch.n, diode.n, coil.p),
            (coil.n, tank.p, load.p), (source.n, diode.p, tank.n, load.n, ground.p),
        ],
    )  # fmt: skip


class Cylinder(Component):
    """A piston between two chambers of gas; a valve feeds one of them, and the other one from half of the way on."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        m, A, d = self.parameter("m", 2.0), self.parameter("A", 1e-3), self.parameter("d", 100.0)
        L, dead, C = self.parameter("L", 0.2), self.parameter("dead", 0.01), self.parameter("C", 2e-9)
        supply, air, RT = self.parameter("supply", 6e5), self.parameter("air", 1e5), self.parameter("RT", 8.4e4)
        x, v = self.variable("x", start=0.02, fixed=True), self.variable("v", start=0.0, fixed=True)
        p, q = self.variable("p", start=1e5, fixed=True), self.variable("q", start=1e5, fixed=True)
        fed, left = self.variable("fed"), self.variable("left")
        forward = self.discrete("forward", start=1)
        self.add_equations(
            Eq(der(x), v),
            Eq(m * der(v), (p - q) * A - d * v),
            Eq(fed, through(C, forward * supply + (1 - forward) * air, p)),
            Eq(left, through(C, q, forward * air + (1 - forward) * supply)),
            Eq(der(p) * A * (x + dead), RT * fed - p * A * v),
            Eq(der(q) * A * (L - x + dead), q * A * v - RT * left),
        )
        self.when(x >= L / 2, assign(forward, 0))


def through(C: Any, p: Any, q: Any) -> Any:
    """The flow of gas from the pressure p to q (ISO 6358, critical ratio 0.5, linear where they are close)."""
    ratio = Min(p, q) / Max(p, q)
    part = Piecewise((1, ratio < 0.5), (sqrt(1 - (2 * Min(ratio, 0.999) - 1) ** 2), True))
    return C * Max(p, q) * part * Max(-1, Min(1, (p - q) / 1e3))


def pneumatic_cylinder() -> AcausalCompiler:
    ev = EqnEnv()
    return compiler(ev, Cylinder(ev, "cylinder"), connect=[])


def quarter_car() -> AcausalCompiler:
    """Body and wheel on a road with a step, friction that sticks in the strut, and a force by a sampled controller."""
    ev = EqnEnv()
    body, wheel = tr.Mass(ev, "body", 320.0, 0.0, 0.0), tr.Mass(ev, "wheel", 40.0, 0.0, 0.0)
    strut, tyre = tr.SpringDamper(ev, "strut", 2.2e4, 1.6e3, 0.0), tr.SpringDamper(ev, "tyre", 1.8e5, 150.0, 0.0)
    friction = StickingFriction(ev, "friction", 40.0)
    road, force = tr.PositionSource(ev, "road"), tr.Force(ev, "force")
    sensor, control = tr.SpeedSensor(ev, "sensor"), signal.DiscretePI(ev, "control", kp=-500.0, ki=0.0, period=0.02)
    return compiler(
        ev, body, wheel, strut, tyre, friction, road, force, sensor, control,
        connect=[
            (road.flange, tyre.flange_a), (tyre.flange_b, wheel.flange, strut.flange_a, friction.flange_a),
            (strut.flange_b, body.flange, friction.flange_b, force.flange, sensor.flange),
            (sensor.y, control.u), (control.y, force.f),
        ],
    )  # fmt: skip


class Reactor(Component):
    """A cooled stirred tank, a reaction of first order, and an outflow through a valve."""

    def __init__(self, ev: EqnEnv, name: str):
        super().__init__(ev, name)
        V, c, T = (self.variable(n, start=s, fixed=True) for n, s in (("V", 1.0), ("c", 0.5), ("T", 350.0)))
        k0, E = self.parameter("k0", 7.2e10), self.parameter("E", 8750.0)
        feed, c_feed, T_feed = self.parameter("feed", 1.0), self.parameter("c_feed", 1.0), self.parameter("T_feed", 350)
        UA, T_cool, heat = self.parameter("UA", 50.0), self.parameter("T_cool", 300.0), self.parameter("heat", 209.0)
        valve, out, rate = self.parameter("valve", 1.0), self.variable("out"), self.variable("rate")
        self.add_equations(
            Eq(out, valve * V),
            Eq(rate, k0 * exp(-E / T) * c),
            Eq(der(V), feed - out),
            Eq(V * der(c), feed * (c_feed - c) - V * rate),
            Eq(V * der(T), feed * (T_feed - T) + heat * V * rate + UA / 23.9 * V * (T_cool - T)),
        )


def reactor() -> AcausalCompiler:
    ev = EqnEnv()
    return compiler(ev, Reactor(ev, "reactor"), connect=[])


def one_thermal_state() -> AcausalCompiler:
    ev = EqnEnv()
    mass, loss = thermal.HeatCapacitor(ev, "mass", 2e3, initial_temperature=350.0), thermal.Convection(ev, "loss", 8.0)
    air = thermal.FixedTemperature(ev, "air", 293.0)
    return compiler(ev, mass, loss, air, connect=[(mass.heat, loss.port_a), (loss.port_b, air.heat)])


def plate() -> AcausalCompiler:
    """100 by 100 cells, heated at one edge."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    n = 100
    cells = diagram.add_array(ev, "cell", thermal.HeatCapacitor, (n, n), C=10.0, initial_temperature=293.0)
    along = diagram.add_array(ev, "along", thermal.ThermalConductor, (n - 1, n), G=2.0)
    across = diagram.add_array(ev, "across", thermal.ThermalConductor, (n, n - 1), G=2.0)
    edge = diagram.add_array(ev, "edge", thermal.ThermalConductor, n, G=5.0)
    hot = thermal.FixedTemperature(ev, "hot", 373.0)
    diagram.connect(cells[:-1, :].heat, along.port_a)
    diagram.connect(cells[1:, :].heat, along.port_b)
    diagram.connect(cells[:, :-1].heat, across.port_a)
    diagram.connect(cells[:, 1:].heat, across.port_b)
    diagram.connect(edge.port_a, hot.heat)
    diagram.connect(edge.port_b, cells[0, :].heat)
    return AcausalCompiler(ev, diagram)


def motor_drive() -> AcausalCompiler:
    """A motor with a gear, and a controller of its speed."""
    ev = EqnEnv()
    motor = el.DCMotor(
        ev, "motor", R=1.2, L=8e-3, k=0.25, J=2e-3, d=1e-3, initial_current=0.0, initial_angle=0.0, initial_speed=0.0
    )
    gear, load = rot.IdealGear(ev, "gear", 12.0), rot.Inertia(ev, "load", 0.4)
    friction, base = rot.Damper(ev, "friction", 0.6), rot.FixedAngle(ev, "base")
    speed, pi = rot.SpeedSensor(ev, "speed"), signal.PI(ev, "pi", k=12.0, Ti=0.05)
    source, ground = el.SignalVoltage(ev, "source"), el.Ground(ev, "ground")
    return compiler(
        ev, motor, gear, load, friction, base, speed, pi, source, ground,
        connect=[
            (source.p, motor.p), (source.n, motor.n, ground.p), (motor.flange, gear.flange_a),
            (gear.flange_b, load.flange_a), (load.flange_b, friction.flange_b, speed.flange),
            (friction.flange_a, base.flange), (speed.y, pi.measured), (pi.y, source.u),
        ],
    )  # fmt: skip


def bridge_rectifier() -> AcausalCompiler:
    """Four ideal diodes behind a sine, a capacitor and a load; two periods."""
    ev = EqnEnv()
    source, inner = el.SineVoltage(ev, "source", amplitude=10.0, frequency=50.0), el.Resistor(ev, "inner", 0.5)
    a, b, c, d = (el.IdealDiode(ev, n, Goff=1e-6, Ron=1e-3) for n in "abcd")
    tank, load = el.Capacitor(ev, "tank", 1e-3, initial_voltage=0.0), el.Resistor(ev, "load", 50.0)
    ground = el.Ground(ev, "ground")
    return compiler(
        ev, source, inner, a, b, c, d, tank, load, ground,
        connect=[
            (source.p, inner.p), (inner.n, a.p, d.n), (source.n, b.p, c.n), (a.n, b.n, tank.p, load.p),
            (c.p, d.p, tank.n, load.n, ground.p),
        ],
    )  # fmt: skip


def house() -> AcausalCompiler:
    """A wall in three layers, air, a floor, and a limited controller of the heater."""
    ev = EqnEnv()
    outside, room = thermal.FixedTemperature(ev, "outside", 273.0), thermal.HeatCapacitor(ev, "room", 4e6, 288.0)
    R, C, T = [1e-3, 1e-2, 1.4e-3], [2.7e7, 4e5, 1.6e7], [275.0, 280.0, 285.0]
    wall = thermal.Wall(ev, "wall", R=R, C=C, initial_temperature=T)
    floor, underfoot = thermal.HeatCapacitor(ev, "floor", 3e7, 290.0), thermal.Convection(ev, "underfoot", 7.0, 80.0)
    windows, heater = thermal.ThermalConductor(ev, "windows", 130.0), thermal.HeatFlowSource(ev, "heater")
    sensor, aim = thermal.TemperatureSensor(ev, "sensor"), signal.Constant(ev, "aim", 294.0)
    control = signal.PI(ev, "control", k=1500.0, Ti=10800.0, low=0.0, high=6000.0)
    return compiler(
        ev, outside, room, wall, floor, underfoot, windows, heater, sensor, aim, control,
        connect=[
            (outside.heat, wall.port_a, windows.port_a), (floor.heat, underfoot.port_a),
            (room.heat, wall.port_b, windows.port_b, heater.heat, sensor.heat, underfoot.port_b),
            (aim.y, control.setpoint), (sensor.T, control.measured), (control.y, heater.Q_flow),
        ],
    )  # fmt: skip


def water_network() -> AcausalCompiler:
    """Two tanks, a loop of turbulent pipes, and a valve to the air."""
    ev = EqnEnv()
    high, low = hy.Tank(ev, "high", 2.0, initial_level=8.0), hy.Tank(ev, "low", 1.0, initial_level=2.0)
    pipes = [hy.TurbulentPipe(ev, f"pipe{k}", D=0.1, L=50.0 + 20.0 * k) for k in range(5)]
    valve, air = hy.Valve(ev, "valve", A=1e-3), hy.PressureSource(ev, "air")
    a, b, c, d, e = pipes
    return compiler(
        ev, high, low, *pipes, valve, air,
        connect=[
            (high.fluid, a.port_a), (a.port_b, b.port_a, c.port_a), (b.port_b, d.port_a, e.port_a),
            (c.port_b, d.port_b, valve.port_a), (e.port_b, low.fluid), (valve.port_b, air.fluid),
        ],
    )  # fmt: skip


MODELS: dict[str, Model] = {
    "rod on a pin": Model(rod_on_a_pin, 2.0, "rod.body.phi", "rod.m"),
    "four-bar": Model(four_bar, 1.0, "rocker.body.phi", "crank.m"),
    "buck converter": Model(buck_converter, 0.1, "tank.v", "load.R"),
    "pneumatic cylinder": Model(pneumatic_cylinder, 0.5, "cylinder.x", "cylinder.m"),
    "quarter car": Model(quarter_car, 1.0, "body.s", "strut.c", {"inputs": {"road.u": 0.05}}),
    "reactor": Model(reactor, 5.0, "reactor.T", "reactor.UA"),
    "one thermal state": Model(one_thermal_state, 600.0, "mass.T", "mass.C"),
    "plate": Model(plate, 60.0, "cell[0,50].T", "hot.T"),
    "motor drive": Model(motor_drive, 1.0, "load.w", "load.J", {"inputs": {"pi.setpoint": 6.0}}),
    "bridge rectifier": Model(bridge_rectifier, 0.04, "tank.v", "load.R"),
    "house": Model(house, 172800.0, "room.T", "room.C"),
    "water network": Model(water_network, 600.0, "low.level", "low.A"),
}


def times(model: Model) -> np.ndarray:
    return np.linspace(0.0, model.t1, SAVED)
