"""Simulations outside of jit: their programs are compiled once, also those of derivatives, and can be let go."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import rc_circuit, rc_voltage

from jaxonomy_dae import simulate
from jaxonomy_dae.programs.cache import PROGRAMS

TS = np.array([0.3, 1.0])


@functools.cache
def circuit():
    return rc_circuit()


def voltage(R):
    return simulate(circuit().with_parameters({"r.R": R}), 1.0, ts=TS)["c.v"]


def total(R):
    return jnp.sum(voltage(R) ** 2)


def slope(R, h=1e-6):
    """Of the closed form."""
    sums = [np.sum(rc_voltage(TS, R=R + d) ** 2) for d in (h, -h)]
    return (sums[0] - sums[1]) / (2 * h)


@pytest.fixture
def compilations():
    """The names of what XLA compiles."""
    seen = []

    def listen(event, duration, **_):
        if "compile" in event and active:
            seen.append(event)

    active = [True]
    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    active.clear()


def test_a_gradient_is_compiled_once(compilations):
    """Each operation was compiled by itself, loops anew at every call: 4.2 s a call, and 346 memory mappings."""
    np.testing.assert_allclose(jax.grad(total)(jnp.array(2.0)), slope(2.0), rtol=1e-5)
    assert compilations
    compilations.clear()
    for R in (1.5, 2.5):
        np.testing.assert_allclose(jax.grad(total)(jnp.array(R)), slope(R), rtol=1e-5)
    assert not compilations
    PROGRAMS.clear()
    np.testing.assert_allclose(jax.grad(total)(jnp.array(3.0)), slope(3.0), rtol=1e-5)
    assert compilations


def test_a_batch_is_compiled_once(compilations):
    def checked(R):
        expected = [rc_voltage(TS, R=one) for one in R]
        np.testing.assert_allclose(jax.vmap(voltage)(jnp.array(R)), expected, rtol=1e-5)

    checked([1.0, 2.0])
    assert compilations
    compilations.clear()
    checked([3.0, 4.0])
    assert not compilations
