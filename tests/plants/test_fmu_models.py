"""Whole plants as FMUs: nothing for FMPy to find, runs of both kinds beside `simulate`, derivatives beside JAX."""

import shutil
import subprocess
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from fmu_models import buck, clutch, discrete_filter, four_bar, house, pack, rectifier, stick_slip
from fmus import check_derivatives, compare, exported, run
from planar_models import squeezing_mechanism
from testset.problem import load

from jaxonomy_dae.fmi.compilers import FLAGS, compiler_for, this_platform

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
    with zipfile.ZipFile(path) as file:
        binary = next(info for info in file.infolist() if info.filename.startswith("binaries/"))
    assert binary.file_size <= 300_000
    functions = strictly_compiled(path, tmp_path / "strict")
    assert functions and all(name.startswith("fmi3") for name in functions)
    compare(system, path, t1, names, 1e-6, inputs, rtol=1e-9, start_values=inputs)
    compare(system, path, t1, names, 1e-8, inputs, rtol=1e-9, start_values=inputs, fmi_type="CoSimulation")
    check_derivatives(system, path, [n for n in names if n not in system.discretes and n not in system.states])


def strictly_compiled(path, folder):
    """The names of functions that the binaries of gcc and of clang export, with all warnings as errors."""
    with zipfile.ZipFile(path) as file:
        file.extractall(folder)
    compilers = [found for name in ("gcc", "clang") if (found := shutil.which(name))]
    exported = set()
    for compiler in compilers or compiler_for(this_platform()) or ():
        command = [compiler, *FLAGS, "-Wall", "-Wextra", "-Werror", "fmi3.c", "-o", "x.so", "-lm"]
        done = subprocess.run(command, cwd=folder / "sources", capture_output=True, text=True)
        assert not done.returncode, done.stderr
        table = subprocess.run(["nm", "-D", "--defined-only", "x.so"], cwd=folder / "sources", capture_output=True)
        exported |= {line.split()[-1] for line in table.stdout.decode().splitlines()}
    return exported


def test_andrews_mechanism(tmp_path):
    """Seven bodies in three loops, of 45 simultaneous equations and more, which are solved without KLU: the start and
    the positions after 0.03 s as published (Mazzia & Magherini 2008, II-13)."""
    facts = load("andrews")
    path = exported(squeezing_mechanism(facts), tmp_path)
    angles = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")
    names = [f"{name}.phi" for name in angles] + [f"{name}.omega" for name in angles]
    start = {"torque.tau": facts["parameters"]["mom"]}
    found = run(path, 0.03, names, start_values=start, fmi_type="CoSimulation")
    np.testing.assert_allclose([found[n][0] for n in names], facts["initial"]["y0"][:14], rtol=0, atol=1e-11)
    # Errors of steps with rtol 1e-9, beside 9.6 published digits of angles up to 16.
    np.testing.assert_allclose([found[n][-1] for n in names[:7]], facts["reference"]["y"][:7], rtol=0, atol=1e-8)


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
