"""One block of equations after the other, from a start far off: a system whose roots are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.run.start.sizes import Sizes
from jaxonomy_dae.run.start.stages import solve_in_stages


@pytest.mark.parametrize("start", [[1.0, 1.0, 1.0, 1.0], [50.0, -3.0, 0.1, 7.0]])
def test_blocks_are_solved_in_their_order(start):
    """x0³ = 8; then x1 + x2 = x0 and x1 − x2 = x0²; then exp(x3) = x1 + 2, rows listed in another order."""

    def function(x):
        return jnp.stack([jnp.exp(x[3]) - x[1] - 2, x[1] - x[2] - x[0] ** 2, x[0] ** 3 - 8, x[1] + x[2] - x[0]])

    nothing = jnp.zeros(4)
    row_of, block = np.array([2, 3, 1, 0]), np.array([0, 1, 1, 2])
    found = jax.jit(
        lambda x: solve_in_stages(function, x, Sizes(nothing, jnp.abs(x), nothing, nothing), row_of, block)
    )(jnp.array(start))
    np.testing.assert_allclose(found, [2.0, 3.0, -1.0, np.log(5.0)], rtol=1e-12)
