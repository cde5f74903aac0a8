"""Blocks of the Modelica Standard Library 4.1.0 that filter, limit, sample and decide, around our own plants.

Each stands beside its equations in SciPy, or beside its closed form; slopes are those of central differences.
`MODELICA_LIBRARY` names the folder of the library; without it the tests are skipped.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from device_library import standard_library
from open_classes import by_differences, opened, run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.library.signal import Integrator
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow
TYPES = "Modelica.Blocks.Types"


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


def steady(numerator, denominator, u):
    """(A, B, C, D) of a transfer function, and its state at rest with the input u."""
    A, B, C, D = scipy.signal.tf2ss(numerator, denominator)
    return (A, B[:, 0], C[0], D[0, 0]), -np.linalg.solve(A, B[:, 0] * u)


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
