"""Second derivatives of runs and of consistent starts, against closed forms and differences of values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, pendulum
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der, simulate

TS = jnp.array([0.5, 1.0])


@pytest.mark.slow
def test_of_a_model():
    """A pendulum in Cartesian coordinates, by its rod's length: against second differences of the values."""
    system = pendulum()

    def x(length):
        changed = system.with_parameters({"pend.L": length})
        return simulate(changed, 1.0, ts=TS, rtol=1e-11, atol=1e-12)["pend.x"].sum()

    found = jax.jit(jax.hessian(x))(1.0)
    h = 1e-3
    value = jax.jit(x)
    weights = {-2: -1, -1: 16, 0: -30, 1: 16, 2: -1}
    second = sum(w * value(1.0 + k * h) for k, w in weights.items()) / (12 * h**2)
    np.testing.assert_allclose(found, second, rtol=1e-4)


class Cubic(Component):
    """y = x³ + x with y fixed at the start."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p = self.parameter("p", 10.0)
        x, y = self.variable("x"), self.variable("y", start=p, fixed=True)
        self.add_equations(Eq(der(x), -x), Eq(y, x**3 + x))


@pytest.mark.slow
@pytest.mark.parametrize(
    "twice",
    [jax.hessian, pytest.param(lambda f: jax.jacfwd(jax.jacfwd(f)), marks=pytest.mark.slow)],
    ids=["forward over reverse", "forward twice"],
)
def test_of_a_start(twice):
    """x³ + x = p has x' = 1/(3x² + 1), x'' = −6x x'²/(3x² + 1)."""
    system = compiled(Cubic(EqnEnv(), "c"))

    def x(p):
        return system.with_parameters({"c.p": p}).initialize()[0]

    np.testing.assert_allclose(jax.jit(twice(x))(10.0), -6 * 2 / 13**3, rtol=1e-12)  # at x = 2


@pytest.mark.slow
def test_of_a_nearest_point():
    """Guesses a and b for a point of the unit circle: the nearest one has the angle atan2(b, a)."""

    class Circle(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            a, b = self.parameter("a", 2.0), self.parameter("b", 1.0)
            x, y = self.variable("x", start=a), self.variable("y", start=b)
            k = self.variable("k")
            self.add_equations(Eq(x**2 + y**2, 1), Eq(der(der(x)), k * x), Eq(der(der(y)), k * y))

    system = compiled(Circle(EqnEnv(), "c"))

    def angle(p):
        at = system.with_parameters({"c.a": p[0], "c.b": p[1]})
        x, y = at.observe(["c.x", "c.y"], 0.0, at.initialize())
        return jnp.arctan2(y, x)

    p = jnp.array([2.0, 1.0])
    found, exact = jax.jit(jax.hessian(angle))(p), jax.hessian(lambda p: jnp.arctan2(p[1], p[0]))(p)
    np.testing.assert_allclose(found, exact, rtol=1e-8, atol=1e-10)
