"""Whole plants that become FMUs: circuits that switch, friction, a linkage, a battery pack, a house, a filter, a
Modelica text."""

import numpy as np
from modelica_twins import TWINS
from problems import compiled

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library import electrical as el
from jaxonomy_dae.library import planar, signal, thermal
from jaxonomy_dae.library import translational as line
from jaxonomy_dae.library.battery import HeatedPack
from jaxonomy_dae.library.friction import StickingFriction
from jaxonomy_dae.modelica import FlatComponent, load


def rectifier():
    """Four diodes between a source of 10 V, 50 Hz, and a capacitor with a load."""
    ev = EqnEnv()
    diodes = [el.IdealDiode(ev, f"d{k}", Ron=0.05, Goff=1e-4) for k in range(4)]
    source, inner = el.SineVoltage(ev, "source", 10.0, 50.0), el.Resistor(ev, "inner", 0.5)
    tank, load_ = el.Capacitor(ev, "tank", 1e-3, initial_voltage=0.0), el.Resistor(ev, "load", 50.0)
    ground = el.Ground(ev, "ground")
    connect = [
        (source.p, inner.p), (inner.n, diodes[0].p, diodes[1].n), (source.n, diodes[2].p, diodes[3].n),
        (diodes[0].n, diodes[2].n, tank.p, load_.p), (diodes[1].p, diodes[3].p, tank.n, load_.n, ground.p),
    ]  # fmt: skip
    return compiled(*diodes, source, inner, tank, load_, ground, connect=connect)


def buck():
    """A converter of 24 V whose voltage a sampled controller holds at 9 V."""
    ev = EqnEnv()
    width, pi = signal.PulseWidth(ev, "width", period=1e-3), signal.DiscretePI(ev, "pi", 0.02, 15.0, 1e-3, 0.0, 0.9)
    wished, error = signal.Constant(ev, "wished", k=9.0), signal.Sum(ev, "error", (1, -1))
    switch, diode = el.Switch(ev, "switch", Goff=1e-5, Ron=0.02), el.IdealDiode(ev, "diode", Goff=1e-5, Ron=0.02)
    source, coil = el.VoltageSource(ev, "source", 24.0), el.Inductor(ev, "coil", 1e-3, initial_current=0.0)
    tank, load_ = el.Capacitor(ev, "tank", 1e-4, initial_voltage=0.0), el.Resistor(ev, "load", 5.0)
    ground, sensor = el.Ground(ev, "ground"), el.VoltageSensor(ev, "sensor")
    connect = [
        (source.p, switch.p), (switch.n, diode.n, coil.p), (coil.n, tank.p, load_.p, sensor.p),
        (source.n, diode.p, tank.n, load_.n, ground.p, sensor.n), (wished.y, error.u1), (sensor.v, error.u2),
        (error.y, pi.u), (pi.y, width.u), (width.y, switch.u),
    ]  # fmt: skip
    return compiled(width, pi, wished, error, switch, diode, source, coil, tank, load_, ground, sensor, connect=connect)


def stick_slip():
    """A mass on a belt's end, pulled through a spring by a force from outside."""
    ev = EqnEnv()
    mass, wall = line.Mass(ev, "mass", 2.0, initial_position=0.0, initial_velocity=0.0), line.FixedPosition(ev, "wall")
    friction, force = StickingFriction(ev, "friction", sliding=3.0, breakaway=5.0), line.Force(ev, "force")
    sine = signal.Sine(ev, "sine", amplitude=8.0, frequency=0.5)
    connect = [
        (wall.flange, friction.flange_a), (friction.flange_b, mass.flange, force.flange), (sine.y, force.f),
    ]  # fmt: skip
    return compiled(mass, wall, friction, force, sine, connect=connect)


def four_bar():
    ev = EqnEnv()
    west, east = planar.World(ev, "west"), planar.World(ev, "east", x=2.0)
    crank = planar.MassiveLink(ev, "crank", 0.8, m=1.0)
    coupler = planar.MassiveLink(ev, "coupler", 1.9, m=0.6, guess_angle=0.3)
    rocker = planar.MassiveLink(ev, "rocker", 1.5, m=1.5, guess_angle=1.7)
    pins = [planar.Revolute(ev, "j1", initial_angle=1.0, initial_speed=5.0)]
    pins += [planar.Revolute(ev, f"j{k}") for k in (2, 3, 4)]
    connect = [
        (west.frame, pins[0].frame_a), (pins[0].frame_b, crank.frame_a), (crank.frame_b, pins[1].frame_a),
        (pins[1].frame_b, coupler.frame_a), (coupler.frame_b, pins[2].frame_a), (pins[2].frame_b, rocker.frame_b),
        (east.frame, pins[3].frame_a), (pins[3].frame_b, rocker.frame_a),
    ]  # fmt: skip
    return compiled(west, east, crank, coupler, rocker, *pins, connect=connect)


SOC, OCV = [0.0, 0.1, 0.25, 0.5, 0.8, 1.0], [3.0, 3.45, 3.58, 3.70, 3.97, 4.19]


def pack():
    """Two rows of three cells that differ, cooled, discharged by a current from outside."""
    ev, rng = EqnEnv(), np.random.default_rng(3)
    cells = HeatedPack(
        ev, "pack", 2, 3, SOC, OCV, Q=2.5 * (1 + 0.03 * rng.standard_normal((2, 3))),
        R0=0.03 * (1 + 0.1 * rng.standard_normal((2, 3))), initial_soc=0.95, R=[0.015], C=[2e3], kind="cubic", Ea=2e4,
        C_heat=45.0, G_neighbour=0.3, G_coolant=0.08, initial_temperature=298.15,
    )  # fmt: skip
    coolant = thermal.FixedTemperature(ev, "coolant", 293.15)
    drain, ground = el.SignalCurrent(ev, "drain"), el.Ground(ev, "ground")
    connect = [(cells.p, drain.p), (cells.n, drain.n, ground.p), (cells.coolant, coolant.heat)]
    return compiled(cells, coolant, drain, ground, connect=connect)


def house():
    """A wall of two layers between the weather and a room, whose heating comes from outside."""
    ev = EqnEnv()
    weather, heating = thermal.TemperatureSource(ev, "weather"), thermal.HeatFlowSource(ev, "heating")
    wall = thermal.Wall(ev, "wall", R=[0.001, 0.01, 0.002], C=[3e6, 1e6, 5e6])
    air = thermal.HeatCapacitor(ev, "air", 3e6, initial_temperature=288.15)
    connect = [(weather.heat, wall.port_a), (wall.port_b, air.heat, heating.heat)]
    return compiled(weather, wall, air, heating, connect=connect)


def discrete_filter():
    """A sine through a digital low-pass of second order, and a lag that follows it."""
    ev = EqnEnv()
    sine = signal.Sine(ev, "sine", amplitude=1.0, frequency=1.0)
    digital = signal.DiscreteTransferFunction(ev, "digital", [0.1, 0.2, 0.1], [1.0, -0.9, 0.3], 0.05)
    lag = signal.FirstOrder(ev, "lag", k=1.0, T=0.2)
    return compiled(sine, digital, lag, connect=[(sine.y, digital.u), (digital.y, lag.u)])


def clutch():
    """Two discs that slide until they turn as one: a flat Modelica text."""
    return compiled(FlatComponent(EqnEnv(), "m", load(TWINS["Clutch"])))
