"""Gradients: reverse mode, forward mode and central differences agree, for all that a loss can depend on."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from problems import compiled, drag_on, mlp, pendulum
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der, simulate

TIMES = np.array([0.5, 1.0, 1.5])
WEIGHTS = np.array([[1.0, -0.7, 0.4], [0.3, 0.8, -0.5], [0.05, -0.04, 0.03]])  # of x, y, lam at the three times
TRAINED = ("drag", "pend.m", "pend.L", "pend.g_y", "pend.initial_theta")


# Tight, so that what central differences see of the step-size control is below 1e-6 of the gradient. Between the modes
# it must not be tight: where rounding is a part of the error estimate that counts, two programs take other steps.
TIGHT, MODERATE = 1e-11, 1e-9


def three_time_loss(trainable, frozen, rtol=TIGHT, adjoint=None):
    """Position and tension at three times, so that every trained quantity matters, the mass too."""
    solution = simulate(eqx.combine(trainable, frozen), 1.5, ts=TIMES, rtol=rtol, atol=rtol / 10, adjoint=adjoint)
    seen = jnp.stack([solution["pend.x"], solution["pend.y"], solution["pend.lam"]])
    return jnp.sum(WEIGHTS * seen**2)


class Gradients:
    """Of the three-time loss in one flat vector: the networks' weights last, parameters as in `TRAINED` before."""

    def __init__(self, mode):
        system = pendulum(
            drag_on("vx", "vy", network=mlp(2, 2)), initial_omega=0.3, m=0.8, L=1.2, compiler={"state_selection": mode}
        )
        trainable, frozen = system.partition(*TRAINED)
        self.flat, unravel = ravel_pytree(trainable)

        @jax.jit
        def value_and_gradient(flat, rtol):
            return jax.value_and_grad(lambda f: three_time_loss(unravel(f), frozen, rtol))(flat)

        @jax.jit
        def forward(flat):
            return jax.jacfwd(lambda f: three_time_loss(unravel(f), frozen, MODERATE, diffrax.ForwardMode()))(flat)

        self.value = lambda flat: value_and_gradient(flat, np.array(TIGHT))[0]
        self.reverse = lambda rtol: np.asarray(value_and_gradient(self.flat, np.array(rtol))[1])
        self._forward = forward
        names = jax.tree.map(lambda leaf: np.zeros(leaf.shape), trainable)
        names = eqx.tree_at(lambda s: s.parameters.free, names, np.arange(1.0, len(TRAINED)))
        kind = np.asarray(ravel_pytree(names)[0]).astype(int)
        self.where = {name: np.flatnonzero(kind == k) for k, name in enumerate(TRAINED)}

    @functools.cached_property
    def forward(self):
        return np.asarray(self._forward(self.flat))


@pytest.fixture(scope="module", params=["auto", "dummy_derivatives"])
def gradients(request):
    return Gradients(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("gradients", ["auto"], indirect=True, scope="module")
@pytest.mark.parametrize("name", TRAINED)
def test_reverse_equals_forward(gradients, name):
    reverse, forward = (g[gradients.where[name]] for g in (gradients.reverse(MODERATE), gradients.forward))
    size = np.max(np.abs(reverse))
    assert size > 1e-3  # the loss depends on it
    # Both differentiate the same steps exactly: 1e-11 is rounding, amplified by some hundred steps.
    np.testing.assert_allclose(reverse, forward, rtol=1e-11, atol=1e-11 * size)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINED)
def test_reverse_equals_central_differences(gradients, name):
    direction = np.zeros(gradients.flat.shape)
    where = gradients.where[name]
    direction[where] = np.random.default_rng(0).normal(size=len(where))
    slope = float(gradients.reverse(TIGHT) @ direction)

    def quotient(h):
        up, down = (gradients.value(np.asarray(gradients.flat) + s * h * direction) for s in (1.0, -1.0))
        return float(up - down) / (2 * h)

    # Richardson's extrapolation leaves O(h⁴); the solves' error 1e-11 divided by h = 1e-3 leaves 1e-8.
    difference = (4 * quotient(1e-3) - quotient(2e-3)) / 3
    assert slope == pytest.approx(difference, rel=1e-6)


class Driven(Component):
    """x'' = u − ω²·x, started at rest from x0: x = x0·cos(ωt) + forced part."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        w = self.parameter("w", 2.0)
        x0 = self.parameter("x0", 0.5)
        x, v = self.variable("x", start=x0, fixed=True), self.variable("v", start=0, fixed=True)
        u = self.input("u", default=0.0)
        self.add_equations(Eq(der(x), v), Eq(der(v), u - w**2 * x))


class Ramp(eqx.Module):
    """u(t) = a + b·t."""

    a: jax.Array
    b: jax.Array

    def __call__(self, t):
        return self.a + self.b * t


VALUES = {k: np.array(v) for k, v in dict(w=2.0, x=0.3, v=-0.2, a=0.7, b=0.4).items()}


@pytest.fixture(scope="module")
def driven():
    """The loss x(1) + 2·x(2) of (parameters, initial values, input), and its value and gradient."""
    system = compiled(Driven(EqnEnv(), "mass"))

    def loss(values, adjoint=None):
        changed = system.with_parameters({"mass.w": values["w"]})
        solution = simulate(
            changed,
            2.0,
            ts=np.array([1.0, 2.0]),
            initial={"mass.x": values["x"], "mass.v": values["v"]},
            inputs={"mass.u": Ramp(values["a"], values["b"])},
            rtol=1e-11,
            atol=1e-12,
            adjoint=adjoint,
        )
        return solution["mass.x"] @ np.array([1.0, 2.0])

    return loss, functools.cache(lambda: jax.jit(jax.value_and_grad(loss))(VALUES))


def driven_reference(v):
    """x(1) + 2·x(2) in closed form: particular solution (a + b·t)/ω² plus a free oscillation."""
    w = v["w"]

    def x(t):
        free = (v["x"] - v["a"] / w**2) * jnp.cos(w * t) + (v["v"] - v["b"] / w**2) / w * jnp.sin(w * t)
        return (v["a"] + v["b"] * t) / w**2 + free

    return x(1.0) + 2 * x(2.0)


@pytest.mark.long("one gradient by everything that a run depends on")
def test_parameters_initial_values_and_inputs_against_the_closed_form(driven):
    value, reverse = driven[1]()
    expected, slopes = jax.jit(jax.value_and_grad(driven_reference))(VALUES)
    assert float(value) == pytest.approx(float(expected), abs=1e-9)  # a hundred times the tolerance
    for name in VALUES:
        assert float(reverse[name]) == pytest.approx(float(slopes[name]), rel=1e-8), name  # likewise


@pytest.mark.slow
def test_parameters_initial_values_and_inputs_in_forward_mode(driven):
    loss, reverse = driven
    forward = jax.jit(jax.jacfwd(lambda values: loss(values, diffrax.ForwardMode())))(VALUES)
    for name in VALUES:
        assert float(forward[name]) == pytest.approx(float(reverse()[1][name]), rel=1e-9), name
