"""Grids: several `jax.vmap`, each over an argument of its own, outside of jit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled as system_of

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.host.cache import compiled
from jaxonomy_dae.host.members import batch_size
from jaxonomy_dae.run.simulation.event_log import Side
from jaxonomy_dae.write import Eq

A, B = jnp.array([1.0, 0.5]), jnp.array([1.0, 2.0])  # of one length, so that one axis could be taken for the other


def law(a, b):
    return jnp.sin(a) * b**2


NESTED = {
    "vmap of vmap": lambda f: jax.vmap(lambda a: jax.vmap(lambda b: f(a, b))(B))(A),
    "one argument of both": lambda f: jax.vmap(lambda a: jax.vmap(lambda b: f(a * b, b))(B))(A),
    "other axes": lambda f: jax.vmap(
        lambda a: jax.vmap(lambda b: f(a, b), in_axes=1, out_axes=1)(jnp.stack([B, 3 * B, B * B]))
    )(A),
    "three": lambda f: jax.vmap(lambda a: jax.vmap(lambda b: jax.vmap(lambda c: f(a * c, b))(A))(B))(A),
    "vmap of grad of vmap": lambda f: jax.vmap(jax.grad(lambda a: jnp.sum(jax.vmap(lambda b: f(a, b))(B))))(A),
    "vmap of jacrev of vmap": lambda f: jax.vmap(jax.jacrev(lambda a: jax.vmap(lambda b: f(a, b))(B)))(A),
    "vmap of jacfwd of vmap": lambda f: jax.vmap(jax.jacfwd(lambda a: jax.vmap(lambda b: f(a, b))(B)))(A),
    "grad by a of grad by b": lambda f: jax.vmap(lambda a: jax.grad(lambda b: jax.grad(f)(a, b))(2.0))(A),
}


@pytest.mark.parametrize("form", NESTED)
def test_each_argument_keeps_its_own_axis(form):
    """Beside the same law that JAX transforms without programs of this package."""
    np.testing.assert_allclose(NESTED[form](compiled(law)), NESTED[form](law), rtol=1e-14)


def test_the_size_of_a_grid():
    """By which memory for records is shared out."""
    seen = []
    jax.vmap(lambda a: jax.vmap(lambda b: seen.append(batch_size({"a": a, "b": b, "c": 1.0})) or a * b)(jnp.ones(5)))(A)
    assert seen == [10]


class Falling(Component):
    def __init__(self, ev, name):
        super().__init__(ev, name)
        v = self.variable("v", start=1.0, fixed=True)
        self.add_equations(Eq(der(v), -v))
        self.output("twice", 2 * v)


def test_variables_at_events_of_a_grid():
    """Of runs by two `vmap`, each variable has both axes before that of the events."""
    one = system_of(Falling(EqnEnv(), "m"))
    system = eqx.filter_vmap(eqx.filter_vmap(lambda _: one))(jnp.zeros((2, 3)))
    ts = jnp.arange(12.0).reshape(2, 3, 2).at[1, 2, 1].set(jnp.inf)
    rows = jnp.where(jnp.isfinite(ts), 10 - ts, 0.0)[..., None]
    found = Side(ts, rows, system, {}, lambda: (jnp.zeros((2, 3)), jnp.ones((2, 3, 1))))["m.twice"]
    np.testing.assert_allclose(found, jnp.where(jnp.isfinite(ts), 20 - 2 * ts, jnp.nan))
