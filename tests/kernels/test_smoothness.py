"""The prior of smoothness of a learned law, beside closed forms and a direct maximum of the evidence."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from jaxonomy_dae.compile.model.opaque import OpaqueFunction
from jaxonomy_dae.learning.coordinates import Coordinates
from jaxonomy_dae.learning.evaluation import Evaluation, Weights
from jaxonomy_dae.learning.evidence import Evidence, log_evidence
from jaxonomy_dae.learning.factors import Factors
from jaxonomy_dae.learning.smoothness import Bends, Law, directions, spread_out


class Polynomial(eqx.Module):
    """Linear in its weights, so that Laplace's approximation is exact."""

    weights: jnp.ndarray

    def __call__(self, u):
        return jnp.stack([sum(c * u[0] ** k for k, c in enumerate(self.weights))])


class Plane(eqx.Module):
    """Two outputs of two inputs."""

    weights: jnp.ndarray

    def __call__(self, u):
        a, b = self.weights
        return jnp.stack([a * u[0] ** 3, b * u[0] ** 2 * u[1] + 5 * u[0]])


def bends_of(module, points, size):
    opaque, count = OpaqueFunction(0, "f", None, points.shape[1], frozenset()), len(module.weights)
    law = Law(module, opaque, np.arange(count), points, size)
    none, zeros, flags = np.full(count, np.inf), np.zeros(count), np.zeros(count, bool)
    names = tuple(f"w[{k}]" for k in range(count))
    weights = Coordinates(
        names, ("",) * count, ("f",) * count, ~flags, flags, np.ones(count), zeros, -none, none, none, zeros, flags,
        n_shared=count, n_own=0, experiments=1,
    )  # fmt: skip
    return Bends.of((law,), weights, np.arange(count))


def test_derivatives_along_directions():
    """Third derivatives of a·x³ and b·x²·y along d = (p, q) of half ranges (s, t): 6·a·(p·s)³ and 6·b·(p·s)²·(q·t)."""
    points, size = np.array([[0.5, -1.0], [2.0, 0.0], [0.0, 0.0]]), np.array([2.0, 0.5])
    bends = bends_of(Plane(jnp.zeros(2)), points, size)
    values, slopes = bends.at(np.array([0.3, -0.7]))
    assert len(bends.owner) == 4 and len(values) == 4 * 3 * 4
    p, q = directions(2).T * size[:, None]
    root = np.sqrt(12)
    third = [6 * 0.3 * p**3, 6 * -0.7 * p**2 * q]
    second = [6 * 0.3 * np.multiply.outer(points[:, 0], p**2)]
    second.append(-0.7 * (2 * np.multiply.outer(points[:, 1], p**2) + 4 * np.multiply.outer(points[:, 0], p * q)))
    for k, expected in enumerate((second[0], np.tile(third[0], 3), second[1], np.tile(third[1], 3))):
        np.testing.assert_allclose(values[bends.group == k], np.ravel(expected) / root, atol=1e-12)
    np.testing.assert_allclose(values, slopes @ [0.3, -0.7], atol=1e-12)  # these laws are linear in their weights


def test_points_cover_what_was_seen():
    seen = np.random.default_rng(0).normal(size=(300, 2)) * [1.0, 1e5]
    chosen = spread_out(seen, 20)
    assert len(chosen) == 20 and len(np.unique(chosen, axis=0)) == 20
    scale = np.ptp(seen, axis=0)
    gaps = np.linalg.norm((seen[:, None] - chosen) / scale, axis=-1).min(axis=1)
    assert gaps.max() < 0.35
    assert len(spread_out(np.zeros((5, 1)), 20)) == 1


def test_precisions_are_those_of_greatest_evidence():
    """The fixed point of the updates, of a prior on weights and two of derivatives that overlap, is where the evidence
    that SciPy maximises is greatest."""
    rng, count = np.random.default_rng(1), 6
    x = np.linspace(-1, 1, 40)
    jacobian = np.vander(x, count, increasing=True) / 0.05
    data = (np.sin(2 * x) + 0.05 * rng.standard_normal(40)) / 0.05
    bends = bends_of(Polynomial(jnp.zeros(count)), np.linspace(-1, 1, 15)[:, None], np.ones(1))
    everything, z = np.ones(count, bool), np.zeros(count)
    evidence = Evidence(np.full(40, -1), (), np.zeros(0), (everything,), laws=(everything,))
    weights = Weights(np.ones(40), np.ones(count), np.zeros(count), np.ones(40), bends, np.full(2, 1e-3))

    def minimum(weights):
        rows = weights.applied(np.zeros(count), Evaluation(-data, jacobian))
        return np.linalg.lstsq(rows.jacobian, -rows.residual, rcond=None)[0]

    for _ in range(3000):
        z = minimum(weights)
        found = Evaluation(jacobian @ z - data, jacobian)
        factors = Factors.of(*weights.applied(z, found), 1e-12)
        weights, change = evidence.reweigh(z, found, weights, factors, everything, True)
        if change < 1e-9:
            break

    def minus(logs):
        precision, *stiffness = np.exp(logs)
        given = dataclasses.replace(weights, precision=np.full(count, precision), stiffness=np.array(stiffness))
        best = minimum(given)
        return -log_evidence(best, Evaluation(jacobian @ best - data, jacobian), given)

    here = np.log([weights.precision[0], *weights.stiffness])
    best = scipy.optimize.minimize(minus, here + 0.5, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-10})
    assert minus(here) < best.fun + 1e-5
    # by the closed form of the evidence of a linear model, N(0, I + J P⁻¹ Jᵀ)
    prior = weights.prior(z).jacobian
    covariance = np.eye(40) + jacobian @ np.linalg.solve(prior.T @ prior, jacobian.T)
    closed = -0.5 * data @ np.linalg.solve(covariance, data) - 0.5 * np.linalg.slogdet(covariance)[1]
    np.testing.assert_allclose(-minus(here), closed, rtol=1e-9)


class Ramp(eqx.Module):
    """Piecewise linear: no weight bends it."""

    weights: jnp.ndarray

    def __call__(self, u):
        return jnp.maximum(self.weights * u[0], 0.0)


def test_a_law_that_nothing_bends_has_no_prior_of_derivatives():
    """Its precision went to infinity, with a warning of NumPy."""
    everything, one = np.ones(1, bool), np.ones(1)
    bends = bends_of(Ramp(jnp.ones(1)), np.array([[0.5], [1.0]]), one)
    evidence = Evidence(np.full(3, -1), (), np.zeros(0), (everything,), laws=(everything,))
    weights = Weights(np.ones(3), one, np.zeros(1), np.ones(3), bends, np.ones(2))
    found = Evaluation(np.zeros(3), np.ones((3, 1)))
    factors = Factors.of(*weights.applied(one, found), 1e-12)
    better, change = evidence.reweigh(one, found, weights, factors, everything, True)
    np.testing.assert_array_equal(better.stiffness, [1.0, 1.0])
    assert np.isfinite(change) and np.isfinite(better.precision).all()
