"""One search for roots in NumPy and JAX, alone and in batches: where whole steps diverge, where nothing leads on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.solve.linear.newton import Tried, newton, twice


def arctan(xp):
    """arctan(x) = 0: from beyond 1.39 whole Newton steps diverge."""

    def look(x, part, least):
        value = xp.arctan(x)
        return Tried(abs(value) < (1 - part / 4) * least, abs(value) < 1e-14, -value * (1 + x**2), abs(value))

    return look


@pytest.mark.parametrize("start", [0.0, 1.0, 3.0, -20.0])
def test_numpy_and_jax_take_the_same_steps(start):
    begin = np.asarray(start), np.asarray(np.inf)
    here = newton(arctan(np), *begin, 60)
    there = jax.jit(lambda x, least: newton(arctan(jnp), x, least, 60))(*map(jnp.asarray, begin))
    assert here.holds and there.holds and abs(here.x) < 1e-14 and int(here.count) == int(there.count)
    assert isinstance(here.x, np.ndarray | np.floating)


def test_members_of_a_batch_are_on_their_own():
    starts = jnp.array([0.0, 1.0, 3.0, -20.0, jnp.nan])
    found = jax.jit(lambda x: newton(arctan(jnp), x, jnp.full(5, jnp.inf), 60, 1e-6, batch=(5,)))(starts)
    np.testing.assert_array_equal(found.holds, [True, True, True, True, False])
    np.testing.assert_allclose(found.x[:4], 0.0, atol=1e-14)


def test_where_no_step_helps_the_search_ends():
    """x² + 1: no root. The step from the lowest point is infinite, and no part of it helps."""

    def look(x, part, least):
        value = x**2 + 1
        return Tried(value < (1 - part / 4) * least, value < 1e-14, -value / (2 * x), value)

    with np.errstate(all="ignore"):
        found = newton(look, np.asarray(1.0), np.asarray(np.inf), 1000, 1e-6)
    assert not found.holds and found.count < 60


def test_two_steps_carry_first_and_second_derivatives():
    """x² = p at p = 4: x = 2, 1/4, −1/32."""

    def root(p):
        return twice(lambda x: (x - (x**2 - p) / 4.0, x), jnp.asarray(2.0))[0]

    p = jnp.asarray(4.0)
    derivatives = root(p), jax.grad(root)(p), jax.hessian(root)(p)
    np.testing.assert_allclose(derivatives, [2.0, 0.25, -1 / 32], rtol=1e-12)
