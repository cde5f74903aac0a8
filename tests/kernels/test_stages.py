"""Stages written out, or looped over where fields are large: the same methods."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.solve.methods.field_size import LARGE, is_large
from jaxonomy_dae.solvers import DAETerm, Rodas5P, Tsit5, solve_dae

TS = np.array([0.5, 1.0, 2.0])


def kinetics(t, x, z, k):
    return jnp.stack([-k * x[0] + z[0] * x[1], k * x[0] - z[0] * x[1] + 0.1 * jnp.sin(t)])


def balance(t, x, z, k):
    return z**3 + z - x[:1] - t


KINETICS = DAETerm(kinetics, balance)
START = np.array([1.0, 0.5]), np.array([0.6823278038280193])  # z³ + z = 1


def swing(t, y, a):
    return jnp.stack([y[1], -a * jnp.sin(y[0])])


SWING = diffrax.ODETerm(swing)


@pytest.mark.parametrize(
    "method, term, y0", [(Rodas5P, KINETICS, START), (Tsit5, SWING, np.array([1.0, 0.0]))], ids=["rodas5p", "tsit5"]
)
def test_a_loop_over_stages_is_the_same_step(method, term, y0):
    """The same formulas in another order: values, errors and derivatives differ by rounding."""

    def step(k, looped):
        solver = method(looped=looped)
        t0, t1 = jnp.asarray(0.1), jnp.asarray(0.3)
        state = solver.init(term, t0, t1, y0, k)
        end, error, dense, _, _ = solver.step(term, t0, t1, y0, k, state, jnp.asarray(False))
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves((end, error, dense))])

    @jax.jit
    def both(k):
        one = jnp.ones(())
        return [jax.jvp(lambda k, looped=looped: step(k, looped), (k,), (one,)) for looped in (False, True)]

    (values, slopes), (looped_values, looped_slopes) = both(np.array(3.0))
    # What cancels in small entries are terms of the size of the large ones.
    rounding = 16 * np.finfo(float).eps * np.abs(values).max()
    np.testing.assert_allclose(looped_values, values, rtol=1e-12, atol=rounding)
    np.testing.assert_allclose(looped_slopes, slopes, rtol=1e-12, atol=1e-14)


def end(k, looped):
    x, z = solve_dae(KINETICS, 2.0, START, ts=TS, args=k, solver=Rodas5P(looped=looped), rtol=1e-8, atol=1e-10).ys
    return jnp.append(jnp.sum(x @ jnp.array([1.0, 2.0])), jnp.sum(z))


def explicit_end(a, looped):
    solved = diffrax.diffeqsolve(
        SWING, Tsit5(looped=looped), 0.0, 2.0, 0.01, jnp.array([1.0, 0.0]), a, saveat=diffrax.SaveAt(ts=TS),
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
    )  # fmt: skip
    return jnp.sum(solved.ys, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("of", [jax.jacrev(end), jax.jacrev(explicit_end)])
def test_a_loop_over_stages_is_the_same_run(of):
    """Some tens of steps, and their gradients."""
    written, looped = (jax.jit(of, static_argnums=1)(3.0, which) for which in (False, True))
    np.testing.assert_allclose(looped, written, rtol=1e-10)


@pytest.mark.parametrize("repeated", [1, LARGE])
def test_inner_programs_count(repeated):
    def field(x):
        inner = jax.jit(lambda x: [x := jnp.sin(x) for _ in range(repeated)][-1])
        return jax.lax.cond(x > 0, inner, jnp.cos, x)

    assert is_large(field, 1.0) == (repeated > 1)
