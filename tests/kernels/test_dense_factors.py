"""Factors of dense matrices, whatever the units of their rows."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.solve.linear.algebra import EXPLICIT_INVERSE, Dense


@pytest.mark.parametrize("blocks", [2, 4, EXPLICIT_INVERSE])
def test_units_of_rows_do_not_choose_pivots(blocks):
    """Kind: a result that hangs on the unit of an equation. Blocks [[ε, 1], [1, 1]] are well conditioned, but with
    their first row in units of 1e12 ε is the larger pivot, and the elimination loses the 1 beside 1/ε: ten digits."""
    n = 2 * blocks
    matrix = np.kron(np.eye(blocks), [[1e-10, 1.0], [1.0, 1.0]]) + 1e-3 * np.roll(np.eye(n), 3, axis=1)
    unit = np.tile([1e12, 1.0], blocks)
    expected = np.linspace(1.0, 2.0, n)
    scaled = unit[:, None] * matrix
    factor = Dense().factor(jnp.asarray(scaled))
    np.testing.assert_allclose(Dense().apply(factor, None, jnp.asarray(scaled @ expected)), expected, rtol=1e-12)
    transposed = Dense().apply_transposed(factor, jnp.asarray(scaled.T @ (expected / unit)))
    np.testing.assert_allclose(transposed * unit, expected, rtol=1e-12)
