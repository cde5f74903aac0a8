"""Flows of linear systems and the noise that they gather, against SciPy's exponentials and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from kalman import discretized, held

from jaxonomy_dae.learning.linear_models import affine_flow, linear_flow


@pytest.mark.slow
@pytest.mark.parametrize("n, h", [(1, 0.3), (3, 0.7), (4, 5.0)])
def test_against_exponentials(n, h):
    rng = np.random.default_rng(n)
    a, root = rng.standard_normal((n, n)), rng.standard_normal((n, n))
    g = root @ root.T
    flow, noise = jax.jit(linear_flow)(jnp.asarray(a), jnp.asarray(g), h)
    np.testing.assert_allclose(flow + np.eye(n), scipy.linalg.expm(a * h), rtol=1e-11, atol=1e-12 * np.abs(flow).max())
    np.testing.assert_allclose(noise, discretized(a, g, h)[1], rtol=1e-11, atol=1e-12 * np.abs(noise).max())
    # and what is pushed by first + rate·s, which is the same system with one more state
    first, rate = rng.standard_normal((2, n))
    bigger = np.block([[a, rate[:, None]], [np.zeros((1, n + 1))]])
    expected = held(bigger, np.append(first, 1.0), h)[:n]
    moved, phi, q = affine_flow(*(jnp.asarray(v) for v in (a, first, rate, g)), h)
    np.testing.assert_allclose(moved, expected, rtol=1e-10, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_allclose(phi, flow + np.eye(n), rtol=1e-10, atol=1e-11 * np.abs(flow).max())
    np.testing.assert_allclose(q, noise, rtol=1e-10, atol=1e-11 * np.abs(noise).max())


def test_stiff_and_unstable_scalars():
    """g (e^{2ah} − 1)/(2a), also where e^{−ah} would overflow; and its derivative by a."""
    for a in (-1e6, -3.0, 0.0, 2.0):
        found, slope = jax.jvp(lambda a: linear_flow(a[None, None], jnp.eye(1), 1.5)[1][0, 0], (a,), (1.0,))
        expected = np.expm1(3 * a) / (2 * a) if a else 1.5
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        derivative = (3 * np.exp(3 * a) - 2 * expected) / (2 * a) if a else 1.5**2
        np.testing.assert_allclose(slope, derivative, rtol=1e-9)


def test_no_time_changes_nothing():
    for found in linear_flow(jnp.eye(2), jnp.eye(2), jnp.zeros(())):
        np.testing.assert_array_equal(found, np.zeros((2, 2)))
