"""Whole plants as FMUs: nothing for FMPy to find, runs of both kinds beside `simulate`, derivatives beside JAX."""

import jax.numpy as jnp
import numpy as np
import pytest
from fmu_models import buck, clutch, discrete_filter, four_bar, house, pack, rectifier, stick_slip
from fmus import check_derivatives, compare, exported

from jaxonomy_dae.fmi.compilers import compiler_for, this_platform

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(compiler_for(this_platform()) is None, reason="no C compiler on this machine"),
]


@pytest.mark.parametrize(
    "plant, names, t1, inputs",
    [
        (rectifier, ["tank.v", "source.i"], 0.0405, {}),
        (buck, ["coil.i", "tank.v"], 0.01015, {}),
        (stick_slip, ["mass.s", "mass.v"], 3.03, {}),
        (four_bar, ["crank.body.omega", "rocker.body.phi"], 1.0, {}),
        (pack, ["pack.cell[0,0].soc", "pack.p.v", "pack.body[1,2].T"], 1000.0, {"drain.u": 7.5}),
        (discrete_filter, ["lag.y", "digital.y"], 2.02, {}),
        (clutch, ["m.w1", "m.w2", "m.friction"], 8.0, {}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_plant_runs_as_simulate_does(tmp_path, plant, names, t1, inputs):
    system = plant()
    path = exported(system, tmp_path)
    compare(system, path, t1, names, 1e-6, inputs, rtol=1e-9, start_values=inputs)
    compare(system, path, t1, names, 1e-8, inputs, rtol=1e-9, start_values=inputs, fmi_type="CoSimulation")
    check_derivatives(system, path, [n for n in names if n not in system.discretes and n not in system.states])


def test_a_house_with_inputs_that_change(tmp_path):
    """The heating goes off after an hour. FMPy holds inputs between its outputs, so that they change in steps."""
    system = house()
    path = exported(system, tmp_path)
    given = np.zeros(4, [("time", float), ("weather.T", float), ("heating.Q_flow", float)])
    given["time"], given["weather.T"], given["heating.Q_flow"] = [0, 3600, 3600, 7200], 270.0, [4e3, 4e3, 0, 0]
    inputs = {"weather.T": 270.0, "heating.Q_flow": (jnp.array([0.0, 3600.0]), jnp.array([4e3, 0.0]), "held")}
    names = ["air.T", "wall.conductor0.Q_flow"]
    compare(system, path, 7200.0, names, 1e-6, inputs, rtol=1e-9, input=given)
    compare(system, path, 7200.0, names, 1e-6, inputs, rtol=1e-9, input=given, fmi_type="CoSimulation")
    check_derivatives(system, path, names[1:])
