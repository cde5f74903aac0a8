"""Blocks of the Modelica Standard Library 4.1.0 that limit, sample and decide, around our own plants.

Each stands beside its equations in SciPy, or beside its closed form; slopes are those of central differences.
`MODELICA_LIBRARY` names the folder of the library; without it the tests are skipped.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from device_library import standard_library
from open_classes import along_by_differences, by_differences, opened, run_along, run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.library import thermal
from jaxonomy_dae.library.signal import Integrator
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def by_parts(slope, start, ts, breaks=(), **options):
    """The solution of SciPy at times, begun anew at each break of what drives it."""
    t, x, rows = 0.0, np.asarray(start, float), []
    for end in sorted({*breaks, ts[-1]}):
        inside = ts[(ts > t) & (ts <= end)]
        given = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12, "t_eval": [*inside, *({end} - {*inside})]} | options
        run = scipy.integrate.solve_ivp(slope, (np.nextafter(t, end), end), x, **given)
        assert run.success
        rows.append(run.y[:, : len(inside)])
        t, x = end, run.y[:, -1]
    return np.concatenate(rows, axis=1)


def test_controllers_of_heated_bodies(library):
    """A PID controller with limits heats our body and does not wind up; one that is on or off heats another, with a
    timer; a signal of ours runs up and down between the limits of a hysteresis. By SciPy, and by exponentials."""
    ev, d = EqnEnv(), AcausalDiagram()

    def part(path, name, *, structure=None, **values):
        x = library.component(f"Modelica.Blocks.{path}", **(structure or {}))(ev, name, **values)
        d.add(x)
        return x

    wanted = part("Sources.Step", "wanted", height=25.0, offset=295.0, startTime=1.0)
    pid = part(
        "Continuous.LimPID", "pid", structure={"Td": 0.5}, k=20.0, Ti=4.0, yMax=400.0, yMin=0.0, xi_start=0.0,
        xd_start=-295.0,
    )  # fmt: skip
    goal, switch = (
        part("Sources.Constant", "goal", k=310.0),
        part("Logical.OnOffController", "switch", bandwidth=2.0),
    )
    power, timer = part("Math.BooleanToReal", "power", realTrue=300.0, realFalse=0.0), part("Logical.Timer", "timer")
    bodies = [thermal.HeatCapacitor(ev, f"body{k}", 50.0, T) for k, T in enumerate((295.0, 308.0))]
    films = [thermal.ThermalConductor(ev, f"film{k}", G=5.0) for k in range(2)]
    heaters = [thermal.HeatFlowSource(ev, f"heater{k}") for k in range(2)]
    sensors, room = [thermal.TemperatureSensor(ev, f"sensor{k}") for k in range(2)], thermal.FixedTemperature(
        ev, "room", 290.0
    )  # fmt: skip
    d.add(*bodies, *films, *heaters, *sensors, room)
    for body, film, heater, sensor in zip(bodies, films, heaters, sensors, strict=True):
        d.connect(body.heat, film.port_a, heater.heat, sensor.heat)
        d.connect(film.port_b, room.heat)
    d.connect(wanted.y, pid.u_s)
    d.connect(sensors[0].T, pid.u_m)
    d.connect(pid.y, heaters[0].Q_flow)
    d.connect(goal.y, switch.reference)
    d.connect(sensors[1].T, switch.u)
    d.connect(switch.y, power.u, timer.u)
    d.connect(power.y, heaters[1].Q_flow)
    relay = part("Logical.Hysteresis", "relay", uLow=-0.5, uHigh=1.0)
    falls, rises, chosen = (
        part("Sources.Constant", "falls", k=-1.5),
        part("Sources.Constant", "rises", k=1.0),
        part("Logical.Switch", "chosen"),
    )
    level = Integrator(ev, "level", initial_y=0.2)
    d.add(level)
    d.connect(level.y, relay.u)
    d.connect(relay.y, chosen.u2)
    d.connect(falls.y, chosen.u1)
    d.connect(rises.y, chosen.u3)
    d.connect(chosen.y, level.u)
    system = AcausalCompiler(ev, d)()
    values = {"pid.k": 20.0, "pid.Ti": 4.0, "pid.Ni": 0.9, "pid.yMax": 400.0, "wanted.height": 25.0}
    values |= {"switch.bandwidth": 2.0, "power.realTrue": 300.0, "relay.uLow": -0.5, "falls.k": -1.5}
    ts = np.array([2.0, 4.5, 8.0])
    names = ["body0.T", "pid.y", "body1.T", "timer.y", "level.y"]
    found, along = run_along(system, values, ts, names)

    def reference(k, Ti, Ni, high, height, band, heat, low, falls):
        def controlled(t, x):
            T, xi, xd = x
            set_to = 295.0 + height * (t >= 1.0)
            free = k * (set_to - T + xi + 10.0 * (-T - xd))
            y = np.clip(free, 0.0, high)
            change = (set_to - T + (y - free) / (k * Ni)) / Ti
            return [(y - 5.0 * (T - 290.0)) / 50.0, change, (-T - xd) / 0.05], y

        x = by_parts(
            lambda t, x: controlled(t, x)[0], [295.0, 0.0, -295.0], ts, [1.0], method="RK45", rtol=1e-10, max_step=2e-3
        )
        y = [controlled(t, x)[1] for t, x in zip(ts, x.T, strict=True)]

        def switched(t_end):
            t, T, on, since = 0.0, 308.0, True, 0.0
            while True:
                rest = 290.0 + heat * on / 5.0
                target = 310.0 + (band if on else -band) / 2
                at = t - 10.0 * np.log((target - rest) / (T - rest))
                if at >= t_end:
                    return rest + (T - rest) * np.exp((t - t_end) / 10.0), (t_end - since) * on
                t, T, on = at, target, not on
                since = t if on else since

        def running(t_end):
            t, y, up = 0.0, 0.2, True
            while True:
                rate, target = (1.0, 1.0) if up else (falls, low)
                at = t + (target - y) / rate
                if at >= t_end:
                    return y + rate * (t_end - t)
                t, y, up = at, target, not up

        return np.array([x[0], y, *np.array([switched(t) for t in ts]).T, [running(t) for t in ts]])

    expected = reference(*values.values())
    for k, n in enumerate(names):
        np.testing.assert_allclose(found[k], expected[k], rtol=1e-6, atol=1e-6, err_msg=n)
    # The output is 220 times a temperature, and SciPy steps over the bends of its limits.
    np.testing.assert_allclose(along, along_by_differences(reference, values, 1e-4), rtol=1e-4, atol=1e-4)


def test_sampled_blocks_of_a_wave(library):
    """What is held, extrapolated, filtered and triggered, by loops over the samples; a sampled signal closes a loop
    around our integrator."""
    ev, d, T = EqnEnv(), AcausalDiagram(), 0.25
    sine = opened(library, "Blocks.Sources.Sine")(ev, "sine", amplitude=1.5, f=0.7, phase=0.3, offset=0.2)
    above = opened(library, "Blocks.Logical.GreaterThreshold")(ev, "above", threshold=0.9)
    trigger = opened(library, "Blocks.Discrete.TriggeredSampler")(ev, "trigger", y_start=-1.0)
    d.add(sine, above, trigger)
    d.connect(sine.y, above.u, trigger.u)
    d.connect(above.y, trigger.trigger)

    def sampled(path, name, signal, **structure):
        x = library.component(f"Modelica.Blocks.Discrete.{path}", samplePeriod=T, **structure)(ev, name)
        d.add(x)
        if signal is not None:
            d.connect(signal, x["u[1]" if path == "StateSpace" else "u"])
        return x

    sampled("Sampler", "sampler", sine.y)
    sampled("FirstOrderHold", "first", sine.y)
    sampled("TransferFunction", "tf", sine.y, b=[0.5, 0.2], a=[2.0, -1.2, 0.5])
    sampled("StateSpace", "ss", sine.y, A=[[0.5, 0.3], [-0.3, 0.5]], B=[[1.0], [0.2]], C=[[1.0, 0.0]], D=[[0.1]])
    level = Integrator(ev, "level", k=-1.5, initial_y=2.0)
    held = sampled("ZeroOrderHold", "held", level.y)
    d.add(level)
    d.connect(held.y, level.u)
    system = AcausalCompiler(ev, d)()
    values = {"sine.amplitude": 1.5, "sine.f": 0.7, "level.k": -1.5, "above.threshold": 0.9}
    ts = np.array([0.1, 1.1, 2.2])
    names = ["sampler.y", "first.y", "tf.y", "ss.y[1]", "level.y", "trigger.y"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(amplitude, f, k, threshold):
        def wave(t):
            return 0.2 + amplitude * np.sin(2 * np.pi * f * np.asarray(t) + 0.3)

        n = np.floor(ts / T).astype(int)
        u = wave(T * np.arange(n[-1] + 1))
        slope = np.where(n > 0, (u[n] - u[n - 1]) / T, 0.0)
        first = np.where(n > 0, u[n - 1], u[0]) + slope * (ts - n * T)
        tf = scipy.signal.lfilter([0.0, 0.5, 0.2], [2.0, -1.2, 0.5], u)[n]
        x, ss = np.zeros(2), []
        for value in u:
            ss.append(x[0] + 0.1 * value)
            x = np.array([[0.5, 0.3], [-0.3, 0.5]]) @ x + np.array([1.0, 0.2]) * value
        level = 2.0 * (1 + k * T) ** n * (1 + k * (ts - n * T))
        crossed = [(np.arcsin((threshold - 0.2) / amplitude) - 0.3) / (2 * np.pi * f) + m / f for m in range(3)]
        triggered = [-1.0 if t < crossed[0] else wave(max(c for c in crossed if c <= t)) for t in ts]
        return np.array([u[n], first, tf, np.array(ss)[n], level, triggered])

    expected = reference(*values.values())
    for name, row in zip(names, expected, strict=True):
        np.testing.assert_allclose(found[name], row, rtol=1e-7, atol=1e-8, err_msg=name)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-5, abs=1e-7), name
