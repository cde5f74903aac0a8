"""Components that switch, stick and sample against closed forms, brute force and SciPy.

Runs are made at rtol = atol = 1e-10. Between events most of what is integrated is smooth on scales of a second, so that
a state is right to some tens of tolerances: 1e-8 and tighter below, unless a comment says what else limits it.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from component_references import checks, measured
from problems import compiled

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.hydraulic as hyd
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
import jaxonomy_dae.library.translational as line
from jaxonomy_dae import EqnEnv, ModelError, simulate
from jaxonomy_dae.library.friction import Brake, Clutch, OneWayClutch, StickingFriction

TIGHT = dict(rtol=1e-10, atol=1e-10)
ORIGIN = "some tens of tolerances of 1e-10"
SMOOTH = 1e-8  # what the tolerances leave of states and event times
EXACT = dict(rtol=1e-12, atol=1e-13)  # of SciPy's references


def events(solution):
    return np.asarray(solution.events.ts)[: len(solution.events)]


def central(f, p, h):
    return (f(p + h) - f(p - h)) / (2 * h)


# --- diodes, switches, thyristors ------------------------------------------------------------------------------------


def circuit(*parts, connect, ground):
    """The parts, and a node at zero potential."""
    g = el.Ground(parts[0].ev, "g")
    return compiled(*parts, g, connect=[*connect, (ground, g.p)])


def test_a_half_wave_rectifier():
    """i = max(10·sin(2πt), 0)/R, without any state."""
    ev = EqnEnv()
    source, diode, load = el.SineVoltage(ev, "src", 10.0, 1.0), el.IdealDiode(ev, "d"), el.Resistor(ev, "r", 4.0)
    system = circuit(
        source, diode, load, connect=[(source.p, diode.p), (diode.n, load.p), (load.n, source.n)], ground=source.n
    )
    ts = np.linspace(0.0, 2.2, 45)
    solution = simulate(system, 2.2, ts=jnp.asarray(ts), **TIGHT)
    v = 10 * np.sin(2 * np.pi * ts)
    # Nothing is integrated: rounding, but for samples at the zeros of the sine.
    np.testing.assert_allclose(solution["d.i"], np.maximum(v, 0) / 4, atol=1e-12)
    np.testing.assert_allclose(solution["d.v"], np.minimum(v, 0), atol=1e-12)
    np.testing.assert_allclose(events(solution), [0.5, 1.0, 1.5, 2.0], atol=1e-11)


@checks(
    {el.IdealDiode: ("SciPy's DOP853 from switch to switch", "c.v", "events")},
    origin=ORIGIN,
)
def test_a_smoothed_rectifier():
    """C v' = max(src − v, 0)/Rs − v/R, by SciPy, from switch to switch."""
    Rs, R, C = 2.0, 50.0, 0.02
    ev = EqnEnv()
    source, series, diode = el.SineVoltage(ev, "src", 10.0, 1.0), el.Resistor(ev, "rs", Rs), el.IdealDiode(ev, "d")
    tank, load = el.Capacitor(ev, "c", C, initial_voltage=0.0), el.Resistor(ev, "r", R)
    system = circuit(
        source, series, diode, tank, load,
        connect=[(source.p, series.p), (series.n, diode.p), (diode.n, tank.p, load.p), (tank.n, load.n, source.n)],
        ground=source.n,
    )  # fmt: skip
    ts = np.linspace(0.0, 3.0, 31)

    def drive(t, v):
        return 10 * np.sin(2 * np.pi * t) - v[0]

    expected, switched = by_modes(
        ts, [0.0], True, drive, lambda on: lambda t, v: [(on * drive(t, v) / Rs - v[0] / R) / C]
    )
    solution = simulate(system, 3.0, ts=jnp.asarray(ts), **TIGHT)
    measured("c.v", solution["c.v"], expected[0], SMOOTH)
    measured("events", events(solution), switched, SMOOTH)


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


RON, GOFF = 0.05, 1e-3


def bridge_by_brute_force(source, v_load, R=None, goff=GOFF, knee=0.0):
    """(potentials, currents, conducting) of a bridge whose output is held at v_load, or loaded by R.

    The sixteen modes of four diodes, and the one in which none contradicts itself. Nodes: 0 the source's other end,
    1 its end behind Rs = 1, 2 the positive and 3 the negative rail.
    """
    ends = [(1, 2), (0, 2), (3, 1), (3, 0)]
    fits = []
    for modes in itertools.product((False, True), repeat=4):
        # Unknowns: potentials of nodes 1, 2, 3 and the current out of the load's source.
        A, b = np.zeros((4, 4)), np.zeros(4)
        A[0, 0], b[0] = 1.0, source  # (source − v1)/Rs flows into node 1
        conductances = np.array([1 / RON if on else goff for on in modes])
        offsets = np.array([goff * knee - knee / RON if on else 0.0 for on in modes])
        for (p, n), conductance, offset in zip(ends, conductances, offsets, strict=True):
            for node, other, sign in ((p, n, 1), (n, p, -1)):
                if node:
                    b[node - 1] -= sign * offset
                    A[node - 1, node - 1] += conductance
                    if other:
                        A[node - 1, other - 1] -= conductance
        A[1, 3], A[2, 3] = 1.0, -1.0  # the load takes a current from 2 to 3
        A[3, 1], A[3, 2], A[3, 3] = 1.0, -1.0, 0.0 if R is None else -R
        b[3] = v_load
        v1, v2, v3, i = np.linalg.solve(A, b)
        node = [0.0, v1, v2, v3]
        voltage = np.array([node[p] - node[n] for p, n in ends])
        if all((v - knee >= -1e-12) if on else (v - knee <= 1e-12) for v, on in zip(voltage, modes, strict=True)):
            fits.append((np.array(node), i, voltage * conductances + offsets, modes))
    return fits[0]


@pytest.mark.parametrize(
    "goff, knee",
    [(1e-6, 0.6)]
    + [pytest.param(*v, marks=pytest.mark.slow) for v in ((GOFF, 0.0), (1e-9, 0.6), (1e-10, 0.7), (1e-8, 0.0))],
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


def charging(opens=False):
    """12 V through 1 kΩ (and 3 kΩ more while the switch is open) onto 1 mF."""
    ev = EqnEnv()
    source, series = el.VoltageSource(ev, "src", 12.0), el.Resistor(ev, "r", 1e3)
    switch, tank = el.TimedSwitch(ev, "s", time=0.7, opens=opens), el.Capacitor(ev, "c", 1e-3, initial_voltage=0.0)
    return circuit(
        source, series, switch, tank,
        connect=[(source.p, switch.p), (switch.n, series.p), (series.n, tank.p), (tank.n, source.n)], ground=source.n,
    )  # fmt: skip


@pytest.mark.parametrize("opens", [pytest.param(False, marks=pytest.mark.slow), True])
@checks(
    {el.TimedSwitch: ("exponential from the switching on, and its derivative by that time", "c.v", "slope")},
    origin=ORIGIN,
    opens=lambda: True,
)
def test_a_timed_switch(opens):
    """v = 12·(1 − exp(−s/τ)), τ = 1 s, with s the time for which it has been closed: dv/d(time) is ∓12·exp(−s)."""
    system, ts = charging(opens), np.array([0.3, 0.7, 1.1, 2.0])

    def voltage(instant):
        return simulate(system.with_parameters({"s.time": instant}), 2.0, ts=jnp.asarray(ts), **TIGHT)["c.v"]

    on = np.minimum(ts, 0.7) if opens else np.maximum(ts - 0.7, 0)
    measured("c.v", voltage(0.7), 12 * (1 - np.exp(-on)), SMOOTH)
    slope = jax.jit(jax.jacrev(voltage))(0.7)
    switched = ts > 0.7
    expected = np.where(switched, (1 if opens else -1) * 12 * np.exp(-on), 0.0)
    measured("slope", slope[switched], expected[switched], SMOOTH * np.abs(expected[switched]).min())
    assert slope[0] == 0


@checks({el.Switch: ("currents by Ohm's law, and times by arcsin", "q.y", "events")}, origin=ORIGIN)
def test_a_switch_that_a_signal_drives():
    """Closed while sin(2πt) > 1/2, from 1/12 to 5/12: 3 A, and 6/(2 + 100) A while it is open."""
    ev = EqnEnv()
    source, load = el.VoltageSource(ev, "src", 6.0), el.Resistor(ev, "r", 2.0)
    switch, wave, charge = el.Switch(ev, "s", Goff=0.01), sig.Sine(ev, "wave", 1.0, 1.0), sig.Integrator(ev, "q")
    system = circuit(
        source, load, switch, wave, charge,
        connect=[(source.p, switch.p), (switch.n, load.p), (load.n, source.n), (wave.y, switch.u), (load.i, charge.u)],
        ground=source.n,
    )  # fmt: skip
    solution = simulate(system, 2.0, ts=jnp.array([1.0, 2.0]), **TIGHT)
    once = 3 / 3 + 6 / 102 * 2 / 3
    measured("q.y", solution["q.y"], [once, 2 * once], SMOOTH)
    measured("events", events(solution), [1 / 12, 5 / 12, 13 / 12, 17 / 12], SMOOTH)


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


@checks(
    {StickingFriction: ("Den Hartog's closed form of stick and slip", "m.s", "events")},
    origin=ORIGIN,
)
def test_stick_and_slip():
    """A mass behind a spring whose end moves at the speed V: it sticks until k·V·t = Fs, and slips as
    x = V·s + b + A·cos(ws + p) until its speed is zero again (Den Hartog 1956, Mechanical Vibrations, section 7.6)."""
    m, k, V, sliding, breakaway = 1.0, 4.0, 0.5, 1.0, 2.0
    ev = EqnEnv()
    mass = line.Mass(ev, "m", m, initial_position=0.0, initial_velocity=0.0)
    pull, spring = line.SpeedSource(ev, "pull"), line.Spring(ev, "s", k)
    ground, friction = line.FixedPosition(ev, "g"), StickingFriction(ev, "f", sliding, breakaway)
    system = compiled(
        mass, pull, spring, ground, friction,
        connect=[(pull.flange, spring.flange_a), (spring.flange_b, mass.flange, friction.flange_b),
                 (ground.flange, friction.flange_a)],
    )  # fmt: skip
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
    solution = simulate(system, ts[-1], ts=jnp.asarray(ts), inputs={"pull.u": V}, **TIGHT)
    measured("events", events(solution), [t1, t1 + slip, t1 + slip + wait], SMOOTH)
    measured("m.s", solution["m.s"], [0, *x, moved, *(moved + x)], SMOOTH)
    np.testing.assert_array_equal(solution["f.mode"], [0, 1, 1, 0, 1, 1])


@checks({OneWayClutch: ("SciPy's DOP853 from switch to switch", "a.w", "b.w", "events")}, origin=ORIGIN)
def test_a_freewheel():
    """A driven inertia and one that coasts behind a damper, J·w' = sin t and J₂·w' = −d·w while it runs free; SciPy
    from switch to switch."""
    J, J2, d = 1.0, 0.5, 0.3
    ev = EqnEnv()
    torque = rot.Torque(ev, "drive")
    first = rot.Inertia(ev, "a", J, initial_angle=0.0, initial_speed=0.0)
    second = rot.Inertia(ev, "b", J2, initial_angle=0.0, initial_speed=0.2)
    wheel, damper, ground = OneWayClutch(ev, "c"), rot.Damper(ev, "d", d), rot.FixedAngle(ev, "g")
    system = compiled(
        torque, first, second, wheel, damper, ground,
        connect=[(torque.flange, first.flange_a), (first.flange_b, wheel.flange_a), (wheel.flange_b, second.flange_a),
                 (second.flange_b, damper.flange_a), (damper.flange_b, ground.flange)],
    )  # fmt: skip
    ts = np.linspace(0.0, 12.0, 25)

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
    solution = simulate(system, 12.0, ts=jnp.asarray(ts), inputs={"drive.tau": jnp.sin}, **TIGHT)
    measured("events", events(solution), switched, SMOOTH)
    for name, true in zip(("a.w", "b.w"), np.concatenate(rows, axis=1), strict=True):
        measured(name, solution[name], true, SMOOTH)
    # It pushes one way only, and never runs backwards.
    assert np.min(solution["c.tau"]) > -1e-9 and np.min(solution["c.w_rel"]) > -1e-9


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


@checks(
    {
        sig.SampleHold: ("the samples", "hold.y"),
        sig.SampledDelay: ("the samples, later", "late.y"),
        sig.DiscreteTransferFunction: ("SciPy's dlsim", "tf.y"),
        sig.DiscretePI: ("a loop over the samples", "pi.y", "bounded.y"),
        sig.Counter: ("arcsin of the threshold", "count.y"),
        sig.Hysteresis: ("a loop over fine samples", "relay.y"),
    },
    origin="sums of a few hundred roundings",
)
def test_sampled_blocks():
    """All at once, of u = sin 3t: values at the middles of the periods are functions of samples at k·T."""
    ev = EqnEnv()
    wave = sig.Sine(ev, "wave", 1.0, 3 / (2 * np.pi))
    numerator, denominator = [0.5, 0.2], [2.0, -1.2, 0.5]
    blocks = [
        sig.SampleHold(ev, "hold", T, initial_y=7.0), sig.SampledDelay(ev, "late", 3, T, initial_y=0.4),
        sig.DiscreteTransferFunction(ev, "tf", numerator, denominator, T),
        sig.DiscretePI(ev, "pi", 2.0, 3.0, T), sig.DiscretePI(ev, "bounded", 2.0, 3.0, T, lower=-0.8, upper=1.0),
        sig.Counter(ev, "count", 0.5), sig.Hysteresis(ev, "relay", -0.3, 0.6, low=-2.0, high=5.0),
    ]  # fmt: skip
    clock = sig.Integrator(ev, "nothing")
    system = compiled(wave, *blocks, clock, connect=[(wave.y, *(b.u for b in [*blocks, clock]))])
    k = np.arange(60)
    u, ts = np.sin(3 * k * T), (k + 0.5) * T
    solution = simulate(system, 6.0, ts=jnp.asarray(ts), **TIGHT)
    _, filtered = scipy.signal.dlsim((numerator, denominator, T), u)
    total = np.concatenate([[0.0], np.cumsum(3.0 * T * u)])[:-1]
    bounded, kept = [], 0.0
    for v in u:
        wished = 2.0 * v + kept
        bounded.append(np.clip(wished, -0.8, 1.0))
        kept += 0.0 if wished > 1.0 and v > 0 or wished < -0.8 and v < 0 else 3.0 * T * v
    wave_at = np.sin(3 * ts)
    rises = np.floor((3 * ts - np.arcsin(0.5)) / (2 * np.pi)) + 1
    on, relay = False, []
    for v in np.sin(3 * np.linspace(0.0, ts[-1], 20 * 119 + 1)):  # fine enough to see every crossing
        on = v > 0.6 or (on and v >= -0.3)
        relay.append(5.0 if on else -2.0)
    # Sampled values are sums of a few hundred roundings.
    for name, expected in {
        "hold": u, "late": np.concatenate([[0.4] * 3, u[:-3]]), "tf": filtered[:, 0], "pi": 2.0 * u + total,
        "bounded": bounded, "count": rises, "relay": relay[20::40],
    }.items():  # fmt: skip
        measured(f"{name}.y", solution[f"{name}.y"], expected, 1e-12 * max(1.0, np.abs(expected).max()))
    np.testing.assert_allclose(solution["wave.y"], wave_at, atol=1e-12)


def test_a_relay_and_a_lag():
    """τ·y' = u − y with u = ±1 from a relay of −y at ±b: it rings with a period of 2·τ·ln((1 + b)/(1 − b))."""
    tau, b = 0.5, 0.25
    ev = EqnEnv()
    lag, back = sig.FirstOrder(ev, "lag", 1.0, tau), sig.Gain(ev, "back", -1.0)
    relay = sig.Hysteresis(ev, "relay", -b, b, -1.0, 1.0, initially_on=True)
    system = compiled(lag, back, relay, connect=[(lag.y, back.u), (back.y, relay.u), (relay.y, lag.u)])
    solution = simulate(system, 3.0, ts=jnp.array([3.0]), **TIGHT)
    first, half = tau * np.log(1 / (1 - b)), tau * np.log((1 + b) / (1 - b))
    expected = first + half * np.arange(len(events(solution)))
    np.testing.assert_allclose(events(solution), expected, atol=SMOOTH)
    assert len(expected) == 1 + int((3.0 - first) / half)


@checks({sig.PulseWidth: ("sum of the shares", "mean.y")}, origin=ORIGIN)
def test_pulse_width():
    """The share of every period is the input at its beginning, cut to what is possible."""
    ev = EqnEnv()
    pulse, mean = sig.PulseWidth(ev, "pulse", T, height=5.0), sig.Integrator(ev, "mean")
    system = compiled(pulse, mean, connect=[(pulse.y, mean.u)])
    k = np.arange(12)

    def share(t):
        return 0.6 + 0.7 * jnp.sin(7.0 * t)

    solution = simulate(
        system, 1.2, ts=jnp.asarray((k + 1) * T - 1e-6), inputs={"pulse.u": share}, **TIGHT
    )  # just before the next pulse begins
    shares = np.clip(0.6 + 0.7 * np.sin(7.0 * k * T), 0.0, 1.0)
    lost = 5.0 * 1e-6 * (shares == 1)
    assert (shares == 0).any() and (shares == 1).any() and ((0 < shares) & (shares < 1)).any()
    measured("mean.y", solution["mean.y"], 5.0 * T * np.cumsum(shares) - lost, SMOOTH)


def test_what_blocks_refuse():
    ev = EqnEnv()
    with pytest.raises(ModelError, match="denominator"):
        sig.DiscreteTransferFunction(ev, "a", [1.0, 2.0], [1.0])
    with pytest.raises(ModelError, match="samples"):
        sig.SampledDelay(ev, "b", 0)
    with pytest.raises(ModelError, match="period"):
        sig.SampleHold(ev, "c", period=0.0)


# --- valves ----------------------------------------------------------------------------------------------------------


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


def test_a_relief_valve_shuts_below_where_it_opens():
    with pytest.raises(ModelError, match="'valve': p_close must not be above p_open"):
        hyd.ReliefValve(EqnEnv(), "valve", p_open=1e6, p_close=4e6)


def test_a_relief_valve_may_begin_open():
    ev = EqnEnv()
    high, low = hyd.PressureSource(ev, "high", p=6e6), hyd.PressureSource(ev, "low", p=1e5)
    valve = hyd.ReliefValve(ev, "valve", p_open=4e6, p_close=1e6)
    system = compiled(high, low, valve, connect=[(high.fluid, valve.port_a), (valve.port_b, low.fluid)])
    flow = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]))["valve.m_flow"]
    np.testing.assert_allclose(flow, 1e-4 * 0.6 * np.sqrt(2 * hyd.DENSITY * 5.9e6), rtol=1e-9)  # (dp_small/dp)²/4
