"""Distributions of noise beside SciPy's, tests of residuals, and intervals of correlated residuals: NumPy alone."""

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.learning import Noise, Progress
from jaxonomy_dae.learning.agreement import correlated
from jaxonomy_dae.learning.noise import Tails
from jaxonomy_dae.learning.progress import Watch, reporter

U = np.array([-30.0, -4.0, -1.5, -0.3, 0.0, 1e-9, 0.2, 1.2, 1.6, 3.0, 50.0])


def huber(k):
    """Of SciPy: the density ∝ exp(−ρ)."""

    def rho(x):
        return 0.5 * x**2 if abs(x) <= k else k * abs(x) - 0.5 * k**2

    whole = sum(scipy.integrate.quad(lambda x: np.exp(-rho(x)), *ends)[0] for ends in ((-60, -k), (-k, k), (k, 60)))
    return np.vectorize(rho), whole


@pytest.mark.parametrize("nu, k", [(4.0, np.inf), (1.5, np.inf), (np.inf, 1.5), (np.inf, 0.7), (np.inf, np.inf)])
def test_distributions_are_those_of_scipy(nu, k):
    tails = Tails(np.full(len(U), nu), np.full(len(U), k))
    v, slope = tails.bent(U)
    if np.isfinite(k):
        rho, whole = huber(k)
        logs = -rho(U) - np.log(whole)
        beyond = [
            scipy.integrate.quad(lambda x: np.exp(-rho(x)), x, max(60, x + 60), limit=200)[0] / whole for x in abs(U)
        ]
    else:
        law = scipy.stats.norm if np.isinf(nu) else scipy.stats.t(nu)
        logs, beyond = law.logpdf(U), law.sf(abs(U))
    np.testing.assert_allclose(-0.5 * v**2 + tails.log_peak() - 0.5 * np.log(2 * np.pi), logs, rtol=1e-10)
    step = 1e-6
    before, after = (tails.bent(U + s)[0] for s in (-step, step))
    smooth = np.abs(np.abs(U) - k) > 1e-3 if np.isfinite(k) else np.ones(len(U), bool)
    np.testing.assert_allclose(slope[smooth], ((after - before) / (2 * step))[smooth], rtol=1e-6)
    moved = U != 0
    np.testing.assert_allclose(tails.pull(U)[moved], (v * slope / np.where(moved, U, 1))[moved], rtol=1e-9)
    near = np.abs(U) < 20
    np.testing.assert_allclose(scipy.stats.norm.sf(np.abs(tails.scores(U)))[near], np.array(beyond)[near], rtol=1e-5)
    assert (np.diff(tails.scores(U)) > 0).all()
    grid = np.linspace(-60, 60, 240_001)
    wide = Tails(np.full(len(grid), nu), np.full(len(grid), k))
    w, pull = wide.bent(grid)[0], wide.pull(grid) * grid
    p = np.exp(-0.5 * w**2 + wide.log_peak()) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(np.sum(p * pull**2) * (grid[1] - grid[0]), tails.information()[0], rtol=1e-3)


def test_intervals_hold_where_residuals_are_correlated():
    """Intervals took residuals as white, and covered half of what they said."""
    rng = np.random.default_rng(1)
    n, rho = 400, 0.8
    t = np.linspace(-1, 1, n)
    jacobian = np.stack([np.ones(n), t, np.sin(5 * t)], axis=1)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    inside, white = [], []
    for _ in range(300):
        e = rng.standard_normal(n)
        for k in range(1, n):
            e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * e[k]
        found = inverse @ jacobian.T @ e
        r = e - jacobian @ found
        middle = correlated(jacobian * r[:, None], np.zeros(n, int), np.arange(n))
        spread = np.sqrt(np.diag(inverse @ middle @ inverse))
        inside.append(np.abs(found) < 1.96 * spread)
        white.append(np.abs(found) < 1.96 * np.sqrt(np.diag(inverse)) * r.std())
    assert np.mean(inside) > 0.88 and np.mean(white) < 0.6


def test_noise_that_does_not_fit():
    for given, text in [
        ({"level": 0.0}, "level is a standard deviation > 0"),
        ({"level": 0.1, "shared": "all"}, "a level that is shared, 'all', is estimated"),
        ({"student": 1.0}, "degrees of freedom > 1"),
        ({"huber": -1.0}, "a number of levels > 0"),
        ({"student": 4.0, "huber": 1.0}, "leave one of them out"),
    ]:
        with pytest.raises(ModelError, match=text):
            Noise(**given)


def test_a_watch_tells_how_long_it_takes():
    seen: list[Progress] = []
    watch = Watch(seen.append, 1e-3)
    for k in range(5):
        watch.began -= 1.0  # a second for each step
        watch(k, 10.0 / (k + 1), 1.0, 10.0**-k * 100)
    assert seen[0].step == 0 and np.isnan(seen[0].left) and 0.7 < seen[-1].left < 1.3  # one decade is left
    assert "step 4: cost 2, χ²/n 1, 0.01 σ to go" in str(seen[-1])
    assert reporter(None, 1e-3) is None
    with pytest.raises(ModelError, match="progress is True, or a function"):
        reporter(3, 1e-3)
