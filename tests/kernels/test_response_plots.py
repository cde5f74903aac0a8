"""Bode and Nyquist plots draw what closed forms say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import FrequencyResponse, ModelError

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

OMEGA = np.array([1e3, 10.0, 0.1])  # in any order


@pytest.fixture
def response():
    """A lag of 0.1 s, and four of them in a row, whose phase goes on to −360°."""
    lag = 1 / (1 + 0.1j * OMEGA)
    values = jnp.asarray(np.stack([lag, lag**4], axis=1)[:, :, None])
    return FrequencyResponse(jnp.asarray(OMEGA), values, ("src.u",), ("one.y", "four.y"))


def test_bode(response):
    upper, lower = response.bode()
    one, four = upper.lines
    np.testing.assert_array_equal(one.get_xdata(), [0.1, 10.0, 1e3])
    decibels = -10 * np.log10([1 + 1e-4, 2.0, 1 + 1e4])
    np.testing.assert_allclose(one.get_ydata(), decibels, rtol=1e-12, atol=1e-14)  # of a magnitude near one
    np.testing.assert_allclose(four.get_ydata(), 4 * decibels, rtol=1e-12, atol=1e-14)
    degrees = -np.degrees(np.arctan([0.01, 1.0, 100.0]))
    np.testing.assert_allclose(lower.lines[0].get_ydata(), degrees, rtol=1e-12)
    np.testing.assert_allclose(lower.lines[1].get_ydata(), 4 * degrees, rtol=1e-12)
    assert [t.get_text() for t in upper.get_legend().get_texts()] == ["src.u → one.y", "src.u → four.y"]
    assert upper.get_xscale() == lower.get_xscale() == "log" and "rad/s" in lower.get_xlabel()
    again = response.bode(("one.y", "src.u"), axes=(upper, lower))
    assert again[0] is upper and len(upper.lines) == 3


def test_nyquist(response):
    ax = response.nyquist(("one.y", "src.u"))
    line, mirrored, critical = ax.lines
    x, y = line.get_data()
    np.testing.assert_allclose((x - 0.5) ** 2 + y**2, 0.25, rtol=1e-12)  # a lag runs along half a circle
    assert np.all(y < 0)
    np.testing.assert_array_equal(mirrored.get_ydata(), -y)
    np.testing.assert_array_equal(critical.get_data(), [[-1.0], [0.0]])


def test_what_cannot_be_drawn(response):
    with pytest.raises(ModelError, match="'two.y' is not an output of this response"):
        response.bode(("two.y", "src.u"))
    with pytest.raises(ModelError, match="two axes, for magnitude and phase; got shape"):
        response.bode(axes=np.empty(3, object))
    with pytest.raises(ModelError, match="one response is drawn at a time"):
        jax.tree.map(lambda leaf: leaf[None], response).nyquist()
