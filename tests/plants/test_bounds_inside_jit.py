"""Declared bounds hold, and numbers must be finite, where values are not known: inside jit, vmap, grad and loops of
users. What is not admitted is NaN, has a code of its own, and costs no steps."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import compiled, component
from sympy import Eq

from jaxonomy_dae import ModelError, der, simulate

ENDS = jnp.array([1.0])


def write(self, ev):
    """x' = u − k·x with k in [0, 10], and k/4 in [0, 1]."""
    k = self.parameter("k", 1.0, bounds=(0.0, 10.0))
    self.parameter("quarter", k / 4, bounds=(0.0, 1.0))
    self.add_equations(Eq(der(self.variable("x", start=1.0, fixed=True)), self.input("u") - k * self.x))


@pytest.fixture(scope="module")
def system():
    return compiled(component(write))


def end(system, u):
    solution = simulate(system, 1.0, ts=ENDS, inputs={"c.u": u})
    return solution["c.x"][0], (solution.result, solution.stats["num_steps"])


@pytest.fixture(scope="module")
def gradient(system):
    """Values, codes, steps, and derivatives by k, for a batch of (k, u)."""
    of_k = jax.value_and_grad(lambda k, u: end(system.with_parameters({"c.k": k}), u), has_aux=True)
    return jax.jit(jax.vmap(of_k))


@pytest.mark.slow
def test_values_out_of_bounds_are_not_a_number(gradient):
    """k = −3 gave exp(3) inside jit; k = 5 puts the parameter computed from it out of its bounds. One member of a batch
    with NaN made all wait for max_steps rejected steps, and was called `max_steps_reached`."""
    k, u = jnp.array([-3.0, 2.0, 5.0, jnp.nan, 1.0]), jnp.array([0.0, 0.0, 0.0, 0.0, jnp.inf])
    (x, (result, steps)), slope = gradient(k, u)
    bad = np.array([True, False, True, True, True])
    assert np.array_equal(np.isnan(x), bad) and np.array_equal(np.isnan(slope), bad)
    assert float(x[1]) == pytest.approx(np.exp(-2.0), abs=1e-6)
    assert float(slope[1]) == pytest.approx(-np.exp(-2.0), abs=1e-5)
    assert np.array_equal(result == diffrax.RESULTS.nonfinite, bad)
    assert np.array_equal(np.asarray(steps) == 0, bad)


@pytest.mark.slow
def test_what_a_loss_leaves_out_does_not_reach_its_gradient(system):
    @jax.jit
    @jax.grad
    def loss(k):
        x, (result, _) = end(system.with_parameters({"c.k": k}), 0.0)
        return jnp.where(diffrax.is_okay(result), x, k**2)

    assert float(loss(-3.0)) == -6.0


@pytest.mark.slow
def test_however_values_arrive(system):
    """By `partition`, as in a loop of a user's own with Optax, and put among the leaves by hand."""
    trainable, frozen = system.partition("c.k")
    updated = optax.apply_updates(trainable, jax.tree.map(lambda leaf: jnp.full_like(leaf, -3.0), trainable))
    combined = eqx.combine(updated, frozen)
    by_hand = eqx.tree_at(lambda s: s.parameters.values, system, system.parameters.values - 3.0)
    run = eqx.filter_jit(end)
    for changed in (combined, by_hand):
        x, (result, _) = run(changed, 0.0)
        assert np.isnan(x) and result == diffrax.RESULTS.nonfinite
        with pytest.raises(ModelError, match=r"parameter 'c\.k' must lie in \[0, 10\]; got -2\. Set it with"):
            end(changed, 0.0)
    assert np.isnan(jax.jit(lambda s: s.vector_field(0.0, jnp.ones(1), {"c.u": 0.0}))(combined)).all()


@pytest.mark.slow
def test_an_input_that_stops_being_finite(system):
    """√(a − t) from t = a on, which only the run meets."""
    run = jax.jit(lambda a: end(system, lambda t: jnp.sqrt(a - t)))
    (x, (result, _)), (_, (fine, _)) = run(0.5), run(2.0)
    assert np.isnan(x) and result == diffrax.RESULTS.nonfinite and fine == diffrax.RESULTS.successful


@pytest.mark.slow
def test_a_run_backwards(system):
    """Refused where t1 is known, and as little a result where it is not."""
    run = jax.jit(
        lambda t1: (lambda s: (s["c.x"][-1], s.result))(simulate(system, t1, inputs={"c.u": 0.0}, max_steps=64))
    )
    (x, result), (back, code) = run(1.0), run(-1.0)
    assert result == diffrax.RESULTS.successful and np.isclose(x, np.exp(-1), rtol=1e-5)
    assert code == diffrax.RESULTS.nonfinite and np.isnan(back)


@pytest.mark.slow
def test_a_loop_of_a_users_own_in_free_numbers(system):
    """k = 0.2 found by Optax from data, by steps that would leave [0, 10] if they were taken in k."""
    optimizer = optax.adam(0.3)

    @jax.jit
    def step(free, state):
        value, slope = jax.value_and_grad(lambda f: (end(system.constrain(f), 0.0)[0] - jnp.exp(-0.2)) ** 2)(free)
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimizer.update(slope, state, free)
        return optax.apply_updates(free, updates), state, value

    free = system.unconstrain("c.k")
    state = optimizer.init(free)
    seen = []
    for _ in range(200):
        free, state, _ = step(free, state)
        seen.append(float(system.constrain(free).parameters["c.k"]))
    assert max(np.abs(np.diff(seen))) > 0.1 and 0.0 < min(seen) and max(seen) < 10.0
    assert seen[-1] == pytest.approx(0.2, abs=1e-2)
