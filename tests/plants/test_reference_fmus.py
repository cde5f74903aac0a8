"""FMUs of others as components: the Reference FMUs of the Modelica Association, beside closed forms and SciPy.

They are built here from their sources, whose folder the environment variable REFERENCE_FMUS names: a copy of the
repository modelica/Reference-FMUs. Without it, these tests are skipped.
"""

import os
import subprocess
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from fmus import fmpy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning, simulate
from jaxonomy_dae.fmi import FmuComponent
from jaxonomy_dae.fmi.compilers import FLAGS, FOLDERS_OF_FMI_2, compiler_for, this_platform
from jaxonomy_dae.library import signal, thermal

SOURCES = os.environ.get("REFERENCE_FMUS", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SOURCES, reason="REFERENCE_FMUS does not name the sources of the Reference FMUs"),
]
assert fmpy


def built(name, version, folder):
    """An FMU, compiled from its sources."""
    sources, library = Path(SOURCES), folder / f"{name}.so"
    files = [sources / "src" / f"fmi{version}Functions.c", sources / name / "model.c", sources / "src/cosimulation.c"]
    own = [f for f in FLAGS if f not in ("-std=c99", "-fvisibility=hidden")]
    command = [*(compiler_for(this_platform()) or ()), *own, f"-DFMI_VERSION={version}"]
    command.append("-DDISABLE_PREFIX")  # names as in shared libraries
    include = [f"-I{sources / 'include'}", f"-I{sources / name}"]
    done = subprocess.run([*command, *include, *map(str, files), "-o", str(library), "-lm"], capture_output=True)
    assert not done.returncode, done.stderr.decode()
    at = this_platform() if version == 3 else FOLDERS_OF_FMI_2[this_platform()]
    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(path, "w") as file:
        file.write(sources / name / f"FMI{version}.xml", "modelDescription.xml")
        file.write(library, f"binaries/{at}/{name}.so")
    return path


def imported(path):
    ev, diagram = EqnEnv(), AcausalDiagram()
    component = FmuComponent(ev, "f", path)
    diagram.add(component)
    return component, AcausalCompiler(ev, diagram)()


@pytest.mark.parametrize("version", [2, 3])
def test_a_ball_that_bounces(tmp_path, version):
    """From 1 m with e = 0.7: height, and its gradient by e through two bounces, in closed form."""
    _, system = imported(built("BouncingBall", version, tmp_path))
    g, fall = 9.81, np.sqrt(2 / 9.81)

    def height(e, t, lib):
        """After the second bounce, at 2·e·fall after the first."""
        s = t - fall - 2 * e * fall
        return lib.where(t < fall + 2 * e * fall, e * g * fall * (t - fall) - g * (t - fall) ** 2 / 2, 0) + lib.where(
            t < fall + 2 * e * fall, 0, e**2 * g * fall * s - g * s**2 / 2
        )

    ts = jnp.array([0.6, 0.9, 1.2, 1.4])
    run = simulate(system, 1.4, rtol=1e-9, atol=1e-11, ts=ts)
    np.testing.assert_allclose(run["f.h"], height(0.7, np.asarray(ts), np), atol=1e-7)

    def last(e):
        return simulate(system.with_parameters({"f.e": e}), 1.4, rtol=1e-9, atol=1e-11, ts=ts)["f.h"][-1]

    assert jax.grad(last)(0.7) == pytest.approx(float(jax.grad(lambda e: height(e, 1.4, jnp))(0.7)), rel=1e-6)


@pytest.mark.parametrize("version", [2, 3])
def test_steps_at_times_that_the_fmu_names(tmp_path, version):
    """A counter goes up once a second; the FMU ends the run when it is 10."""
    _, system = imported(built("Stair", version, tmp_path))
    ts = jnp.array([0.5, 1.5, 4.5, 8.5])
    run = simulate(system, 20.0, ts=ts)
    np.testing.assert_array_equal(run["f.counter"], [1, 2, 5, 9])
    assert run.events.terminated == "the FMU ended the run"


@pytest.mark.parametrize("version", [2, 3])
def test_van_der_pol_with_directional_derivatives(tmp_path, version):
    component, system = imported(built("VanDerPol", version, tmp_path))
    assert component.derivatives == "directional derivatives"
    ts = np.linspace(0.0, 10.0, 11)
    run = simulate(system, 10.0, rtol=1e-10, atol=1e-12, ts=jnp.asarray(ts))
    expected = scipy.integrate.solve_ivp(
        lambda t, x: [x[1], (1 - x[0] ** 2) * x[1] - x[0]], (0, 10), [2, 0], "DOP853", ts, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(run["f.x0"], expected.y[0], atol=1e-7)


@pytest.mark.parametrize("version", [2, 3])
def test_decay_by_its_rate(tmp_path, version):
    """x = exp(−k·t): values in a batch, and the gradient by k."""
    _, system = imported(built("Dahlquist", version, tmp_path))

    def last(k):
        own = system.with_parameters({"f.k": k})
        return simulate(own, 2.0, rtol=1e-10, atol=1e-12, ts=jnp.array([2.0]))["f.x"][0]

    k = jnp.array([0.5, 1.0, 2.0])
    np.testing.assert_allclose(jax.vmap(last)(k), np.exp(-2 * k), atol=1e-8)
    assert jax.grad(last)(0.5) == pytest.approx(-2 * np.exp(-1.0), rel=1e-6)


def test_van_der_pol_by_its_parameter(tmp_path):
    """The gradient by mu beside the variational equation, by SciPy."""
    _, system = imported(built("VanDerPol", 3, tmp_path))

    def slopes(t, y, mu=1.0):
        (x, v), (a, b) = y[:2], y[2:]
        return [v, mu * (1 - x**2) * v - x, b, (1 - x**2) * v + (-2 * mu * x * v - 1) * a + mu * (1 - x**2) * b]

    expected = scipy.integrate.solve_ivp(slopes, (0, 3), [2, 0, 0, 0], "DOP853", rtol=1e-12, atol=1e-12).y[2, -1]

    def last(mu):
        own = system.with_parameters({"f.mu": mu})
        return simulate(own, 3.0, rtol=1e-10, atol=1e-12, ts=jnp.array([3.0]))["f.x0"][0]

    assert jax.grad(last)(1.0) == pytest.approx(expected, rel=1e-6)


def test_a_signal_that_passes_through(tmp_path):
    """An FMU without states between two lags: w' = 1 − w and v' = w − v, v = 1 − (1 + t)·exp(−t)."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    step, before, after = signal.Constant(ev, "step", k=1.0), *(signal.FirstOrder(ev, n, T=1.0) for n in ("w", "v"))
    fmu = FmuComponent(ev, "f", built("Feedthrough", 3, tmp_path), parameters=[], outputs=["Float64_continuous_output"])
    diagram.add(step, before, after, fmu)
    diagram.connect(step.y, before.u)
    diagram.connect(before, "y", fmu, "Float64_continuous_input")
    diagram.connect(fmu, "Float64_continuous_output", after, "u")
    ts = jnp.array([0.5, 2.0])
    run = simulate(AcausalCompiler(ev, diagram)(), 2.0, rtol=1e-9, atol=1e-11, ts=ts)
    np.testing.assert_allclose(run["v.y"], 1 - (1 + ts) * jnp.exp(-ts), rtol=0, atol=1e-7)


def test_a_fit_around_an_fmu_of_others(tmp_path):
    """A body that a foreign FMU heats, through a conductor: with w = exp(−k·t) and a = G/C, its temperature is
    a·(exp(−k·t) − exp(−a·t))/(a − k). The fit finds k inside the FMU and G outside of it."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    fmu = FmuComponent(ev, "f", built("Dahlquist", 3, tmp_path))
    source, wall = thermal.TemperatureSource(ev, "source"), thermal.ThermalConductor(ev, "wall", G=1.0)
    body = thermal.HeatCapacitor(ev, "body", 2.0, initial_temperature=0.0)
    diagram.add(fmu, source, wall, body)
    diagram.connect(fmu, "x", source, "T")
    diagram.connect(source.heat, wall.port_a)
    diagram.connect(wall.port_b, body.heat)
    system = AcausalCompiler(ev, diagram)()

    k, a, ts = 0.4, 0.75, np.linspace(0.25, 5.0, 20)
    values = a * (np.exp(-k * ts) - np.exp(-a * ts)) / (a - k)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(ts))
    record = learning.Experiment(jnp.asarray(ts), {"body.T": values + noise}, sigma=1e-3)
    fit = learning.Problem(system, record, train=["f.k", "wall.G"]).fit()

    # Least squares of the closed form, by SciPy.
    expected = scipy.optimize.least_squares(
        lambda p: p[1] * (np.exp(-p[0] * ts) - np.exp(-p[1] * ts)) / (p[1] - p[0]) - values - noise, [0.5, 1.0],
        xtol=1e-12,
    )  # fmt: skip
    found = [fit.system.parameters.table.names.index(name) for name in ("f.k", "wall.G")]
    k_found, G_found = np.asarray(fit.system.parameters.values)[found]
    np.testing.assert_allclose([k_found, G_found / 2.0], expected.x, rtol=1e-4)
