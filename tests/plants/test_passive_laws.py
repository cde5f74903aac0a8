"""Passive laws in plants: no energy comes from them, whatever their weights."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, ModelError, der, simulate
from jaxonomy_dae.learning import AbstractPassive, Passive
from jaxonomy_dae.testing import assert_energy_balance

TS = np.linspace(0.0, 2.0, 41)


class Carriage(Component):
    """Two masses on springs, and a force between each and the ground that is learned and passive.

    The stored energy is ½(v₁² + v₂²) + 2(x₁² + x₂²) + 2(x₁ − x₂)², and −f·v is lost.
    """

    def __init__(self, ev, law, kind=AbstractPassive):
        super().__init__(ev, "c")
        x = [self.variable(f"x{k}", start=s, fixed=True, unit="m") for k, s in enumerate((0.5, -0.2))]
        v = [self.variable(f"v{k}", start=s, fixed=True, unit="m/s") for k, s in enumerate((0.0, 1.0))]
        f = self.learned("friction", law, v, kind=kind)
        stretch = x[0] - x[1]
        for k, sign in enumerate((1, -1)):
            self.add_equations(Eq(der(x[k]), v[k]), Eq(der(v[k]), f[k] - 4 * x[k] - sign * 4 * stretch))
        self.declare_energy(*(u**2 / 2 + 2 * p**2 for u, p in zip(v, x, strict=True)), 2 * stretch**2)
        self.declare_dissipation(*(-force * u for force, u in zip(f, v, strict=True)))


def with_weights(law, key, factor):
    """The same law with other weights, `factor` times as large as at first."""
    leaves, structure = jax.tree.flatten(eqx.filter(law, eqx.is_inexact_array))
    keys = jax.random.split(key, len(leaves))
    drawn = [factor * jax.random.normal(k, a.shape) / jnp.sqrt(a.shape[-1]) for k, a in zip(keys, leaves, strict=True)]
    return eqx.combine(jax.tree.unflatten(structure, drawn), law)


@pytest.fixture(scope="module")
def system():
    return compiled(Carriage(EqnEnv(), Passive(2, key=jax.random.key(1))))


@pytest.mark.slow
def test_the_account_of_energy_balances_and_only_loses(system):
    solution = simulate(system, 2.0, ts=TS, rtol=1e-8, atol=1e-10)
    assert_energy_balance(solution, rtol=1e-6)
    energy = np.asarray(solution.energy())
    assert (np.asarray(solution.dissipation()) > 0)[1:].all() and (np.diff(energy) < 0).all()
    np.testing.assert_array_equal(solution.supply(), 0.0)


@pytest.mark.slow
def test_a_thousand_random_laws_gain_nothing(system):
    """In one program; the same network without its structure gains energy in nearly all draws."""
    keys = jax.random.split(jax.random.key(2), 1000)
    factors = 10.0 ** jax.random.uniform(jax.random.key(3), (1000,), minval=-1.0, maxval=0.5)

    class Plain(eqx.Module):
        network: eqx.nn.MLP

        def __call__(self, u):
            return self.network(u)[:2]

    passive, plain = system.neural["c.friction"], Plain(system.neural["c.friction"].network)

    def rises(law):
        @eqx.filter_jit
        @eqx.filter_vmap(in_axes=(0, 0))
        def one(key, factor):
            other = eqx.tree_at(lambda s: s.neural, system, {"c.friction": with_weights(law, key, factor)})
            solution = simulate(other, 2.0, ts=TS, rtol=1e-8, atol=1e-10, max_steps=20_000, throw=False)
            return solution.energy()

        energy = np.asarray(one(keys, factors))
        return np.diff(energy, axis=1).max(axis=1) / energy[:, 0], np.isfinite(energy).all(axis=1)

    rise, finished = rises(passive)
    assert finished.all() and rise.max() < 1e-6  # a hundred times the tolerance
    rise, finished = rises(plain)
    assert (~finished | (rise > 1e-3)).mean() > 0.5


def test_a_law_that_may_add_energy_is_refused():
    with pytest.raises(ModelError, match=r"'c\.friction': only a law of kind AbstractPassive may stand here; got MLP"):
        Carriage(EqnEnv(), eqx.nn.MLP(2, 2, 4, 1, jnp.tanh, key=jax.random.key(0)))
