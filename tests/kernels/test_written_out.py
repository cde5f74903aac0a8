"""Small linear systems whose elimination is written out, against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.solve.linear.written_out import solve


@pytest.mark.parametrize("n", [1, 2, 4, 6])
@pytest.mark.parametrize("positive", [False, True])
def test_unrolled_elimination(n, positive):
    rng = np.random.default_rng(n)
    a = rng.normal(size=(n, n, 5))  # a batch of five
    if positive:
        a = np.einsum("ikb,jkb->ijb", a, a) + np.eye(n)[:, :, None]
    elif n > 1:
        a[0, 0] = 0.0  # a pivot that must be avoided
    b = rng.normal(size=(n, 5))
    found = solve([[jnp.asarray(x) for x in row] for row in a], [jnp.asarray(x) for x in b], positive=positive)
    expected = np.linalg.solve(np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)[..., None])[..., 0].T
    # Rounding times the condition of random 6 by 6 matrices, some hundreds.
    np.testing.assert_allclose(np.stack(found), expected, rtol=1e-9)
