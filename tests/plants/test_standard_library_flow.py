"""Flows of heat and fluids through parts of the Modelica Standard Library 4.1.0 and our own ones.

Each stands beside its equations in SciPy; slopes are those of central differences. `MODELICA_LIBRARY` names the folder
of the library; without it the tests are skipped.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from device_library import standard_library
from open_classes import by_differences, run_with_slopes

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.library import rotational, thermal
from jaxonomy_dae.library.signal import Constant, Step
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow
HEAT = "Modelica.Thermal.FluidHeatFlow"
WATER = f"medium = {HEAT}.Media.Water()"
DENSITY, CAPACITY = 995.6, 4177.0  # of this medium, in kg/m3 and J/(kg.K)
G = 9.80665


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def test_a_pump_on_our_shaft_whose_flow_turns(library):
    """Our torque turns a pump, which lifts water through a heated pipe and a valve. When it falls, the pressure of the
    sink drives the water back. The flow by the sum of all pressures, the shaft and the pipe by their balances."""
    ev, d = EqnEnv(), AcausalDiagram()

    def part(path, name, *, start=None, structure=None, **values):
        Class = library.component(f"{HEAT}.{path}", WATER, **(structure or {}))
        x = Class(ev, name, **values, **({"start": start} if start else {}))
        d.add(x)
        return x

    none = {"m": 0.0}
    source = part("Sources.Ambient", "source", constantAmbientPressure=1e5, constantAmbientTemperature=290.0)
    sink = part("Sources.Ambient", "sink", constantAmbientPressure=1.4e5, constantAmbientTemperature=350.0)
    pump = part("Sources.IdealPump", "pump", structure=none, T0=293.15, wNominal=100.0, dp0=1.5e5, V_flow0=2e-3)
    pipe = part(
        "Components.Pipe", "pipe", structure={"useHeatPort": True}, start={"T": 300.0}, T0=293.15, m=0.5,
        V_flowLaminar=1e-4, dpLaminar=500.0, V_flowNominal=1e-3, dpNominal=2e4, h_g=1.0,
    )  # fmt: skip
    valve = part(
        "Components.Valve", "valve", structure=none | {"LinearCharacteristic": False}, T0=293.15, y1=1.0,
        Kv1=1e-3, kv0=0.05, dp0=1e4, rho0=1000.0, frictionLoss=0.0,
    )  # fmt: skip
    shaft, torque = rotational.Inertia(ev, "shaft", J=0.01, initial_angle=0.0, initial_speed=90.0), rotational.Torque(
        ev, "torque"
    )  # fmt: skip
    wanted = Step(ev, "wanted", height=-1.3, start_time=1.0, offset=1.2)
    opening = Constant(ev, "opening", 0.8)
    wall, film = thermal.HeatCapacitor(ev, "wall", 2e3, 330.0), thermal.ThermalConductor(ev, "film", G=300.0)
    d.add(shaft, torque, wanted, opening, wall, film)
    d.connect(wanted.y, torque.tau)
    d.connect(torque.flange, shaft.flange_a)
    d.connect(shaft.flange_b, pump.flange_a)
    d.connect(source.flowPort, pump.flowPort_a)
    d.connect(pump.flowPort_b, pipe.flowPort_a)
    d.connect(pipe.flowPort_b, valve.flowPort_a)
    d.connect(valve.flowPort_b, sink.flowPort)
    d.connect(opening.y, valve.y)
    d.connect(wall.heat, film.port_a)
    d.connect(film.port_b, pipe.heatPort)
    system = AcausalCompiler(ev, d)()
    values = {"pump.dp0": 1.5e5, "pipe.h_g": 1.0, "valve.kv0": 0.05, "wanted.height": -1.3, "film.G": 300.0}
    ts = np.array([0.5, 2.0, 4.0])
    names = ["shaft.w", "pipe.T", "wall.T", "pipe.V_flow"]
    found, slopes = run_with_slopes(system, values, ts, names, names)

    def reference(dp0, height, kv0, falls, G_film):
        laminar, k = 500.0 / 1e-4, (2e4 - 5e3) / 9e-4**2
        Kv = 1e-3 * kv0 * np.exp(np.log(1 / kv0) * 0.8)

        def flow(w):
            def rest(V):
                s = w / 100.0
                lost = laminar * V + np.sign(V) * k * max(abs(V) - 1e-4, 0.0) ** 2
                valve = 1e4 * DENSITY / 1000.0 * V * abs(V) / Kv**2
                return dp0 * s * abs(s) * (1 - V / (2e-3 * s)) - lost - DENSITY * G * height - valve - 4e4

            return scipy.optimize.brentq(rest, -0.1, 0.1, xtol=1e-18, rtol=1e-15)

        def slope(t, x, tau):
            w, T, T_wall = x
            V, s = flow(w), w / 100.0
            load = dp0 * s * abs(s) * (1 - V / (2e-3 * s)) * V / w
            m, Q = DENSITY * V, G_film * (T_wall - T)
            carried = max(m, 0.0) * (290.0 - T) + max(-m, 0.0) * (350.0 - T)
            return [(tau - load) / 0.01, (carried * CAPACITY + Q) / (0.5 * CAPACITY), -Q / 2e3]

        options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-9, "max_step": 0.01}
        first = scipy.integrate.solve_ivp(
            slope, (0.0, 1.0), [90.0, 300.0, 330.0], args=(1.2,), t_eval=[0.5, 1.0], **options
        )
        then = scipy.integrate.solve_ivp(
            slope, (1.0, 4.0), first.y[:, -1], args=(1.2 + falls,), t_eval=ts[1:], **options
        )
        x = np.column_stack([first.y[:, 0], then.y])
        return np.array([*x, [flow(w) for w in x[0]]])

    expected = reference(*values.values())
    assert expected[-1, -1] < 0 < expected[-1, 0]
    np.testing.assert_allclose([found[n] for n in names], expected, rtol=1e-6)
    for name, by_hand in by_differences(reference, values).items():
        assert slopes[name] == pytest.approx(by_hand, rel=1e-4), name
