"""The noise that a linear system gathers, against Van Loan's exponential and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kalman import discretized

from jaxonomy_dae.learning.diffusion import linear_flow


@pytest.mark.parametrize("n, h", [(1, 0.3), (3, 0.7), (4, 5.0)])
def test_against_van_loan(n, h):
    rng = np.random.default_rng(n)
    a, root = rng.standard_normal((n, n)), rng.standard_normal((n, n))
    g = root @ root.T
    found = jax.jit(gathered_noise)(jnp.asarray(a), jnp.asarray(g), h)
    np.testing.assert_allclose(found, discretized(a, g, h)[1], rtol=1e-11, atol=1e-12 * np.abs(found).max())


def test_stiff_and_unstable_scalars():
    """g (e^{2ah} − 1)/(2a), also where e^{−ah} would overflow; and its derivative by a."""
    for a in (-1e6, -3.0, 0.0, 2.0):
        found, slope = jax.jvp(lambda a: linear_flow(a[None, None], jnp.eye(1), 1.5)[0, 0], (a,), (1.0,))
        expected = np.expm1(3 * a) / (2 * a) if a else 1.5
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        derivative = (3 * np.exp(3 * a) - 2 * expected) / (2 * a) if a else 1.5**2
        np.testing.assert_allclose(slope, derivative, rtol=1e-9)


def test_no_time_gathers_nothing():
    np.testing.assert_array_equal(linear_flow(jnp.eye(2), jnp.eye(2), jnp.zeros(())), np.zeros((2, 2)))
