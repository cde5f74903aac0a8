"""Wrong models whose runs say what is wrong, by name."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component, mlp, rc_circuit
from sympy import Eq

from jaxonomy_dae import EqnEnv, InitializationError, ModelError, SimulationError, der, simulate
from jaxonomy_dae.library import electrical as el


@pytest.mark.slow
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

    text = r"not finite at the start, c: 0 = der\(x\) \+ 1/x  \(\w+\.py:\d+\), with 'c\.x' = 0\. .*division"
    with pytest.raises(SimulationError, match=text):
        simulate(compiled(component(write)), 1.0, ts=jnp.array([1.0]))


@pytest.mark.slow
def test_a_run_from_contradicting_starts():
    """y = x³ + x, started at x = 3 and y = 10."""

    def write(self, ev):
        x, y = self.variable("x", start=3.0, fixed=True), self.variable("y", start=10.0, fixed=True)
        self.add_equations(Eq(der(x), -x), Eq(y, x**3 + x))

    system = compiled(component(write))
    with pytest.raises(InitializationError, match=r"start of c\.y, 10: off by"):
        simulate(system, 1.0, ts=jnp.array([1.0]))


def test_inputs_that_are_missing():
    def write(self, ev):
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -x), Eq(self.variable("y"), self.input("u")))

    system = compiled(component(write))
    with pytest.raises(
        ModelError, match=r"input 'c\.u' was not given, and has no default: pass inputs=\{'c\.u': 1\.0\}"
    ):
        simulate(system, 1.0)
    with pytest.raises(ModelError, match=r"'c\.v' is not an input of this system: did you mean 'c\.u'"):
        simulate(system, 1.0, inputs={"c.v": 1.0})
    with pytest.raises(
        ModelError,
        match=r"input 'c\.u' must be a number, samples or a function.*\(3,\).*\(times, values\)",
    ):
        simulate(system, 1.0, inputs={"c.u": jnp.ones(3)})
    for call in (system.initialize, lambda: system.vector_field(0.0, jnp.ones(1))):
        with pytest.raises(ModelError, match=r"input 'c\.u' was not given.*connect a signal"):
            call()


def test_a_state_of_another_shape():
    system = rc_circuit()
    for call in (lambda x: system.observe("c.v", 0.0, x), lambda x: system.vector_field(0.0, x)):
        with pytest.raises(ModelError, match=r"a state of this system has shape \(1,\); got \(2,\)"):
            call(jnp.ones(2))


def test_a_signal_that_nothing_drives():
    ev = EqnEnv()
    source, r, ground = el.SignalVoltage(ev, "source"), el.Resistor(ev, "r"), el.Ground(ev, "ground")
    system = compiled(source, r, ground, connect=[(source.p, r.p), (r.n, source.n, ground.p)])
    with pytest.raises(ModelError, match=r"input 'source\.u' was not given, and has no default: pass inputs="):
        simulate(system, 1.0)
