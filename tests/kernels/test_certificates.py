"""Checks of derivatives and of passivity, on functions whose answer is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import ModelError, learning
from jaxonomy_dae.testing import assert_gradient, assert_passive
from jaxonomy_dae.testing.gradient import _difference


def test_differences_find_a_derivative_and_their_own_error():
    """Ridders' extrapolation on closed forms: the error is no larger than estimated."""
    for f, slope in ((np.exp, 1.0), (np.sin, 1.0), (lambda s: 1 / (1 + s), -1.0), (lambda s: 3.0 * s, 3.0)):
        found, error = _difference(lambda s, f=f: float(f(s)))
        assert abs(found - slope) <= max(error, 1e-12) < 1e-8
    found, error = _difference(lambda s: float(np.exp(s) + 1e-4 * np.sin(1e7 * s)))
    assert error > 1e-4 and abs(found - 1) < 5 * error


def test_right_derivatives_are_certified():
    at = {"a": jnp.array([0.3, -2.0]), "k": 1e5, "n": 3}
    found = assert_gradient(lambda p: jnp.sum(jnp.sin(p["a"])) * p["n"] + jnp.log(p["k"]), at, rtol=1e-8)
    assert found.holds and found.error < 1e-9 and "each of 3 numbers" in repr(found) and "passed" in repr(found)
    many = assert_gradient(lambda x: jnp.cumsum(x**3), jnp.linspace(-1.0, 1.0, 40), rtol=1e-8)
    assert "8 random directions of 40" in many.checked


@jax.custom_vjp
def off(x):
    return x**2


off.defvjp(lambda x: (x**2, x), lambda x, g: (2.002 * x * g,))


@jax.custom_jvp
def off_both(x):
    return x**2


off_both.defjvp(lambda p, t: (p[0] ** 2, 2.002 * p[0] * t[0]))


def test_wrong_derivatives_are_found_and_placed():
    with pytest.raises(AssertionError, match=r"failed: derivatives .*(?s:.*)along \['b'\]"):
        assert_gradient(lambda p: p["a"] + off_both(p["b"]), {"a": 2.0, "b": 3.0}, rtol=5e-4)
    assert_gradient(lambda p: p["a"] + off_both(p["b"]), {"a": 2.0, "b": 3.0}, rtol=2e-3)  # off by a thousandth
    with pytest.raises(ModelError, match="cannot be differentiated forwards"):
        assert_gradient(off, 3.0)


def test_what_cannot_be_told_is_no_pass():
    noise = jax.jit(lambda x: jnp.exp(x) + 1e-3 * jax.lax.stop_gradient(jnp.sin(1e9 * x)))
    with pytest.raises(AssertionError, match="are good to .* only"):
        assert_gradient(noise, 0.5, rtol=1e-4)
    with pytest.raises(AssertionError, match="not finite"):
        assert_gradient(lambda x: jnp.sqrt(x), 0.0)
    with pytest.raises(ModelError, match="no floating-point numbers"):
        assert_gradient(lambda x: x, 3)
    with pytest.raises(ModelError, match="outside jit, grad and vmap"):
        jax.jit(lambda x: assert_gradient(jnp.sin, x).error)(0.5)
    with pytest.raises(ModelError, match="must return floating-point numbers"):
        assert_gradient(lambda x: jnp.sum(x > 0), jnp.ones(2))


LAWS = {  # networks, made by the tests that read them: making one compiles programs
    "Passive": lambda: learning.Passive(2, key=jax.random.key(0)),
    "Passive of a context": lambda: learning.Passive(
        1, context=1, key=jax.random.key(1), inputs=[0.1, 300.0], power=1e3
    ),
    "IsotropicPassive": lambda: learning.IsotropicPassive(2, key=jax.random.key(2), inputs=3.0, power=13.0),
    "Dissipation": lambda: learning.Dissipation(2, 1, key=jax.random.key(3)),
    "PortHamiltonian": lambda: learning.PortHamiltonian(2, key=jax.random.key(4)),
}


@pytest.mark.parametrize("name", LAWS)
def test_laws_keep_their_promise_whatever_their_weights(name):
    law = LAWS[name]()
    found = assert_passive(law, weights=20)
    assert found.holds and "20 sets" in found.checked


@pytest.mark.slow
def test_callables_are_sampled_and_climbed():
    assert_passive(lambda v: -v * jnp.sum(v**2), 3)
    assert_passive(lambda u: -u[:1] * jnp.exp(-u[1]), 1, inputs=[1.0, 0.2])
    with pytest.raises(AssertionError, match="no finite value at u = "):
        assert_passive(lambda u: -u[:1] * jnp.exp(-u[1]), 1, inputs=[1.0, 2.0])
    with pytest.raises(AssertionError, match="no finite value at u = "):
        assert_passive(lambda v: v * jnp.nan, 1)
    turned = jnp.array([[-1.0, 5.0], [-5.0, -1.0]])
    assert_passive(lambda v: turned @ v, 2)
    with pytest.raises(AssertionError, match=r"failed: the law brings no energy in(?s:.*)at u = "):
        assert_passive(lambda v: turned @ v + jnp.array([[0.0, 0.0], [0.0, 1.5]]) @ v, 2)
    narrow = 5e-5  # active where v points along (1, 2, 3) to within 1/100: 2.5e-5 of all directions

    def law(v):
        along = v @ jnp.array([1.0, 2.0, 3.0]) / jnp.sqrt(14.0) / jnp.linalg.norm(v)
        return v * (2 / (1 + (1 - along) / narrow) - 1)

    with pytest.raises(AssertionError, match="brings no energy in"):
        assert_passive(law, 3)


def test_passivity_needs_to_know_the_inputs():
    with pytest.raises(ModelError, match="how many inputs has the law"):
        assert_passive(lambda v: -v)
    with pytest.raises(ModelError, match="must return shape"):
        assert_passive(lambda v: -v[:1], 2)
    with pytest.raises(ModelError, match="has size 2"):
        assert_passive(LAWS["Passive"](), 3)
    with pytest.raises(ModelError, match="typical sizes > 0"):
        assert_passive(lambda v: -v, 2, inputs=[1.0])
    with pytest.raises(ModelError, match="size is a whole number"):
        assert_passive(lambda v: -v, 0)
    for given in ({"weights": -1}, {"count": 0}):  # an active law passed: no set of weights was looked at
        with pytest.raises(ModelError, match="is a whole number"):
            assert_passive(lambda v: v, 1, **given)
    with pytest.raises(ModelError, match="directions is a whole number ≥ 1; got 0"):
        assert_gradient(lambda x: jnp.sum(x**2), jnp.ones(20), directions=0)
    plain = eqx.nn.MLP(2, 2, 8, 2, jnp.tanh, key=jax.random.key(0))
    with pytest.raises(AssertionError):
        assert_passive(plain, 2)
