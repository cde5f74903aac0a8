"""Every electrical component against a closed form."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from component_references import checks, measured
from problems import compiled
from scipy.linalg import expm
from scipy.special import lambertw
from trajectories import balanced, trajectory

import jaxonomy_dae.library.electrical as el
from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.rotational import Torque
from jaxonomy_dae.library.thermal import FixedTemperature, HeatCapacitor, ThermalConductor

# Solutions of linear circuits without storage: rounding alone.
ROUNDING = 1e-12


class Board:
    """Circuits side by side on one ground, compiled as one model."""

    def __init__(self):
        self.ev = EqnEnv()
        self.ground = el.Ground(self.ev, "ground")
        self.parts = [self.ground]
        self.joined = []

    def __call__(self, kind, name, *args, **kwargs):
        part = kind(self.ev, name, *args, **kwargs)
        self.parts.append(part)
        return part

    def join(self, *ends):
        self.joined.append(ends)

    def earth(self, *ends):
        self.joined.append((*ends, self.ground.p))

    def load(self, name, R, p, n=None):
        """A resistor between two ports, or a port and the ground."""
        part = self(el.Resistor, name, R)
        self.join(part.p, p)
        self.join(part.n, n) if n is not None else self.earth(part.n)
        return part

    def source(self, name, v, *ends):
        """A constant voltage from the ground to some ports."""
        part = self(el.VoltageSource, name, v)
        if ends:
            self.join(part.p, *ends)
        self.earth(part.n)
        return part

    def compile(self):
        return compiled(*self.parts, connect=self.joined)


@functools.cache
def static():
    """Circuits without storage, and what must be read in them."""
    b, expected = Board(), {}

    t = b(el.IdealTransformer, "transformer", 4.0)  # the load appears as n²·R: i1 = 12/(2 + 16·3)
    series = b.load("t_in", 2.0, t.p1, b.source("t_source", 12.0).p)
    b.earth(t.n1, t.n2)
    b.load("t_out", 3.0, t.p2)
    expected |= {"transformer.i1": 12 / 50, "t_out.v": 4 * 3 * 12 / 50, f"{series.name}.i": -12 / 50}

    g = b(el.Gyrator, "gyrator", 0.5)  # a load R appears as 1/(G²·R): i1 = 6/(1 + 1/(0.25·8))
    b.load("g_in", 1.0, g.p1, b.source("g_source", 6.0).p)
    b.earth(g.n1, g.n2)
    b.load("g_out", 8.0, g.p2)
    expected |= {"gyrator.i1": 4.0, "gyrator.v1": 2.0, "g_out.v": 4.0 / 0.5}

    for name, kind, gain, v2 in (
        ("vcvs", el.VoltageControlledVoltage, 7.0, 7.0 * 3.0),
        ("vccs", el.VoltageControlledCurrent, 0.2, -0.2 * 3.0 * 5.0),
    ):
        c = b(kind, name, gain)
        b.source(f"{name}_source", 3.0, c.p1)
        b.earth(c.n1, c.n2)
        b.load(f"{name}_load", 5.0, c.p2)
        expected |= {f"{name}.v2": v2, f"{name}.i1": 0.0}
    for name, kind, gain, v2 in (
        ("ccvs", el.CurrentControlledVoltage, 7.0, 7.0 * 1.5),
        ("cccs", el.CurrentControlledCurrent, 4.0, -4.0 * 1.5 * 5.0),
    ):
        c = b(kind, name, gain)
        b.load(f"{name}_in", 2.0, c.p1, b.source(f"{name}_source", 3.0).p)
        b.earth(c.n1, c.n2)
        b.load(f"{name}_load", 5.0, c.p2)
        expected |= {f"{name}.v2": v2, f"{name}.i1": 1.5}

    a = b(el.IdealOpAmp, "amplifier")  # inverting: −R2/R1·v
    b.load("a_in", 2.0, a.minus, b.source("a_source", 1.5).p)
    b.load("a_back", 10.0, a.minus, a.out)
    b.load("a_load", 100.0, a.out)
    b.earth(a.plus)
    expected |= {"a_load.v": -7.5}

    pot = b(el.Potentiometer, "pot", 10.0)  # unloaded 10 V·0.3; loaded by R: divider of 7 and 3‖6 ohm
    b.source("pot_source", 10.0, pot.p)
    b.earth(pot.n)
    b.load("pot_load", 6.0, pot.slider)
    expected |= {"pot_load.v": 10.0 * 2 / 9}

    meter, amps, power = b(el.VoltageSensor, "volts"), b(el.CurrentSensor, "amps"), b(el.PowerSensor, "watts")
    b.source("m_source", 9.0, amps.p)
    b.join(amps.n, power.pc, power.pv)
    m = b.load("m_load", 3.0, power.nc)
    kept = b(el.CurrentSource, "kept", 1.2)  # from p to n through the source: it draws from the load
    b.load("k_load", 5.0, kept.p)
    b.earth(kept.n)
    # All circuits give back to the ground what they take, but for the amplifier's output: it sinks the currents of two
    # resistors at −7.5 V.
    expected |= {"k_load.v": -6.0, "m_load.i": 3.0, "m_source.p.v": 9.0, "ground.p.i": -7.5 / 100 - 7.5 / 10}
    b.join(meter.p, m.p)
    b.earth(meter.n, power.nv)
    expected |= {"volts.y": 9.0, "amps.y": 3.0, "watts.y": 27.0}

    warm = b(el.HeatedResistor, "warm", 2.0, alpha=0.01, T_ref=300.0)  # R = 2·(1 + 0.01·50)
    b.source("w_source", 6.0, warm.p)
    b.earth(warm.n)
    bath = b(FixedTemperature, "bath", 350.0)
    b.join(warm.heat, bath.heat)
    expected |= {"warm.i": 2.0, "bath.heat.Q_flow": 12.0}

    # Is·(exp(v/Vt) − 1) = (V − v)/R, in Lambert's function (Corless et al. 1996); without the parallel resistance.
    d = b(el.Diode, "diode", 1e-9, 0.04, 1e300)
    b.load("d_in", 1e3, d.p, b.source("d_source", 5.0).p)
    b.earth(d.n)
    z = 1e-9 * 1e3 / 0.04
    current = 0.04 / 1e3 * lambertw(z * np.exp((5.0 + 1e-9 * 1e3) / 0.04)).real - 1e-9
    expected |= {"diode.i": current}

    u, j = b(el.SignalVoltage, "signal_v"), b(el.SignalCurrent, "signal_i")
    b.earth(u.n, j.n)
    b.load("u_load", 4.0, u.p)
    b.load("j_load", 4.0, j.p)
    expected |= {"u_load.i": 0.5, "j_load.v": -4.0 * 0.25}
    return b.compile(), {"signal_v.u": 2.0, "signal_i.u": 0.25, "pot.position": 0.3}, expected


KIRCHHOFF = "Kirchhoff's and Ohm's laws"


@checks(
    {
        el.Ground: (KIRCHHOFF, "m_source.p.v", "ground.p.i"),
        el.Resistor: (KIRCHHOFF, "m_load.i"),
        el.VoltageSource: (KIRCHHOFF, "m_source.p.v", "m_load.i"),
        el.CurrentSource: (KIRCHHOFF, "k_load.v"),
        el.SignalVoltage: (KIRCHHOFF, "u_load.i"),
        el.SignalCurrent: (KIRCHHOFF, "j_load.v"),
        el.IdealTransformer: ("a load appears as n²·R", "transformer.i1", "t_out.v", "t_in.i"),
        el.Gyrator: ("a load appears as 1/(G²·R)", "gyrator.i1", "gyrator.v1", "g_out.v"),
        el.IdealOpAmp: ("gain −R2/R1 of the inverting amplifier", "a_load.v"),
        el.Potentiometer: ("divider of 7 Ω and 3 ‖ 6 Ω", "pot_load.v"),
        el.HeatedResistor: ("V/R at the bath's temperature, and its heat", "warm.i", "bath.heat.Q_flow"),
        el.Diode: ("Lambert's function W, for Shockley's law behind a resistor", "diode.i"),
        el.VoltageSensor: (KIRCHHOFF, "volts.y"),
        el.CurrentSensor: (KIRCHHOFF, "amps.y"),
        el.PowerSensor: (KIRCHHOFF, "watts.y"),
        el.VoltageControlledVoltage: (KIRCHHOFF, "vcvs.v2", "vcvs.i1"),
        el.VoltageControlledCurrent: (KIRCHHOFF, "vccs.v2", "vccs.i1"),
        el.CurrentControlledVoltage: (KIRCHHOFF, "ccvs.v2", "ccvs.i1"),
        el.CurrentControlledCurrent: (KIRCHHOFF, "cccs.v2", "cccs.i1"),
    },
    origin="rounding of linear algebra",
)
def test_circuits_without_storage():
    system, inputs, expected = static()
    start = system.initialize(inputs=inputs)
    values = jax.jit(lambda x: system.observe(list(expected), 0.0, x, inputs))(start)
    for name, value, true in zip(expected, np.asarray(values), expected.values(), strict=True):
        measured(name, value, true, ROUNDING * max(abs(true), 1.0), scale=abs(true) or 1.0)


@pytest.mark.slow
def test_energy_without_storage():
    """What all of these components bring in is lost at the same instant."""
    system, inputs, _ = static()
    solution = simulate(system, 1.0, ts=jnp.array([1.0]), inputs=inputs)
    lost = float(solution.dissipation()[0])
    assert lost > 100.0
    np.testing.assert_allclose(solution.supply()[0], lost, rtol=ROUNDING)


def linear(a, x0, b, ts):
    """x' = a·x + b from x0."""
    n = len(a)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = a, b
    return np.array([(expm(whole * t) @ [*x0, 1.0])[:n] for t in ts])


TS = np.linspace(0.0, 2.0, 9)
MOTOR = dict(R=2.0, L=0.5, k=0.8, J=0.3, d=0.1)


@functools.cache
def dynamic():
    """Circuits with storage, their solutions at TS."""
    b, expected = Board(), {}

    m = b(el.MutualInductor, "coils", 2.0, 1.0, 0.8, initial_current1=1.0, initial_current2=0.0)
    b.load("c1", 3.0, m.p1)
    b.load("c2", 2.0, m.p2)
    b.earth(m.n1, m.n2)
    inductance = np.array([[2.0, 0.8], [0.8, 1.0]])
    currents = linear(-np.linalg.solve(inductance, np.diag([3.0, 2.0])), [1.0, 0.0], [0.0, 0.0], TS)
    expected |= {"coils.i1": currents[:, 0], "coils.i2": currents[:, 1]}

    s = b(el.SineVoltage, "sine", 2.0, 0.7, 0.4, 0.5)  # L·i' + R·i = v(t)
    coil = b(el.Inductor, "s_coil", 1.5, initial_current=0.2)
    b.load("s_load", 2.5, s.p, coil.p)
    b.earth(s.n, coil.n)
    w, z = 2 * np.pi * 0.7, 2.5 + 1j * 2 * np.pi * 0.7 * 1.5

    def steady(t):
        return 0.5 / 2.5 + np.imag(2.0 * np.exp(1j * (w * t + 0.4)) / z)

    expected |= {"s_coil.i": steady(TS) + (0.2 - steady(0.0)) * np.exp(-2.5 / 1.5 * TS)}

    i = b(el.SineCurrent, "charge", 0.3, 0.5, 0.0, 0.1)  # from p to n through the source: it empties the capacitor
    store = b(el.Capacitor, "c_store", 0.2, initial_voltage=1.0)
    b.join(i.p, store.p)
    b.earth(i.n, store.n)
    passed = 0.1 * TS + 0.3 / np.pi * (1 - np.cos(np.pi * TS))
    expected |= {"c_store.v": 1.0 - passed / 0.2}

    a = b(el.IdealOpAmp, "integrator")  # v_out = v0 − V·t/(R·C)
    back = b(el.Capacitor, "i_back", 0.25, initial_voltage=0.0)
    b.load("i_in", 2.0, a.minus, b.source("i_source", 0.6).p)
    b.join(back.p, a.minus)
    b.join(back.n, a.out)
    b.load("i_load", 10.0, a.out)
    b.earth(a.plus)
    expected |= {"i_load.v": -0.6 * TS / 0.5}

    motor, torque = b(el.DCMotor, "motor", **MOTOR, initial_current=0.0, initial_angle=0.0, initial_speed=0.0), None
    b.source("supply", 6.0, motor.p)
    b.earth(motor.n)
    torque = b(Torque, "load")
    b.join(motor.flange, torque.flange)
    R, L, k, J, d = MOTOR.values()
    states = linear([[-R / L, -k / L, 0], [k / J, -d / J, 0], [0, 1, 0]], [0.0] * 3, [6.0 / L, -0.4 / J, 0.0], TS)
    expected |= {"motor.inductor.i": states[:, 0], "motor.rotor.w": states[:, 1], "motor.rotor.phi": states[:, 2]}

    heater = b(el.HeatedResistor, "heater", 4.0)  # C·T' = V²/R − G·(T − T0)
    b.source("h_source", 8.0, heater.p)
    b.earth(heater.n)
    mass, wall, out = b(HeatCapacitor, "mass", 5.0, 300.0), b(ThermalConductor, "wall", 2.0), b(FixedTemperature, "out")
    b.join(heater.heat, mass.heat, wall.port_a)
    b.join(wall.port_b, out.heat)
    expected |= {"mass.T": 293.15 + 8.0 + (300.0 - 293.15 - 8.0) * np.exp(-2.0 / 5.0 * TS)}

    # R(w)·w' = k·V integrates to Roff·w − (Roff − Ron)·w²/2 = … + k·V·t.
    memory = b(el.Memristor, "memory", 1.0, 5.0, 0.2, 0.1)
    b.source("m_source", 4.0, memory.p)
    b.earth(memory.n)
    right = 5.0 * 0.1 - 2.0 * 0.1**2 + 0.2 * 4.0 * TS
    expected |= {"memory.w": (5.0 - np.sqrt(25.0 - 8.0 * right)) / 4.0}

    step, pulse = b(el.StepVoltage, "step", 3.0, 0.6, 1.0), b(el.PulseCurrent, "pulse", 2.0, 0.8, 0.25, 0.3, -0.5)
    held = b(el.Capacitor, "held", 0.5, initial_voltage=1.0)
    b.load("step_load", 2.0, step.p, held.p)
    b.earth(step.n, held.n)
    expected |= {"held.v": np.where(TS < 0.6, 1.0, 4.0 - 3.0 * np.exp(-(TS - 0.6)))}
    filled = b(el.Capacitor, "filled", 1.0, initial_voltage=0.0)
    b.join(pulse.n, filled.p)
    b.earth(pulse.p, filled.n)
    cycle = np.maximum(TS - 0.3, 0.0)
    on = np.floor(cycle / 0.8) * 0.2 + np.minimum(cycle % 0.8, 0.2)
    expected |= {"filled.v": -0.5 * TS + 2.0 * on}
    # The others of these sources, with the same edges: v' = −i/C, and i' = v/L.
    jump, wave = b(el.StepCurrent, "jump", 0.8, 0.6, 0.2), b(el.PulseVoltage, "wave", 2.0, 0.8, 0.25, 0.3, -0.5)
    drained = b(el.Capacitor, "drained", 0.4, initial_voltage=2.0)
    b.join(jump.p, drained.p)
    b.earth(jump.n, drained.n)
    expected |= {"drained.v": 2.0 - (0.2 * TS + 0.8 * np.maximum(TS - 0.6, 0.0)) / 0.4}
    driven = b(el.Inductor, "driven", 0.5, initial_current=0.3)
    b.join(wave.p, driven.p)
    b.earth(wave.n, driven.n)
    expected |= {"driven.i": 0.3 + (-0.5 * TS + 2.0 * on) / 0.5}
    return b.compile(), expected


EDGES = [0.6, 0.3, 0.5, 1.1, 1.3, 1.9]
LOAD = {"load.tau": -0.4}


MOTION = "matrix exponential of the armature's and the shaft's equations"


@checks(
    {
        el.Capacitor: ("integral of a current", "drained.v", "c_store.v", "i_load.v"),
        el.Inductor: ("integral of a voltage", "driven.i", "s_coil.i"),
        el.MutualInductor: ("matrix exponential of the coils' equations", "coils.i1", "coils.i2"),
        el.SineVoltage: ("phasor and decay of R and L in series", "s_coil.i"),
        el.SineCurrent: ("integral of a sine", "c_store.v"),
        el.IdealOpAmp: ("−∫v/(R·C) of the integrator", "i_load.v"),
        el.EMF: (MOTION, "motor.inductor.i", "motor.rotor.w"),
        el.DCMotor: (MOTION, "motor.inductor.i", "motor.rotor.w", "motor.rotor.phi"),
        el.HeatedResistor: ("exponential of a heated mass", "mass.T"),
        el.Memristor: ("square root of the charge's integral", "memory.w"),
        el.StepVoltage: ("exponential of R and C after the step", "held.v"),
        el.StepCurrent: ("integral of a step", "drained.v"),
        el.PulseVoltage: ("integral of pulses", "driven.i"),
        el.PulseCurrent: ("integral of pulses", "filled.v"),
    },
    origin="rtol 1e-9 for each of fewer than 200 steps",
)
def test_circuits_with_storage():
    system, expected = dynamic()
    found = trajectory(system, TS, list(expected), LOAD, edges=EDGES)
    for name, true in expected.items():
        measured(name, found[name], true, 2e-7 * np.abs(true).max())


@pytest.mark.slow
def test_a_run_and_its_energy():
    """The same by `simulate`, and the account of every component's energy."""
    system, expected = dynamic()
    solution = simulate(system, 2.0, ts=TS, rtol=1e-9, atol=1e-11, inputs=LOAD, jump_ts=sorted(EDGES))
    for name, true in expected.items():
        np.testing.assert_allclose(solution[name], true, rtol=0, atol=2e-7 * np.abs(true).max(), err_msg=name)
    balanced(system, 2.0, LOAD, edges=EDGES)


@pytest.mark.slow
def test_gradients_of_a_circuit():
    """Of the end's values with respect to every parameter: reverse against forward mode."""
    system, expected = dynamic()
    computed = {system.parameters.names[k] for k in system.parameters.table.expressions}
    # The times of edges are given by number: the integration stops there, and their derivatives are impulses.
    timing = {f"{source}.start_time" for source in ("step", "jump", "pulse", "wave")}
    timing |= {f"{source}.{name}" for source in ("pulse", "wave") for name in ("period", "width")}
    names = [n for n in system.parameters.names if n not in computed and n not in timing]
    values = jnp.array([float(system.parameters[n]) for n in names])

    def end(v, adjoint=None):
        changed = system.with_parameters(dict(zip(names, v, strict=True)))
        solution = simulate(
            changed, 2.0, ts=TS[-1:], rtol=1e-7, atol=1e-9, inputs=LOAD, jump_ts=sorted(EDGES), adjoint=adjoint,
            solver=diffrax.Tsit5(),
        )  # fmt: skip
        return sum(jnp.sum(solution[n]) for n in expected)

    reverse = jax.jit(jax.grad(end))(values)
    forward = jax.jit(jax.jacfwd(lambda v: end(v, diffrax.ForwardMode())))(values)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-8 * np.abs(forward).max())
