"""Modelica classes in plants with our own parts, beside closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from device_library import written_to

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, keep_programs, simulate
from jaxonomy_dae.host import kept
from jaxonomy_dae.library import electrical, thermal
from jaxonomy_dae.library.signal import Step
from jaxonomy_dae.modelica import Library, component


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    before = list(kept._CHOSEN)
    keep_programs(None)
    yield Library(written_to(tmp_path_factory.mktemp("devices")))
    kept._CHOSEN[:] = before


@pytest.mark.slow
def test_a_capacitor_is_charged_through_a_switch_and_a_heated_resistor(library):
    """C v' = (V - v)/R_all, R_all = R + 1/Goff before the switch closes, R + Ron afterwards; the heat in the resistor
    warms our capacity. The step that closes the switch is ours, its time a parameter."""
    V, R, C, Ron, Goff, capacity, at = 2.0, 1.5, 0.4, 0.01, 0.001, 5.0, 0.3
    ev, diagram = EqnEnv(), AcausalDiagram()
    r = library.component("Devices.Resistor", useHeatPort=True)(ev, "r", R=R)
    switch = library["Devices.Switch"](ev, "switch")
    c = library["Devices.Capacitor"](ev, "c", C=C, start={"v": 0.0})
    sensor, copy = library["Devices.Sensor"](ev, "sensor"), library["Devices.Source"](ev, "copy")
    v, g = electrical.VoltageSource(ev, "v", V=V), electrical.Ground(ev, "g")
    heat, load = thermal.HeatCapacitor(ev, "heat", capacity, 300.0), electrical.Resistor(ev, "load", R=10.0)
    step = Step(ev, "step", start_time=at)
    diagram.add(r, switch, c, sensor, copy, v, g, heat, load, step)
    diagram.connect(v.p, switch.p)
    diagram.connect(switch.n, r.p)
    diagram.connect(r.n, c.p, sensor.p)
    diagram.connect(c.n, v.n, g.p, copy.n, load.n)
    diagram.connect(r.heatPort, heat.heat)
    diagram.connect(copy.p, load.p)
    diagram.connect(sensor.y, copy.u)
    diagram.connect(step.y, switch.closed)
    system = AcausalCompiler(ev, diagram)()
    ts = jnp.array([0.2, 0.6, 1.5])

    def run(values):
        solution = simulate(system.with_parameters(values), 1.5, ts=ts, rtol=1e-9, atol=1e-11)
        return jnp.stack([solution["c.v"], solution["load.v"], solution["heat.T"], solution["switch.conducts"]])

    def closed(values):
        R, C, v0, at = (values[k] for k in ("r.R", "c.C", "c.initial_v", "step.start_time"))
        slow, fast = (R + 1 / Goff) * C, (R + Ron) * C
        gap = jnp.where(ts < at, (V - v0) * jnp.exp(-ts / slow), (V - v0) * jnp.exp(-at / slow - (ts - at) / fast))
        before, before_at = C / 2 * (V - v0) ** 2 * (1 - jnp.exp(-2 * jnp.stack([ts, 0 * ts + at]) / slow))
        later = before_at * R / (R + 1 / Goff) + C / 2 * ((V - v0) ** 2 * jnp.exp(-2 * at / slow) - gap**2) * R / (
            R + Ron
        )
        energy = jnp.where(ts < at, before * R / (R + 1 / Goff), later)
        return jnp.stack([V - gap, V - gap, 300.0 + energy / capacity, jnp.where(ts > at, 1.0, 0.0)])

    values = {"r.R": R, "c.C": C, "c.initial_v": 0.0, "step.start_time": at}
    both = jax.jit(lambda p: (run(p), jax.grad(lambda q: jnp.sum(run(q)[:3] ** 2))(p)))
    found, slopes = both(values)
    np.testing.assert_allclose(found, closed(values), atol=1e-7)
    expected = jax.grad(lambda q: jnp.sum(closed(q)[:3] ** 2))(values)
    for name in values:
        np.testing.assert_allclose(slopes[name], expected[name], rtol=1e-5, err_msg=name)


def test_what_flows_through_a_connector_is_not_zero_in_semi_linear():
    """The front end takes flows of loose connectors for zero: H = semiLinear(m, h, inside) was read as h = inside."""
    text = """
record Medium parameter Real cp = 1; end Medium;
connector Port parameter Medium medium; Real p; flow Real m; Real h; flow Real H; end Port;
model Source
  parameter Real p0, h0;
  Port port;
  Real inside;
equation
  port.p = p0;
  inside = h0;
  port.H = semiLinear(port.m, port.h, inside);
end Source;
model Pipe
  Port a, b;
  Real inside;
equation
  a.m + b.m = 0;
  a.p - b.p = a.m;
  a.H + b.H = 0;
  a.H = semiLinear(a.m, a.h, inside);
  b.H = semiLinear(b.m, b.h, inside);
end Pipe;
"""
    Source, Pipe = (component(n, source=text) for n in ("Source", "Pipe"))
    ev, d = EqnEnv(), AcausalDiagram()
    one, two, pipe = Source(ev, "one", p0=3.0, h0=5.0), Source(ev, "two", p0=1.0, h0=7.0), Pipe(ev, "pipe")
    d.add(one, two, pipe)
    d.connect(one.port, pipe.a)
    d.connect(pipe.b, two.port)
    system = AcausalCompiler(ev, d)()
    names = ["pipe.inside", "pipe.b.h", "one.port.H", "two.port.H"]
    for p, expected in ((1.0, [5.0, 5.0, -10.0, 10.0]), (4.0, [7.0, 7.0, 7.0, -7.0])):
        solution = simulate(system.with_parameters({"two.p0": p}), 1.0, ts=jnp.array([1.0]))
        np.testing.assert_allclose(solution[names][0], expected, rtol=1e-9)
