"""The notebooks of examples/gallery run, and arrive at results that follow from physics."""

import json
import pathlib

import jax
import numpy as np
import pytest

GALLERY = pathlib.Path(__file__).parents[1] / "examples" / "gallery"
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def as_in_a_notebook():
    """Figures are drawn nowhere, and types are promoted as they are by default: Optax needs it."""
    plt = pytest.importorskip("matplotlib.pyplot")
    backend, settings = plt.get_backend(), dict(plt.rcParams)
    plt.switch_backend("Agg")
    with jax.numpy_dtype_promotion("standard"):
        yield
    plt.close("all")
    plt.rcParams.update(settings)
    plt.switch_backend(backend)


def names_after(notebook):
    """Runs the cells of a notebook one after the other; returns what they define."""
    cells = json.loads((GALLERY / f"{notebook}.ipynb").read_text())["cells"]
    names = {}
    for k, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{notebook}, cell {k}", "exec"), names)
    return names


def test_every_notebook_is_stored_with_its_outputs():
    for path in GALLERY.glob("*.ipynb"):
        cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        assert all(cell["execution_count"] for cell in cells)
        outputs = [output for cell in cells for output in cell["outputs"]]
        assert any("image/png" in output.get("data", {}) for output in outputs)
        assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)
        assert path.stat().st_size < 400_000


def test_battery_pack():
    names = names_after("battery_pack")
    # Charge is counted by a linear equation: only rounding and the tolerance of the run are left.
    np.testing.assert_allclose(names["by_row"], names["expected"], rtol=0, atol=1e-5)
    # A cell's mean current is 2.5 A: so much a row loses by resistance, less what warm cells gain (Ea).
    np.testing.assert_allclose(names["by_resistance"].sum(axis=1), -2.5, rtol=0.15)
    # The misfit of 160 measurements with their true noise is 1, give or take sqrt(2/160) = 0.11.
    assert abs(names["fit"].best_loss - 1) < 0.33
    np.testing.assert_allclose(names["found"], names["true"], rtol=0, atol=1e-3)


def test_motor_with_a_controller():
    names = names_after("motor_control")
    assert names["error"] < 1e-6  # of the energy balance, for a run at rtol 1e-6
    assert names["history"][-1] < 0.01 * names["history"][0]
    w = np.asarray(names["after"]["load.w"])
    assert w[names["t"] < 1.0].max() < 1.03 * names["SETPOINT"]
    assert np.abs(names["after"]["source.v"]).max() < names["LIMIT"] + 0.5
    # At rest the motor carries the friction and the brake through the gear: k·i = (0.6·w + 3)/12 + d·12·w.
    current = (0.6 * w[-1] + 3.0) / 12 / 0.25 + 1e-3 * 12 * w[-1] / 0.25
    np.testing.assert_allclose(names["after"]["motor.inductor.i"][-1], current, rtol=1e-2)


def test_linkage():
    names = names_after("linkage")

    def point(ground, crank, coupler, rocker, phi):
        """Two circles meet, above the line between their centres."""
        x, y = crank * np.cos(phi), crank * np.sin(phi)
        span = np.hypot(ground - x, y)
        at = np.arctan2(-y, ground - x) + np.arccos((coupler**2 + span**2 - rocker**2) / (2 * coupler * span))
        ahead, aside = names["POINT"]
        return np.array([x + ahead * np.cos(at) - aside * np.sin(at), y + ahead * np.sin(at) + aside * np.cos(at)])

    lengths, phi = np.asarray(names["lengths"]), names["START"]
    np.testing.assert_allclose(names["there"], point(*lengths, phi), rtol=0, atol=1e-9)
    for k, move in enumerate(1e-5 * np.eye(4)):
        slope = (point(*(lengths + move), phi) - point(*(lengths - move), phi)) / 2e-5
        np.testing.assert_allclose(names["slopes"][:, k], slope, rtol=0, atol=1e-6)
    assert names["closed"] < 1e-9
    np.testing.assert_allclose(names["energy"], names["energy"][0], rtol=1e-5)
