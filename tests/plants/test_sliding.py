"""Solutions that slide along a surface at which an equation jumps, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import sympy
from problems import compiled

from jaxonomy_dae import Component, Eq, EqnEnv, der, simulate

TIGHT = dict(rtol=1e-10, atol=1e-10)


class Relay(Component):
    """x' = a·sin(t) − u with u = 1 above zero and u = −1 below it, from x = x0."""

    def __init__(self, ev, name, x0):
        super().__init__(ev, name)
        x, u, a = self.variable("x", start=x0, fixed=True), self.variable("u"), self.parameter("a", 1.5)
        self.add_equations(Eq(der(x), a * sympy.sin(ev.t) - u))
        self.sliding(x, u - 1, u + 1)


@pytest.mark.slow
@pytest.mark.parametrize("x0", [0.7, 0.0])
def test_it_stays_where_both_fields_lead_back_and_leaves_where_one_does_not(x0):
    """From 0.7 it reaches zero while |1.5·sin t| < 1, stays until t* where 1.5·sin(t*) = −1, and falls as
    x = a·(cos t* − cos t) + t − t*. From zero it stays until a·sin(t*) = 1, and rises."""
    system, (side, last) = compiled(Relay(EqnEnv(), "c", x0)), ((-1, 5.0) if x0 else (1, 2.0))

    def left(a):
        t = np.pi + np.arcsin(1 / a) if x0 else np.arcsin(1 / a)
        return a * (np.cos(t) - np.cos(last)) - side * (last - t)

    def run(a):
        return simulate(system.with_parameters({"c.a": a}), last, ts=jnp.array([last]), **TIGHT)

    solution = run(1.5)
    assert float(solution["c.x"][0]) == pytest.approx(left(1.5), rel=1e-8)
    assert float(solution["c.side"][0]) == side
    if x0:
        reached = scipy.optimize.brentq(lambda t: x0 + 1.5 * (1 - np.cos(t)) - t, 3.0, 3.8)
        np.testing.assert_allclose(solution.events.ts[:2], [reached, np.pi + np.arcsin(1 / 1.5)], rtol=1e-8)
    slope = jax.jit(jax.grad(lambda a: run(a)["c.x"][0]))(1.5)
    assert float(slope) == pytest.approx((left(1.5 + 1e-5) - left(1.5 - 1e-5)) / 2e-5, rel=1e-7)


class Ring(Component):
    """x' = −y − u·x, y' = x − u·y, drawn to the unit circle by u = a outside and −a inside."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=2.0, fixed=True), self.variable("y", start=0.0, fixed=True)
        u, a = self.variable("u"), self.parameter("a", 0.5)
        self.add_equations(Eq(der(x), -y - u * x), Eq(der(y), x - u * y))
        self.sliding(x**2 + y**2 - 1, u - a, u + a)


@pytest.mark.slow
def test_a_curved_surface_is_kept():
    """The circle holds to rounding, and the angle is t."""
    run = simulate(compiled(Ring(EqnEnv(), "c")), 50.0, ts=jnp.array([2.0, 50.0]), **TIGHT)
    np.testing.assert_allclose(run["c.x"] ** 2 + run["c.y"] ** 2, 1.0, rtol=1e-13)
    np.testing.assert_allclose(run["c.x"], np.cos(run.ts), atol=1e-8)


class Onto(Component):
    """x' = u from zero, where u = `above` and u = `below` meet."""

    def __init__(self, ev, name, above, below):
        super().__init__(ev, name)
        x, u = self.variable("x", start=0.0, fixed=True), self.variable("u")
        self.add_equations(Eq(der(x), u))
        self.sliding(x, u - above, u - below)


@pytest.mark.slow
@pytest.mark.parametrize(("above", "below", "x", "side"), [(-1, -2, -2, -1), (2, 1, 2, 1), (-1, 2, 0, 0)])
def test_a_start_on_the_surface(above, below, x, side):
    run = simulate(compiled(Onto(EqnEnv(), "c", above, below)), 1.0, ts=jnp.array([1.0]))
    assert float(run["c.x"][0]) == pytest.approx(x, abs=1e-12)
    assert float(run["c.side"][0]) == side


@pytest.mark.slow
def test_two_solutions_end_the_run():
    run = simulate(compiled(Onto(EqnEnv(), "c", 1, -1)), 1.0, ts=jnp.array([0.0, 1.0]))
    assert "both fields lead away" in run.events.terminated
    assert np.isnan(run["c.x"][1])


class Turning(Component):
    """x' = u with u = y − 1 above zero and u = 1 − y below it, y = t: drawn to zero before t = 1, and away after."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y, u = self.variable("x", start=0.3, fixed=True), self.variable("y"), self.variable("u")
        self.add_equations(Eq(der(x), u), Eq(y, ev.t))
        self.sliding(x, u - (y - 1), u + (y - 1))


@pytest.mark.slow
def test_fields_that_turn_away_along_the_surface_end_the_run():
    """From x = 0.3 it slides from t − t²/2 = 0.3 on. It went on along the surface, which no longer attracts it."""
    run = simulate(compiled(Turning(EqnEnv(), "c")), 2.0, ts=jnp.array([0.9, 2.0]), **TIGHT)
    assert "both fields lead away from here on" in run.events.terminated
    np.testing.assert_allclose(run.events.ts[:2], [1 - np.sqrt(0.4), 1.0], rtol=1e-9)
    assert abs(run["c.x"][0]) < 1e-12 and np.isnan(run["c.x"][1])


def test_names_of_several():
    """A second one with the default name was refused."""

    class Several(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, u = self.variable("x", start=1.0, fixed=True), self.variable("u")
            v, i, w, j = (self.variable(n) for n in "viwj")
            self.add_equations(Eq(der(x), -u), Eq(v, 1 - i), Eq(w, 1 - j))
            self.modes = [self.sliding(x, u - 1, u + 1), self.complementary(v, i), self.complementary(w, j)]
            self.modes.append(self.sliding(x - 2, self.variable("z") - u - 1, u + 1))

    assert [str(mode) for mode in Several(EqnEnv(), "c").modes] == ["side", "active", "active2", "side2"]
