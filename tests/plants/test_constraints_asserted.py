"""States moved off their constraints by known distances are found, and by how much."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, oscillator

from jaxonomy_dae import EqnEnv, ModelError, simulate
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.testing import assert_constraints

TS = np.linspace(0.0, 1.0, 11)


@pytest.fixture(scope="module")
def swing():
    """Of length 2, from 0.3 rad."""
    system = compiled(PlanarPendulum(EqnEnv(), name="pend", L=2.0, initial_theta=0.3))
    return simulate(system, 1.0, ts=TS)


@pytest.mark.slow
def test_a_run_is_certified(swing):
    found = assert_constraints(swing, rtol=1e-12, atol=1e-12)
    assert found.holds and "2 hidden constraints at 11 saved times" in found.checked
    assert "hidden constraint: pend: 0 = -L**2 + x**2 + y**2" in repr(found)


def test_a_state_off_the_circle_is_found(swing):
    """Moved outwards by δ, it lies δ from the circle: x moves back by δ·cos θ."""
    names, delta, row = swing.system.states, 1e-4, 6
    x, y = (names.index(f"pend.{n}") for n in "xy")
    states = np.array(swing.states)
    outwards = states[row, [x, y]] / 2.0
    states[row, [x, y]] += delta * outwards
    moved = eqx.tree_at(lambda s: s.states, swing, jnp.asarray(states))
    with pytest.raises(AssertionError, match=r"failed(?s:.*)'pend\.[xy]' at t=0\.6, which would move by") as caught:
        assert_constraints(moved, rtol=1e-6, atol=0.0)
    worst = max(np.abs(delta * outwards) / np.abs(np.asarray(swing.states)[:, [x, y]]).max(axis=0))
    assert f"largest error: {worst / 1e-6:.3g} " in str(caught.value), str(caught.value)
    assert_constraints(moved, rtol=1.1 * worst, atol=0.0)


def test_what_cannot_be_checked(swing):
    missed = eqx.tree_at(lambda s: s.states, swing, swing.states.at[4:].set(jnp.nan))
    with pytest.raises(ModelError, match="row 4 of the solution, t=0.4, was not reached"):
        assert_constraints(missed)
    with pytest.raises(ModelError, match="outside jit, grad and vmap"):
        jax.jit(lambda s: assert_constraints(eqx.tree_at(lambda t: t.states, swing, s)).error)(swing.states)
    batch = jax.tree.map(lambda a: jnp.stack([a, a]) if eqx.is_array(a) else a, swing)
    with pytest.raises(ModelError, match=r"this is a batch of shape \(2,\)"):
        assert_constraints(batch)


@pytest.mark.slow
def test_a_model_without_constraints_says_so():
    found = assert_constraints(simulate(oscillator(), 1.0, ts=TS))
    assert found.holds and "no hidden constraints" in found.checked
