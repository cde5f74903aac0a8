"""Programs hold no callback that would say why a run failed: whoever called them outside of jit says it."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import compiled
from sympy import Eq, log

from jaxonomy_dae import Component, EqnEnv, ModelError, SimulationError, assign, der, pre, simulate, sweep
from jaxonomy_dae.learning import minimize

TS = jnp.array([0.5, 1.0])
ESCAPE = r"'c\.x' is .* infinite near t="


class Blowup(Component):
    """x' = x² from p: x = p/(1 − p·t)."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p = self.parameter("p", 0.2)
        x = self.variable("x", start=p, fixed=True)
        self.add_equations(Eq(der(x), x**2))


@pytest.fixture(scope="module")
def blowup():
    return compiled(Blowup(EqnEnv(), "c"))


def read(system):
    return simulate(system, 1.0, ts=TS, max_steps=200)["c.x"]


def loss(system):
    return -jnp.sum(read(system))  # least where the run fails


@pytest.mark.slow
def test_steps_say_why_they_stopped(blowup):
    with pytest.warns(RuntimeWarning, match=f"stopped after 1 updates: the loss is nan.*{ESCAPE}.*best iterate"):
        found = minimize(blowup, loss, optax.sgd(2.0), 4, train="c.p", progress=False)
    assert found.best_step == 0
    outside = blowup.with_parameters({"c.p": 1.5})
    with pytest.raises(ModelError, match=f"the loss is nan at the start: .*{ESCAPE}"):
        minimize(outside, loss, optax.sgd(2.0), 4, train="c.p", progress=False)


@pytest.mark.slow
def test_a_sweep_says_where_and_why(blowup):
    values = {"c.p": jnp.array([0.2, 1.5, 1.8])}
    message = rf"2 of 3 values of the sweep failed, the first at c\.p = 1\.5: .*{ESCAPE}"
    with pytest.raises(SimulationError, match=message):
        sweep(blowup, values, read)
    quiet = sweep(blowup, values, t1=1.0, ts=TS, max_steps=200, throw=False)["c.x"]
    p = np.array([0.2, 1.5, 1.8])[:, None]
    exact = p / (1 - p * np.asarray(TS))
    np.testing.assert_allclose(np.asarray(quiet)[:2, 0], exact[:2, 0], rtol=1e-4)
    np.testing.assert_allclose(quiet[0], exact[0], rtol=1e-4)
    assert np.isnan(np.asarray(quiet)[1:, 1]).all()
    eqx.filter_jit(lambda v: sweep(blowup, {"c.p": v}, read).values)(values["c.p"])  # inside a program: no error


@pytest.mark.slow
def test_an_event_that_writes_no_number_is_not_stiffness():
    """Both ended with one code, so the run was made once more with an implicit solver, and called stiff."""

    class Decay(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, n = self.variable("x", start=1.0, fixed=True), self.discrete("n", start=0)
            self.add_equations(Eq(der(x), -x))
            self.when(x <= 0.5, assign(n, log(pre(n) - 1)))

    solution = simulate(compiled(Decay(EqnEnv(), "d")), 2.0, throw=False)
    assert solution.stats["solver"] == "Tsit5" and solution.stats["reason"].startswith("explicit")
    assert solution.result != diffrax.RESULTS.successful
