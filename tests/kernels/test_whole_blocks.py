"""Linear blocks that stay whole: solutions that equations determine, and only those."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.solve.linear.sparse import SparsePattern
from jaxonomy_dae.solve.linear.whole import LAPACK, solve_whole


def ring(n: int):
    """a·yₖ − yₖ₊₁ − yₖ₋₁ = (−1)ᵏ as a function of a, for an even n: yₖ = (−1)ᵏ/(a + 2), and at a = 2 whatever constant
    is added; there is no solution at a = −2."""
    k = np.arange(n)
    pattern = SparsePattern(np.tile(k, 3), np.concatenate([k, (k + 1) % n, (k - 1) % n]), n)
    right = jnp.asarray((-1.0) ** k)

    @jax.jit
    def solved(a):
        return solve_whole(pattern, jnp.concatenate([jnp.full(n, a), jnp.full(2 * n, -1.0)]), right)

    return solved, np.asarray(right)


@pytest.mark.parametrize("n", [LAPACK // 2, LAPACK + 12])
def test_singular_equations_that_agree_have_no_solution(n):
    """One of many is not returned: which, rounding would decide."""
    solved, right = ring(n)
    for a in (3.0, 2 + 1e-6, 2 + 1e-9):
        np.testing.assert_allclose(solved(a), right / (a + 2), rtol=1e-4)
    for a in (2.0, -2.0):
        assert np.isnan(solved(a)).all()


@pytest.mark.parametrize("n", [LAPACK // 2, LAPACK + 12])
def test_what_a_leak_determines_is_kept(n):
    """A row of unit resistors that only a leak of 1e-14 S holds, fed with 1e-14 A: by currents and potentials, every
    value is known to rounding, though the matrix is singular but for 1e-14."""
    rows, cols, values = [], [], []

    def put(row, col, value):
        rows.append(row)
        cols.append(col)
        values.append(value)

    m = n // 2  # potentials 0 … m − 1, then currents from each to the next; the last one is that of the leak
    right = np.zeros(2 * m)
    for k in range(m):
        put(k, m + k, 1.0)  # what comes in goes on
        if k:
            put(k, m + k - 1, -1.0)
        put(m + k, m + k, 1.0 if k < m - 1 else -1.0)  # v = i·1 Ω; i = G·v
        put(m + k, k, -1.0 if k < m - 1 else 1e-14)
        if k < m - 1:
            put(m + k, k + 1, 1.0)
    right[0] = 1e-14
    pattern = SparsePattern(np.array(rows), np.array(cols), 2 * m)
    found = jax.jit(lambda a, b: solve_whole(pattern, a, b))(jnp.asarray(values), jnp.asarray(right))
    np.testing.assert_allclose(found[:m], 1.0, rtol=1e-10)
