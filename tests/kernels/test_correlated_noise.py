"""Noise of first order, tails of residuals and splines of inputs beside SciPy: no model is compiled."""

import warnings
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
import scipy.stats

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.learning import Noise, powers
from jaxonomy_dae.learning.colour import Colour, steps_between
from jaxonomy_dae.learning.data import Stacked
from jaxonomy_dae.learning.discovery import criterion
from jaxonomy_dae.learning.evaluation import Weights
from jaxonomy_dae.learning.outliers import heavy_tails, outliers
from jaxonomy_dae.run.system.splines import natural_spline


def stacked(times, sigma):
    """Two records of two outputs, of which only times and noise count."""
    shape, n = (2, len(times), 2), len(times)
    whole = np.ones(shape)
    return Stacked(
        outputs=("x", "y"), times=np.stack([times, times]), t0=np.zeros(2), values=whole, observed=whole > 0,
        sigma=sigma * whole, unit=whole, level_of=("x", "y"), tails=np.full((2, 2), np.inf), rho=np.zeros(2),
        weight=np.ones(2), holdout=np.zeros(2, bool), inputs={}, kinds=(), starts={}, labels=("a", "b"), counts=(n, n),
    )  # fmt: skip


@pytest.mark.parametrize("rho", [0.6, -0.4])
def test_the_likelihood_is_that_of_the_joint_normal_distribution(rho):
    """With samples missing, two records, and one output that is white: against SciPy's density of all of them."""
    rng, n = np.random.default_rng(0), 30
    observed = rng.random((2, n, 2)) > 0.2
    rows = np.nonzero(observed)
    errors = rng.standard_normal(len(rows[0]))
    data = stacked(0.1 * np.arange(n), [0.3, 2.0])
    colour = Colour.of(data, rows, np.array([rho, 0.0]))
    w, level = colour.whitened(errors), data.sigma[rows]
    found = np.sum(scipy.stats.norm.logpdf(w, scale=level)) - colour.log_scale(np.ones(len(w)))
    exact = 0.0
    for k, j in np.ndindex(2, 2):
        own = (rows[0] == k) & (rows[2] == j)
        lags = np.abs(np.subtract.outer(rows[1][own], rows[1][own]))
        covariance = level[own][0] ** 2 * (rho**lags if j == 0 else np.eye(len(lags)))
        exact += scipy.stats.multivariate_normal.logpdf(errors[own], cov=covariance)
    assert found == pytest.approx(exact, rel=1e-12)
    np.testing.assert_allclose(colour.coloured(w), errors, rtol=1e-10)


@pytest.mark.parametrize("rho", [1.0, -2.0, "some", np.nan])
def test_no_correlation_beyond_one(rho):
    with pytest.raises(ModelError, match="rho is a correlation between −1 and 1, or 'estimate'"):
        Noise(rho=rho)


def test_unknown_keywords_are_explained():
    """Kind: a raw TypeError."""
    with pytest.raises(ModelError, match="powers: there is no argument 'high': did you mean 'highest'"):
        powers(high=3)  # pyright: ignore[reportCallIssue]


def test_tails_are_judged_as_scipy_does():
    u = np.random.default_rng(1).standard_t(4, (5, 60))
    u -= u.mean(axis=1, keepdims=True)
    by_kurtosis = scipy.stats.kurtosistest(u, axis=1, alternative="greater").pvalue
    n, share = 60, np.max(u**2, axis=1) / np.sum(u**2, axis=1)
    by_greatest = n * scipy.stats.beta(0.5, (n - 1) / 2).sf(share)
    expected = np.minimum(2 * np.minimum(by_kurtosis, by_greatest), 1.0)
    np.testing.assert_allclose(heavy_tails(u), expected, rtol=1e-9)
    noise = np.random.default_rng(2).standard_normal(200)
    far = np.array([20, 90])
    noise[far] = [40.0, -30.0]
    assert np.flatnonzero(outliers(noise)).tolist() == far.tolist()
    noise[90:110] += 30.0  # a piece of the record, not single samples
    assert not outliers(noise).any()
    assert np.isfinite(heavy_tails(np.zeros((1, 30)))).all()


@pytest.mark.parametrize("n", [2, 40])
def test_splines_of_inputs_are_natural(n):
    """The causal cubic curve was off by fourteen times as much, at nine samples a period."""
    rng = np.random.default_rng(3)
    t, y = np.cumsum(rng.uniform(0.1, 1.0, n)), rng.standard_normal(n)
    at = np.linspace(t[0], t[-1], 50)
    exact = np.interp(at, t, y) if n == 2 else scipy.interpolate.CubicSpline(t, y, bc_type="natural")(at)

    def curve(y):
        return jax.vmap(natural_spline(jnp.array(t), y).evaluate)(jnp.array(at))

    np.testing.assert_allclose(curve(jnp.array(y)), exact, atol=1e-12)
    forward, backward = jax.jacfwd(curve)(jnp.array(y)), jax.jacrev(curve)(jnp.array(y))
    np.testing.assert_allclose(forward, backward, atol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(forward @ y, exact, atol=1e-12)  # a curve is linear in its samples


def test_criteria_count_the_density_of_correlated_noise():
    """BIC = −2 ln L + k ln n, less n ln 2π, beside SciPy: without the density's own factor, closed forms whose noise
    correlates differently could not be compared."""
    rng, n, sigma = np.random.default_rng(0), 30, 0.3
    data, errors = stacked(0.1 * np.arange(n), [sigma, 2.0]), rng.standard_normal(n)
    rows = (np.zeros(n, int), np.arange(n), np.zeros(n, int))
    for rho in (0.0, 0.8):
        colour = Colour.of(data, rows, np.array([rho, 0.0]))
        weights = Weights(np.full(n, 1 / sigma), np.zeros(0), np.zeros(0), np.ones(n))
        cost = weights.cost(np.zeros(0), colour.whitened(errors))
        fitted: Any = SimpleNamespace(
            minimum=SimpleNamespace(cost=cost, weights=weights), objective=SimpleNamespace(colour=colour)
        )
        covariance = sigma**2 * rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        exact = -2 * scipy.stats.multivariate_normal.logpdf(errors, cov=covariance) + 3 * np.log(n)
        assert criterion(fitted, 3) == pytest.approx(exact - n * np.log(2 * np.pi), rel=1e-12)


def test_steps_of_a_part_of_a_record():
    """Over a tenth of the time, the times that are cut off repeat the last: the median step was zero."""
    times = np.minimum(0.5 * np.arange(40), 2.0)
    np.testing.assert_array_equal(steps_between(times)(np.array([0, 1, 3])), [1.0, 2.0])
