"""Samples of the posterior, against closed forms for linear models and quadrature by SciPy."""

import functools
import importlib.util

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats
from kalman import negative_log_likelihood
from problems import compiled

from jaxonomy_dae import EqnEnv, ModelError
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.learning import Data, Experiment, Filter, Problem, Unknown, objective
from jaxonomy_dae.learning import density as densities
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

needs_blackjax = pytest.mark.skipif(importlib.util.find_spec("blackjax") is None, reason="needs BlackJAX (extra bayes)")
SIGMA, GUESS, SPREAD = 0.2, (1.0, -0.5), (0.3, 0.5)
TIMES = (np.linspace(0.5, 3.0, 6), np.linspace(0.2, 2.0, 5))


class Line(Component):
    """x' = b, with y = 2 x − 1 beside it."""

    def __init__(self, ev, name="c"):
        super().__init__(ev, name)
        b = self.parameter("b", 0.5)
        x, y = self.variable("x", start=0.0), self.variable("y")
        self.add_equations(Eq(der(x), b), Eq(y, 2 * x - 1))


class Decay(Component):
    """x' = −k x."""

    def __init__(self, ev, name="c"):
        super().__init__(ev, name)
        k, x = self.parameter("k", 1.0, bounds=POSITIVE), self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * x))


def measured(k):
    rng = np.random.default_rng(k)
    return GUESS[k] + 0.1 + 0.8 * TIMES[k] + SIGMA * rng.standard_normal(len(TIMES[k]))


def lines(sigma, spreads):
    return Data(
        *(
            Experiment(
                TIMES[k], {"c.x": measured(k)}, sigma=sigma, initial={"c.x": Unknown(GUESS[k], spread=spreads[k])}
            )
            for k in range(2)
        )
    )


@functools.cache
def line_problem():
    return Problem(compiled(Line(EqnEnv())), lines(SIGMA, SPREAD), train="c.b")


def regression():
    """(A, y) of y = A (b, x0, x1)."""
    rows = [np.stack([t, np.full_like(t, k == 0), np.full_like(t, k == 1)], axis=1) for k, t in enumerate(TIMES)]
    return np.concatenate(rows), np.concatenate([measured(0), measured(1)])


def assert_like(draws, effective, mean, deviation):
    """Within four standard errors of means and of standard deviations of normal draws."""
    assert abs(draws.mean() - mean) < 4 * deviation / np.sqrt(effective)
    assert abs(draws.std() / deviation - 1) < 4 / np.sqrt(2 * min(effective, draws.size / 2))


@needs_blackjax
@pytest.mark.slow
def test_a_linear_model_with_normal_priors():
    """The posterior is normal: (AᵀA/σ² + P)⁻¹."""
    found = line_problem().fit().sample(1000)
    a, y = regression()
    precision = np.diag([0.0, *(1 / np.square(SPREAD))])
    covariance = np.linalg.inv(a.T @ a / SIGMA**2 + precision)
    mean = covariance @ (a.T @ y / SIGMA**2 + precision @ [0.0, *GUESS])
    assert found.mixed and len(found) == 4000 and found.steps.max() < 8 * 1000, found
    names = ["c.b", "c.x, experiment 0", "c.x, experiment 1"]
    assert found.names == tuple(names)
    for k, name in enumerate(names):
        assert_like(found[name], found.effective[name], mean[k], np.sqrt(covariance[k, k]))
    correlation = np.corrcoef(found[names[0]].ravel(), found[names[2]].ravel())[0, 1]
    expected = covariance[0, 2] / np.sqrt(covariance[0, 0] * covariance[2, 2])
    assert abs(correlation - expected) < 4 * (1 - expected**2) / np.sqrt(min(found.effective.values()))
    # A variable that was not measured, at a time beyond the data: y = 2 (x1 + 4 b) − 1.
    ahead = found.predict(["c.y"], ts=[0.5, 4.0], experiment=1, draws=1000)
    row = np.array([4.0, 0.0, 1.0])
    deviation = 2 * np.sqrt(row @ covariance @ row)
    np.testing.assert_allclose(ahead.mean["c.y"][1], 2 * row @ mean - 1, atol=4 * deviation / np.sqrt(800))
    np.testing.assert_allclose(ahead.spread["c.y"][1], deviation, rtol=4 / np.sqrt(1600))
    width = (ahead.high["c.y"] - ahead.low["c.y"])[1] / deviation
    assert abs(width / (2 * 1.95996) - 1) < 0.15
    rows = found.table()
    np.testing.assert_allclose(rows["c.b"].high - rows["c.b"].low, 2 * 1.95996 * np.sqrt(covariance[0, 0]), rtol=0.1)
    # By the same programs, other draws.
    count = len(PROGRAMS)
    again = line_problem().fit().sample(1000, seed=1)
    assert len(PROGRAMS) == count and (again["c.b"] != found["c.b"]).all()


@needs_blackjax
@pytest.mark.slow
def test_a_linear_model_with_an_unknown_noise_level():
    """Flat in ln σ: the slope has Student's distribution, and n − 3 residual variances over σ² have χ²'s."""
    found = line_problem().fit(lines("estimate", (None, None))).sample(1500)
    a, y = regression()
    inverse, freedom = np.linalg.inv(a.T @ a), len(y) - 3
    mean = inverse @ a.T @ y
    left = np.sum((y - a @ mean) ** 2)
    slope = scipy.stats.t(freedom, mean[0], np.sqrt(left / freedom * inverse[0, 0]))
    assert found.mixed, found
    for share in (0.025, 0.25, 0.5, 0.75, 0.975):
        error = 4 * np.sqrt(share * (1 - share) / (0.5 * found.effective["c.b"]))
        assert abs(np.mean(found["c.b"] < slope.ppf(share)) - share) < error
        level = np.sqrt(left / scipy.stats.chi2(freedom).ppf(1 - share))
        assert abs(np.mean(found["sigma of c.x"] < level) - share) < error


@functools.cache
def decay_problem():
    data = Experiment([1.0, 2.0], {"c.x": [0.5, 0.05]}, sigma=0.25)
    return Problem(compiled(Decay(EqnEnv())), data, train="c.k")


def by_quadrature(low, high):
    """The distribution function of ln k, flat between two ends, from two samples: skewed, as exp(−k t) saturates."""
    grid = np.linspace(low, high, 20001)
    k = np.exp(grid)
    logs = -0.5 * ((np.exp(-k) - 0.5) ** 2 + (np.exp(-2 * k) - 0.05) ** 2) / 0.25**2
    mass = scipy.integrate.cumulative_simpson(np.exp(logs), x=grid, initial=0.0)
    return grid, mass / mass[-1]


@needs_blackjax
@pytest.mark.slow
@pytest.mark.parametrize("bounds", [(0.2, 6.0), (0.2, 0.9)])  # in the second, the maximum lies on the bound
def test_one_skewed_parameter(bounds):
    fit = decay_problem().fit(bounds={"c.k": bounds})
    assert (fit.table()["c.k"].note != "") == (bounds[1] < 1)
    found = fit.sample(1500)
    assert found.mixed and found["c.k"].min() >= bounds[0] and found["c.k"].max() <= bounds[1], found
    grid, mass = by_quadrature(*np.log(bounds))
    if bounds[1] > 1:
        mean, below = np.average(grid, weights=np.gradient(mass)), np.interp(np.log(fit.values["c.k"]), grid, mass)
        assert abs(below - 0.5) > 0.03 and abs(mean - np.log(fit.values["c.k"])) > 0.02  # it is skewed
    for share in (0.025, 0.1, 0.5, 0.9, 0.975):
        end = np.exp(np.interp(share, mass, grid))
        error = 4 * np.sqrt(share * (1 - share) / (0.5 * found.effective["c.k"]))
        assert abs(np.mean(found["c.k"] < end) - share) < error


@pytest.mark.slow
def test_what_no_bound_nor_sample_determines_is_refused():
    far = Experiment([1e3, 2e3], {"c.x": [0.0, 0.0]}, sigma=0.25)
    fit = decay_problem().fit(far)
    with pytest.raises(ModelError, match="neither data, priors nor bounds determine 'c.k': freeze it"):
        densities.posed(fit)


def between(*arrays):
    return [np.asarray(a) for a in densities.between(*map(jnp.asarray, arrays))]


def test_coordinates_between_bounds():
    """Against finite differences, over all four kinds."""
    low, high = np.array([0.0, -np.inf, -2.0, -np.inf]), np.array([np.inf, 3.0, 5.0, np.inf])
    y = np.array([[-3.0, 0.5, 2.0, -1.0], [4.0, -2.0, -30.0, 7.0]])
    z, slope = between(y, low, high)
    assert (z > low).all() and (z < high).all() and (z[:, 3] == y[:, 3]).all()
    step = 1e-6
    up, down = (between(y + s, low, high)[0] for s in (step, -step))
    np.testing.assert_allclose(np.exp(slope), (up - down) / (2 * step), rtol=1e-3, atol=1e-9)


def test_where_sampling_begins_lies_inside():
    """The slopes of the map from free numbers at the centre, its bend and its own curvature, against differences."""
    low, high = np.array([0.0, -np.inf, -2.0, -np.inf]), np.array([np.inf, 3.0, 5.0, np.inf])
    z, gradient = np.array([0.0, 3.0, 4.0, 1.0]), np.array([2.0, -4.0, 0.0, 0.0])
    jacobian = np.diag([1.0, 2.0, 3.0, 1.0])
    y, slope, curvature = densities._centre(z, jacobian, gradient, low, high)

    def cost(y):
        moved, logs = between(y, low, high)
        return gradient * moved - logs

    step = 1e-4
    moved = between(y, low, high)[0]
    np.testing.assert_allclose(moved, [1 / 3, 3 - 1 / 6, 4.0, 1.0])
    up, down = (between(y + s, low, high)[0] for s in (step, -step))
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(
        curvature, (cost(y + step) + cost(y - step) - 2 * cost(y)) / step**2, rtol=1e-5, atol=1e-6
    )


@pytest.mark.slow
def test_gradients_backwards_are_those_forwards(monkeypatch):
    """As for networks, whose weights are many."""
    fit = line_problem().fit(lines("estimate", (None, None)))
    found = []
    for many in (40, 0):
        monkeypatch.setattr(objective, "MANY", many)
        program, told, _ = densities.posed(fit)
        assert program.backwards == (many == 0)
        found.append(densities.density_and_gradient(program, told, jnp.array([0.3, -0.2, 0.5, 0.1])))
    for forwards, backwards in zip(*found, strict=True):
        np.testing.assert_allclose(forwards, backwards, rtol=1e-7)


@pytest.mark.slow
def test_the_density_of_a_filter_is_that_of_kalmans():
    """At points around the estimate, against a filter in NumPy; noise levels among them."""
    noise = {"c.x": Unknown(0.3, spread=0.5)}
    problem = Problem(line_problem().system, lines("estimate", SPREAD), train="c.b", method=Filter(noise))
    fit = problem.fit()
    program, told, names = densities.posed(fit)
    assert names == () and len(told.centre) == 3
    found, expected = [], []
    for u in 0.5 * np.random.default_rng(0).standard_normal((4, 3)):
        value, slope = densities.density_and_gradient(program, told, jnp.asarray(u))
        z, _, logs = (np.asarray(a) for a in densities.coordinates_at(told, jnp.asarray(u)))
        c = fit.objective.coordinates
        v = dict(zip(c.names, c.natural(fit.objective.full(z)), strict=True))
        cost = 0.5 * ((np.log(v["noise of c.x"] / 0.3)) / 0.5) ** 2 - logs
        for k in range(2):
            cost += negative_log_likelihood(
                np.zeros((1, 1)), lambda u, b=v["c.b"]: np.array([b]), np.array([[v["noise of c.x"] ** 2]]),
                np.ones((1, 1)), lambda u: np.zeros(1), np.array([v["sigma of c.x"]]), np.array([GUESS[k]]),
                np.array([[SPREAD[k] ** 2]]), TIMES[k], np.zeros(len(TIMES[k]) + 1), measured(k)[:, None],
            )  # fmt: skip
        found.append(float(value))
        expected.append(-cost)
        step = 1e-5
        for j, e in enumerate(np.eye(3)):
            up, down = (
                float(densities.density_and_gradient(program, told, jnp.asarray(u + s * e))[0]) for s in (step, -step)
            )
            np.testing.assert_allclose(slope[j], (up - down) / (2 * step), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-6, atol=1e-7)


@needs_blackjax
@pytest.mark.slow
def test_wrong_arguments():
    fit = line_problem().fit()
    with pytest.raises(ModelError, match="draws is a whole number ≥ 4; got 2"):
        fit.sample(2)
    with pytest.raises(ModelError, match="chains is a whole number ≥ 1; got 0"):
        fit.sample(chains=0)
    found = fit.sample(20, chains=1, warmup=10)
    assert not found.mixed and "fewer than 400 effective draws" in repr(found)
    with pytest.raises(ModelError, match="'c.c' was not estimated"):
        found["c.c"]
    with pytest.raises(ModelError, match="'c.z'"):
        found.predict("c.z")
    with pytest.raises(ModelError, match="was not trained"):
        found.band("drag", [0.0])


def test_without_the_library_the_extra_is_named(monkeypatch):
    from jaxonomy_dae.learning import chains

    monkeypatch.setattr("importlib.import_module", lambda name: (_ for _ in ()).throw(ImportError(name)))
    with pytest.raises(ImportError, match=r"posterior samples need BlackJAX: pip install 'jaxonomy_dae\[bayes\]'"):
        chains.blackjax()
