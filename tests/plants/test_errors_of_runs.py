"""Wrong models whose runs say what is wrong, by name."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component, mlp, rc_circuit
from sympy import Eq

from jaxonomy_dae import ModelError, SimulationError, der, simulate


def test_non_finite_parameters_and_weights_are_named():
    rc = rc_circuit()
    broken = eqx.tree_at(lambda s: s.parameters.values, rc, rc.parameters.values.at[1].set(jnp.nan))
    with pytest.raises(ModelError, match=r"parameter 'r\.R' is not finite: nan"):
        simulate(broken, 2.0, ts=jnp.array([2.0]))

    def write(self, ev):
        (law,) = self.learned("law", mlp(1, 1), inputs=[self.variable("x", start=1.0, fixed=True)])
        self.add_equations(Eq(der(self.x), law))

    system = compiled(component(write))
    broken = jax.tree.map(lambda leaf: leaf * np.nan if eqx.is_inexact_array(leaf) and leaf.ndim else leaf, system)
    with pytest.raises(ModelError, match=r"a weight of network 'c\.law' is not finite.*earlier iterate"):
        simulate(broken, 2.0, ts=jnp.array([2.0]))


def test_a_start_at_a_singular_point():
    def write(self, ev):
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), -1 / x))

    with pytest.raises(
        SimulationError, match=r"not finite at the start, c: 0 = der\(x\) \+ 1/x, with 'c\.x' = 0\. .*division"
    ):
        simulate(compiled(component(write)), 1.0, ts=jnp.array([1.0]))
