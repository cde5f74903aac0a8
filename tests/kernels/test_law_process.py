"""A learned law as a Gaussian process: its posterior and its evidence are those of normal distributions."""

import dataclasses
import itertools

import numpy as np
import pytest
import scipy.special
import scipy.stats

from jaxonomy_dae.learning.process import LENGTHS, SIZES, TRENDS, Kernel, Process, matern


def covariance(u, v, kernel):
    """k(u, v), written out."""
    d = np.sqrt(3) * np.abs(u[:, None, 0] - v[None, :, 0]) / kernel.length
    return kernel.size**2 * (1 + d) * np.exp(-d) + kernel.trend**2 * (1 + np.outer(u, v))


def given(rng, law):
    """(places, the law there, how 60 samples answer to it)."""
    places = np.linspace(-1, 1, 12)[:, None]
    return places, law(places), 3 * rng.standard_normal((60, 12))


def values_at(beyond):
    """The slopes of values `beyond` by heights."""
    return lambda kernel, places: kernel.between(beyond, places)


def conditioned(places, beyond, kernel, a, target):
    """(means, variances) beyond, of a normal distribution given a f + noise."""
    across = covariance(beyond, places, kernel)
    gain = across @ a.T @ np.linalg.inv(np.eye(len(a)) + a @ covariance(places, places, kernel) @ a.T)
    return gain @ target, np.diag(covariance(beyond, beyond, kernel) - gain @ a @ across.T)


def test_the_variance_is_that_of_normal_distributions():
    rng = np.random.default_rng(0)
    places, values, answers = given(rng, lambda u: 2.0 * np.abs(u) - 0.4)
    residual = rng.standard_normal(60)
    found = Process.of(places, values, answers, residual)
    assert found is not None and abs(sum(found.kernels.values()) - 1) < 1e-12
    beyond, size = np.array([[0.03], [0.7], [1.0], [4.0]]), np.sqrt(np.mean(values**2))
    target = answers @ values[:, 0] - residual
    each = [conditioned(places, beyond, k, size * answers, target) for k in found.kernels]
    means, variances = (size**n * np.array(part) for n, part in zip((1, 2), zip(*each, strict=True), strict=True))
    share = np.array(list(found.kernels.values()))
    expected = share @ (variances + (means - share @ means) ** 2)
    variance = found.variance(beyond, values_at(beyond))
    np.testing.assert_allclose(variance, expected, rtol=1e-4)
    assert variance[3] > 9 * variance[:3].max()  # what was not explored is not known


def test_the_evidence_is_the_density_of_the_data():
    """Beside that of another model of the same residuals, it decides."""
    rng = np.random.default_rng(1)
    places, values, answers = given(rng, np.sin)
    residual = rng.standard_normal(60)
    found = Process.of(places, values, answers, residual)
    assert found is not None
    size = np.sqrt(np.mean(values**2))
    a = size * answers
    densities = {}
    for kernel in itertools.starmap(Kernel, itertools.product(SIZES, TRENDS, LENGTHS)):
        cov = np.eye(60) + a @ covariance(places, places, kernel) @ a.T
        target = a @ values[:, 0] / size - residual
        densities[kernel] = scipy.stats.multivariate_normal(np.zeros(60), cov).logpdf(target)
    logs = np.array(list(densities.values()))
    expected = scipy.special.logsumexp(logs) - np.log(len(logs))
    np.testing.assert_allclose(-found.surprise - 30 * np.log(2 * np.pi), expected, rtol=1e-6)
    chosen = np.array([densities[kernel] for kernel in found.kernels])
    np.testing.assert_allclose(list(found.kernels.values()), scipy.special.softmax(chosen), rtol=1e-4)


def test_two_outputs_that_act_apart_are_those_of_one_each():
    rng = np.random.default_rng(2)
    places, values, answers = given(rng, np.cos)
    both = np.zeros((120, 24))
    both[:60, :12], both[60:, 12:] = answers, answers
    residual = rng.standard_normal(60)
    one = Process.of(places, values, answers, residual)
    two = Process.of(places, np.concatenate([values, values], axis=1), both, np.concatenate([residual, residual]))
    assert one is not None and two is not None
    best = max(one.kernels, key=lambda k: one.kernels[k])
    one, two = (dataclasses.replace(p, kernels={best: 1.0}) for p in (one, two))
    beyond = np.array([[0.2], [1.7]])
    alone = one.variance(beyond, values_at(beyond))
    for k in (0, 1):
        apart = two.variance(beyond, lambda *a, k=k: np.kron(np.eye(2)[[k]], values_at(beyond)(*a)))
        np.testing.assert_allclose(apart, alone, rtol=1e-9)


@pytest.mark.slow
def test_bands_cover_laws_as_often_as_they_say():
    """Laws drawn from a process whose kernel is not known, from records that gather what the law does."""
    rng, inside = np.random.default_rng(3), []
    places = np.linspace(-1, 1, 20)[:, None]
    for _ in range(25):
        law = Kernel(1.0, 1.0, rng.choice([0.4, 0.8, 1.6])).root(places) @ rng.standard_normal((20, 1))
        answers = 5 * np.tri(40, 20)[:, rng.permutation(20)]
        noise = rng.standard_normal(40)
        found = Process.of(places, law, answers, noise)  # residuals at the law itself: A f − y
        assert found is not None
        size, target = np.sqrt(np.mean(law**2)), answers @ law[:, 0] - noise
        means = [size * conditioned(places, places, k, size * answers, target)[0] for k in found.kernels]
        off = np.array(list(found.kernels.values())) @ means - law[:, 0]
        inside.append(np.mean(off**2 <= 1.96**2 * found.variance(places[:0], values_at(places))))
    assert 0.91 <= np.mean(inside) <= 0.98  # 0.95, by 25 laws


def test_a_law_that_is_zero_has_no_size():
    assert Process.of(np.zeros((3, 1)), np.zeros((3, 1)), np.ones((5, 3)), np.ones(5)) is None


def test_correlations_of_matern():
    """At a distance of one length: (1 + √3) exp(−√3)."""
    found = matern(np.zeros((1, 2)), np.array([[3.0, 4.0], [0.0, 0.0]]), 5.0)
    np.testing.assert_allclose(found, [[(1 + np.sqrt(3)) * np.exp(-np.sqrt(3)), 1.0]], rtol=1e-14)
