"""Ensembles and figures of fits: a cooling law learned from two records, whose truth is integrated by SciPy."""

import functools

import jax
import numpy as np
import pytest
import scipy.integrate
from problems import compiled

from jaxonomy_dae import EqnEnv, ModelError, simulate
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.learning import Data, Experiment, IsotropicPassive, Problem, ensemble
from jaxonomy_dae.learning.ensemble import _mixed
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

SIGMA, K = 0.01, 1.5
TIMES = np.linspace(0.0, 4.0, 41)[1:]


class Cooling(Component):
    """x' = k·u + N(x)."""

    def __init__(self, ev, name="c"):
        super().__init__(ev, name)
        k, u = self.parameter("k", 1.0, bounds=POSITIVE, unit="1/s"), self.input("u", default=0.0)
        x = self.variable("x", start=2.0, fixed=True, unit="K")
        (f,) = self.learned("law", IsotropicPassive(key=jax.random.key(0)), [x])
        self.add_equations(Eq(der(x), k * u + f))


def truth(x):
    return -0.4 * x - 0.3 * x * np.abs(x)


def record(seed, u, **others):
    run = scipy.integrate.solve_ivp(lambda t, x: K * u + truth(x), (0, 4), [2.0], "DOP853", TIMES, rtol=1e-11)
    data = run.y[0] + SIGMA * np.random.default_rng(seed).standard_normal(40)
    data[5] = np.nan
    return Experiment(TIMES, {"c.x": data}, sigma=SIGMA, inputs={"c.u": u}, **others)


@functools.cache
def problem():
    data = Data(record(0, 0.0, name="cools"), record(1, 1.2, name="heated"), record(2, 0.5, holdout=True, name="kept"))
    return Problem(compiled(Cooling(EqnEnv())), data, train=["c.k", "c.law"])


@functools.cache
def members():
    return ensemble(problem(), 4, seed=1)


def test_a_mixture_of_normal_distributions():
    """The variance of a mixture is the mean of variances plus the variance of means; with n − 1 for the latter."""
    mean, between, spread = _mixed([np.array([1.0]), np.array([3.0])], [np.array([0.5]), np.array([1.5])])
    np.testing.assert_allclose([mean[0], between[0] ** 2, spread[0] ** 2], [2.0, 2.0, 2.0 + (0.25 + 2.25) / 2])
    assert _mixed([np.array([1.0])], [np.array([0.5])])[1][0] == 0.0


@pytest.mark.slow  # residuals and their Jacobian compile for fifteen seconds
def test_members_agree_where_the_data_speak():
    """And nothing is compiled after the first fit."""
    first = problem().fit()
    count = len(PROGRAMS)
    found = members()
    assert len(PROGRAMS) == count and len(found.estimates) == 4 and len(found) >= 3
    assert any(one.values == first.values for one in found.estimates)
    chi2 = [one.chi2 for one in found.estimates]
    assert max(one.chi2 for one in found.kept) < min(chi2) + 40
    grid = np.linspace(0.1, 5.0, 50)
    band = found.band("c.law", grid)
    inside = band.inside & (grid > 0.3)
    assert 0.7 < band.explored[0, 1] / 2.0 < 1.3
    assert (np.abs(band.mean - truth(grid)) < 4 * band.spread + 1e-3)[inside].all()
    assert (band.between <= band.spread).all() and band.between[-1] > 5 * np.median(band.between[inside])
    run = found.predict("c.x", experiment="kept")
    reference = scipy.integrate.solve_ivp(lambda t, x: K * 0.5 + truth(x), (0, 4), [2.0], "DOP853", TIMES, rtol=1e-11)
    assert (np.abs(run.mean["c.x"] - reference.y[0]) < 4 * run.spread["c.x"] + 1e-3).all()
    assert "Ensemble(of" in repr(found)


@pytest.mark.slow
def test_networks_to_begin_with():
    nets = [IsotropicPassive(key=jax.random.key(k)) for k in (0, 5)]
    found = ensemble(problem(), networks={"c.law": nets}, freeze={"c.k": K})
    assert len(found.estimates) == 2 and found.best.values["c.k"] == K
    with pytest.raises(ModelError, match="'c.low' is not trained here"):
        ensemble(problem(), networks={"c.low": nets})
    with pytest.raises(ModelError, match="must be built like"):
        ensemble(problem(), networks={"c.law": [IsotropicPassive(key=jax.random.key(0), width=3)]})
    with pytest.raises(ModelError, match="members is a whole number"):
        ensemble(problem(), 0)
    with pytest.raises(ModelError, match="start does not go with"):
        ensemble(problem(), 2, start={"c.k": 1.0})


def lines(ax):
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in ax.get_lines()]


@pytest.fixture
def plt():
    plt = pytest.importorskip("matplotlib.pyplot")
    backend = plt.get_backend()
    plt.switch_backend("Agg")
    yield plt
    plt.close("all")
    plt.switch_backend(backend)


def test_records_are_drawn_without_a_model(plt):
    data = problem().data
    (ax,) = data.plot()
    assert len(lines(ax)) == 3 and ax.get_ylabel() == "c.x"
    np.testing.assert_array_equal(lines(ax)[0][1], data.experiments[0].data["c.x"])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["cools", "heated", "kept (held out)"]
    with pytest.raises(ModelError, match="there are no data of 'c.y'"):
        data.plot("c.y")


@pytest.mark.slow
def test_figures_show_what_was_found(plt):
    fit = members().best
    axes = fit.plot()
    assert axes.shape == (1, 3) and axes[0, 0].get_ylabel() == "c.x / K" and "held out" in axes[0, 2].get_title("left")
    (t, measured), (_, fitted) = lines(axes[0, 0])
    assert len(t) == 39 and len(fitted) == 40  # one sample is missing
    np.testing.assert_allclose((fitted[10] - measured[9]) / SIGMA, 0, atol=6)
    ordinary = fit.predict("c.x", experiment=0)
    np.testing.assert_allclose(fitted, ordinary.mean["c.x"], rtol=1e-8)
    np.testing.assert_allclose(fit.at_samples[1][0, :, 0], ordinary.spread["c.x"], rtol=1e-6, atol=1e-12)

    left, right = fit.plot_residuals()[0]
    r = fit.residuals["cools"]["c.x"]
    assert len(r) == 40
    r = r[np.isfinite(r)]
    np.testing.assert_allclose(lines(left)[0][1], r)
    np.testing.assert_allclose(lines(right)[0][1][0], r[1:] @ r[:-1] / (r @ r))

    assert len(lines(fit.plot_history())[0][0]) == len(fit.minimum.history)
    image = fit.plot_correlations().images[0].get_array()
    np.testing.assert_allclose(np.asarray(image), [[1.0]], atol=1e-9)  # k alone is no weight
    ax = fit.table().plot(true={"c.k": K})
    row, cross = fit.table()["c.k"], lines(ax)[-1][0][0]
    np.testing.assert_allclose(cross, 100 * (K / row.value - 1))
    spectrum = lines(fit.identifiability().plot())[0][1]
    np.testing.assert_allclose(spectrum, fit.identifiability().spectrum)
    grid = np.linspace(0.0, 3.0, 20)
    ax = members().band("c.law", grid).plot(truth=truth)
    np.testing.assert_allclose(lines(ax)[1][1], truth(grid))
    (ax,) = fit.predict("c.x").plot()
    np.testing.assert_allclose(lines(ax)[0][1], ordinary.mean["c.x"])
    run = simulate(fit.system, 1.0, ts=np.linspace(0.0, 1.0, 5))
    ax = run.plot_phase("c.x", "c.law")
    np.testing.assert_allclose(lines(ax)[0][0], run["c.x"])
    assert ax.get_xlabel() == "c.x / K"
    with pytest.raises(ModelError, match="needs 1 × 3 axes; got 1"):
        fit.plot(axes=[ax])
