"""Gates, registers, clocked controllers, means and switches of the Modelica Standard Library 4.1.0, beside what their
specifications say. `MODELICA_LIBRARY` names the folder of the library; without it the tests are skipped."""

import jax.numpy as jnp
import numpy as np
import pytest
from device_library import standard_library
from open_classes import run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate
from jaxonomy_dae.library import electrical
from jaxonomy_dae.library.signal import Constant, FirstOrder, Sine, Step, Sum
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow
UNKNOWN, ZERO, ONE = 1, 3, 4  # levels of Modelica.Electrical.Digital


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def stairs(ev, d, name, first, *steps):
    """A signal that begins at `first` and steps by pairs (time, height)."""
    parts = [Constant(ev, f"{name}0", first)]
    parts += [Step(ev, f"{name}{k}", start_time=t, height=h) for k, (t, h) in enumerate(steps, 1)]
    total = Sum(ev, name, [1.0] * len(parts))
    d.add(*parts, total)
    for k, part in enumerate(parts, 1):
        d.connect(part.y, total[f"u{k}"])
    return total.y


def test_gates_and_registers(library):
    """A NAND gate rises 0.1 s and falls 0.05 s after its inputs. A register takes its data at rising edges of its
    clock, and knows nothing before the first one. `edge` and `pre` of inputs, from a true input at the start on."""
    digital = "Modelica.Electrical.Digital"
    ev, d = EqnEnv(), AcausalDiagram()
    zero = f"y0 = {digital}.Interfaces.Logic.'0'"
    nand = library.component(f"{digital}.Gates.NandGate", zero)(ev, "nand", tLH=0.1, tHL=0.05)
    register = library[f"{digital}.Registers.DFFREG"](ev, "register")
    pre = library["Modelica.Blocks.Logical.Pre"](ev, "pre")
    delay = library["Modelica.Blocks.MathBoolean.OnDelay"](ev, "delay", delayTime=0.15)
    d.add(nand, register, pre, delay)
    d.connect(stairs(ev, d, "a", ZERO, (0.2, 1.0), (0.4, -1.0)), nand["x[1]"])
    d.connect(stairs(ev, d, "b", ONE), nand["x[2]"])
    d.connect(stairs(ev, d, "data", ZERO, (0.2, 1.0), (0.6, -1.0)), register["dataIn[1]"])
    d.connect(stairs(ev, d, "clock", ZERO, (0.3, 1.0), (0.5, -1.0), (0.7, 1.0)), register.clock)
    d.connect(stairs(ev, d, "reset", ZERO), register.reset)
    d.connect(stairs(ev, d, "pulse", 0.0, (0.1, 1.0), (0.2, -1.0), (0.3, 1.0)), pre.u, delay.u)
    ts = jnp.array([0.05, 0.15, 0.22, 0.28, 0.33, 0.43, 0.48, 0.55, 0.65, 0.75])
    s = simulate(AcausalCompiler(ev, d)(), 0.8, ts=ts)
    assert s["nand.y"].tolist() == [ZERO, ONE, ONE, ZERO, ZERO, ZERO, ZERO, ONE, ONE, ONE]
    assert s["register.dataOut[1]"].tolist() == [UNKNOWN] * 4 + [ONE] * 5 + [ZERO]
    assert s["pre.y"].tolist() == [0, 1, 0, 0, 1, 1, 1, 1, 1, 1]
    assert s["delay.y"].tolist() == [0, 0, 0, 0, 0, 0, 1, 1, 1, 1]


def test_clocked_controllers_means_and_switches(library):
    """The clocked PI controller of the library around our lag; the mean of a sine over half of its period; two phases
    with a switch in each, one of which opens."""
    ev, d = EqnEnv(), AcausalDiagram()
    pi = library.component("Modelica.Clocked.RealSignals.NonPeriodic.PI", clock=0.125)(ev, "pi", k=1.5, T=0.5)
    lag, goal, gap = FirstOrder(ev, "lag", T=0.4), Constant(ev, "goal", 1.0), Sum(ev, "gap", (1, -1))
    mean = library.component("Modelica.Blocks.Math.Mean", f=2.0)(ev, "mean")
    sine = Sine(ev, "sine", amplitude=1.5, frequency=1.0, offset=0.3)
    Switch, small = library.component("Modelica.Electrical.Polyphase.Ideal.IdealOpeningSwitch", m=2), 1e-5
    switch = Switch(ev, "switch", Ron=[small, small], Goff=[small, small])
    opens, stays, g = Step(ev, "opens", start_time=0.4), Constant(ev, "stays", 0.0), electrical.Ground(ev, "g")
    d.add(pi, lag, goal, gap, mean, sine, switch, opens, stays, g)
    d.connect(goal.y, gap["u1"])
    d.connect(lag.y, gap["u2"])
    d.connect(gap.y, pi.u)
    d.connect(pi.y, lag.u)
    d.connect(sine.y, mean.u)
    d.connect(opens.y, switch["control[1]"])
    d.connect(stays.y, switch["control[2]"])
    for k in (0, 1):
        v, r = electrical.VoltageSource(ev, f"v{k}", V=10.0), electrical.Resistor(ev, f"r{k}", R=5.0)
        d.add(v, r)
        d.connect(v.p, switch.plug_p[k])
        d.connect(switch.plug_n[k], r.p)
        d.connect(r.n, v.n, g.p)
    system = AcausalCompiler(ev, d)()
    values = {"pi.k": 1.5, "pi.T": 0.5, "lag.T": 0.4, "sine.amplitude": 1.5}
    ts = np.array([0.1, 0.3, 0.45, 0.7, 1.1])
    names = ["lag.y", "mean.y", "r0.i", "r1.i"]
    found, slopes = run_with_slopes(system, values, ts, names, ["lag.y", "mean.y"])

    def by_hand(k, T, tau, amplitude):
        x, v, out, left = 0.0, 0.0, [], list(ts)
        for n in range(9):
            u = 1.0 - v
            x = x + u * 0.125 / T
            y = k * (x + u)
            while left and left[0] < (n + 1) * 0.125:
                out.append(y + (v - y) * np.exp(-(left.pop(0) - n * 0.125) / tau))
            v = y + (v - y) * np.exp(-0.125 / tau)
        halves = 2.0 * amplitude / np.pi
        return np.array(out), np.array([0.0, 0.0, 0.0, 0.3 + halves, 0.3 - halves])

    lagged, means = by_hand(*values.values())
    np.testing.assert_allclose(found["lag.y"], lagged, rtol=1e-7)
    np.testing.assert_allclose(found["mean.y"], means, rtol=1e-7, atol=1e-12)
    closed, opened = 10.0 / (5.0 + small), 10.0 / (5.0 + 1.0 / small)
    np.testing.assert_allclose(found["r1.i"], closed, rtol=1e-9)
    np.testing.assert_allclose(found["r0.i"], [closed, closed, opened, opened, opened], rtol=1e-9)
    for k, name in enumerate(values):
        ends = [sum(f[-1] for f in by_hand(*(v * (1 + h * (j == k)) for j, v in enumerate(values.values()))))
                for h in (1e-6, -1e-6)]  # fmt: skip
        slope = (ends[0] - ends[1]) / (2e-6 * values[name])
        np.testing.assert_allclose(slopes[name], slope, rtol=1e-5, err_msg=name)
