"""Components that switch, stick and sample against closed forms, brute force and SciPy.

Runs are made at rtol = atol = 1e-10. Between events most of what is integrated is smooth on scales of a second, so that
a state is right to some tens of tolerances: 1e-8 and tighter below, unless a comment says what else limits it.
"""

import functools
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from component_references import checks, measured
from diode_bridges import GOFF, RON, bridge_by_brute_force
from problems import compiled
from sympy import cos, sin

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.hydraulic as hyd
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import Component, Eq, EqnEnv, Rotational, Translational, simulate
from jaxonomy_dae.library.friction import Brake, Clutch, OneWayClutch, StickingFriction

TIGHT = dict(rtol=1e-10, atol=1e-10)
ORIGIN = "some tens of tolerances of 1e-10"
SMOOTH = 1e-8  # what the tolerances leave of states and event times
EXACT = dict(rtol=1e-12, atol=1e-13)  # of SciPy's references


def events(solution):
    return np.asarray(solution.events.ts)[: len(solution.events)]


class Run(NamedTuple):
    """Values and derivatives of variables at times, by name, and when events happened, by the name of the component."""

    ts: np.ndarray
    names: list[str]
    parameters: list[str]
    rows: np.ndarray
    jacobian: np.ndarray
    happened: list[tuple[float, str]]

    def _at(self, ts):
        return np.argmin(np.abs(self.ts[:, None] - ts), axis=0)

    def values(self, name, ts):
        return self.rows[self.names.index(name)][self._at(ts)]

    def slopes(self, name, parameter, ts):
        return self.jacobian[self.names.index(name), :, self.parameters.index(parameter)][self._at(ts)]

    def events(self, component):
        return np.array([t for t, name in self.happened if name.startswith(f"{component}: ")])


def ran(system, t1, ts, names, parameters, inputs=None) -> Run:
    """One run in one program, with derivatives by parameters."""

    def run(p):
        changed = system.with_parameters(dict(zip(parameters, p, strict=True)))
        solution = simulate(
            changed, t1, ts=jnp.asarray(ts), inputs=inputs, solver=diffrax.Tsit5(), adjoint=diffrax.ForwardMode(),
            throw=False, max_events=200, **TIGHT,
        )  # fmt: skip
        values = jnp.stack([solution[name] for name in names])
        return values, (values, solution.events.ts, solution.events.which)

    by = jax.jacfwd(run, has_aux=True) if parameters else lambda p: (jnp.zeros((len(names), len(ts), 0)), run(p)[1])
    jacobian, (values, times, which) = jax.tree.map(np.asarray, jax.jit(by)(jnp.array([*parameters.values()])))
    happened = [(t, system.plan.events.names[int(k)]) for t, k in zip(times, which, strict=True) if k >= 0]
    return Run(ts, names, [*parameters], values, jacobian, happened)


def central(f, p, h):
    return (f(p + h) - f(p - h)) / (2 * h)


# --- diodes, switches, thyristors ------------------------------------------------------------------------------------


def circuit(*parts, connect, ground):
    """The parts, and a node at zero potential."""
    g = el.Ground(parts[0].ev, "g")
    return compiled(*parts, g, connect=[*connect, (ground, g.p)])


@functools.cache
def circuits(opens):
    """Four circuits in one system, and a run of 3 s: (values, derivatives by the time of a switch, events)."""
    ev = EqnEnv()
    # A sine behind a diode on a resistor.
    half = el.SineVoltage(ev, "half", 10.0, 1.0), el.IdealDiode(ev, "d0"), el.Resistor(ev, "r0", 4.0)
    # The same with a capacitor.
    source, series, diode = el.SineVoltage(ev, "src", 10.0, 1.0), el.Resistor(ev, "rs", RS), el.IdealDiode(ev, "d")
    tank, load = el.Capacitor(ev, "c", C, initial_voltage=0.0), el.Resistor(ev, "r", R)
    # 12 V through 1 kΩ, and 3 kΩ more while the switch is open, onto 1 mF.
    battery, charging = el.VoltageSource(ev, "battery", 12.0), el.Resistor(ev, "charging", 1e3)
    timed, charged = el.TimedSwitch(ev, "s", time=0.7, opens=opens), el.Capacitor(ev, "c1", 1e-3, initial_voltage=0.0)
    # 6 V on 2 Ω while a signal is above 1/2.
    six, two, charge = el.VoltageSource(ev, "six", 6.0), el.Resistor(ev, "two", 2.0), sig.Integrator(ev, "q")
    driven, wave = el.Switch(ev, "driven", Goff=0.01), sig.Sine(ev, "wave", 1.0, 1.0)
    g = [el.Ground(ev, f"g{k}") for k in range(4)]
    system = compiled(
        *half, source, series, diode, tank, load, battery, charging, timed, charged, six, two, driven, wave, charge, *g,
        connect=[
            (half[0].p, half[1].p), (half[1].n, half[2].p), (half[2].n, half[0].n, g[0].p),
            (source.p, series.p), (series.n, diode.p), (diode.n, tank.p, load.p), (tank.n, load.n, source.n, g[1].p),
            (battery.p, timed.p), (timed.n, charging.p), (charging.n, charged.p), (charged.n, battery.n, g[2].p),
            (six.p, driven.p), (driven.n, two.p), (two.n, six.n, g[3].p), (wave.y, driven.u), (two.i, charge.u),
        ],
    )  # fmt: skip
    return ran(system, 3.0, CIRCUIT_TIMES, ["d0.i", "d0.v", "c.v", "c1.v", "q.y"], {"s.time": 0.7})


RS, R, C = 2.0, 50.0, 0.02
SMOOTHED = np.linspace(0.0, 3.0, 31)
HALF = np.linspace(0.0, 2.2, 45)
SWITCHED = np.array([0.3, 0.7, 1.1, 2.0])
CIRCUIT_TIMES = np.unique([*SMOOTHED, *HALF, *SWITCHED, 1.0])


@pytest.mark.slow
def test_a_half_wave_rectifier():
    """i = max(10·sin(2πt), 0)/R, without any state."""
    run = circuits(True)
    v = 10 * np.sin(2 * np.pi * HALF)
    # Nothing is integrated: rounding, but for samples at the zeros of the sine.
    np.testing.assert_allclose(run.values("d0.i", HALF), np.maximum(v, 0) / 4, atol=1e-12)
    np.testing.assert_allclose(run.values("d0.v", HALF), np.minimum(v, 0), atol=1e-12)
    np.testing.assert_allclose(run.events("d0")[:4], [0.5, 1.0, 1.5, 2.0], atol=1e-11)


@pytest.mark.slow
@checks(
    {el.IdealDiode: ("SciPy's DOP853 from switch to switch", "c.v", "events")},
    origin=ORIGIN,
)
def test_a_smoothed_rectifier():
    """C v' = max(src − v, 0)/Rs − v/R, by SciPy, from switch to switch."""
    run = circuits(True)

    def drive(t, v):
        return 10 * np.sin(2 * np.pi * t) - v[0]

    expected, switched = by_modes(
        SMOOTHED, [0.0], True, drive, lambda on: lambda t, v: [(on * drive(t, v) / RS - v[0] / R) / C]
    )
    measured("c.v", run.values("c.v", SMOOTHED), expected[0], SMOOTH)
    measured("events", run.events("d"), switched, SMOOTH)


@pytest.mark.slow
@pytest.mark.parametrize("opens", [False, True])
@checks(
    {el.TimedSwitch: ("exponential from the switching on, and its derivative by that time", "c.v", "slope")},
    origin=ORIGIN,
    opens=lambda: True,
)
def test_a_timed_switch(opens):
    """v = 12·(1 − exp(−s/τ)), τ = 1 s, with s the time for which it has been closed: dv/d(time) is ∓12·exp(−s)."""
    run, ts = circuits(opens), SWITCHED
    on = np.minimum(ts, 0.7) if opens else np.maximum(ts - 0.7, 0)
    measured("c.v", run.values("c1.v", ts), 12 * (1 - np.exp(-on)), SMOOTH)
    slope = run.slopes("c1.v", "s.time", ts)
    switched = ts > 0.7
    expected = np.where(switched, (1 if opens else -1) * 12 * np.exp(-on), 0.0)
    measured("slope", slope[switched], expected[switched], SMOOTH * np.abs(expected[switched]).min())
    assert slope[0] == 0


@pytest.mark.slow
@checks({el.Switch: ("currents by Ohm's law, and times by arcsin", "q.y", "events")}, origin=ORIGIN)
def test_a_switch_that_a_signal_drives():
    """Closed while sin(2πt) > 1/2, from 1/12 to 5/12: 3 A, and 6/(2 + 100) A while it is open."""
    run = circuits(True)
    once = 3 / 3 + 6 / 102 * 2 / 3
    measured("q.y", run.values("q.y", np.array([1.0, 2.0])), [once, 2 * once], SMOOTH)
    measured("events", run.events("driven")[:4], [1 / 12, 5 / 12, 13 / 12, 17 / 12], SMOOTH)


def by_modes(ts, x, on, guard, slopes):
    """A system that switches where a guard changes its sign: states at ts and the times, by SciPy's own events."""
    guard = functools.partial(guard)  # SciPy reads its options from attributes
    guard.terminal = True
    t, end, rows, switched = ts[0], ts[-1], [], []
    while t < end:
        guard.direction = -1.0 if on else 1.0
        run = scipy.integrate.solve_ivp(
            slopes(on), (t, end), x, "DOP853", dense_output=True, events=guard, max_step=0.05, **EXACT
        )
        inside = (ts >= t) & (ts < run.t[-1]) if run.status else ts >= t
        rows.append(run.sol(ts[inside]))
        t, x = run.t[-1], run.y[:, -1]
        if run.status:
            switched.append(t)
            on = not on
    return np.concatenate(rows, axis=1), switched


@pytest.mark.slow
@pytest.mark.parametrize(
    "goff, knee",
    [(1e-6, 0.6), (GOFF, 0.0), (1e-10, 0.7), (1e-8, 0.0)],
)
def test_a_bridge_against_all_of_its_modes(goff, knee):
    """Two diodes carry one current, but for leakage, and block at one instant."""
    ev = EqnEnv()
    source, series = el.SineVoltage(ev, "src", 10.0, 1.0), el.Resistor(ev, "rs", 1.0)
    d = [el.IdealDiode(ev, f"d{k}", Ron=RON, Goff=goff, Vknee=knee) for k in range(4)]
    tank, load = el.Capacitor(ev, "c", 0.05, initial_voltage=1.0), el.Resistor(ev, "r", 20.0)
    system = circuit(
        source, series, *d, tank, load,
        connect=[
            (source.p, series.p), (series.n, d[0].p, d[2].n), (source.n, d[1].p, d[3].n),
            (d[0].n, d[1].n, tank.p, load.p), (d[2].p, d[3].p, tank.n, load.n),
        ],
        ground=source.n,
    )  # fmt: skip
    ts = np.linspace(0.0, 2.0, 81)
    solution = simulate(system, 2.0, ts=jnp.asarray(ts), **TIGHT)
    v = np.asarray(solution["c.v"])
    # At every saved time, the mode and the currents are those of the only mode of sixteen that fits.
    for k, t in enumerate(ts):
        node, _, currents, modes = bridge_by_brute_force(10 * np.sin(2 * np.pi * t), v[k], goff=goff, knee=knee)
        found = [float(solution[f"d{j}.i"][k]) for j in range(4)]
        np.testing.assert_allclose(found, currents, atol=1e-10)
        drop = [float(solution[f"d{j}.v"][k]) for j in range(4)]
        if min(abs(x - knee) for x in drop) > 1e-9:
            assert [bool(solution[f"d{j}.active"][k]) for j in range(4)] == list(modes)

    # And the voltage is what these currents make of it: the right side is continuous, with kinks that steps of
    # 0.01 s cross with errors below 1e-7.
    def charging(t, v):
        return (bridge_by_brute_force(10 * np.sin(2 * np.pi * t), v[0], goff=goff, knee=knee)[1] - v / 20.0) / 0.05

    reference = scipy.integrate.solve_ivp(
        charging,
        (0.0, 0.5), [1.0], "RK45", t_eval=ts[:21], rtol=1e-9, atol=1e-9, max_step=0.01,
    )  # fmt: skip
    np.testing.assert_allclose(v[:21], reference.y[0], atol=1e-7)


@pytest.mark.slow
@checks(
    {el.IdealThyristor: ("the charge in a period, and its derivative by the angle", "charge", "slope")}, origin=ORIGIN
)
def test_a_dimmer():
    """A thyristor fired at the time a of every period of 10·sin(2πt), onto 4 Ω; the charge in a period is
    10/4·(1 + cos 2πa)/2π, and its derivative by a is −10/4·sin 2πa."""
    ev = EqnEnv()
    source, thyristor, load = (
        el.SineVoltage(ev, "src", 10.0, 1.0),
        el.IdealThyristor(ev, "t"),
        el.Resistor(ev, "r", 4.0),
    )
    fire = sig.Ramp(ev, "fire", 1.0, duration=1.0, start_time=-0.3)
    charge = sig.Integrator(ev, "q")
    system = circuit(
        source, thyristor, load, fire, charge,
        connect=[
            (source.p, thyristor.p), (thyristor.n, load.p), (load.n, source.n), (fire.y, thyristor.fire),
            (load.i, charge.u),
        ],
        ground=source.n,
    )  # fmt: skip

    def run(angle):  # the ramp is at 1/2 half a second after its start
        changed = system.with_parameters({"fire.start_time": angle - 0.5})
        return simulate(changed, 0.9, ts=jnp.array([0.9]), **TIGHT)["q.y"][-1]

    for a in (0.05, 0.2, 0.4):
        measured("charge", run(a), 2.5 * (1 + np.cos(2 * np.pi * a)) / (2 * np.pi), SMOOTH)
    slope = jax.jit(jax.grad(run))
    for a in (0.2, 0.4):
        true = -2.5 * np.sin(2 * np.pi * a)
        measured("slope", slope(a), true, SMOOTH * abs(true))


# --- friction that sticks --------------------------------------------------------------------------------------------


@pytest.mark.slow
@checks({Brake: ("parabola of the angle, and its derivative by mu", "J.w", "J.phi", "events", "slope")}, origin=ORIGIN)
def test_a_brake():
    """w falls at the rate r = mu·cgeo·fn_max·u/J, to rest at w₀/r after the angle w₀²/2r: dphi/dmu = −phi/mu."""
    ev = EqnEnv()
    inertia = rot.Inertia(ev, "J", 2.0, initial_angle=0.0, initial_speed=3.0)
    brake = Brake(ev, "brake", mu=0.4, fn_max=10.0, cgeo=1.5)
    system = compiled(inertia, brake, connect=[(inertia.flange_b, brake.flange)])
    rate = 0.4 * 10 * 1.5 * 0.5 / 2

    def run(mu):
        changed = system.with_parameters({"brake.mu": mu})
        return simulate(changed, 3.0, ts=jnp.array([1.0, 2.5, 3.0]), inputs={"brake.u": 0.5}, **TIGHT)

    solution = run(0.4)
    measured("J.w", solution["J.w"], [3 - rate, 0, 0], SMOOTH)
    measured("J.phi", solution["J.phi"], [3 - rate / 2, 4.5 / rate, 4.5 / rate], SMOOTH)
    measured("events", events(solution), [3 / rate], SMOOTH)
    np.testing.assert_array_equal(solution["brake.mode"], [1, 0, 0])
    slope = jax.jit(jax.grad(lambda mu: run(mu)["J.phi"][-1]))(0.4)
    measured("slope", slope, -4.5 / rate / 0.4, SMOOTH * 4.5 / rate / 0.4)


# A mass behind a spring whose end moves at a constant speed: kg, N/m, m/s, N, N.
MASS, STIFFNESS, SPEED, SLIDING, BREAKAWAY = 1.0, 4.0, 0.5, 1.0, 2.0
# A driven inertia, the one behind a freewheel, and its damper: kg·m², kg·m², N·m·s.
INERTIA, BEHIND, DAMPING = 1.0, 0.5, 0.3
FREE = np.linspace(0.0, 12.0, 25)


def den_hartog():
    """(times, when it breaks loose and sticks, positions)"""
    m, k, V, sliding, breakaway = MASS, STIFFNESS, SPEED, SLIDING, BREAKAWAY
    # In s since it broke loose at t₁, with the spring stretched by e = Fs/k: m·x'' = k·(e + V·s − x) − Fd.
    w, b = np.sqrt(k / m), (breakaway - sliding) / k
    t1 = breakaway / (k * V)
    # x = V·s + b − b·cos(ws) − V/w·sin(ws), and x' = V − V·cos(ws) + b·w·sin(ws) = 0 at ws = 2·(π − atan(b·w/V)).
    slip = 2 * (np.pi - np.arctan(b * w / V)) / w
    # Where it comes to rest the spring is as much too short as it was too long: Fd − (Fs − Fd).
    wait = 2 * (breakaway - sliding) / (k * V)
    s = np.array([0.3, 0.9]) * slip
    ts = np.concatenate([[0.5 * t1], t1 + s, [t1 + slip + 0.5 * wait], t1 + slip + wait + s])
    x = V * s + b - b * np.cos(w * s) - V / w * np.sin(w * s)
    moved = V * slip + 2 * b
    return ts, [t1, t1 + slip, t1 + slip + wait], np.array([0, *x, moved, *(moved + x)])


@functools.cache
def rubbing():
    """Stick and slip, and a freewheel, in one run of 12 s."""
    ev = EqnEnv()
    mass = line.Mass(ev, "m", MASS, initial_position=0.0, initial_velocity=0.0)
    pull, spring = line.SpeedSource(ev, "pull"), line.Spring(ev, "s", STIFFNESS)
    wall, friction = line.FixedPosition(ev, "wall"), StickingFriction(ev, "f", SLIDING, BREAKAWAY)
    torque = rot.Torque(ev, "drive")
    first = rot.Inertia(ev, "a", INERTIA, initial_angle=0.0, initial_speed=0.0)
    second = rot.Inertia(ev, "b", BEHIND, initial_angle=0.0, initial_speed=0.2)
    wheel, damper, ground = OneWayClutch(ev, "c"), rot.Damper(ev, "d", DAMPING), rot.FixedAngle(ev, "g")
    system = compiled(
        mass, pull, spring, wall, friction, torque, first, second, wheel, damper, ground,
        connect=[
            (pull.flange, spring.flange_a), (spring.flange_b, mass.flange, friction.flange_b),
            (wall.flange, friction.flange_a),
            (torque.flange, first.flange_a), (first.flange_b, wheel.flange_a), (wheel.flange_b, second.flange_a),
            (second.flange_b, damper.flange_a), (damper.flange_b, ground.flange),
        ],
    )  # fmt: skip
    ts = np.unique([*den_hartog()[0], *FREE])
    names, inputs = ["m.s", "f.mode", "a.w", "b.w", "c.tau", "c.w_rel"], {"pull.u": SPEED, "drive.tau": jnp.sin}
    return ran(system, 12.0, ts, names, {}, inputs)


class Yoke(Component):
    """A scotch yoke: s = r·sin(φ)."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.port("a", Rotational), self.port("b", Translational)
        r = self.parameter("r", 0.1)
        self.add_equations(Eq(b.s, r * sin(a.phi)), Eq(a.tau + r * cos(a.phi) * b.f, 0))


@pytest.mark.slow
def test_friction_beyond_a_dead_centre():
    """Where a yoke turns back its speed is zero, and its crank goes on. J·w²/2 is less by F times the way of the yoke,
    r·(2 − sin φ) behind the first dead centre, whatever F is."""
    ev = EqnEnv()
    crank, yoke = rot.Inertia(ev, "crank", 0.02, initial_angle=0.0, initial_speed=20.0), Yoke(ev, "yoke")
    wall, friction = line.FixedPosition(ev, "wall"), StickingFriction(ev, "f", 5.0)
    system = compiled(
        crank, yoke, wall, friction,
        connect=[(crank.flange_b, yoke.a), (yoke.b, friction.flange_b), (friction.flange_a, wall.flange)],
    )  # fmt: skip

    @jax.value_and_grad
    def energy(force):
        run = simulate(system.with_parameters({"f.sliding": force}), 0.25, ts=jnp.array([0.25]), **TIGHT)
        phi, w = run[["crank.phi", "crank.w"]][0]
        return 0.01 * w**2 + force * 0.1 * (2 - jnp.sin(phi))

    value, slope = energy(5.0)
    assert float(value) == pytest.approx(4.0, rel=SMOOTH)
    assert abs(float(slope)) < SMOOTH


@pytest.mark.slow
@checks(
    {StickingFriction: ("Den Hartog's closed form of stick and slip", "m.s", "events")},
    origin=ORIGIN,
)
def test_stick_and_slip():
    """A mass behind a spring whose end moves at the speed V: it sticks until k·V·t = Fs, and slips as
    x = V·s + b + A·cos(ws + p) until its speed is zero again (Den Hartog 1956, Mechanical Vibrations, section 7.6)."""
    ts, times, s = den_hartog()
    run = rubbing()
    measured("events", run.events("f")[:3], times, SMOOTH)
    measured("m.s", run.values("m.s", ts), s, SMOOTH)
    np.testing.assert_array_equal(run.values("f.mode", ts), [0, 1, 1, 0, 1, 1])


@pytest.mark.slow
def test_friction_does_not_hold_a_prescribed_motion():
    """Kind: a mode that cannot hold what it is to hold. The friction of parts that are moved by a source had the wrong
    sign where they turned back: sticking and breaking away followed each other without end. Friction has the sign of
    the speed, whichever flange moves."""
    ev = EqnEnv()
    wall, shift = line.FixedPosition(ev, "wall"), line.PositionSource(ev, "shift")
    one, other = StickingFriction(ev, "one", SLIDING, BREAKAWAY), StickingFriction(ev, "other", SLIDING, BREAKAWAY)
    turn, shaft, gear = rot.AngleSource(ev, "turn"), rot.Inertia(ev, "shaft", INERTIA), rot.IdealGear(ev, "gear", -3.0)
    brake = Brake(ev, "brake", mu=0.4, fn_max=10.0, cgeo=1.5, peak=1.5)
    system = compiled(
        wall, shift, one, other, turn, shaft, gear, brake,
        connect=[
            (wall.flange, one.flange_a, other.flange_b), (shift.flange, one.flange_b, other.flange_a),
            (turn.flange, shaft.flange_a), (shaft.flange_b, gear.flange_a), (gear.flange_b, brake.flange),
        ],
    )  # fmt: skip
    # Not at 0.25 and 0.75, where both turn back.
    ts = jnp.array([0.1, 0.24, 0.26, 0.6, 0.74, 0.76, 1.0])
    inputs = {"shift.u": lambda t: 0.1 * jnp.sin(2 * np.pi * t), "turn.u": lambda t: 0.2 * jnp.sin(2 * np.pi * t)}
    solution = simulate(system, 1.0, ts=ts, inputs={**inputs, "brake.u": 1.0})
    sign = np.sign(np.cos(2 * np.pi * np.asarray(ts)))
    np.testing.assert_array_equal(np.sign(solution["brake.w"]), np.sign(solution["brake.flange.tau"]))
    np.testing.assert_allclose(np.abs(solution["brake.flange.tau"]), 6.0, rtol=1e-12)
    np.testing.assert_allclose(solution["one.f"], SLIDING * sign, rtol=1e-12)
    np.testing.assert_allclose(solution["other.f"], -SLIDING * sign, rtol=1e-12)


@pytest.mark.slow
def test_a_freewheel_that_begins_by_slipping_the_wrong_way():
    """J·w is conserved where flange_b catches up at once: it stayed slower by 10 rad/s, "locked"."""
    ev = EqnEnv()
    wheel, a, b = OneWayClutch(ev, "c"), rot.Inertia(ev, "a", 1.0), rot.Inertia(ev, "b", 2.0)
    system = compiled(a, wheel, b, connect=[(a.flange_b, wheel.flange_a), (wheel.flange_b, b.flange_a)])
    still = {"a.phi": 0.0, "b.phi": 0.0, "b.w": 0.0}
    solution = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), initial={"a.w": 10.0, **still})
    np.testing.assert_allclose(solution[["a.w", "b.w", "c.w_rel"]], [[10 / 3, 10 / 3, 0.0]] * 2, atol=1e-9)
    np.testing.assert_array_equal(solution["c.locked"], [1, 1])
    faster = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), initial={"a.w": -10.0, **still})
    np.testing.assert_allclose(faster[["a.w", "b.w"]], [[-10.0, 0.0]] * 2, atol=1e-9)


@pytest.mark.slow
@checks({OneWayClutch: ("SciPy's DOP853 from switch to switch", "a.w", "b.w", "events")}, origin=ORIGIN)
def test_a_freewheel():
    """A driven inertia and one that coasts behind a damper, J·w' = sin t and J₂·w' = −d·w while it runs free; SciPy
    from switch to switch."""
    J, J2, d = INERTIA, BEHIND, DAMPING
    ts = FREE

    def slopes(locked):
        def f(t, x):
            a, b = (np.sin(t) / J, -d * x[1] / J2)
            if locked:
                a = b = (np.sin(t) - d * x[1]) / (J + J2)
            return [a, b]

        return f

    def guard(locked):  # falls where the wheel locks, or comes free
        return lambda t, x: slopes(True)(t, x)[1] * J2 + d * x[1] if locked else x[1] - x[0]

    t, x, locked, rows, switched = 0.0, [0.0, 0.2], False, [], []
    while t < ts[-1]:
        event = guard(locked)
        event.terminal, event.direction = True, -1.0
        run = scipy.integrate.solve_ivp(
            slopes(locked), (t, ts[-1]), x, "DOP853", dense_output=True, events=event, max_step=0.1, **EXACT
        )
        rows.append(run.sol(ts[(ts >= t) & ((ts < run.t[-1]) | (run.status == 0))]))
        t, x, locked = run.t[-1], run.y[:, -1], not locked
        if run.status:
            switched.append(t)
    found = rubbing()
    measured("events", found.events("c"), switched, SMOOTH)
    for name, true in zip(("a.w", "b.w"), np.concatenate(rows, axis=1), strict=True):
        measured(name, found.values(name, ts), true, SMOOTH)
    # It pushes one way only, and never runs backwards.
    assert np.min(found.values("c.tau", ts)) > -1e-9 and np.min(found.values("c.w_rel", ts)) > -1e-9


@pytest.mark.slow
def test_a_clutch_that_locks():
    """Inertias of 1 and 2 kg·m² at 10 and 0 rad/s, 3 N·m on the first one and a slip torque of 8 N·m between them: they
    turn together from 10/9 s on, as 19/3 rad/s at t = 3."""
    ev = EqnEnv()
    driven = rot.Inertia(ev, "J1", 1.0, initial_angle=0.0, initial_speed=10.0)
    load = rot.Inertia(ev, "J2", 2.0, initial_angle=0.0, initial_speed=0.0)
    clutch, torque = Clutch(ev, "c", mu=0.5, fn_max=16.0), rot.Torque(ev, "drive")
    system = compiled(
        driven, load, clutch, torque,
        connect=[
            (torque.flange, driven.flange_a), (driven.flange_b, clutch.flange_a), (clutch.flange_b, load.flange_a)
        ],
    )  # fmt: skip
    end = np.array([3.0])
    run = ran(system, 3.0, end, ["J1.w", "J2.w", "J1.phi"], {"c.mu": 0.5}, {"c.u": 1.0, "drive.tau": 3.0})
    np.testing.assert_allclose(run.events("c"), [10 / 9], rtol=0, atol=SMOOTH)
    np.testing.assert_allclose([run.values(f"J{k}.w", end)[0] for k in (1, 2)], 19 / 3, rtol=SMOOTH)
    np.testing.assert_allclose(run.values("J1.phi", end), 18.2037037037037, rtol=SMOOTH)
    np.testing.assert_allclose(run.slopes("J1.phi", "c.mu", end) / 16.0, -0.617283950617284, rtol=SMOOTH)


COUPLED = [
    0.4, 0.70962147469375, 0.79166235915482, 0.83110850613765, 0.9, 0.90685019279788, 1.0002958598946, 1.1439674924732,
    1.25,
]  # fmt: skip
TURNED = 7.4861190991143


@functools.cache
def clutches():
    ev = EqnEnv()
    J = [rot.Inertia(ev, f"J{k}", 1.0, initial_angle=0.0, initial_speed=10.0 * (k == 1)) for k in range(1, 5)]
    c = [Clutch(ev, f"c{k}", mu=0.5, fn_max=20.0, peak=1.1) for k in range(1, 4)]
    torque = rot.Torque(ev, "drive")
    joined = [(torque.flange, J[0].flange_a)]
    for k in range(3):
        joined += [(J[k].flange_b, c[k].flange_a), (c[k].flange_b, J[k + 1].flange_a)]
    return compiled(torque, *J, *c, connect=joined)


def coupled(mu, **options):
    inputs = {
        "drive.tau": lambda t: 10 * jnp.sin(2 * jnp.pi * 5 * t),
        "c1.u": lambda t: jnp.sin(2 * jnp.pi * 0.2 * t + jnp.pi / 2),
        "c2.u": lambda t: jnp.where(t < 0.4, 0.0, 1.0),
        "c3.u": lambda t: jnp.where(t < 0.9, 0.0, 1.0),
    }
    return simulate(
        clutches().with_parameters({"c1.mu": mu}), 1.5, ts=jnp.array([1.5]), inputs=inputs,
        jump_ts=jnp.array([0.4, 0.9]), **TIGHT, **options,
    )  # fmt: skip


@pytest.mark.slow
@checks(
    {Clutch: ("closed form of CoupledClutches, in extended precision", "events", "J1.phi")},
    origin=ORIGIN,
)
def test_coupled_clutches():
    """CoupledClutches of the Modelica Standard Library, against its closed form in extended precision; a Modelica
    tool's published event times are off by up to 4e-6 s."""
    solution = coupled(0.5)
    measured("events", events(solution), COUPLED, SMOOTH)
    measured("J1.phi", solution["J1.phi"][-1], TURNED, SMOOTH)


# --- sampled blocks --------------------------------------------------------------------------------------------------

T = 0.1


NUMERATOR, DENOMINATOR = [0.5, 0.2], [2.0, -1.2, 0.5]
MIDDLES = (np.arange(60) + 0.5) * T
PERIODS = np.arange(12)
BEFORE = (PERIODS + 1) * T - 1e-6  # just before the next pulse begins


def share(t):
    return 0.6 + 0.7 * jnp.sin(7.0 * t)


@functools.cache
def sampling():
    """Sampled blocks of a wave, and the mean of pulses, in one run of 6 s."""
    ev = EqnEnv()
    wave = sig.Sine(ev, "wave", 1.0, 3 / (2 * np.pi))
    blocks = [
        sig.SampleHold(ev, "hold", T, initial_y=7.0), sig.SampledDelay(ev, "late", 3, T, initial_y=0.4),
        sig.DiscreteTransferFunction(ev, "tf", NUMERATOR, DENOMINATOR, T),
        sig.DiscretePI(ev, "pi", 2.0, 3.0, T, high=np.inf),
        sig.DiscretePI(ev, "bounded", 2.0, 3.0, T, low=-0.8, high=1.0),
        sig.DiscretePI(ev, "reverse", -2.0, -3.0, T, low=-1.0, high=0.8),
        sig.Counter(ev, "count", 0.5), sig.Hysteresis(ev, "relay", -0.3, 0.6, low=-2.0, high=5.0),
    ]  # fmt: skip
    clock = sig.Integrator(ev, "nothing")
    pulse, mean = sig.PulseWidth(ev, "pulse", T, height=5.0), sig.Integrator(ev, "mean")
    system = compiled(
        wave, *blocks, clock, pulse, mean,
        connect=[(wave.y, *(b.u for b in [*blocks, clock])), (pulse.y, mean.u)],
    )  # fmt: skip
    names = [f"{block.name}.y" for block in blocks] + ["wave.y", "mean.y"]
    return ran(system, 6.0, np.unique([*MIDDLES, *BEFORE]), names, {}, {"pulse.u": share})


@pytest.mark.slow
@checks(
    {
        sig.SampleHold: ("the samples", "hold.y"),
        sig.SampledDelay: ("the samples, later", "late.y"),
        sig.DiscreteTransferFunction: ("SciPy's dlsim", "tf.y"),
        sig.DiscretePI: ("a loop over the samples", "pi.y", "bounded.y", "reverse.y"),
        sig.Counter: ("arcsin of the threshold", "count.y"),
        sig.Hysteresis: ("a loop over fine samples", "relay.y"),
    },
    origin="sums of a few hundred roundings",
)
def test_sampled_blocks():
    """All at once, of u = sin 3t: values at the middles of the periods are functions of samples at k·T."""
    numerator, denominator = NUMERATOR, DENOMINATOR
    u, ts = np.sin(3 * np.arange(60) * T), MIDDLES
    found = sampling()
    _, filtered = scipy.signal.dlsim((numerator, denominator, T), u)
    total = np.concatenate([[0.0], np.cumsum(3.0 * T * u)])[:-1]
    bounded, kept = [], 0.0
    for v in u:
        wished = 2.0 * v + kept
        bounded.append(np.clip(wished, -0.8, 1.0))
        kept += 0.0 if wished > 1.0 and v > 0 or wished < -0.8 and v < 0 else 3.0 * T * v
    rises = np.floor((3 * ts - np.arcsin(0.5)) / (2 * np.pi)) + 1
    on, relay = False, []
    for v in np.sin(3 * np.linspace(0.0, ts[-1], 20 * 119 + 1)):  # fine enough to see every crossing
        on = v > 0.6 or (on and v >= -0.3)
        relay.append(5.0 if on else -2.0)
    # Sampled values are sums of a few hundred roundings.
    for name, expected in {
        "hold": u, "late": np.concatenate([[0.4] * 3, u[:-3]]), "tf": filtered[:, 0], "pi": 2.0 * u + total,
        "bounded": bounded, "reverse": -np.array(bounded), "count": rises, "relay": relay[20::40],
    }.items():  # fmt: skip
        measured(f"{name}.y", found.values(f"{name}.y", ts), expected, 1e-12 * max(1.0, np.abs(expected).max()))
    np.testing.assert_allclose(found.values("wave.y", ts), np.sin(3 * ts), atol=1e-12)


@pytest.mark.slow
@checks({sig.PulseWidth: ("sum of the shares", "mean.y")}, origin=ORIGIN)
def test_pulse_width():
    """The share of every period is the input at its beginning, cut to what is possible."""
    k = PERIODS
    shares = np.clip(0.6 + 0.7 * np.sin(7.0 * k * T), 0.0, 1.0)
    lost = 5.0 * 1e-6 * (shares == 1)
    assert (shares == 0).any() and (shares == 1).any() and ((0 < shares) & (shares < 1)).any()
    measured("mean.y", sampling().values("mean.y", BEFORE), 5.0 * T * np.cumsum(shares) - lost, SMOOTH)


# --- valves ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@checks(
    {hyd.CheckValve: ("SciPy's solution from switch to switch", "first.p", "second.p", "events")},
    origin=ORIGIN,
)
def test_a_check_valve_fills_a_volume():
    """A flow of sin(2πt) kg/s into a volume, from which a check valve leads to a second one, by SciPy."""
    crack, R, C1, C2, rho = 2e4, 3e4, 1e-8, 4e-8, hyd.DENSITY
    ev = EqnEnv()
    source, valve = hyd.MassFlowSource(ev, "src"), hyd.CheckValve(ev, "valve", p_crack=crack, R=R)
    first = hyd.HydraulicCapacity(ev, "first", C=C1, initial_pressure=1e5)
    second = hyd.HydraulicCapacity(ev, "second", C=C2, initial_pressure=1e5)
    system = compiled(
        source, valve, first, second,
        connect=[(source.fluid, valve.port_a, first.fluid), (valve.port_b, second.fluid)],
    )  # fmt: skip
    ts = np.linspace(0.0, 3.0, 31)

    def drive(t, p):
        return (p[0] - p[1] - crack) / 1e5

    def slopes(on):
        def slope(t, p):
            q = on * 1e5 * drive(t, p) / R
            return [(np.sin(2 * np.pi * t) - q) / (rho * C1), q / (rho * C2)]

        return slope

    expected, switched = by_modes(ts, [1e5, 1e5], False, drive, slopes)
    flow = {"src.m_flow": lambda t: jnp.sin(2 * jnp.pi * t)}
    solution = simulate(system, 3.0, ts=jnp.asarray(ts), inputs=flow, **TIGHT)
    measured("first.p", solution["first.p"], expected[0], SMOOTH * 1e5)
    measured("second.p", solution["second.p"], expected[1], SMOOTH * 1e5)
    measured("events", events(solution), switched, SMOOTH)


@pytest.mark.slow
@checks({hyd.ReliefValve: ("times in closed form, and their slope", "events", "slope")}, origin=ORIGIN)
def test_a_relief_valve_opens_and_shuts():
    """With 0.1 kg/s into a volume, dp rises in proportion to time and falls, s = √dp, with 2s·ds/(m − k·s) = dt/(ρC):
    the times are integrals in closed form."""
    m, C, rho, area, upper, lower = 0.1, 1e-9, hyd.DENSITY, 1e-5, 4e6, 1e6

    def phases(upper):
        k = area * 0.6 * np.sqrt(2 * rho)

        def until(s):
            return -2 * rho * C * (s / k + m / k**2 * np.log(np.abs(m - k * s)))

        return rho * C * (upper - lower) / m, until(np.sqrt(lower)) - until(np.sqrt(upper))

    ev = EqnEnv()
    source, ambient = hyd.MassFlowSource(ev, "src"), hyd.PressureSource(ev, "ambient", p=1e5)
    volume = hyd.HydraulicCapacity(ev, "volume", C=C, initial_pressure=lower + 1e5)
    valve = hyd.ReliefValve(ev, "valve", p_open=upper, p_close=lower, A=area, dp_small=0.1)
    system = compiled(
        source, ambient, volume, valve,
        connect=[(source.fluid, volume.fluid, valve.port_a), (valve.port_b, ambient.fluid)],
    )  # fmt: skip
    rise, fall = phases(upper)
    end = 3.5 * (rise + fall)

    def run(p_open, **options):
        changed = system.with_parameters({"valve.p_open": p_open})
        return simulate(changed, end, ts=jnp.array([end]), inputs={"src.m_flow": m}, **TIGHT, **options)

    solution = run(upper)
    expected = np.cumsum([rise, fall] * 4)
    measured("events", events(solution), expected[expected < end], SMOOTH * expected[0])
    slope = jax.grad(lambda p: run(p, max_events=8).events.ts[5])(upper)
    exact = central(lambda p: 3 * sum(phases(p)), upper, 1e2)
    measured("slope", slope, exact, 1e-6 * abs(exact))


@pytest.mark.slow
def test_a_relief_valve_may_begin_open():
    ev = EqnEnv()
    high, low = hyd.PressureSource(ev, "high", p=6e6), hyd.PressureSource(ev, "low", p=1e5)
    valve = hyd.ReliefValve(ev, "valve", p_open=4e6, p_close=1e6)
    system = compiled(high, low, valve, connect=[(high.fluid, valve.port_a), (valve.port_b, low.fluid)])
    flow = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]))["valve.m_flow"]
    np.testing.assert_allclose(flow, 1e-4 * 0.6 * np.sqrt(2 * hyd.DENSITY * 5.9e6), rtol=1e-9)  # (dp_small/dp)²/4


@pytest.mark.slow
def test_dry_frictions_in_a_row_of_which_the_weaker_slides():
    """Nothing has mass between them; the model was said to be singular. 2 m/s under 1 N end after 2 s and 2 m."""
    ev = EqnEnv()
    mass, wall = line.Mass(ev, "m", initial_position=0.0, initial_velocity=2.0), line.FixedPosition(ev, "wall")
    weak, strong = StickingFriction(ev, "weak", 1.0), StickingFriction(ev, "strong", 2.0)
    ends = (wall.flange, strong.flange_a), (strong.flange_b, weak.flange_a), (weak.flange_b, mass.flange)
    system = compiled(mass, wall, weak, strong, connect=ends)

    def rests(sliding):
        given = system.with_parameters({"weak.sliding": sliding})
        return simulate(given, 3.0, initial={"strong.v_rel": 0.0})["m.s"][-1]

    np.testing.assert_allclose(jax.value_and_grad(rests)(1.0), [2.0, -2.0], rtol=1e-7)
