"""Plants of library components with a nonlinear block or a closed mechanism, that switch. References: SciPy's solution
in the fewest coordinates, from event to event."""

import numpy as np
import pytest
from from_event_to_event import compare, followed, root
from problems import compiled
from sympy import cos, sin, tanh

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.hydraulic as hyd
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.thermal as heat
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import Component, Eq, EqnEnv, Rotational, Translational, der
from jaxonomy_dae.library.contacts import DogClutch
from jaxonomy_dae.library.electrical.two_pin import TwoPin
from jaxonomy_dae.library.friction import Brake
from jaxonomy_dae.library.transmissions import Planetary

pytestmark = pytest.mark.slow
RHO, G, AMBIENT, SMALL, SIGMA = 998.2, 9.80665, 101325.0, 100.0, 5.670374419e-8


def through(dp, size):
    """The flow of an orifice or a turbulent pipe."""
    return size * dp / (dp**2 + SMALL**2) ** 0.25


def orifice(A):
    return A * 0.6 * np.sqrt(2 * RHO)


def pipe(D, L):
    return np.pi * D**2 / 4 * np.sqrt(2 * RHO * D / (0.02 * L))


def in_series(dp, first, second):
    """The pressure that falls over the first of two restrictions."""
    if dp == 0 or second == 0:
        return 0.0
    return root(lambda over: through(over, first) - through(dp - over, second), *sorted((0.0, dp)))


def by_turns(slopes, levels, y, end):
    """The state at the end of a run in which modes follow each other: slopes(t, y, k) in mode k, until levels[k](t, y)
    falls through zero."""
    t, k = 0.0, 0
    while t < end:
        mode = k % len(levels)
        t, y = followed(lambda t, y, mode=mode: slopes(t, y, mode), y, t, end, levels[mode])
        k += 1
    assert k > 3, "modes change at least three times"
    return y


class Choke(TwoPin):
    """A coil whose iron saturates: the flux is core·tanh(i/knee) + air·i."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        core, knee, air = (self.parameter(k, x) for k, x in (("core", 0.05), ("knee", 2.0), ("air", 1e-3)))
        v, i = self._two_pins()
        flux = self.variable("flux", start=0.0, fixed=True)
        self.add_equations(Eq(der(flux), v), Eq(flux, core * tanh(i / knee) + air * i))


def test_a_relay_holds_the_speed_of_a_motor_whose_iron_saturates():
    ev = EqnEnv()
    source, r, choke, emf, ground = (
        el.SignalVoltage(ev, "source"), el.Resistor(ev, "r", 0.8), Choke(ev, "choke"), el.EMF(ev, "emf", 0.15),
        el.Ground(ev, "ground"),
    )  # fmt: skip
    rotor, load, wall = (
        rot.Inertia(ev, "rotor", 2e-3, 0.0, 0.0),
        rot.Damper(ev, "load", 4e-3),
        rot.FixedAngle(ev, "wall"),
    )
    sensor, relay = (
        rot.SpeedSensor(ev, "sensor"),
        sig.Hysteresis(ev, "relay", lower=40.0, upper=50.0, low=24.0, high=0.0),
    )
    ends = (
        (source.p, r.p), (r.n, choke.p), (choke.n, emf.p), (emf.n, source.n, ground.p),
        (emf.flange, rotor.flange_a), (rotor.flange_b, load.flange_b, sensor.flange), (load.flange_a, wall.flange),
        (sensor.y, relay.u), (relay.y, source.u),
    )  # fmt: skip
    system = compiled(source, r, choke, emf, ground, rotor, load, wall, sensor, relay, connect=ends)

    def known(p):
        k, upper, core = p

        def slopes(t, y, mode):
            i, w = y
            inductance = core / 2.0 / np.cosh(i / 2.0) ** 2 + 1e-3
            return [((24.0, 0.0)[mode] - 0.8 * i - k * w) / inductance, (k * i - 4e-3 * w) / 2e-3]

        return by_turns(slopes, [lambda t, y: upper - y[1], lambda t, y: y[1] - 40.0], [0.0, 0.0], 0.1)[1]

    compare(system, ["emf.k", "relay.upper", "choke.core"], [0.15, 50.0, 0.05], "rotor.w", known, 0.1)


def test_a_rectifier_with_an_exponential_diode_whose_load_is_switched_on():
    ev = EqnEnv()
    source, r, diode = el.SineVoltage(ev, "source", 10.0, 50.0), el.Resistor(ev, "r", 1.0), el.Diode(ev, "diode")
    c, switch = el.Capacitor(ev, "c", 1e-3, 0.0), el.TimedSwitch(ev, "switch", time=0.0223)
    load, ground = el.Resistor(ev, "load", 20.0), el.Ground(ev, "ground")
    ends = (
        (source.p, r.p), (r.n, diode.p), (diode.n, c.p, switch.p), (switch.n, load.p),
        (load.n, c.n, source.n, ground.p),
    )  # fmt: skip
    system = compiled(source, r, diode, c, switch, load, ground, connect=ends)

    def known(p):
        at, scale, capacity = p

        def slopes(t, y, load):
            drive = 10.0 * np.sin(100 * np.pi * t) - y[0]

            def missing(v):
                return scale * np.expm1(v / 0.04) + v / 1e8 - (drive - v)

            return [(drive - root(missing, -25.0, 1.2) - load * y[0]) / capacity]

        _, y = followed(lambda t, y: slopes(t, y, 0.0), [0.0], 0.0, at)
        return followed(lambda t, y: slopes(t, y, 1 / 20.0), y, at, 0.05)[1][0]

    compare(system, ["switch.time", "diode.Is", "c.C"], [0.0223, 1e-9, 1e-3], "c.v", known, 0.05)


def test_a_float_switch_on_a_valve_behind_a_long_pipe():
    ev = EqnEnv()
    source, feed, valve = (
        hyd.PressureSource(ev, "source", 2e5), hyd.TurbulentPipe(ev, "feed", D=0.02, L=10.0),
        hyd.Valve(ev, "valve", A=1.5e-4),
    )  # fmt: skip
    tank, out, drain = (
        hyd.Tank(ev, "tank", A=0.05, initial_level=1.0), hyd.Orifice(ev, "out", A=5e-5),
        hyd.PressureSource(ev, "drain"),
    )  # fmt: skip
    switch = sig.Hysteresis(ev, "switch", lower=0.8, upper=1.2, low=1.0, high=0.0)
    ends = (
        (source.fluid, feed.port_a), (feed.port_b, valve.port_a), (valve.port_b, tank.fluid, out.port_a),
        (out.port_b, drain.fluid), (tank.level, switch.u), (switch.y, valve.opening),
    )  # fmt: skip
    system = compiled(source, feed, valve, tank, out, drain, switch, connect=ends)

    def known(p):
        upper, lower, wide = p

        def slopes(t, y, mode):
            dp = 2e5 - AMBIENT - RHO * G * y[0]
            inflow = through(in_series(dp, pipe(wide, 10.0), orifice(1.5e-4)), pipe(wide, 10.0)) if mode == 0 else 0.0
            return [(inflow - through(RHO * G * y[0], orifice(5e-5))) / (RHO * 0.05)]

        return by_turns(slopes, [lambda t, y: upper - y[0], lambda t, y: y[0] - lower], [1.0], 400.0)[0]

    compare(system, ["switch.upper", "switch.lower", "feed.D"], [1.2, 0.8, 0.02], "tank.level", known, 400.0)


def test_a_piston_between_two_check_valves_fills_an_accumulator():
    """The chamber sucks, is compressed, delivers, and expands, in turn; the gas of the accumulator follows its law."""
    ev = EqnEnv()
    wave, crank, cylinder = sig.Sine(ev, "wave", 0.05), line.PositionSource(ev, "crank"), hyd.Cylinder(ev, "cylinder")
    chamber, sea = hyd.HydraulicCapacity(ev, "chamber", 2e-10, AMBIENT - 100.0), hyd.PressureSource(ev, "sea")
    suction, pressure = hyd.CheckValve(ev, "suction", R=1e4), hyd.CheckValve(ev, "pressure", R=1e4)
    store = hyd.Accumulator(ev, "store", p0=2e5, n=1.4, initial_volume=1e-4)
    out, drain = hyd.Orifice(ev, "out", A=4e-6), hyd.PressureSource(ev, "drain")
    ends = (
        (wave.y, crank.u), (crank.flange, cylinder.flange), (sea.fluid, suction.port_a),
        (suction.port_b, cylinder.fluid, chamber.fluid, pressure.port_a), (pressure.port_b, store.fluid, out.port_a),
        (out.port_b, drain.fluid),
    )  # fmt: skip
    system = compiled(wave, crank, cylinder, chamber, sea, suction, pressure, store, out, drain, connect=ends)

    def known(p):
        charge, area, stroke = p

        def stored(y):
            return charge * (1e-3 / (1e-3 - y[1])) ** 1.4

        def slopes(t, y, mode):
            taken = (AMBIENT - y[0]) / 1e4 if mode == 0 else 0.0
            given = (y[0] - stored(y)) / 1e4 if mode == 2 else 0.0
            drawn = RHO * 1e-3 * stroke * 2 * np.pi * np.cos(2 * np.pi * t)
            leaves = through(stored(y) - AMBIENT, orifice(area))
            return [(taken - given - drawn) / (RHO * 2e-10), (given - leaves) / RHO]

        levels = [
            lambda t, y: AMBIENT - y[0], lambda t, y: stored(y) - y[0], lambda t, y: y[0] - stored(y),
            lambda t, y: y[0] - AMBIENT,
        ]  # fmt: skip
        return by_turns(slopes, levels, [AMBIENT - 100.0, 1e-4], 1.6)[1]

    names = ["store.p0", "out.A", "wave.amplitude"]
    compare(system, names, [2e5, 4e-6, 0.05], "store.V_fluid", known, 1.6)


def test_a_relief_valve_before_a_long_pipe():
    ev = EqnEnv()
    supply, store, relief = (
        hyd.MassFlowSource(ev, "supply"), hyd.Accumulator(ev, "store", V0=2e-3, p0=2e5, n=1.4, initial_volume=1e-4),
        hyd.ReliefValve(ev, "relief", p_open=6e5, p_close=2e5, A=2e-5),
    )  # fmt: skip
    back, sump = hyd.TurbulentPipe(ev, "back", D=0.008, L=5.0), hyd.PressureSource(ev, "sump")
    ends = (supply.fluid, store.fluid, relief.port_a), (relief.port_b, back.port_a), (back.port_b, sump.fluid)
    system = compiled(supply, store, relief, back, sump, connect=ends)

    def known(p):
        p_open, p_close, wide = p

        def total(y):
            return 2e5 * (2e-3 / (2e-3 - y[0])) ** 1.4 - AMBIENT

        def over(y):
            return in_series(total(y), orifice(2e-5), pipe(wide, 5.0))

        def slopes(t, y, mode):
            return [(0.15 - (through(over(y), orifice(2e-5)) if mode else 0.0)) / RHO]

        return by_turns(slopes, [lambda t, y: p_open - total(y), lambda t, y: over(y) - p_close], [1e-4], 30.0)[0]

    names = ["relief.p_open", "relief.p_close", "back.D"]
    compare(system, names, [6e5, 2e5, 0.008], "store.V_fluid", known, 30.0, {"supply.m_flow": 0.15})


def test_a_thermostat_on_a_radiator_whose_resistance_follows_its_temperature():
    """The element stores no heat: its temperature solves R(T)·σ·(T⁴ − room⁴) = V², and was found below zero kelvin."""
    ev = EqnEnv()
    source, element, ground = (
        el.SignalVoltage(ev, "source"), el.HeatedResistor(ev, "element", R=100.0, alpha=4e-3), el.Ground(ev, "ground"),
    )  # fmt: skip
    shines, room, leak, outside = (
        heat.Radiation(ev, "shines", A=0.01), heat.HeatCapacitor(ev, "room", 2000.0, 290.0),
        heat.ThermalConductor(ev, "leak", 0.5), heat.FixedTemperature(ev, "outside", 280.0),
    )  # fmt: skip
    sensor, relay = (
        heat.TemperatureSensor(ev, "sensor"),
        sig.Hysteresis(ev, "relay", lower=293.0, upper=295.0, low=100.0, high=0.0),
    )  # fmt: skip
    ends = (
        (source.p, element.p), (element.n, source.n, ground.p), (element.heat, shines.port_a),
        (shines.port_b, room.heat, leak.port_a, sensor.heat), (leak.port_b, outside.heat),
        (sensor.T, relay.u), (relay.y, source.u),
    )  # fmt: skip
    system = compiled(source, element, ground, shines, room, leak, outside, sensor, relay, connect=ends)

    def known(p):
        upper, alpha, surface = p

        def slopes(t, y, mode):
            def missing(T):
                return 0.9 * SIGMA * surface * (T**4 - y[0] ** 4) * 100.0 * (1 + alpha * (T - 293.15)) - 1e4

            warms = 1e4 / (100.0 * (1 + alpha * (root(missing, y[0], 2000.0) - 293.15))) if mode == 0 else 0.0
            return [(warms - 0.5 * (y[0] - 280.0)) / 2000.0]

        return by_turns(slopes, [lambda t, y: upper - y[0], lambda t, y: y[0] - 293.0], [290.0], 1500.0)[0]

    names = ["relay.upper", "element.alpha", "shines.A"]
    compare(system, names, [295.0, 4e-3, 0.01], "room.T", known, 1500.0, part=1e-5)  # of a level 2 K above the other


def test_a_brake_on_the_ring_of_a_planetary_gear():
    """The ring slips, sticks and is let go; the carrier winds up a spring that hardens."""
    ev = EqnEnv()
    sun, ring, carrier = (rot.Inertia(ev, k, J, 0.0, 0.0) for k, J in (("sun", 0.02), ("ring", 0.05), ("carrier", 0.1)))
    gear, spring, wall = (
        Planetary(ev, "gear"), rot.NonlinearSpring(ev, "spring", c=3.0, c3=2.0), rot.FixedAngle(ev, "wall"),
    )  # fmt: skip
    drive, brake = rot.Torque(ev, "drive"), Brake(ev, "brake", mu=0.5, fn_max=400.0, cgeo=0.1)
    press = sig.Pulse(ev, "press", period=10.0, width=0.04, start_time=0.3)
    ends = (
        (drive.flange, sun.flange_a), (sun.flange_b, gear.sun), (ring.flange_a, gear.ring),
        (ring.flange_b, brake.flange), (carrier.flange_a, gear.carrier), (carrier.flange_b, spring.flange_b),
        (spring.flange_a, wall.flange), (press.y, brake.u),
    )  # fmt: skip
    system = compiled(sun, ring, carrier, gear, spring, wall, drive, brake, press, connect=ends)

    def known(p):
        inertia, c3, begins = p
        way = np.array([1.0, 2.0]) / 3.0  # of the carrier, by sun and ring
        mass = np.diag([inertia, 0.05]) + 0.1 * np.outer(way, way)

        def slopes(t, y, rubs=0.0, held=False):
            turned = way @ y[:2]
            pull = np.array([2.0, -rubs]) - way * (3.0 * turned + c3 * turned**3)
            if held:
                return [y[2], 0.0, pull[0] / mass[0, 0], 0.0]
            return [*y[2:], *np.linalg.solve(mass, pull)]

        _, y = followed(slopes, [0.0] * 4, 0.0, begins)
        turns = np.sign(y[3])
        t, y = followed(lambda t, y: slopes(t, y, 20.0 * turns), y, begins, begins + 0.4, lambda t, y: turns * y[3])
        y[3] = 0.0
        _, y = followed(lambda t, y: slopes(t, y, held=True), y, t, begins + 0.4)
        return followed(slopes, y, begins + 0.4, 1.0)[1][0]

    names = ["sun.J", "spring.c3", "press.start_time"]
    compare(system, names, [0.02, 2.0, 0.3], "sun.phi", known, 1.0, {"drive.tau": 2.0})


def test_a_dimmed_lamp_behind_a_thyristor_and_an_exponential_diode():
    """The thyristor conducts from its pulse to the end of the current; the filament's resistance follows its heat."""
    ev = EqnEnv()
    source, gate = (
        el.SineVoltage(ev, "source", 325.0, 50.0),
        sig.Pulse(ev, "gate", period=0.02, width=0.05, start_time=3e-3),
    )
    thyristor, diode = el.IdealThyristor(ev, "thyristor"), el.Diode(ev, "diode")
    lamp, ground = el.HeatedResistor(ev, "lamp", R=60.0, alpha=4.5e-3), el.Ground(ev, "ground")
    filament, shines, walls = (
        heat.HeatCapacitor(ev, "filament", 0.02, 300.0), heat.Radiation(ev, "shines", A=1e-4),
        heat.FixedTemperature(ev, "walls", 300.0),
    )  # fmt: skip
    ends = (
        (source.p, thyristor.p), (thyristor.n, diode.p), (diode.n, lamp.p), (lamp.n, source.n, ground.p),
        (gate.y, thyristor.fire), (lamp.heat, filament.heat, shines.port_a), (shines.port_b, walls.heat),
    )  # fmt: skip
    system = compiled(source, gate, thyristor, diode, lamp, ground, filament, shines, walls, connect=ends)

    def known(p):
        begins, peak, scale = p

        def slopes(t, y, conducts):
            resistance, warms = 60.0 * (1 + 4.5e-3 * (y[0] - 293.15)), 0.0
            if conducts:
                drive = peak * np.sin(100 * np.pi * t)
                v = root(lambda v: scale * np.expm1(v / 0.04) + v / 1e8 - (drive - v) / resistance, -1.0, 1.2)
                warms = (drive - v) ** 2 / resistance
            return [(warms - 0.9 * SIGMA * 1e-4 * (y[0] ** 4 - 300.0**4)) / 0.02]

        y, t = [300.0], 0.0
        for turn, conducts in ((begins, 0), (0.01, 1), (begins + 0.02, 0), (0.03, 1), (0.036, 0)):
            _, y = followed(lambda t, y, conducts=conducts: slopes(t, y, conducts), y, t, turn)
            t = turn
        return y[0]

    names = ["gate.start_time", "source.amplitude", "diode.Is"]
    compare(system, names, [3e-3, 325.0, 1e-9], "filament.T", known, 0.036)


def test_a_check_valve_stops_the_water_of_a_long_pipe():
    """Inertia carries the water beyond equal levels; where it would turn back, the valve shuts and holds the levels."""
    ev = EqnEnv()
    high, low = (hyd.Tank(ev, k, A=0.1, initial_level=h) for k, h in (("high", 2.0), ("low", 1.0)))
    check, column = hyd.CheckValve(ev, "check", R=1e2, inertial=True), hyd.Inertance(ev, "column", 200.0, 5e-3, 0.0)
    walls = hyd.TurbulentPipe(ev, "walls", D=0.08, L=20.0)
    ends = (
        (high.fluid, check.port_a), (check.port_b, column.port_a), (column.port_b, walls.port_a),
        (walls.port_b, low.fluid),
    )  # fmt: skip
    system = compiled(high, low, check, column, walls, connect=ends)

    def known(p):
        length, wide, resistance = p

        def slopes(t, y):
            lost = root(lambda dp: through(dp, pipe(wide, 20.0)) - y[2], -1e6, 1e6)
            pull = RHO * G * (y[0] - y[1]) - resistance * y[2] - lost
            return [-y[2] / (RHO * 0.1), y[2] / (RHO * 0.1), pull * 5e-3 / length]

        _, y = followed(slopes, [2.0, 1.0, 0.0], 0.0, 5.0)
        t, y = followed(slopes, y, 5.0, 200.0, lambda t, y: y[2])
        assert t < 100.0 and y[1] > 1.5
        return y[1]

    compare(system, ["column.L", "walls.D", "check.R"], [200.0, 0.08, 1e2], "low.level", known, 100.0)


class Yoke(Component):
    """b.s = r·sin(a.phi): a scotch yoke."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b, r = self.port("a", Rotational), self.port("b", Translational), self.parameter("r", 0.1)
        self.add_equations(Eq(b.s, r * sin(a.phi)), Eq(a.tau + r * cos(a.phi) * b.f, 0))


def test_a_dog_clutch_engages_a_scotch_yoke():
    """The impulse meets the inertia that the mechanism has in its position."""
    ev = EqnEnv()
    wheel, shaft, clutch = (
        rot.Inertia(ev, "wheel", 0.05, 0.0, 10.0), rot.Inertia(ev, "shaft", 0.01, 0.4, 3.0), DogClutch(ev, "clutch"),
    )  # fmt: skip
    yoke, mass, spring, wall = (
        Yoke(ev, "yoke"), line.Mass(ev, "mass", 2.0), line.Spring(ev, "spring", c=100.0),
        line.FixedPosition(ev, "wall"),
    )  # fmt: skip
    gate = sig.Pulse(ev, "gate", period=10.0, width=0.03, start_time=0.2)
    ends = (
        (wheel.flange_b, clutch.flange_a), (clutch.flange_b, shaft.flange_a), (shaft.flange_b, yoke.a),
        (yoke.b, mass.flange, spring.flange_b), (spring.flange_a, wall.flange), (gate.y, clutch.u),
    )  # fmt: skip
    system = compiled(wheel, shaft, clutch, yoke, mass, spring, wall, gate, connect=ends)

    def known(p):
        r, inertia, begins = p

        def slopes(t, y, more=0.0):
            way, bend = r * np.cos(y[0]), -r * np.sin(y[0])
            pull = -100.0 * r * np.sin(y[0]) * way - 2.0 * way * bend * y[1] ** 2
            return [y[1], pull / (0.01 + 2.0 * way**2 + more)]

        _, y = followed(slopes, [0.4, 3.0], 0.0, begins)
        own = 0.01 + 2.0 * (r * np.cos(y[0])) ** 2
        start = [y[0], (own * y[1] + inertia * 10.0) / (own + inertia)]
        _, y = followed(lambda t, y: slopes(t, y, inertia), start, begins, begins + 0.3)
        return followed(slopes, y, begins + 0.3, 0.8)[1][0]

    names = ["yoke.r", "wheel.J", "gate.start_time"]
    compare(system, names, [0.1, 0.05, 0.2], "shaft.phi", known, 0.8)
