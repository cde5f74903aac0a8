"""The system's Jacobian and its pattern, from the structure, against dense automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import rc_ladder
from shared_models import MODELS, cascade

from jaxonomy_dae import ModelError
from jaxonomy_dae.compile.lowering import pattern
from jaxonomy_dae.run.system.nonlinear import Refinement


def covers(found, dense: np.ndarray):
    """Whether all entries of a matrix that are not zero are in the pattern."""
    inside = np.zeros(dense.shape, bool)
    inside[found] = True
    return not np.any(dense[~inside])


QUICK = ("cascade",)


DENSE = [m for m in MODELS if m != "nonlinear grid"]  # whose program takes XLA half a minute


@pytest.mark.parametrize("model", [m if m in QUICK else pytest.param(m, marks=pytest.mark.slow) for m in DENSE])
def test_jacobian_is_the_dense_one(model):
    system = MODELS[model]()

    @jax.jit
    def both():
        x = system.initialize()
        return jax.jacfwd(lambda x: system.vector_field(0.2, x))(x), system.jacobian(0.2, x).dense()

    dense, written = (np.asarray(v) for v in both())
    # A Newton correction at a solution passes derivatives with respect to its start that are rounding errors.
    dense = np.where(np.abs(dense) < 1e-9, 0.0, dense)
    found = system.jacobian_pattern
    assert found.shape == dense.shape and covers((found.rows, found.cols), dense)
    np.testing.assert_allclose(written, dense, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize(
    "model", [pytest.param(m, marks=pytest.mark.slow) for m in ("pendulum, minimal", "nonlinear grid")] + ["implicit"]
)
def test_pattern_of_the_semi_explicit_form(model):
    """F = [f(t, x, z); g(t, x, z)], at any z, not only a solution."""
    system = MODELS[model]()
    n, plan = len(system.states), system.plan
    state = np.random.default_rng(0).uniform(0.4, 1.2, plan.n_state)

    def residual(state):
        point = system.at(0.2, None)
        f = point.run(plan.derivative, state, Refinement.NONE).read(plan.next_derivative)
        return jnp.concatenate([jnp.broadcast_to(f, (n,)), point.carried_vector(point.t, state)])

    assert len(system.carried)
    dense = np.asarray(jax.jit(jax.jacfwd(residual))(state))
    rows, columns = plan.dae_pattern.rows, plan.dae_pattern.cols
    assert covers((rows, columns), dense)
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows)
    if model == "nonlinear grid":  # no row has more entries than a node has neighbours, with their currents
        assert len(rows) < 6 * plan.n_state


@pytest.mark.parametrize("n", [100, pytest.param(20_000, marks=pytest.mark.slow)])
def test_ladder_is_tridiagonal(n):
    system = rc_ladder(n)
    found = system.jacobian_pattern
    k = np.arange(n)
    expected = np.concatenate([k * n + k, k[1:] * n + k[:-1], k[:-1] * n + k[1:]])
    np.testing.assert_array_equal(np.sort(found.rows.astype(np.int64) * n + found.cols), np.sort(expected))
    assert found.n_colors == 3

    # With all resistances and capacitances 1: −2 on the diagonal (−1 at the end), 1 beside it.
    def at(x):
        jacobian = system.jacobian(0.0, x)
        return jacobian.values, jacobian @ x

    values, product = jax.jit(at)(np.ones(n))
    dense = np.where(found.rows == found.cols, np.where(found.rows == n - 1, -1.0, -2.0), 1.0)
    np.testing.assert_allclose(values, dense, rtol=1e-12)
    np.testing.assert_allclose(product, np.eye(1, n)[0] * -1.0, atol=1e-12)


def test_large_and_dense_is_said(monkeypatch):
    monkeypatch.setattr(pattern, "LIMIT", 50)
    system = cascade(12)
    assert system.jacobian_pattern is None and system.plan.dae_pattern is None
    with pytest.raises(ModelError, match="dense"):
        system.jacobian(0.0, jnp.zeros(12))
