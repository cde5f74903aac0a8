"""Diodes, switches and thyristors against closed forms, brute force and SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from component_references import checks, measured
from diode_bridges import GOFF, RON, bridge_by_brute_force
from problems import compiled
from switched_runs import ORIGIN, SMOOTH, TIGHT, by_modes, ran

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.signal as sig
from jaxonomy_dae import EqnEnv, simulate


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
