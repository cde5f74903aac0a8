"""Equations whose highest derivatives cancel for some values of the parameters only."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq, Min, Piecewise

from jaxonomy_dae import Component, EqnEnv, SimulationError, der, simulate


@functools.cache
def coupled():
    """c(p)·y1' − p·y2' = −y1 and y2' − y1' = −y2. With c = min(p, 10⁴) = p the sum says y2 = −y1/p, and
    y1 = exp(−t/(p + 1))."""

    class Coupled(Component):
        def __init__(self, ev):
            super().__init__(ev, "c")
            p, y1, y2 = self.parameter("p", 10.0), self.variable("y1", start=1.0), self.variable("y2")
            self.add_equations(Eq(Min(p, 1e4) * der(y1) - p * der(y2), -y1), Eq(der(y2) - der(y1), -y2))

    return compiled(Coupled(EqnEnv()))


def at_one(p):
    solution = simulate(coupled().with_parameters({"c.p": p}), 1.0, ts=jnp.array([1.0]))
    return jnp.stack([solution["c.y1"][0], solution["c.y2"][0]])


@pytest.mark.slow
def test_what_cancels_at_the_values_compiled_with_does_not_elsewhere():
    """That it cancels was judged from parameters up to a hundred times those given. Beyond 10⁴ the wrong equation was
    integrated without a word: y2(0) = −1e-4 for p = 1e5, which leaves y2 to its start."""
    y1 = np.exp(-1 / np.array([11.0, 1001.0]))
    found = jax.jit(jax.vmap(at_one))(jnp.array([10.0, 1e3, 1e5]))
    np.testing.assert_allclose(found[:2], np.stack([y1, -y1 / [10.0, 1e3]], axis=-1), rtol=1e-5)
    assert np.isnan(found[2]).all()
    with pytest.raises(SimulationError, match=r"highest derivatives cancel.*for c\.p = 100000.*Compile"):
        at_one(1e5)


def test_a_switch_that_couples_rates():
    """With the switch on, y1' − y2' = −y1 and y2' − y1' = −y2 add to y1 + y2 = 0, which `with_parameters` kept when it
    was off."""

    class Coupled(Component):
        def __init__(self, ev):
            super().__init__(ev, "d")
            on, y1, y2 = self.parameter("coupled", 1.0), self.variable("y1"), self.variable("y2")
            rate = Piecewise((der(y1) - der(y2), on > 0.5), (der(y1), True))
            self.add_equations(Eq(rate, -y1), Eq(der(y2) - der(y1), -y2))

    system = compiled(Coupled(EqnEnv()))
    assert len(system.states) == 1
    assert np.isfinite(system.vector_field(0.0, jnp.ones(1))).all()
    assert np.isnan(system.with_parameters({"d.coupled": 0.0}).vector_field(0.0, jnp.ones(1))).all()
