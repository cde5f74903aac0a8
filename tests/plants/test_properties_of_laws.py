"""Which property a learned law has, by the evidence: a pendulum with a drag that is odd, and one that is not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from problems import compiled, component
from sympy import Eq, sin

from jaxonomy_dae import der, learning
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.learning.laws.properties import AlongInput, OddPart, ZeroAtZero

TS = np.linspace(0.03, 6, 200)


def swinging(self, ev):
    """a'' = −9.81 sin a − f(a')."""
    a, w = self.variable("a", start=0.5, fixed=True), self.variable("w", start=0.0, fixed=True)
    (f,) = self.learned("drag", eqx.nn.MLP(1, 1, 8, 1, jnp.tanh, key=jax.random.key(0)), inputs=[w])
    self.add_equations(Eq(der(a), w), Eq(der(w), -9.81 * sin(a) - f))


def fitted(law):
    run = scipy.integrate.solve_ivp(
        lambda t, s: [s[1], -9.81 * np.sin(s[0]) - law(s[1])], (0, 6), [0.5, 0.0], t_eval=TS, rtol=1e-10, atol=1e-12
    )
    y = run.y[0] + 1e-3 * np.random.default_rng(1).standard_normal(len(TS))
    return learning.Problem(compiled(component(swinging)), learning.Experiment(TS, {"c.a": y}, sigma=1e-3)).fit()


@pytest.mark.slow
@pytest.mark.parametrize("lift", [0.0, 0.15])
def test_an_odd_law_is_told_from_one_that_is_not(lift):
    """The lift is a hundred standard deviations of what the record tells of f(0)."""
    fit = fitted(lambda w: 0.3 * w * abs(w) + lift * np.exp(-((w / 0.5) ** 2)))
    found = fit.properties("c.drag")
    assert set(found.fits) == {"none", "zero at zero", "odd", "rising"}
    if lift:
        assert found.best not in ("odd", "zero at zero") and found.worth["odd"] < -10
    else:
        assert found.best == "odd" and found.worth["odd"] > 3 and found.fit.ok and "'c.drag' is odd" in repr(found)
        law = found.fit.system.neural["c.drag"]
        assert float(law(jnp.zeros(1))[0]) == 0 and float(law(-jnp.ones(1))[0]) == -float(law(jnp.ones(1))[0])
    with pytest.raises(ModelError, match="'c.drug' is not a network that was trained: did you mean 'c.drag'"):
        fit.properties("c.drug")


def test_properties_hold_for_all_weights():
    net, u = eqx.nn.MLP(2, 2, 4, 1, jnp.tanh, key=jax.random.key(1)), jnp.array([0.3, -0.8])
    assert not jnp.any(ZeroAtZero(net)(jnp.zeros(2)))
    np.testing.assert_array_equal(OddPart(net)(-u), -OddPart(net)(u))
    law, turned = AlongInput(net, 1e-2), jnp.array([0.8, 0.3])
    np.testing.assert_allclose(jnp.linalg.norm(law(u)), jnp.linalg.norm(law(turned)), rtol=1e-12)
    assert abs(float(law(u) @ turned)) < 1e-14 and not jnp.any(law(jnp.zeros(2)))
