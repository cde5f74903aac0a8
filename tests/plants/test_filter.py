"""The likelihood of a filter: for linear models against Kalman's filter in NumPy and SciPy, and dense normal
distributions."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from kalman import discretized, held, negative_log_likelihood

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.write import POSITIVE, Component, Eq, der


def compiled(component):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(component(ev))
    return AcausalCompiler(ev, diagram)()


def objective_of(problem):
    objective = problem.objective_of(problem._stacked, problem._coordinates(problem._stacked, (), None, None))
    return objective, objective.coordinates.z_start[objective.free]


def gradient_of(function, z, step=1e-5):
    return np.array([(function(z + step * e) - function(z - step * e)) / (2 * step) for e in np.eye(len(z))])


# --- two temperatures -------------------------------------------------------------------------------------------------


class Room(Component):
    """Air and wall, with the heat flow between them as an algebraic variable."""

    def __init__(self, ev, name="room"):
        super().__init__(ev, name)
        value = {"Ci": 1.0, "Cw": 5.0, "R1": 0.5, "R2": 2.0}
        ci, cw, r1, r2 = (self.parameter(n, v, bounds=POSITIVE) for n, v in value.items())
        outside, power = self.input("Ta"), self.input("Ph")
        air, wall = (self.variable(n, start=20.0, fixed=True) for n in ("T", "W"))
        q = self.variable("q")
        self.add_equations(
            Eq(q, (air - wall) / r1), Eq(ci * der(air), power - q), Eq(cw * der(wall), q + (outside - wall) / r2)
        )


TIMES = np.cumsum(np.random.default_rng(0).uniform(0.2, 1.0, 24))
START, SPREAD = np.array([19.0, 15.0]), np.array([0.7, 2.0])


def record(seed, padded=24):
    """The two, with samples that are missing, some throughout a row."""
    rng = np.random.default_rng(seed)
    y = np.stack([20 + rng.standard_normal(24), 5 + 3 * rng.standard_normal(24)], axis=1)
    y[5:9, 0], y[7, 1] = np.nan, np.nan
    u = np.stack([5 + rng.standard_normal(25), 5 * np.abs(rng.standard_normal(25))], axis=1)
    grid = np.concatenate([[0.0], TIMES])
    initial = {f"room.{n}": learning.Unknown(float(x), spread=s) for n, x, s in zip("TW", START, SPREAD, strict=True)}
    one = learning.Experiment(
        TIMES, {"room.T": y[:, 0], "room.q": y[:, 1]}, sigma={"room.T": 0.3, "room.q": "estimate"},
        inputs={f"room.{n}": (grid, u[:, k], "held") for k, n in enumerate(("Ta", "Ph"))}, initial=initial,
    )  # fmt: skip
    return one, u, y


def matrices(v):
    """(A, b(u), G, C) of values by name."""
    ci, r2, cw, r1 = v.get("room.Ci", 1.0), v.get("room.R2", 2.0), 5.0, 0.5
    a = np.array([[-1 / r1 / ci, 1 / r1 / ci], [1 / r1 / cw, -(1 / r1 + 1 / r2) / cw]])
    g = np.diag([v["noise of room.T"] ** 2, v["noise of room.W"] ** 2])
    return a, lambda u: np.array([u[1] / ci, u[0] / r2 / cw]), g, np.array([[1, 0], [1 / r1, -1 / r1]])


def exact(objective, z, u, y):
    c = objective.coordinates
    v = dict(zip(c.names, c.natural(objective.full(z)), strict=True))
    sigma = np.array([0.3, v["sigma of room.q"]])
    a, b, g, out = matrices(v)
    nothing = np.zeros(2)
    return negative_log_likelihood(a, b, g, out, lambda _: nothing, sigma, START, np.diag(SPREAD**2), TIMES, u, y)


@pytest.fixture(scope="module")
def room():
    return compiled(Room)


@pytest.fixture(scope="module")
def problem(room):
    method = learning.Filter({"room.T": 0.2, "room.W": "estimate"})
    return learning.Problem(room, record(0)[0], train=["room.Ci", "room.R2"], method=method, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_the_likelihood_of_a_linear_model_and_its_gradient(problem):
    """Against Kalman's filter with exact discretization; missing samples, an algebraic output, priors of starts."""
    objective, z = objective_of(problem)
    _, u, y = record(0)
    for point in (z, z + [0.3, -0.4, 0.5, -0.6]):
        found = objective.evaluate(point)
        weights = objective.weights(point, found)
        np.testing.assert_allclose(weights.cost(point, found.residual), exact(objective, point, u, y), rtol=1e-9)
        rho, jacobian = weights.applied(point, found)
        slope = gradient_of(lambda p: exact(objective, p, u, y), point)
        np.testing.assert_allclose(jacobian.T @ rho, slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())
    # and what follows from it, by the same program
    count = len(PROGRAMS)
    fit = problem.fit(record(1)[0], freeze={"noise of room.T": 0.4}, bounds={"room.Ci": (0.5, 2.0)})
    assert len(PROGRAMS) == count and fit.minimum.converged
    _, u, y = record(1)
    free = fit.objective.free
    slope = gradient_of(lambda p: exact(fit.objective, p, u, y), fit.point[free])
    inside = ~((fit.minimum.z <= fit.objective.bounds[0]) | (fit.minimum.z >= fit.objective.bounds[1]))
    np.testing.assert_allclose((slope * fit.spread[free])[inside], 0, atol=1e-2)
    np.testing.assert_allclose(
        fit.log_likelihood, -exact(fit.objective, fit.point[free], u, y) - 0.5 * 43 * np.log(2 * np.pi), rtol=1e-9
    )
    assert fit.table()["noise of room.T"].note == "frozen" and fit.table()["room.R2"].low > 0
    assert fit.sigma == {"room.q": fit.values["sigma of room.q"]}
    assert np.isfinite(fit.residuals["experiment 0"]["room.T"]).sum() == 20


@pytest.mark.slow
def test_filtered_smoothed_and_predicted_states_are_those_of_dense_normal_distributions(problem):
    """States at all times are one normal distribution, which samples condition."""
    fit = problem.fit(steps=0)
    _, u, y = record(0)
    a, b, g, out = matrices(fit.values)
    sigma = np.array([0.3, fit.values["sigma of room.q"]])
    n, before = len(TIMES), np.concatenate([[0.0], TIMES[:-1]])
    mean, cov = np.zeros((n, 2)), np.zeros((n, 2, n, 2))
    x, p = START, np.diag(SPREAD**2)
    for k in range(n):
        phi, q = discretized(a, g, TIMES[k] - before[k])
        x = phi @ x + held(a, b(u[k]), TIMES[k] - before[k])
        if k:
            cov[k, :, :k] = np.einsum("ij,jlm->ilm", phi, cov[k - 1, :, :k])
            cov[:k, :, k] = np.einsum("ilm->lmi", cov[k, :, :k])
        p = phi @ p @ phi.T + q
        mean[k], cov[k, :, k] = x, p
    big, seen = scipy.linalg.block_diag(*[out] * n), np.isfinite(y).ravel()
    noise = np.diag(np.tile(sigma**2, n))
    cov, mean = cov.reshape(2 * n, 2 * n), mean.ravel()

    def given(known):
        """Wall's temperature, and the spread, from these samples."""
        h = big[known]
        s = h @ cov @ h.T + noise[np.ix_(known, known)]
        gain = cov @ h.T @ np.linalg.inv(s)
        return mean + gain @ (y.ravel()[known] - h @ mean), cov - gain @ h @ cov

    rows = np.arange(n).repeat(2)
    names = ["room.W", "room.q"]
    smoothed, filtered, ahead, further = (
        fit.smoothed(names), fit.filtered(names), fit.ahead(names), fit.ahead(names, steps=3)
    )  # fmt: skip
    for k in (3, 6, 7, 15, 23):
        for what, known in (
            (smoothed, seen), (filtered, seen & (rows <= k)), (ahead, seen & (rows < k)),
            (further, seen & (rows < k - 2)),
        ):  # fmt: skip
            m, c = given(known)
            at = m[2 * k : 2 * k + 2], c[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
            np.testing.assert_allclose(what.mean["room.W"][k], at[0][1], rtol=1e-8)
            np.testing.assert_allclose(what.mean["room.q"][k], out[1] @ at[0], rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(what.spread["room.W"][k], np.sqrt(at[1][1, 1]), rtol=1e-7)
            np.testing.assert_allclose(what.spread["room.q"][k], np.sqrt(out[1] @ at[1] @ out[1]), rtol=1e-7)
    assert np.isnan(further.mean["room.W"][:3]).all()


@pytest.mark.slow
def test_innovations_find_the_gain_of_least_squared_errors(room):
    """With the parameters known, against SciPy's least squares of the same recursion."""
    rng = np.random.default_rng(4)
    times, u = 0.5 * np.arange(1, 201), np.array([5.0, 4.0])
    a, b, g, _ = matrices({"noise of room.T": 0.5, "noise of room.W": 0.3})
    (phi, q), push = discretized(a, g, 0.5), held(a, b(u), 0.5)
    x, y = np.array([12.0, 11.0]), np.zeros(200)
    for k in range(200):
        x = phi @ x + push + np.linalg.cholesky(q) @ rng.standard_normal(2)
        y[k] = x[0] + 0.4 * rng.standard_normal()
    one = learning.Experiment(
        times, {"room.T": y}, inputs={"room.Ta": 5.0, "room.Ph": 4.0}, initial={"room.T": 12.0, "room.W": 11.0}
    )
    problem = learning.Problem(room, one, train=[], method=learning.Innovations(), rtol=1e-9, atol=1e-10)
    fit = problem.fit()

    def errors(gain):
        x, out = np.array([12.0, 11.0]), np.zeros(200)
        for k in range(200):
            x = phi @ x + push
            out[k] = y[k] - x[0]
            x = x + gain * out[k]
        return out

    best = scipy.optimize.least_squares(errors, [0.1, 0.1], xtol=1e-12, ftol=1e-12)
    gains = [fit.values[f"gain of room.{n} by room.T"] for n in "TW"]
    spread = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)) * 2 * best.cost / 198)
    np.testing.assert_allclose((gains - best.x) / spread, 0, atol=5e-3)
    np.testing.assert_allclose(fit.rms["experiment 0"]["room.T"], np.sqrt(np.mean(best.fun**2)), rtol=1e-4)
    assert fit.whiteness["experiment 0"]["room.T"].probability > 0.01
    found = fit.ahead("room.T").mean["room.T"] - y
    np.testing.assert_allclose(found, fit.residuals["experiment 0"]["room.T"] * fit.sigma["room.T"], rtol=1e-9)


# --- closed form -----------------------------------------------------------------------------------------------------


class Drift(Component):
    """The process of Ornstein and Uhlenbeck."""

    def __init__(self, ev, name="ou"):
        super().__init__(ev, name)
        tau, centre = self.parameter("tau", 2.0, bounds=POSITIVE), self.parameter("m", 1.0)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), (centre - x) / tau))


def drift(seed, n=400, tau=2.0, centre=1.0, noise=0.6, sigma=0.15):
    """Samples by the exact transition, with gaps, from the stationary distribution."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.1, 0.6, n))
    x, y, now = centre + noise * np.sqrt(tau / 2) * rng.standard_normal(), np.zeros(n), 0.0
    for k, t in enumerate(times):
        phi = np.exp(-(t - now) / tau)
        x = centre + phi * (x - centre) + noise * np.sqrt(tau / 2 * (1 - phi**2)) * rng.standard_normal()
        y[k], now = x + sigma * rng.standard_normal(), t
    return learning.Experiment(times, {"ou.x": y}, initial={"ou.x": learning.Unknown(1.0, spread=0.6)})


@pytest.fixture(scope="module")
def drifting():
    method = learning.Filter({"ou.x": "estimate"})
    return learning.Problem(compiled(Drift), drift(0), train=["ou.tau", "ou.m"], method=method, rtol=1e-10, atol=1e-12)


@pytest.mark.long("a filter and its derivatives compile for 5 s")
def test_the_likelihood_of_a_process_of_ornstein_and_uhlenbeck(drifting):
    """In closed form, and its gradient against differences."""
    objective, z = objective_of(drifting)
    s = objective.stacked

    def exact(z):
        tau, centre, noise, sigma = objective.coordinates.natural(objective.full(z))
        cost, x, p, now = 0.0, 1.0, 0.36, 0.0
        for t, y in zip(s.times[0], s.values[0, :, 0], strict=True):
            phi = np.exp(-(t - now) / tau)
            x, p = centre + phi * (x - centre), phi**2 * p + noise**2 * tau / 2 * (1 - phi**2)
            variance = p + sigma**2
            cost += 0.5 * ((y - x) ** 2 / variance + np.log(variance))
            x, p, now = x + p / variance * (y - x), p * sigma**2 / variance, t
        return cost

    found = objective.evaluate(z)
    weights = objective.weights(z, found)
    np.testing.assert_allclose(weights.cost(z, found.residual), exact(z), rtol=1e-9)
    rho, jacobian = weights.applied(z, found)
    np.testing.assert_allclose(jacobian.T @ rho, gradient_of(exact, z), rtol=1e-6, atol=1e-5)


@pytest.mark.slow
def test_intervals_cover_the_truth_of_a_process_of_ornstein_and_uhlenbeck(drifting):
    """Two parameters, intensity and sensor noise of 50 records, all by one program. (Of 150 samples, 89 % of intervals
    cover: that is too few for the distribution of estimates to be normal.)"""
    truth = {"ou.tau": 2.0, "ou.m": 1.0, "noise of ou.x": 0.6, "sigma of ou.x": 0.15}
    inside, steps = [], []
    for seed in range(50):
        fit = drifting.fit(drift(seed))
        table = fit.table()
        inside.append([table[name].low <= value <= table[name].high for name, value in truth.items()])
        steps.append(len(fit.minimum.history))
        assert fit.minimum.converged and 0.6 < fit.chi2 / fit.freedom < 1.5
    assert 0.90 <= np.mean(inside) <= 0.99, np.mean(inside, axis=0)
    assert np.median(steps) < 15
