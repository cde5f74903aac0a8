"""Stages written out, or looped over where fields are large: the same methods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.solvers import DAETerm, Rodas5P, Tsit5, solve_dae
from jaxonomy_dae.solvers.field_size import LARGE, is_large

TS = jnp.array([0.5, 1.0, 2.0])


def kinetics(t, x, z, k):
    return jnp.stack([-k * x[0] + z[0] * x[1], k * x[0] - z[0] * x[1] + 0.1 * jnp.sin(t)])


def balance(t, x, z, k):
    return z**3 + z - x[:1] - t


def end(k, looped):
    term = DAETerm(kinetics, balance)
    y0 = jnp.array([1.0, 0.5]), jnp.array([0.6823278038280193])  # z³ + z = 1
    solver = Rodas5P(looped=looped)
    x, z = solve_dae(term, 2.0, y0, ts=TS, args=k, solver=solver, rtol=1e-8, atol=1e-10).ys
    return jnp.append(jnp.sum(x @ jnp.array([1.0, 2.0])), jnp.sum(z))


def test_a_loop_over_stages_is_the_same_step():
    """The same formulas in another order: values and gradients differ by rounding, some tens of steps."""
    for of in (end, jax.jacrev(end)):
        written, looped = (jax.jit(of, static_argnums=1)(3.0, which) for which in (False, True))
        np.testing.assert_allclose(looped, written, rtol=1e-10)


def test_the_explicit_method_too():
    import diffrax

    def run(a, looped):
        term = diffrax.ODETerm(lambda t, y, a: jnp.stack([y[1], -a * jnp.sin(y[0])]))
        solved = diffrax.diffeqsolve(
            term, Tsit5(looped=looped), 0.0, 2.0, 0.01, jnp.array([1.0, 0.0]), a, saveat=diffrax.SaveAt(ts=TS),
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        )  # fmt: skip
        return jnp.sum(solved.ys, axis=0)

    for of in (run, jax.jacrev(run)):
        written, looped = (jax.jit(of, static_argnums=1)(3.0, which) for which in (False, True))
        np.testing.assert_allclose(looped, written, rtol=1e-10)


@pytest.mark.parametrize("repeated", [1, LARGE])
def test_inner_programs_count(repeated):
    def field(x):
        inner = jax.jit(lambda x: [x := jnp.sin(x) for _ in range(repeated)][-1])
        return jax.lax.cond(x > 0, inner, jnp.cos, x)

    assert is_large(field, 1.0) == (repeated > 1)
