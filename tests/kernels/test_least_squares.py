"""Levenberg–Marquardt, evidence and intervals on models that have closed forms."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize

from jaxonomy_dae.learning.agreement import whiteness
from jaxonomy_dae.learning.descent import CLOSE, descend
from jaxonomy_dae.learning.evaluation import Evaluation, Weights
from jaxonomy_dae.learning.evidence import Evidence
from jaxonomy_dae.learning.factors import Factors
from jaxonomy_dae.learning.identifiability import spreads
from jaxonomy_dae.learning.least_squares import SumOfSquares

FREE = -np.inf, np.inf
NOISE = float(np.sqrt(np.finfo(float).eps))  # relative, of Jacobians in closed form: a bound


def merit(evaluate, weights, residual, finer=lambda factor: None, noise=NOISE):
    return SumOfSquares(evaluate, weights, noise, finer, np.array(False), residual)


def solve(function, jacobian, start, low=FREE[0], high=FREE[1], weights=None, reweigh=None, steps=200):
    start = np.asarray(start, float)
    bounds = np.broadcast_to(low, start.shape).astype(float), np.broadcast_to(high, start.shape).astype(float)
    count = [0]

    def evaluate(z):
        count[0] += 1
        return Evaluation(function(z), jacobian(z))

    def plain(z, found):
        return Weights(np.ones(len(found.residual)), np.zeros(len(z)), np.zeros(len(z)), np.ones(len(found.residual)))

    return descend(merit(evaluate, weights or plain, function), start, bounds, reweigh, steps)


@pytest.fixture
def line():
    rng = np.random.default_rng(3)
    design = rng.standard_normal((40, 3)) * np.array([1.0, 1e3, 1e-4])
    truth = np.array([1.0, 2e-3, -5e4])
    return design, design @ truth + 0.1 * rng.standard_normal(40)


def test_linear_problem_is_solved_in_a_few_steps_whatever_its_units(line):
    design, y = line
    found = solve(lambda z: design @ z - y, lambda z: design, np.zeros(3))
    expected = np.linalg.lstsq(design, y)[0]
    deviation = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * np.sum((design @ expected - y) ** 2) / 37)
    assert found.converged and len(found.history) <= 5
    np.testing.assert_array_less(np.abs(found.z - expected), 2e-3 * deviation)


def test_covariance_is_that_of_linear_regression(line):
    design, y = line
    factors = Factors.of(y, design, 1e-12)
    root = factors.root(factors.rank(1e-12))
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(design.T @ design), rtol=1e-9)
    np.testing.assert_allclose(spreads(factors, 1e-12) ** 2, np.diag(np.linalg.inv(design.T @ design)), rtol=1e-9)


def test_bounds_hold_and_the_rest_is_the_least_among_them(line):
    design, y = line
    high = np.array([0.5, np.inf, np.inf])
    found = solve(lambda z: design @ z - y, lambda z: design, np.zeros(3), high=high)
    expected = scipy.optimize.lsq_linear(design, y, (np.full(3, -np.inf), high), tol=1e-14).x
    assert found.z[0] == 0.5
    np.testing.assert_allclose(found.z, expected, rtol=2e-3)


def test_rosenbrock_is_followed_to_its_end():
    found = solve(
        lambda z: np.array([10 * (z[1] - z[0] ** 2), 1 - z[0]]),
        lambda z: np.array([[-20 * z[0], 10.0], [-1.0, 0.0]]),
        [-1.2, 1.0],
    )
    np.testing.assert_allclose(found.z, 1.0, atol=1e-8)


def test_trials_that_fail_are_rejected():
    """−log z is not defined where a full step leads."""
    logarithm = merit(
        lambda z: Evaluation(np.log(z), np.diag(1 / z)),
        lambda z, e: Weights(np.ones(1), np.zeros(1), np.zeros(1), np.ones(1)),
        lambda z: np.log(z) if z[0] > 0 else None,
    )
    found = descend(logarithm, np.array([8.0]), (np.array([-np.inf]), np.array([np.inf])), None, 200)
    assert found is not None
    np.testing.assert_allclose(found.z, 1.0, rtol=1e-6)


def test_a_start_that_fails_is_told():
    failing = merit(lambda z: None, lambda z, e: None, lambda z: None)
    assert descend(failing, np.zeros(1), (np.zeros(1), np.ones(1)), None, 200) is None


def test_a_direction_without_information_has_an_infinite_spread():
    design = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [3.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.isinf(spreads(Factors.of(np.zeros(4), design, 1e-8), 1e-8)).all()
    design[3, 2] = 2.0
    np.testing.assert_allclose(spreads(Factors.of(np.zeros(4), design, 1e-8), 1e-8), [np.inf, np.inf, 0.5])


def evidence_for(m, p, sigma_known):
    everything = np.ones(p, bool)
    noise = np.full(m, -1 if sigma_known else 0)
    return Evidence(noise, () if sigma_known else ("y",), np.zeros(0 if sigma_known else 1) + 1e-12, (everything,))


@pytest.mark.parametrize("sigma_known", [True, False])
def test_evidence_is_greatest_where_that_of_bayesian_linear_regression_is(sigma_known):
    """The log evidence of y = X w + noise in closed form, maximised by SciPy."""
    rng = np.random.default_rng(0)
    m, p, sigma = 60, 12, 0.3
    design = rng.standard_normal((m, p)) * np.linspace(0.02, 1.0, p)
    y = design @ (0.5 * rng.standard_normal(p)) + sigma * rng.standard_normal(m)

    def negative_log_evidence(logs):
        noise = sigma if sigma_known else np.exp(logs[1])
        covariance = noise**2 * np.eye(m) + design @ design.T / np.exp(logs[0])
        return 0.5 * (np.linalg.slogdet(covariance)[1] + y @ np.linalg.solve(covariance, y))

    best = scipy.optimize.minimize(
        negative_log_evidence, np.zeros(1 if sigma_known else 2), method="Nelder-Mead",
        options={"xatol": 1e-8, "fatol": 1e-12, "maxiter": 4000},
    ).x  # fmt: skip
    evidence = evidence_for(m, p, sigma_known)

    def weights(z, found):
        return evidence.first(Weights(np.full(m, 1 / sigma), np.full(p, 1.0), np.zeros(p), np.ones(m)), found)

    found = solve(
        lambda z: design @ z - y, lambda z: design, np.full(p, 0.1), weights=weights, reweigh=evidence.reweigh
    )
    # The last change of a precision is below 1 %, and such a fixed-point iteration shrinks its error by a third a step.
    np.testing.assert_allclose(np.log(found.weights.precision[0]), best[0], atol=0.03)
    if not sigma_known:
        np.testing.assert_allclose(np.log(evidence.sigma(found.weights)["y"]), best[1], atol=0.03)


def test_whiteness_tells_noise_from_what_is_left_over():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal(400)
    assert whiteness(noise + np.sin(np.linspace(0, 6, 400))).probability < 1e-6
    probabilities = [whiteness(rng.standard_normal(200)).probability for _ in range(400)]
    assert abs(np.mean(np.array(probabilities) < 0.1) - 0.1) < 0.06  # four standard deviations of the share


def test_a_search_tightens_the_tolerance_that_stops_it():
    """Residuals carried an integration's error, in which the search ended, called converged, wherever it was."""
    rng = np.random.default_rng(1)
    ts = np.linspace(0.1, 3.0, 40)
    y = np.exp(-1.3 * ts) + 1e-3 * rng.standard_normal(40)

    def merit_at(tolerance):
        def residual(z):
            rough = np.sin(1e7 * np.sum(z) + np.arange(40))  # another at every point
            return z[1] * np.exp(-z[0] * ts) - y + tolerance * rough

        def evaluate(z):
            law = np.exp(-z[0] * ts)
            return Evaluation(residual(z), np.stack([-ts * z[1] * law, law], axis=1))

        def finer(factor):
            return merit_at(tolerance * factor) if tolerance > 1e-12 else None

        def weights(z, found):
            return Weights(np.full(40, 1e3), np.zeros(2), np.zeros(2), np.ones(40))

        return merit(evaluate, weights, residual, finer, tolerance)

    bounds = np.full(2, -np.inf), np.full(2, np.inf)
    found = descend(merit_at(3e-3), np.array([3.0, 0.3]), bounds, None, 200)
    best = scipy.optimize.curve_fit(lambda t, a, x0: x0 * np.exp(-a * t), ts, y, [1.0, 1.0], xtol=1e-14, ftol=1e-14)[0]
    assert found.converged and found.tolerance < 1e-4
    np.testing.assert_allclose(found.z, best, rtol=1e-4)
    stuck = dataclasses.replace(merit_at(3e-3), finer=lambda factor: None)
    ended = descend(stuck, np.array([3.0, 0.3]), bounds, None, 200)
    assert ended.converged == (ended.left <= CLOSE) and ended.left > 3 * found.left


def test_a_prior_stays_while_the_misfit_is_large():
    """Far from the data, everything seems determined: precisions went to zero, and did not come back."""
    rng = np.random.default_rng(2)
    design = rng.standard_normal((30, 4))
    evidence = Evidence(np.full(30, -1), (), np.zeros(0), (np.ones(4, bool),))
    before = Weights(np.ones(30), np.full(4, 2.0), np.zeros(4), np.ones(30))
    for size, is_minimum, stays in ((100.0, False, True), (100.0, True, False), (1.0, False, False)):
        found = Evaluation(size * rng.standard_normal(30), design)
        factors = Factors.of(*before.applied(np.full(4, 5.0), found), NOISE)
        after, change = evidence.reweigh(np.full(4, 5.0), found, before, factors, np.ones(4, bool), is_minimum)
        assert (after.precision[0] == 2.0) == stays and (change == 0) == stays


def test_a_prior_that_is_too_strong_lets_go():
    """The evidence waited for the misfit to become small, which the prior itself kept large: fits of networks ended
    there, with a law that was almost linear. Where it begins, a prior does not matter."""
    rng = np.random.default_rng(3)
    design, m = rng.standard_normal((60, 6)), 60
    y = design @ (20 * rng.standard_normal(6)) + rng.standard_normal(m)
    evidence, found = evidence_for(m, 6, True), []
    for first in (1e-2, 1e6):
        weights = Weights(np.ones(m), np.full(6, first), np.zeros(6), np.ones(m))
        found.append(
            solve(
                lambda z: design @ z - y, lambda z: design, np.zeros(6), weights=lambda *_, w=weights: w,
                reweigh=evidence.reweigh,
            )
        )  # fmt: skip
    assert all(one.converged for one in found)
    assert float(np.sum(found[1].found.residual ** 2)) < 2 * m
    np.testing.assert_allclose(found[1].z, found[0].z, rtol=1e-3)
    np.testing.assert_allclose(found[1].weights.precision, found[0].weights.precision, rtol=0.03)


def test_a_frequency_that_stands_out_is_noticed():
    """A missing mode of half the noise was taken for noise, more often than not: neighbours hardly correlate."""
    rng, n = np.random.default_rng(5), 200
    white = np.array([whiteness(rng.standard_normal(n)).peak for _ in range(1000)])
    assert 0.03 < np.mean(white < 0.05) < 0.07 and 0.003 < np.mean(white < 0.01) < 0.02
    mode = 0.8 * np.sin(0.9 * np.arange(n))
    seen = [whiteness(mode + rng.standard_normal(n)) for _ in range(20)]
    assert sum(w.peak < 1e-3 for w in seen) >= 17 > sum(w.probability < 1e-3 for w in seen)


@pytest.mark.parametrize("seed", [0, 1])
def test_steps_follow_the_curved_valleys_of_networks(seed):
    """Straight steps, in which weights without effect went furthest, crept for hundreds of steps, and half of the
    searches ended at wrong laws."""
    rng, h = np.random.default_rng(seed), 4
    u = np.linspace(-1, 1, 120)
    y = np.clip(u, 0, None) + 1e-3 * rng.standard_normal(len(u))

    def parts(z):
        a, b, c = z[: 3 * h].reshape(3, h)
        values = np.tanh(np.outer(u, a) + b)
        return values, (1 - values**2) * c

    def residual(z):
        return parts(z)[0] @ z[2 * h : 3 * h] + z[-1] - y

    def evaluate(z):
        values, slope = parts(z)
        return Evaluation(residual(z), np.column_stack([slope * u[:, None], slope, values, np.ones_like(u)]))

    start = np.concatenate([rng.uniform(-1, 1, 2 * h), np.zeros(h + 1)])
    size, ones = len(start), np.ones_like(u)

    def weights(z, found):
        return Weights(1e3 * ones, np.full(size, 0.1), np.zeros(size), ones)

    ends = np.full(size, FREE[0]), np.full(size, FREE[1])
    plain = SumOfSquares(evaluate, weights, 1e-6, lambda factor: None, np.zeros(size, bool), None)
    found = descend(dataclasses.replace(plain, hidden=np.ones(size, bool), residual=residual), start, ends, None, 80)
    before = descend(plain, start, ends, None, 80)
    assert found.converged and len(found.history) < 80 and not before.converged
    assert found.cost < before.cost
    lower = scipy.optimize.least_squares(lambda z: np.concatenate([1e3 * residual(z), np.sqrt(0.1) * z]), found.z)
    assert found.cost < 1.001 * lower.cost


def test_the_finding_names_what_is_not_white():
    """A period of a day was reported as "neighbours correlate by 0.00"."""
    rng, n = np.random.default_rng(5), 480
    noise = rng.standard_normal(n)
    day = np.cos(2 * np.pi * np.arange(n) / 24) + noise
    assert whiteness(day).finding == "a period of 24 samples stands out"
    assert whiteness(np.cumsum(noise)).finding.startswith("neighbours correlate by 0.9")
    third = noise + 0.6 * np.roll(rng.permutation(noise), 3)
    third[3:] += 0.8 * noise[:-3]
    assert whiteness(third).finding.startswith("residuals 3 samples apart correlate by 0.")


@pytest.mark.parametrize("weak, moves", [(1e-17, 0.0), (1e-12, -2e12)])
def test_a_column_of_rounding_moves_nothing(weak, moves):
    """Of a parameter that cancels, rounding leaves a column of any direction, and a step along it was as long as it was
    wrong. A column that is weak but known gives the step of the normal equations: −2/weak for a residual of 2."""
    residual = np.array([1.0, 2.0, 0.0])
    jacobian = np.array([[1.0, 0.0], [0.0, weak], [0.0, 0.0]])
    factors = Factors.of(residual, jacobian, 1e-14)
    np.testing.assert_allclose(factors.step(0.0, factors.rank(1e-14)), [-1.0, moves], rtol=1e-10)
