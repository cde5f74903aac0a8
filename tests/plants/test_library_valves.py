"""Valves that open and shut against closed forms and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from component_references import checks, measured
from problems import compiled
from switched_runs import ORIGIN, SMOOTH, TIGHT, by_modes, central, events

import jaxonomy_dae.library.hydraulic as hyd
from jaxonomy_dae import EqnEnv, simulate


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
