"""What a user's own code checks while it runs stays checked, wherever it stands, eagerly and in a user's jit; and a
program without such checks holds no callback to the host."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from problems import compiled

from jaxonomy_dae import Component, EqnEnv, der, simulate
from jaxonomy_dae.solvers import DAETerm, Rodas5P, solve_dae

LEAST = 0.3  # of x, which decays from 1 to exp(−2)
TS = jnp.array([0.5, 1.0])


@jax.jit
def pulled(x):
    """−2·x, for x that is not small."""
    return -2.0 * eqx.error_if(x, x < LEAST, "x left its range")


class Net(eqx.Module):
    gain: jax.Array

    def __call__(self, u):
        return self.gain * eqx.error_if(u, u[0] > 2.0, "the network was not trained there")


@jax.jit
def cube_root(x):
    """By Newton's method, which two steps do not bring to the end from far away."""
    method = optx.Newton(rtol=1e-8, atol=1e-8)
    return optx.root_find(lambda y, x: y**3 - x, method, jnp.ones_like(x), x, max_steps=8).value


class Checked(Component):
    """x' = f(x) + N(x) + u·(root of y³ = 1 + w)/(1 + w)^⅓."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        u, w = self.input("u", default=0.0), self.input("w", default=0.0)
        (f,) = self.function("f", pulled, [x])
        (n,) = self.learned("n", Net(jnp.zeros(1)), [x])
        (y,) = self.function("y", lambda w: cube_root(1.0 + w), [w])
        self.add_equations(der(x) - f - n - u * y)


@pytest.fixture(scope="module")
def checked():
    return compiled(Checked(EqnEnv(), "c"))


def late(t):
    return 0.0 * eqx.error_if(t, t > 0.7, "the input ends there")


CASES = {
    "function": ("x left its range", 1.0, {}, {}),
    "network": ("the network was not trained there", 0.2, {"c.x": 3.0}, {}),
    "input": ("the input ends there", 0.9, {"c.x": 2.0}, {"c.u": late}),
    "root": ("nonlinear solve", 0.2, {}, {"c.w": 1e12}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow if c == "root" else ()) for c in CASES])
def test_a_check_in_a_compiled_model(checked, case):
    message, t1, initial, inputs = CASES[case]

    def final(x0):
        start = {"c.x": initial.get("c.x", 1.0) * x0}
        return simulate(checked, t1, initial=start, inputs=inputs, ts=TS * t1, solver=diffrax.Tsit5())["c.x"]

    for run in (final, eqx.filter_jit(final)):
        with pytest.raises(Exception, match=f"(?s){message}"):
            jax.block_until_ready(run(1.0))


@pytest.mark.slow
def test_users_jitted_functions_keep_their_checks(checked):
    """They were traced inside: JAX keeps such a trace for the whole process."""
    found = simulate(checked, 0.5, ts=TS / 2, solver=diffrax.Tsit5())["c.x"]
    np.testing.assert_allclose(found, np.exp(-TS), rtol=1e-5)
    for function, bad in ((pulled, 0.1), (cube_root, 1e12)):
        with pytest.raises(Exception, match="(?s)x left its range|nonlinear solve"):
            jax.block_until_ready(eqx.filter_jit(function)(bad))
        assert "callback" in str(jax.make_jaxpr(function)(0.1))


@pytest.mark.slow
def test_a_check_in_a_dae():
    """y' = −a·y, and the derivative of y(1) by a; with a = 2 it falls below what is checked."""

    def field(t, y, a):
        return -a * eqx.error_if(y, y[0] < LEAST, "y left its range")

    def end(a):
        return solve_dae(DAETerm(field, mass=[1.0]), 1.0, jnp.ones(1), args=a, solver=Rodas5P(), rtol=1e-8).ys[0, 0]

    both = eqx.filter_jit(jax.value_and_grad(end))
    np.testing.assert_allclose(both(1.0), [np.exp(-1), -np.exp(-1)], rtol=1e-6)
    for find in (end, both):
        with pytest.raises(Exception, match="(?s)y left its range"):
            jax.block_until_ready(find(2.0))
