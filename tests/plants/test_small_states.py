"""States that are smaller than the default absolute tolerance, and starts that are rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, component
from sympy import Eq

from jaxonomy_dae import EqnEnv, der, simulate
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.solvers import BDF, Rodas5P

TS = np.linspace(0.0, 20.0, 6)


def write(self, ev):
    """x'' = −w²·x from x0, at rest: x = x0·cos(w·t). Nothing is declared of v but that it begins at zero."""
    w, x0 = self.parameter("w", 1.0), self.parameter("x0", 1e-9)
    x, v = self.variable("x", start=x0, fixed=True), self.variable("v", start=0.0, fixed=True)
    self.add_equations(Eq(der(x), v), Eq(der(v), -(w**2) * x))


@pytest.fixture(scope="module")
def oscillator():
    return compiled(component(write))


@pytest.mark.parametrize("w", [1e-3, 1.0, 1e9])
@pytest.mark.parametrize("x0", [1e-18, 1e-9, 1e-3, 1e12])
def test_oscillations_of_any_size(oscillator, w, x0):
    """Kind: results that hang on the unit. An oscillation of a nanometre grew to 287 by the default tolerances: atol of
    1e-8, in units of a nominal value of one that nobody declared, was above all of it."""
    system = oscillator.with_parameters({"c.w": w, "c.x0": x0})
    found = simulate(system, TS[-1] / w, ts=TS / w)["c.x"]
    np.testing.assert_allclose(found / x0, np.cos(TS), rtol=0, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Rodas5P(), BDF()])
def test_by_solvers_of_stiff_models(oscillator, solver):
    found = simulate(oscillator, TS[-1], ts=TS, solver=solver)["c.x"]
    np.testing.assert_allclose(found / 1e-9, np.cos(TS), rtol=0, atol=5e-3 if isinstance(solver, BDF) else 2e-4)


@pytest.mark.slow
def test_inside_jit_sizes_are_those_of_the_system(oscillator):
    found = jax.jit(lambda w: simulate(oscillator.with_parameters({"c.w": w}), TS[-1], ts=jnp.array(TS))["c.x"])(1.0)
    np.testing.assert_allclose(found / 1e-9, np.cos(TS), rtol=0, atol=2e-4)


def test_sizes_between_a_state_and_its_acceleration(oscillator):
    """The size of a speed that begins at zero is between that of the state and that of its acceleration."""
    typical = oscillator.with_parameters({"c.w": 1e6}).typical_sizes
    size = dict(zip(oscillator.plan.quantity_name, np.asarray(typical), strict=True))
    assert 2e-4 < size["c.v"] < 5e-3


@pytest.mark.slow
def test_a_start_that_is_rounding_tells_no_size():
    """L·cos(π/2) = 6e-17 is no size of x. A pendulum that begins upright stays there, or falls; its steps must not be
    those of a motion of 1e-16."""
    bob = PlanarPendulum(EqnEnv(), name="p", m=1.0, L=1.0, initial_theta=np.pi / 2, initial_omega=0.0)
    system = compiled(bob)
    assert np.asarray(system.typical_sizes)[system.plan.quantity_name.index("p.x")] > 1e-3
    solution = simulate(system, 1.0, ts=np.array([1.0]))
    assert solution.counts["num_steps"] < 100
    np.testing.assert_allclose(solution["p.y"], 1.0, atol=1e-5)


@pytest.mark.parametrize("offset", [0.0, 5e-16, 1e-13])
def test_a_slope_that_is_rounding_tells_no_step(offset):
    """Kind: a first step from a slope that is rounding, as behind an event that begins where a current is zero. At
    t = 1 its length was lost in rounding, and steps of length zero, which have no error, were kept without end.
    Closed form: x' = sin(k(t − 1)) + offset."""

    def write(self, ev):
        k, added = self.parameter("k", 3.0), self.parameter("offset", offset)
        x = self.variable("x", start=0.5)
        self.add_equations(Eq(der(x), sympy.sin(k * (ev.t - 1)) + added))

    solution = simulate(compiled(component(write)), 2.0, t0=1.0, ts=np.array([2.0]), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(solution["c.x"], 0.5 + (1 - np.cos(3.0)) / 3, rtol=1e-8)
    assert solution.counts["num_steps"] < 100
