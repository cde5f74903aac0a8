"""Relations at which equations only bend: x″ = −x − 3·max(x − p, 0), from x = 0 at speed 1.

Closed form for 0 < p < 1: sin t up to x = p, then about 3p/4 with the rate 2, and from x = p on with the rate 1 again.
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.solve.adjoint.ends import ending
from jaxonomy_dae.solve.adjoint.late_times import Integration
from jaxonomy_dae.solve.events.control import AtEvents
from jaxonomy_dae.solve.events.facts import EventFacts
from jaxonomy_dae.solve.events.first_order import differentiable_once
from jaxonomy_dae.solve.events.problem import AbstractHybridProblem, HybridTerm
from jaxonomy_dae.solve.events.solver import WithEvents
from jaxonomy_dae.solve.events.start import start
from jaxonomy_dae.solve.methods.drive import integrate
from jaxonomy_dae.solvers import StoredAdjoint
from jaxonomy_dae.write.events import EventFlag

END = 3.0
RELATION = EventFlag.AT_START | EventFlag.REVOCABLE | EventFlag.RELATION
FACTS = EventFacts(flags=(RELATION | EventFlag.STRICT, RELATION), n_clocks=0, ends=(False, False), opposite=(1, 0))


class Stop(AbstractHybridProblem):
    """The discrete value is 1 where x > p."""

    p: Any
    resolution: Any
    facts: EventFacts = eqx.field(static=True)

    def term(self, q):
        return diffrax.ODETerm(lambda t, x, args: self.field(t, x, q, args))

    def prepared(self, solver, q):
        return solver

    def field(self, t, x, q, args):
        return jnp.stack([x[1], -x[0] - 3 * q[0] * (x[0] - self.p)])

    def guards(self, t, x, q, args):
        return jnp.stack([self.p - x[0], x[0] - self.p])

    def written(self, t, x, read, q, previous, events, args):
        return x, jnp.where(events[0], jnp.ones_like(q), jnp.zeros_like(q))

    def settled(self, t, x, q, events, args):
        return jnp.where(events[0], 1.0, jnp.where(events[1], 0.0, q))

    def clocks(self):
        return jnp.zeros(0), jnp.zeros(0)


def final(p, only_kinks):
    """(x at the end, the discrete value there), at rtol = atol = 1e-10."""
    problem = Stop(p, 1e-14, dataclasses.replace(FACTS, only_kinks=only_kinks))
    t0, t1 = jnp.zeros(()), jnp.asarray(END)
    done = integrate(Integration(
        HybridTerm(problem), WithEvents(diffrax.Tsit5(), 64), t0, t1, 0.1,
        start(problem, t0, jnp.array([0.0, 1.0]), jnp.zeros(1), None, 0, False), None,
        save=diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: y.x), adjoint=StoredAdjoint(), max_steps=1000,
        controller=ending(diffrax.PIDController(rtol=1e-10, atol=1e-10), AtEvents()),
    ))  # fmt: skip
    return done.last[1].x[0], done.last[1].q[0]


def exact(p):
    v = jnp.sqrt(1 - p**2)
    above = jnp.arctan2(v / 2, p / 4)
    left = END - jnp.arcsin(p) - above
    return p * jnp.cos(left) - v * jnp.sin(left)


@pytest.mark.slow
@pytest.mark.parametrize("only_kinks", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_value_and_gradient(only_kinks):
    found = jax.jit(jax.vmap(jax.value_and_grad(lambda p: final(p, only_kinks)[0])))
    p = jnp.array([0.2, 0.5, 0.9])
    value, slope = found(p)
    np.testing.assert_allclose(value, exact(p), rtol=0, atol=1e-8)
    np.testing.assert_allclose(slope, jax.vmap(jax.grad(exact))(p), rtol=0, atol=1e-7)


def test_one_that_is_never_reached():
    value, q = jax.jit(lambda p: final(p, True))(jnp.array(1.5))
    np.testing.assert_allclose(value, np.sin(END), rtol=0, atol=1e-8)
    assert q == 0.0


def test_first_derivatives_pass_and_second_ones_are_refused():
    def squared(x):
        return differentiable_once(x**2)

    assert jax.grad(squared)(3.0) == 6.0 and jax.jvp(squared, (3.0,), (1.0,)) == (9.0, 6.0)
    with pytest.raises(ModelError, match="second derivatives through events are not computed"):
        jax.grad(jax.grad(squared))(3.0)
