"""Power converters: switches and diodes that are nearly ideal, against SciPy's solution with ideal ones.

A blocked diode or open switch with an inductor behind it makes a time constant L·G of picoseconds: currents and
voltages that jump at events are then far from where slopes would take them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from problems import compiled

from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library import electrical as el
from jaxonomy_dae.library import signal

PERIOD, INDUCTANCE, CAPACITY = 1e-3, 1e-3, 1e-4
TIGHT = {"rtol": 1e-9, "atol": 1e-12}


def clocked(ev, duty, leak, resistance):
    """A switch that is closed for a share of each period, with the parts that drive it, and a diode."""
    width, share = signal.PulseWidth(ev, "width", period=PERIOD), signal.Constant(ev, "share", k=duty)
    switch = el.Switch(ev, "switch", Goff=leak, Ron=resistance)
    diode = el.IdealDiode(ev, "diode", Goff=leak, Ron=resistance)
    return switch, diode, [width, share], [(share.y, width.u), (width.y, switch.u)]


def buck(leak):
    ev = EqnEnv()
    switch, diode, parts, signals = clocked(ev, 0.4, leak, 0.0)
    source, coil = el.VoltageSource(ev, "source", 24.0), el.Inductor(ev, "coil", INDUCTANCE, initial_current=0.0)
    tank, load = el.Capacitor(ev, "tank", CAPACITY, initial_voltage=0.0), el.Resistor(ev, "load", 5.0)
    ground = el.Ground(ev, "ground")
    connect = [
        *signals, (source.p, switch.p), (switch.n, diode.n, coil.p), (coil.n, tank.p, load.p),
        (source.n, diode.p, tank.n, load.n, ground.p),
    ]  # fmt: skip
    return compiled(*parts, source, connect=connect)


def boost(leak, resistance):
    ev = EqnEnv()
    switch, diode, parts, signals = clocked(ev, 0.5, leak, resistance)
    source, coil = el.VoltageSource(ev, "source", 12.0), el.Inductor(ev, "coil", INDUCTANCE, initial_current=0.0)
    tank, load = el.Capacitor(ev, "tank", CAPACITY, initial_voltage=12.0), el.Resistor(ev, "load", 50.0)
    ground = el.Ground(ev, "ground")
    connect = [
        *signals, (source.p, coil.p), (coil.n, switch.p, diode.p), (diode.n, tank.p, load.p),
        (source.n, switch.n, tank.n, load.n, ground.p),
    ]  # fmt: skip
    return compiled(*parts, source, connect=connect)


def ideal(periods, duty, load, start, closed, conducting):
    """The coil's current and the tank's voltage after some periods, and how often the diode has stopped: dy/dt is
    `closed(y)` while the switch is, then `conducting(y)` as long as a current flows."""
    y, stops = np.array(start), 0
    accurate = {"rtol": 1e-12, "atol": 1e-13}

    def emptied(t, y):
        return y[0]

    emptied.terminal, emptied.direction = True, -1  # pyright: ignore[reportFunctionMemberAccess]
    for _ in range(periods):
        y = scipy.integrate.solve_ivp(lambda t, y: closed(y, load), (0, duty * PERIOD), y, **accurate).y[:, -1]
        rest = (1 - duty) * PERIOD
        run = scipy.integrate.solve_ivp(lambda t, y: conducting(y, load), (0, rest), y, events=emptied, **accurate)
        y = run.y[:, -1]
        if run.status == 1:
            y, stops = np.array([0.0, y[1] * np.exp(-(rest - run.t[-1]) / (load * CAPACITY))]), stops + 1
    return y, stops


def ideal_buck(periods, duty=0.4, load=5.0):
    return ideal(
        periods, duty, load, [0.0, 0.0],
        lambda y, R: [(24 - y[1]) / INDUCTANCE, (y[0] - y[1] / R) / CAPACITY],
        lambda y, R: [-y[1] / INDUCTANCE, (y[0] - y[1] / R) / CAPACITY],
    )  # fmt: skip


def ideal_boost(periods):
    return ideal(
        periods, 0.5, 50.0, [0.0, 12.0],
        lambda y, R: [12 / INDUCTANCE, -y[1] / R / CAPACITY],
        lambda y, R: [(12 - y[1]) / INDUCTANCE, (y[0] - y[1] / R) / CAPACITY],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("leak", [1e-9, 1e-6])
def test_a_buck_converter_whose_coil_empties(leak):
    """The diode stops in each period; its current, followed back by the slope of the blocked circuit, made it conduct
    again, without end; and while the switch was open and the diode not yet conducting, the coil lost energy."""
    solution = simulate(buck(leak), 10 * PERIOD, ts=jnp.array([10 * PERIOD]), max_events=100, **TIGHT)
    (_, voltage), stops = ideal_buck(10)
    # Leaks of 24 V·G beside a current of 1.7 A, for 5 Ω; ten times the tolerance of a run.
    np.testing.assert_allclose(solution["tank.v"][-1], voltage, atol=20 * 24 * leak * 5 + 1e-7)
    # Each period: the switch closes and opens, the source of its signal too, the diode conducts and stops.
    which = [n for n, t in zip(solution.events.names, solution.events.ts, strict=False) if np.isfinite(t)]
    assert sum("diode" in n and "active, 1" in n for n in which) == stops == 10


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [None])
def test_its_gradients(adjoint):
    system = buck(1e-9)

    def voltage(p):
        changed = system.with_parameters({"load.R": p[0], "share.k": p[1]})
        run = simulate(changed, 4 * PERIOD, ts=jnp.array([4 * PERIOD]), max_events=50, adjoint=adjoint, **TIGHT)
        return run["tank.v"][0]

    differentiated = jax.grad if adjoint is None else jax.jacfwd
    found = differentiated(voltage)(jnp.array([5.0, 0.4]))
    h = 1e-5
    by_load = (ideal_buck(4, load=5.0 + h)[0][1] - ideal_buck(4, load=5.0 - h)[0][1]) / (2 * h)
    by_duty = (ideal_buck(4, 0.4 + h)[0][1] - ideal_buck(4, 0.4 - h)[0][1]) / (2 * h)
    # Differences of values with 1e-11 are good to 1e-6; leaks change less.
    np.testing.assert_allclose(found, [by_load, by_duty], rtol=3e-6)


@pytest.mark.slow
def test_a_boost_converter():
    """The switch closes on a diode that conducts, and ideal parts would short-circuit the tank: the diode blocks at
    that instant. A resistance of 1e-5 changes voltages by 4 A·1e-5 Ω beside 30 V."""
    (_, voltage), _ = ideal_boost(10)
    for resistance, rtol in ((1e-5, 1e-5), (0.0, 1e-7)):
        run = simulate(boost(1e-9, resistance), 10 * PERIOD, ts=jnp.array([10 * PERIOD]), max_events=100, **TIGHT)
        np.testing.assert_allclose(run["tank.v"][-1], voltage, rtol=rtol)


@pytest.mark.slow
def test_a_bridge_with_a_coil():
    """L i' = |100 sin 100πt| − R i: all four diodes change at each zero of the source."""
    ev = EqnEnv()
    source = el.SineVoltage(ev, "source", 100.0, 50.0)
    up, un, down, dn = (el.IdealDiode(ev, f"d{k}", Goff=1e-9, Ron=1e-5) for k in range(4))
    coil, load, ground = el.Inductor(ev, "coil", 0.05, 0.0), el.Resistor(ev, "load", 10.0), el.Ground(ev, "ground")
    connect = [
        (source.p, up.p, un.n), (source.n, down.p, dn.n), (up.n, down.n, coil.p), (coil.n, load.p),
        (load.n, un.p, dn.p, ground.p),
    ]  # fmt: skip
    end = 0.105
    solution = simulate(compiled(source, connect=connect), end, ts=jnp.array([end]), **TIGHT)

    def field(t, i):
        return (abs(100 * np.sin(100 * np.pi * t)) - 10 * i) / 0.05

    true = scipy.integrate.solve_ivp(field, (0, end), [0.0], rtol=1e-11, atol=1e-12, max_step=1e-4).y[0, -1]
    # Two diodes of 1e-5 Ω beside 10 Ω.
    np.testing.assert_allclose(solution["coil.i"][-1], true, rtol=5e-6)
