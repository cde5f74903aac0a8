"""Simulations outside of jit: their programs are compiled once, also those of derivatives, and can be let go."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component, rc_circuit, rc_voltage
from sympy import Eq

import jaxonomy_dae
from jaxonomy_dae import der, simulate
from jaxonomy_dae.host.cache import PROGRAMS

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


@pytest.mark.slow
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


def cubic(self, ev):
    """y = x³ + x with y fixed at the start."""
    p = self.parameter("p", 10.0)
    x, y = self.variable("x"), self.variable("y", start=p, fixed=True)
    self.add_equations(Eq(der(x), -x), Eq(y, x**3 + x))


@pytest.mark.slow
def test_derivatives_of_a_start(compilations):
    """x³ + x = p has x' = 1/(3x² + 1), x'' = −6x x'²/(3x² + 1), at x = 2 and 3; in both modes, and batched."""
    system = compiled(component(cubic))

    def x(p):
        return system.with_parameters({"c.p": p}).initialize()[0]

    p, root = jnp.array([10.0, 30.0]), np.array([2.0, 3.0])
    first = 1 / (3 * root**2 + 1)
    for _ in range(2):
        compilations.clear()
        np.testing.assert_allclose(jax.vmap(jax.grad(x))(p), first, rtol=1e-12)
        np.testing.assert_allclose(jax.hessian(x)(p[0]), -6 * 2 * first[0] ** 3, rtol=1e-12)
    assert not compilations


@pytest.mark.slow
def test_runs_that_are_longer_than_their_record():
    """Whether a run is made again, piece by piece, is known before its derivative is compiled: a derivative of one that
    fits into its record has no steps to make again, and is not used for a longer one."""
    count = len(jaxonomy_dae.compilations())

    def end(R, t1):
        run = simulate(circuit().with_parameters({"r.R": R}), t1, ts=np.array([t1]), dtmax=1e-3, rtol=1e-8, atol=1e-10)
        return run["c.v"][0]

    for t1 in (0.1, 1.0, 0.2, 2.0):  # 100, 1000, 200 and 2000 steps; a record has 256 rows
        h = 1e-6
        exact = (rc_voltage(t1, R=2.0 + h) - rc_voltage(t1, R=2.0 - h)) / (2 * h)
        np.testing.assert_allclose(jax.grad(end)(2.0, t1), exact, rtol=1e-6)
    names = [one.name for one in jaxonomy_dae.compilations()[count:]]
    assert names.count("run") == 1 and names.count("gradient of run") == 2
    several = jax.vmap(jax.grad(end), in_axes=(0, None))(jnp.array([2.0, 2.0]), 1.0)
    np.testing.assert_allclose(several, jax.grad(end)(2.0, 1.0), rtol=1e-9)
