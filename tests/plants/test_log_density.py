"""The posterior density, against closed forms, a filter in NumPy and quadrature by SciPy."""

import functools
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from kalman import negative_log_likelihood
from problems import compiled

from jaxonomy_dae import EqnEnv, ModelError
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


@pytest.mark.slow
def test_a_linear_model_is_whitened():
    """With normal priors, the posterior is normal with the covariance (AᵀA/σ² + P)⁻¹: exactly −u²/2."""
    density = line_problem().fit().log_density()
    a, y = regression()
    precision = np.diag([0.0, *(1 / np.square(SPREAD))])
    covariance = np.linalg.inv(a.T @ a / SIGMA**2 + precision)
    mean = covariance @ (a.T @ y / SIGMA**2 + precision @ [0.0, *GUESS])
    assert density.names == ("c.b", "c.x, experiment 0", "c.x, experiment 1") and density.size == 3
    for u in np.random.default_rng(0).standard_normal((3, 3)):
        value, slope = jax.value_and_grad(density)(jnp.asarray(u))
        np.testing.assert_allclose(value - density(jnp.zeros(3)), -0.5 * u @ u, rtol=1e-6)
        np.testing.assert_allclose(slope, -u, rtol=1e-5, atol=1e-6)
    flat = jax.jacobian(lambda u: jnp.stack(list(density.values(u).values())))(jnp.zeros(3))
    np.testing.assert_allclose(flat @ flat.T, covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(list(density.values(jnp.zeros(3)).values()), mean, rtol=1e-6)
    assert float(density.system(jnp.zeros(3)).parameters["c.b"]) == float(density.values(jnp.zeros(3))["c.b"])


@pytest.mark.slow
def test_a_noise_level_is_an_argument():
    """Flat in ln σ: −n ln σ − |y − A b|²/2σ²."""
    density = line_problem().fit(lines("estimate", (None, None))).log_density()
    a, y = regression()
    found, expected = [], []
    for u in np.random.default_rng(0).standard_normal((4, 4)):
        *b, sigma = density.values(jnp.asarray(u)).values()
        found.append(density(jnp.asarray(u)))
        expected.append(-len(y) * np.log(sigma) - np.sum((y - a @ np.array(b)) ** 2) / (2 * sigma**2))
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-6)


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
def test_samples_of_one_skewed_parameter(bounds):
    """As `docs/how-to/posterior.md` draws them."""
    import blackjax

    fit = decay_problem().fit(bounds={"c.k": bounds})
    density = fit.log_density()
    with jax.numpy_dtype_promotion("standard"):
        warmup = blackjax.window_adaptation(blackjax.nuts, density)
        (state, tuned), _ = warmup.run(jax.random.key(0), jnp.zeros(1), 300)
        kernel = blackjax.nuts(density, **tuned)
        keys = jax.random.split(jax.random.key(1), 4000)
        draws = jax.lax.scan(lambda s, key: (new := kernel.step(key, s)[0], new.position), state, keys)[1]
        effective = float(jnp.ravel(blackjax.diagnostics.ess_bulk(draws[None]))[0])
    k = np.asarray(density.values(draws)["c.k"])
    assert effective > 400 and k.min() >= bounds[0] and k.max() <= bounds[1]
    grid, mass = by_quadrature(*np.log(bounds))
    for share in (0.025, 0.1, 0.5, 0.9, 0.975):
        end = np.exp(np.interp(share, mass, grid))
        assert abs(np.mean(k < end) - share) < 4 * np.sqrt(share * (1 - share) / (0.5 * effective))


@pytest.mark.slow
def test_what_no_bound_nor_sample_determines_is_refused():
    far = Experiment([1e3, 2e3], {"c.x": [0.0, 0.0]}, sigma=0.25)
    fit = decay_problem().fit(far)
    with pytest.raises(
        ModelError, match="no finite integral: neither data, priors nor bounds determine 'c.k': freeze it"
    ):
        fit.log_density()


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


def test_the_centre_lies_inside():
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
        density = fit.log_density()
        assert density.program.backwards == (many == 0)
        found.append(jax.value_and_grad(density)(jnp.array([0.3, -0.2, 0.5, 0.1])))
    for forwards, backwards in zip(*found, strict=True):
        np.testing.assert_allclose(forwards, backwards, rtol=1e-7)


@pytest.mark.slow
def test_the_density_of_a_filter_is_that_of_kalmans():
    """At points around the estimate, against a filter in NumPy; noise levels among them."""
    noise = {"c.x": Unknown(0.3, spread=0.5)}
    problem = Problem(line_problem().system, lines("estimate", SPREAD), train="c.b", method=Filter(noise))
    fit = problem.fit()
    density = fit.log_density()
    assert density.size == 3
    found, expected = [], []
    for u in 0.5 * np.random.default_rng(0).standard_normal((4, 3)):
        value, slope = jax.value_and_grad(density)(jnp.asarray(u))
        v = {name: float(a) for name, a in density.values(jnp.asarray(u)).items()}
        logs = densities.coordinates_at(density.posed, jnp.asarray(u))[2]
        cost = 0.5 * ((np.log(v["noise of c.x"] / 0.3)) / 0.5) ** 2 - float(logs)
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
            up, down = (float(density(jnp.asarray(u + s * e))) for s in (step, -step))
            np.testing.assert_allclose(slope[j], (up - down) / (2 * step), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-6, atol=1e-7)
