"""Events as nobody had in mind when they were made, each against an independent computation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component

from jaxonomy_dae import assign, der, pre, reinit, simulate
from jaxonomy_dae.modeling import Eq

TIGHT = dict(rtol=1e-10, atol=1e-10)


def test_a_discrete_variable_whose_start_is_an_expression():
    """It begins at the parameter, is doubled at x = t = 1 and 2, and its derivative by the parameter with it: the
    integral over [0, 3] is a·(1 + 2 + 4). It was computed from its expression for ever."""

    def write(self, ev):
        a = self.parameter("a", 1.5)
        x = self.variable("x", start=0.0, fixed=True)
        y = self.variable("y", start=0.0, fixed=True)
        d = self.discrete("d", start=2 * a)
        self.add_equations(Eq(der(x), 1), Eq(der(y), d))
        self.when(x >= 1, reinit(x, 0), assign(d, 2 * pre(d)))

    system = compiled(component(write))

    def run(a):
        return simulate(system.with_parameters({"c.a": a}), 2.5, ts=jnp.array([0.5, 1.5, 2.5]), **TIGHT)

    np.testing.assert_allclose(run(1.5)["c.d"], [3, 6, 12])
    slope = jax.jit(jax.grad(lambda a: run(a)["c.y"][-1]))(1.5)
    assert float(slope) == pytest.approx(2 * (1 + 2 + 4 / 2), rel=1e-9)
