"""Starts that follow by substitution are found inside programs without a search; outside of them, by the ladder."""

import jax
import numpy as np
import pytest
from planar_models import double_pendulum
from problems import compiled, pendulum, slow
from sympy import Eq, cos, sin

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.run.start.explicit import substitution
from jaxonomy_dae.run.start.rows import initial_rows


def order(system, names=()):
    return substitution(system.plan, initial_rows(system.plan, names))


@pytest.mark.slow
@pytest.mark.parametrize(
    "build, name, value, levels",
    [
        (pendulum, "pend.L", 1.3, 0),
        pytest.param(lambda: double_pendulum("auto"), "a.m", 1.3, 4, marks=pytest.mark.slow),
    ],
)
def test_inside_as_outside(build, name, value, levels):
    system = build()
    found = order(system)
    assert found is not None and found.levels == levels

    def start(v):
        return system.with_parameters({name: v}).initialize()

    x, slope = jax.jit(lambda v: (start(v), jax.jacfwd(start)(v)))(value)
    np.testing.assert_allclose(x, start(value), rtol=1e-14, atol=1e-15)
    h = 1e-6
    np.testing.assert_allclose(slope, (start(value + h) - start(value - h)) / (2 * h), atol=1e-8)


def test_a_contradiction_is_one_inside_too():
    """Positions that are given and lie off the circle: substitution takes them, and the circle says no."""
    system = pendulum()
    names = tuple(sorted(system.states))
    assert order(system, names) is not None

    def start(x, y):
        return system.initialize(initial={"pend.x": x, "pend.y": y, "pend.vx": 0.0, "pend.vy": 0.0})

    inside = jax.jit(start)
    assert np.isnan(inside(0.7, -0.7)).all()
    np.testing.assert_allclose(inside(0.6, -0.8), start(0.6, -0.8), rtol=1e-14, atol=1e-15)


class Bead(Component):
    """A bead on a curve e(x, y) = 0; x and its speed are given, y is guessed."""

    def __init__(self, ev, curve, bounds=None):
        super().__init__(ev, "c")
        x, y = self.variable("x", start=0.6, fixed=True), self.variable("y", start=0.7, bounds=bounds)
        vx, vy, push = self.variable("vx", start=0.2, fixed=True), self.variable("vy"), self.variable("push")
        e, along_x, along_y = curve(x, y, self.parameter("p", 1.0))
        self.add_equations(Eq(der(x), vx), Eq(der(y), vy), Eq(e, 0))
        self.add_equations(Eq(der(vx), push * along_x), Eq(der(vy), push * along_y - 9.81))


SINE = lambda x, y, p: (2 * y - p * sin(x), -p * cos(x), 2)  # noqa: E731
CURVES = {
    "explicit": (SINE, None, True),
    "a coefficient that may be zero": (lambda x, y, p: (p * y - sin(x), -cos(x), p), None, False),
    "a circle": (lambda x, y, p: (x**2 + y**2 - p, 2 * x, 2 * y), None, False),
    "implicit": (lambda x, y, p: (y + y**3 - p * x, -p, 1 + 3 * y**2), None, False),
    "bounds": (SINE, (0.0, 9.0), True),  # which a search heeds
}


@pytest.mark.parametrize("name", slow(CURVES, "a coefficient that may be zero", "a circle", "implicit"))
def test_what_follows_by_substitution(name):
    curve, bounds, follows = CURVES[name]
    system = compiled(Bead(EqnEnv(), curve, bounds))
    assert system.plan.n_constraints == 2
    assert (order(system) is not None) is follows
    inside, outside = jax.jit(lambda: system.initialize())(), system.initialize()
    np.testing.assert_allclose(inside, outside, rtol=1e-13)


@pytest.mark.slow
def test_derivatives_outside_of_jit():
    """Pullbacks of `jax.jacrev` and `jax.grad` failed: a loop collected residuals that nothing read."""
    system = pendulum()

    def start(length):
        return system.with_parameters({"pend.L": length}).initialize()

    np.testing.assert_allclose(jax.jacrev(start)(1.2), jax.jacfwd(start)(1.2), rtol=1e-14, atol=1e-15)
