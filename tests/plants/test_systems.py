"""Electrical and thermal systems of library components, with the default solver, against closed forms and SciPy."""

import numpy as np
import pytest
import scipy.optimize
from problems import compiled
from reference_systems import (
    ReferenceSystem,
    check_gradient,
    check_solution,
    driven,
    integrated,
    linear,
    system_of,
    values_of,
)
from trajectories import check_trajectory

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.thermal as th
from jaxonomy_dae import Component, Electrical, EqnEnv, frequency_response, linearize, steady_state
from jaxonomy_dae.write import Eq

ROUNDING = 1e-11  # of linear algebra with these small matrices

# --- a drive with speed control ------------------------------------------------------------------------------------

SETPOINT, LOAD_TORQUE = 6.0, -3.0  # rad/s, N·m


def drive():
    """A DC motor, a gear, a load with friction and a torque, and a PI controller of the load's speed."""

    def make():
        ev = EqnEnv()
        motor = el.DCMotor(ev, "motor", 1.2, 8e-3, 0.25, 2e-3, 1e-3, 0.0, 0.1, 0.0)
        gear, load, friction = rot.IdealGear(ev, "gear", 12.0), rot.Inertia(ev, "load", 0.4), rot.Damper(ev, "bar", 0.6)
        base, torque, speed = rot.FixedAngle(ev, "base"), rot.Torque(ev, "torque"), rot.SpeedSensor(ev, "speed")
        pi, source, ground = sig.PI(ev, "pi", 3.0, 0.15), el.SignalVoltage(ev, "source"), el.Ground(ev, "ground")
        return compiled(
            motor, gear, load, friction, base, torque, speed, pi, source, ground,
            connect=[
                (source.p, motor.p), (source.n, motor.n, ground.p), (motor.flange, gear.flange_a),
                (gear.flange_b, load.flange_a), (load.flange_b, friction.flange_b, torque.flange, speed.flange),
                (friction.flange_a, base.flange), (speed.y, pi.measured), (pi.y, source.u),
            ],
        )  # fmt: skip

    def expected(p):
        a, b = drive_matrices(p)
        n = p["gear.ratio"]
        start = [p["motor.inductor.initial_current"], p["motor.rotor.initial_speed"] / n, p["pi.initial_x"]]
        i, w, x = linear(a, start, b @ [SETPOINT, LOAD_TORQUE], TS_DRIVE)
        return {
            "motor.inductor.i": i, "load.w": w, "pi.x": x, "motor.rotor.w": n * w,
            "source.v": p["pi.k"] * (SETPOINT - w + x),
        }  # fmt: skip

    inputs = {"pi.setpoint": SETPOINT, "torque.tau": LOAD_TORQUE}
    return ReferenceSystem(make, expected, TS_DRIVE, "load.w", inputs)


TS_DRIVE = np.linspace(0.0, 0.25, 9)


def drive_matrices(p):
    """(A, B) of (current, load's speed, integral) and (setpoint, load's torque): the gear brings the motor's inertia
    and friction to the load by ratio²."""
    n, k, gain = p["gear.ratio"], p["motor.k"], p["pi.k"]
    L, J = p["motor.L"], p["motor.J"] * n**2 + p["load.J"]
    a = np.array([
        [-p["motor.R"] / L, -(gain + k * n) / L, gain / L],
        [k * n / J, -(p["motor.d"] * n**2 + p["bar.d"]) / J, 0.0],
        [0.0, -1 / p["pi.Ti"], 0.0],
    ])  # fmt: skip
    return a, np.array([[gain / L, 0.0], [0.0, 1 / J], [1 / p["pi.Ti"], 0.0]])


@pytest.mark.slow
def test_linearized_drive():
    """Poles, and the speed's answer to setpoint and torque: C·(jω − A)⁻¹·B of the equations by hand."""
    _, system = system_of(drive)
    inputs, omega = {"pi.setpoint": SETPOINT, "torque.tau": LOAD_TORQUE}, np.array([0.1, 3.0, 40.0, 1e3])
    point = steady_state(system, inputs=inputs, drifting=["motor.rotor.phi"])
    p = values_of(system)
    a, b = drive_matrices(p)
    at = -np.linalg.solve(a, b @ [SETPOINT, LOAD_TORQUE])
    np.testing.assert_allclose(point[["motor.inductor.i", "load.w", "pi.x"]], at, rtol=ROUNDING)
    space = linearize(system, list(inputs), ["load.w"], at=point)
    poles = np.append(np.linalg.eigvals(a), 0.0)  # the angle's
    found = np.asarray(space.poles())
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(poles), rtol=0, atol=1e-9 * np.abs(poles).max())
    response = space.frequency_response(omega)
    for k, name in enumerate(inputs):
        true = [np.linalg.solve(1j * w * np.eye(3) - a, b[:, k])[1] for w in omega]
        np.testing.assert_allclose(response["load.w", name], true, rtol=1e-9)  # the poles' 1e-9


# --- a notch filter ------------------------------------------------------------------------------------------------


def notch():
    """A parallel resonance with a lossy coil between a source and a load: it keeps its own frequency out."""

    def make():
        ev = EqnEnv()
        hum = el.SineVoltage(ev, "hum", 2.0, 160.0, 0.4, 0.5)
        coil, loss, c = (
            el.Inductor(ev, "coil", 0.1, 0.0),
            el.Resistor(ev, "loss", 2.0),
            el.Capacitor(ev, "c", 1e-5, 0.0),
        )
        signal, load, ground = el.SignalVoltage(ev, "signal"), el.Resistor(ev, "load", 200.0), el.Ground(ev, "ground")
        return compiled(
            hum, coil, loss, c, signal, load, ground,
            connect=[
                (ground.p, hum.n, load.n), (hum.p, signal.n), (signal.p, coil.p, c.p), (coil.n, loss.p),
                (loss.n, c.n, load.p),
            ],
        )  # fmt: skip

    def expected(p):
        # The source is a state of its own: (sin, cos) of its phase.
        L, C, r, R = p["coil.L"], p["c.C"], p["loss.R"], p["load.R"]
        w, amplitude, phase = 2 * np.pi * p["hum.frequency"], p["hum.amplitude"], p["hum.phase"]
        a = np.array([
            [-r / L, 1 / L, 0.0, 0.0],
            [-1 / C, -1 / (R * C), amplitude / (R * C), 0.0],
            [0.0, 0.0, 0.0, w],
            [0.0, 0.0, -w, 0.0],
        ])  # fmt: skip
        start = [p["coil.initial_current"], p["c.initial_voltage"], np.sin(phase), np.cos(phase)]
        i, v, s, _ = linear(a, start, [0.0, p["hum.offset"] / (R * C), 0.0, 0.0], TS_NOTCH)
        return {"coil.i": i, "c.v": v, "load.v": p["hum.offset"] + amplitude * s - v}

    return ReferenceSystem(make, expected, TS_NOTCH, "load.v", {"signal.u": 0.0})


TS_NOTCH = np.linspace(0.0, 0.03, 13)


@pytest.mark.slow
def test_frequency_response_of_the_notch():
    """v/u = R/(R + Z) with 1/Z = s·C + 1/(r + s·L)."""
    _, system = system_of(notch)
    p = values_of(system)
    omega = np.array([0.1, 0.9, 1.0, 1.1, 30.0]) / np.sqrt(p["coil.L"] * p["c.C"])
    s = 1j * omega
    impedance = 1 / (s * p["c.C"] + 1 / (p["loss.R"] + s * p["coil.L"]))
    found = frequency_response(system, inputs={"signal.u": 0.0}, outputs=["load.v"], omega=omega)["load.v", "signal.u"]
    np.testing.assert_allclose(found, p["load.R"] / (p["load.R"] + impedance), rtol=0, atol=ROUNDING)


# --- Wien's bridge -------------------------------------------------------------------------------------------------


def wien():
    """An oscillator with an amplifier; two diodes across a part of the feedback hold the amplitude."""

    def make():
        ev = EqnEnv()
        amplifier, ground = el.IdealOpAmp(ev, "amp"), el.Ground(ev, "ground")
        r1, c1 = el.Resistor(ev, "r1", 1e4), el.Capacitor(ev, "c1", 16e-9, 0.0)
        r2, c2 = el.Resistor(ev, "r2", 1e4), el.Capacitor(ev, "c2", 16e-9, 0.1)
        down, back, soft = el.Resistor(ev, "down", 1e4), el.Resistor(ev, "back", 1.8e4), el.Resistor(ev, "soft", 5e3)
        one, other = el.Diode(ev, "one"), el.Diode(ev, "other")
        return compiled(
            amplifier, ground, r1, c1, r2, c2, down, back, soft, one, other,
            connect=[
                (amplifier.out, r1.p, soft.p, one.p, other.n), (r1.n, c1.p), (c1.n, amplifier.plus, r2.p, c2.p),
                (soft.n, one.n, other.p, back.p), (back.n, amplifier.minus, down.p), (r2.n, c2.n, down.n, ground.p),
            ],
        )  # fmt: skip

    def expected(p):
        def diodes(v):
            """The current of both and of the resistor beside them, and its slope."""
            current, slope = v / p["soft.R"], 1 / p["soft.R"]
            for name, sign in (("one", 1.0), ("other", -1.0)):
                e = np.exp(sign * v / p[f"{name}.Vt"])
                current += sign * p[f"{name}.Is"] * (e - 1) + v / p[f"{name}.R"]
                slope += p[f"{name}.Is"] / p[f"{name}.Vt"] * e + 1 / p[f"{name}.R"]
            return current, slope

        def dropped(plus):
            """The voltage at the diodes: their current is that through `down`, plus/R."""
            return scipy.optimize.brentq(
                lambda v: diodes(v)[0] - plus / p["down.R"], -2.0, 2.0, xtol=1e-15, rtol=1e-15
            )  # fmt: skip

        def slopes(t, y):  # the diodes' equation, differentiated
            v1, plus, v = y
            out = plus * (1 + p["back.R"] / p["down.R"]) + v
            i = (out - v1 - plus) / p["r1.R"]
            rate = (i - plus / p["r2.R"]) / p["c2.C"]
            return [i / p["c1.C"], rate, rate / p["down.R"] / diodes(v)[1]]

        start = [p["c1.initial_voltage"], p["c2.initial_voltage"]]
        v1, plus, v = integrated(slopes, [*start, dropped(start[1])], TS_WIEN)
        return {"c1.v": v1, "c2.v": plus, "soft.v": v, "amp.out.v": plus * (1 + p["back.R"] / p["down.R"]) + v}

    return ReferenceSystem(make, expected, TS_WIEN, "c2.v")


TS_WIEN = np.linspace(0.0, 4e-3, 9)

# --- a rectifier ---------------------------------------------------------------------------------------------------


def rectifier():
    """A bridge of four diodes behind a source with a resistance, a capacitor and a load."""

    def make():
        ev = EqnEnv()
        source, inner = el.SineVoltage(ev, "source", 10.0, 50.0), el.Resistor(ev, "inner", 2.0)
        c, load, ground = el.Capacitor(ev, "c", 5e-4, 0.0), el.Resistor(ev, "load", 100.0), el.Ground(ev, "ground")
        d = [el.Diode(ev, f"d{k}") for k in range(4)]
        return compiled(
            source, inner, c, load, ground, *d,
            connect=[
                (source.p, inner.p), (inner.n, d[0].p, d[2].n), (source.n, d[1].p, d[3].n),
                (d[0].n, d[1].n, c.p, load.p), (d[2].p, d[3].p, c.n, load.n, ground.p),
            ],
        )  # fmt: skip

    def expected(p):
        def diode(k, v):
            e = np.exp(v / p[f"d{k}.Vt"])
            s, leak = p[f"d{k}.Is"], 1 / p[f"d{k}.R"]
            return s * (e - 1) + v * leak, s / p[f"d{k}.Vt"] * e + leak

        w = 2 * np.pi * p["source.frequency"]

        def balance(t, a, b, v):
            """The currents into the nodes a and b of the bridge, their derivatives by a, b, v and t, and the current
            into the capacitor and the load."""
            u = p["source.offset"] + p["source.amplitude"] * np.sin(w * t + p["source.phase"])
            rate = p["source.amplitude"] * w * np.cos(w * t + p["source.phase"])
            g = 1 / p["inner.R"]
            (i0, g0), (i1, g1), (i2, g2), (i3, g3) = diode(0, a - v), diode(1, b - v), diode(2, -a), diode(3, -b)
            fed = (u - (a - b)) * g
            residual = np.array([fed - i0 + i2, -fed - i1 + i3])
            by_nodes = np.array([[-g - g0 - g2, g], [g, -g - g1 - g3]])
            return residual, by_nodes, np.array([g0, g1]), np.array([g, -g]) * rate, i0 + i1

        def slopes(t, y):
            a, b, v = y
            _, by_nodes, by_v, by_t, out = balance(t, a, b, v)
            rate = (out - v / p["load.R"]) / p["c.C"]
            return [*np.linalg.solve(by_nodes, -(by_v * rate + by_t)), rate]

        v0 = p["c.initial_voltage"]
        nodes = scipy.optimize.root(
            lambda n: balance(0.0, *n, v0)[0] * 1e3, [0.0, 0.0], tol=1e-15, jac=lambda n: balance(0.0, *n, v0)[1] * 1e3
        ).x
        a, b, v = integrated(slopes, [*nodes, v0], TS_RECTIFIER, rtol=1e-11)
        # What the nodes have drifted by is taken back by Newton's method; the sum of rows holds no large currents.
        for k, t in enumerate(TS_RECTIFIER):
            for _ in range(4):
                residual, by_nodes, *_ = balance(t, a[k], b[k], v[k])
                both = np.array([[1.0, 0.0], [1.0, 1.0]])
                a[k], b[k] = np.array([a[k], b[k]]) - np.linalg.solve(both @ by_nodes, both @ residual)
        return {"c.v": v, "d0.p.v": a, "d1.p.v": b}

    return ReferenceSystem(make, expected, TS_RECTIFIER, "c.v", stiff=True)


TS_RECTIFIER = np.linspace(0.0, 0.025, 11)

# --- Chua's circuit ------------------------------------------------------------------------------------------------


class CubicConductor(Component):
    """i = a·v + c·v³, active near zero: Chua's diode, smooth (Zhong 1994, IEEE Trans. Circuits Syst. I 41:934)."""

    def __init__(self, ev, name, a=-1.1e-3, c=4.5e-5):
        super().__init__(ev, name)
        first, third = self.parameter("a", a, unit="S"), self.parameter("c", c, unit="S/V2")
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v = self.variable("v", unit="V")
        self.add_equations(Eq(v, p.v - n.v), Eq(p.i, first * v + third * v**3), Eq(p.i + n.i, 0))
        self.declare_dissipation(v * p.i)


def chua():
    """Chua's circuit, with a conductor that is a cubic."""

    def make():
        ev = EqnEnv()
        c1, c2 = el.Capacitor(ev, "c1", 1e-8, 0.1), el.Capacitor(ev, "c2", 1e-7, -0.2)
        coil, r, ground = el.Inductor(ev, "coil", 18e-3, 1e-4), el.Resistor(ev, "r", 1.8e3), el.Ground(ev, "ground")
        active = CubicConductor(ev, "active")
        return compiled(
            c1, c2, coil, r, ground, active,
            connect=[(c2.p, coil.p, r.p), (r.n, c1.p, active.p), (c1.n, c2.n, coil.n, active.n, ground.p)],
        )  # fmt: skip

    def expected(p):
        def slopes(t, y):
            v1, v2, i = y
            through = (v2 - v1) / p["r.R"]
            return [
                (through - p["active.a"] * v1 - p["active.c"] * v1**3) / p["c1.C"], -(through + i) / p["c2.C"],
                v2 / p["coil.L"],
            ]  # fmt: skip

        start = [p["c1.initial_voltage"], p["c2.initial_voltage"], p["coil.initial_current"]]
        v1, v2, i = integrated(slopes, start, TS_CHUA)
        return {"c1.v": v1, "c2.v": v2, "coil.i": i}

    return ReferenceSystem(make, expected, TS_CHUA, "c1.v")


TS_CHUA = np.linspace(0.0, 2e-3, 9)

# --- a house -------------------------------------------------------------------------------------------------------

HOURS = 3600.0 * np.arange(25)
WEATHER = 273.15 + np.array([
    2.1, 1.4, 0.9, 0.2, -0.4, -0.9, -1.1, -0.2, 1.3, 3.0, 4.6, 5.8, 6.7, 7.1, 7.0, 6.2, 5.1, 4.2, 3.6, 3.1, 2.9, 2.6,
    2.2, 1.7, 1.2,
])  # fmt: skip
TS_HOUSE = np.linspace(0.0, HOURS[-1], 13)
WARM = 293.15  # K, the setpoint


def house():
    """A room behind a wall of three layers and a window, heated by a PI controller; hourly samples of the weather."""

    def make():
        ev = EqnEnv()
        weather, wall = th.TemperatureSource(ev, "weather"), th.Wall(
            ev, "wall", [1e-3, 9e-3, 2e-3], [8e6, 6e5, 5e6], [280.0, 285.0, 289.0]
        )  # fmt: skip
        window, air = th.ThermalConductor(ev, "window", 35.0), th.HeatCapacitor(ev, "air", 2e6, 288.15)
        skin, heater = th.Convection(ev, "skin", 8.0, 90.0), th.HeatFlowSource(ev, "heater")
        probe, pi = th.TemperatureSensor(ev, "probe"), sig.PI(ev, "pi", 800.0, 1800.0)
        return compiled(
            weather, wall, window, air, skin, heater, probe, pi,
            connect=[
                (weather.heat, wall.port_a, window.port_a), (wall.port_b, skin.port_a),
                (skin.port_b, air.heat, window.port_b, heater.heat, probe.heat), (probe.T, pi.measured),
                (pi.y, heater.Q_flow),
            ],
        )  # fmt: skip

    def expected(p):
        a, b, q = house_matrices(p)
        start = [p[f"wall.capacitor{k}.initial_temperature"] for k in (1, 2, 3)]
        start += [p["air.initial_temperature"], p["pi.initial_x"]]
        y = driven(a, start, np.stack([b, np.zeros(5), q * WARM], axis=1), HOURS, WEATHER, TS_HOUSE)
        heating = p["pi.k"] * (WARM - y[3] + y[4])
        return {**{f"wall.capacitor{k}.T": y[k - 1] for k in (1, 2, 3)}, "air.T": y[3], "heater.Q_flow": heating}

    inputs = {"weather.T": (HOURS, WEATHER), "pi.setpoint": WARM}
    return ReferenceSystem(make, expected, TS_HOUSE, "air.T", inputs)


def house_matrices(p):
    """A of (the wall's temperatures, the room's, the integral), and the columns of the weather and the setpoint."""
    r, c = [p[f"wall.R{k}"] for k in (1, 2, 3)], [p[f"wall.C{k}"] for k in (1, 2, 3)]
    g = [2 / r[0], 2 / (r[0] + r[1]), 2 / (r[1] + r[2]), 1 / (r[2] / 2 + 1 / (p["skin.h"] * p["skin.A"]))]
    a, b, q = np.zeros((5, 5)), np.zeros(5), np.zeros(5)
    b[0] = g[0] / c[0]
    for k in range(3):
        a[k, k] = -(g[k] + g[k + 1]) / c[k]
        a[k, k + 1] = g[k + 1] / c[k]
        if k:
            a[k, k - 1] = g[k] / c[k]
    C, window, gain = p["air.C"], p["window.G"], p["pi.k"]
    a[3, 2:] = np.array([g[3], -(g[3] + window + gain), gain]) / C
    b[3], q[3] = window / C, gain / C
    a[4, 3], q[4] = -1 / p["pi.Ti"], 1 / p["pi.Ti"]
    return a, b, q


@pytest.mark.slow
def test_the_house_at_rest():
    """The steady state against a linear solve, and poles and answers to the weather of the model linearized there."""
    _, system = system_of(house)
    inputs = {"weather.T": 270.0, "pi.setpoint": WARM}
    a, b, q = house_matrices(values_of(system))
    at = np.linalg.solve(a, -(b * 270.0 + q * WARM))
    names = [*(f"wall.capacitor{k}.T" for k in (1, 2, 3)), "air.T", "pi.x"]
    point = steady_state(system, inputs=inputs)
    np.testing.assert_allclose(point[names], at, rtol=ROUNDING)
    np.testing.assert_allclose(point["air.T"], WARM, rtol=ROUNDING)  # the integral leaves no error
    space = linearize(system, list(inputs), ["air.T", "heater.Q_flow"], at=point)
    order = [space.states.index(n) for n in names]
    found = np.asarray(space.A)[np.ix_(order, order)]
    np.testing.assert_allclose(found, a, rtol=ROUNDING, atol=ROUNDING * np.abs(a).max())
    np.testing.assert_allclose(np.asarray(space.B)[order], np.stack([b, q], axis=1), rtol=ROUNDING, atol=1e-18)
    omega = 2 * np.pi / 86400.0 * np.array([0.2, 1.0, 24.0])
    true = np.array([np.linalg.solve(1j * w * np.eye(5) - a, b)[3] for w in omega])
    np.testing.assert_allclose(space.frequency_response(omega)["air.T", "weather.T"], true, rtol=1e-9)


# --- all of them ---------------------------------------------------------------------------------------------------

SYSTEMS = [drive, notch, wien, rectifier, chua, house]


def test_the_field_of_the_drive():
    check_trajectory(drive)


@pytest.mark.slow
@pytest.mark.parametrize("reference", SYSTEMS)
def test_solution(reference):
    check_solution(reference, energy=reference in (drive, wien))


@pytest.mark.slow
@pytest.mark.parametrize("reference", [drive, notch, rectifier, house])
def test_gradient(reference):
    check_gradient(reference, modes=reference is drive)
