"""Whole states as starts: the projection of a pendulum's state onto its circle, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.run.simulation.from_state import from_state


@pytest.fixture(scope="module")
def system():
    return compiled(PlanarPendulum(EqnEnv(), "pend", L=1.0))


def start(system, both):
    """The consistent state next to the first four numbers, with the fifth as the length."""
    return from_state(system.with_parameters({"pend.L": both[4]}), jnp.zeros(()), {}, both[:4]).x


def test_derivatives_are_those_of_the_projection(system):
    """By the state and by the length of the rod, forwards, backwards, and by differences of whole projections."""
    names = system.states
    angle, speed = 0.4, 1.3
    values = {"pend.x": np.cos(angle), "pend.y": np.sin(angle)}
    values |= {"pend.vx": -speed * np.sin(angle), "pend.vy": speed * np.cos(angle)}
    both = jnp.array([values[n] for n in names] + [1.0])
    run = jax.jit(lambda both: start(system, both))
    np.testing.assert_allclose(run(both), both[:4], atol=1e-12)
    forward = jax.jit(jax.jacfwd(lambda both: start(system, both)))(both)
    backward = jax.jit(jax.jacrev(lambda both: start(system, both)))(both)
    np.testing.assert_allclose(backward, forward, atol=1e-12)
    step = 1e-5
    differences = np.stack([(run(both + d) - run(both - d)) / (2 * step) for d in step * np.eye(5)], axis=1)
    np.testing.assert_allclose(forward, differences, atol=1e-8)
    # Two degrees of freedom.
    np.testing.assert_allclose(np.trace(forward[:, :4]), 2, atol=1e-9)


def test_shapes_and_numbers_are_looked_at(system):
    with pytest.raises(ModelError, match=r"a whole state of this system has shape \(4,\); got shape \(3,\)"):
        simulate(system, 1.0, initial=jnp.ones(3))
    with pytest.raises(ModelError, match="entry 2 of the state is nan"):
        simulate(system, 1.0, initial=np.array([1.0, 0.0, np.nan, 0.0]))
    with pytest.raises(ModelError, match="real numbers"):
        simulate(system, 1.0, initial=np.ones(4, complex))
