"""Batches of systems: read, changed and printed as arrays of systems, whatever the batch's shape."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import rc_circuit

from jaxonomy_dae import ModelError

R = np.array([1.0, 2.0, 4.0])


@pytest.fixture(scope="module")
def rc():
    return rc_circuit(R=3.0, C=0.5)


def batch_of(system, values):
    make = eqx.filter_vmap(lambda r: system.with_parameters({"r.R": r}))
    for _ in range(np.ndim(values) - 1):
        make = eqx.filter_vmap(make)
    return make(jnp.asarray(values))


@pytest.mark.parametrize("shape", [(3,), (3, 1), (2, 3)])
def test_reading(rc, shape):
    values = np.resize(R, shape)
    batch = batch_of(rc, values)
    np.testing.assert_array_equal(batch.parameters["r.R"], values)
    np.testing.assert_array_equal(batch.parameters["c.C"], np.full(shape, 0.5))
    found = dict(batch.parameters.items())
    assert list(found) == rc.parameters.names and len(batch.parameters) == len(rc.parameters)
    np.testing.assert_array_equal(found["r.R"], values)
    assert f"batch of shape {shape}" in repr(batch.parameters) and "r.R=[" in repr(batch.parameters)


def test_changing(rc):
    batch = batch_of(rc, R)
    changed = batch.with_parameters({"c.C": 2.0, "source.V": np.array([1.0, 2.0, 3.0])})
    np.testing.assert_array_equal(changed.parameters["c.C"], [2.0, 2.0, 2.0])
    np.testing.assert_array_equal(changed.parameters["source.V"], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(changed.parameters["r.R"], R)
    with pytest.raises(
        ModelError, match=r"'c\.C' needs a scalar or, in this batch of systems, shape \(3,\); got .*\(2,\)"
    ):
        batch.with_parameters({"c.C": np.ones(2)})
    with pytest.raises(ModelError, match=r"'c\.C' must lie in \(0, inf\); got -1"):
        batch.with_parameters({"c.C": np.array([1.0, -1.0, 2.0])})


def test_each_member_computes_with_its_own_values(rc):
    batch = batch_of(rc, R)
    slope = eqx.filter_vmap(lambda s: s.vector_field(0.0, jnp.array([1.0])))(batch)
    np.testing.assert_allclose(slope[:, 0], (3.0 - 1.0) / (R * 0.5), rtol=1e-14)


def test_an_ensemble_of_trained_parts(rc):
    """One frozen part, and a batch of trained ones: each has its own value, the others are shared."""
    trainable, frozen = rc.partition("r.R")
    members = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), trainable)
    joined = eqx.combine(members, frozen)
    np.testing.assert_array_equal(joined.parameters["r.R"], [3.0, 6.0])
    np.testing.assert_array_equal(joined.parameters.array[:, joined.parameters.names.index("r.R")], [3.0, 6.0])
    np.testing.assert_array_equal(joined.merged().parameters["c.C"], [0.5, 0.5])


def test_a_part_of_a_system_says_where_the_rest_is(rc):
    trainable, frozen = rc.partition("r.R")
    assert repr(trainable.parameters) == "Parameters(r.R=3; the others are in the frozen part)"
    assert "r.R=set apart" in repr(frozen.parameters) and "c.C=0.5" in repr(frozen.parameters)
    assert float(trainable.parameters["r.R"]) == 3.0
    for part, name in ((trainable, "c.C"), (frozen, "r.R")):
        with pytest.raises(ModelError, match=f"'{name}' is in the other part.*equinox.combine"):
            part.parameters[name]
