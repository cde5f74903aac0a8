"""Flows of heat and fluids through parts of the Modelica Standard Library 4.1.0 and our own ones.

Each stands beside its equations in SciPy; slopes are those of central differences. `MODELICA_LIBRARY` names the folder
of the library; without it the tests are skipped.
"""

import numpy as np
import pytest
import scipy.integrate
from device_library import standard_library
from open_classes import along_by_differences, run_along

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.library import thermal
from jaxonomy_dae.modelica import Library

pytestmark = pytest.mark.slow
HEAT = "Modelica.Thermal.FluidHeatFlow"
WATER = f"medium = {HEAT}.Media.Water()"
DENSITY, CAPACITY = 995.6, 4177.0  # of this medium, in kg/m3 and J/(kg.K)
G = 9.80665


@pytest.fixture(scope="module")
def library():
    return Library(standard_library())


def test_heated_pipes_with_flows_to_and_fro(library):
    """Water flows through two heated pipes between reservoirs, forwards in one and backwards in the other: it brings
    the heat of where it comes from. Temperatures by the balances of energy, pressures by friction and height."""
    ev, d = EqnEnv(), AcausalDiagram()

    def part(path, name, *, start=None, structure=None, **values):
        Class = library.component(f"{HEAT}.{path}", WATER, **(structure or {}))
        x = Class(ev, name, **values, **({"start": start} if start else {}))
        d.add(x)
        return x

    for k, V in enumerate((6e-4, -4e-4)):
        source = part("Sources.Ambient", f"source{k}", constantAmbientPressure=1e5, constantAmbientTemperature=290.0)
        sink = part("Sources.Ambient", f"sink{k}", constantAmbientPressure=1.4e5, constantAmbientTemperature=350.0)
        drive = part("Sources.VolumeFlow", f"drive{k}", structure={"m": 0.0}, T0=293.15, constantVolumeFlow=V)
        pipe = part(
            "Components.Pipe", f"pipe{k}", structure={"useHeatPort": True}, start={"T": 300.0}, T0=293.15, m=0.5,
            V_flowLaminar=1e-4, dpLaminar=500.0, V_flowNominal=1e-3, dpNominal=2e4, h_g=1.0,
        )  # fmt: skip
        wall, film = (
            thermal.HeatCapacitor(ev, f"wall{k}", 2e3, 330.0),
            thermal.ThermalConductor(ev, f"film{k}", G=300.0),
        )
        d.add(wall, film)
        d.connect(source.flowPort, drive.flowPort_a)
        d.connect(drive.flowPort_b, pipe.flowPort_a)
        d.connect(pipe.flowPort_b, sink.flowPort)
        d.connect(wall.heat, film.port_a)
        d.connect(film.port_b, pipe.heatPort)
    system = AcausalCompiler(ev, d)()
    values = {"drive0.constantVolumeFlow": 6e-4, "drive1.constantVolumeFlow": -4e-4, "pipe0.h_g": 1.0, "pipe1.m": 0.5}
    values |= {"pipe0.dpNominal": 2e4, "film1.G": 300.0}
    ts = np.array([0.5, 1.5, 4.0])
    names = [f"{n}{k}.{v}" for k in (0, 1) for n, v in
             (("pipe", "T"), ("wall", "T"), ("pipe", "flowPort_a.p"), ("source", "flowPort.H_flow"))]  # fmt: skip
    found, along = run_along(system, values, ts, names)

    def piped(V, height, m, nominal, conduct):
        def slope(t, x):
            w, Q = DENSITY * V, conduct * (x[1] - x[0])
            carried = max(w, 0.0) * (290.0 - x[0]) + max(-w, 0.0) * (350.0 - x[0])
            return [(carried * CAPACITY + Q) / (m * CAPACITY), -Q / 2e3]

        run = scipy.integrate.solve_ivp(slope, (0.0, 4.0), [300.0, 330.0], "DOP853", t_eval=ts, rtol=1e-12, atol=1e-11)
        T, k = run.y[0], (nominal - 5e3) / 9e-4**2
        lost = 500.0 / 1e-4 * V + np.sign(V) * k * max(abs(V) - 1e-4, 0.0) ** 2
        taken = -DENSITY * CAPACITY * V * (290.0 if V > 0 else T)
        return [*run.y, np.full(3, 1.4e5 + lost + DENSITY * G * height), taken + 0.0 * T]

    def reference(there, back, height, m, nominal, conduct):
        return np.array([*piped(there, height, 0.5, nominal, 300.0), *piped(back, 1.0, m, 2e4, conduct)])

    np.testing.assert_allclose(found, reference(*values.values()), rtol=1e-6)
    np.testing.assert_allclose(along, along_by_differences(reference, values), rtol=1e-5, atol=1e-6)
