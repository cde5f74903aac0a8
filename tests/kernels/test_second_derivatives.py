"""Forward mode over `StoredAdjoint`: second derivatives against closed forms and against forward mode alone."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import ModelError
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, StoredAdjoint, Tsit5, consistent_start, solve_dae

TS = jnp.array([0.5, 1.0])
PID = diffrax.PIDController(rtol=1e-9, atol=1e-9)


def logistic(p, solver, adjoint):
    """y' = a·y·(1 − y), y(t0) = b at two times: a vector of a, b and t0."""
    a, b, t0 = p
    term = diffrax.ODETerm(lambda t, y, a: a * y * (1 - y))
    saveat = diffrax.SaveAt(ts=TS)
    solution = diffrax.diffeqsolve(
        term, solver, t0, 1.0, 0.01, b, a, saveat=saveat, stepsize_controller=PID, adjoint=adjoint, throw=False
    )
    return jnp.sum(solution.ys * jnp.array([1.0, 2.0]))


def logistic_exact(p):
    a, b, t0 = p
    return jnp.sum(jnp.array([1.0, 2.0]) / (1 + (1 / b - 1) * jnp.exp(-a * (TS - t0))))


P = jnp.array([1.5, 0.2, 0.1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(Tsit5(), id="own"),
        pytest.param(diffrax.Dopri5(scan_kind="bounded"), id="diffrax"),
    ],
)
def test_hessian_of_the_logistic_equation(solver):
    hessian = jax.jit(jax.hessian(lambda p: logistic(p, solver, StoredAdjoint())))(P)
    np.testing.assert_allclose(hessian, jax.hessian(logistic_exact)(P), rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_the_same_as_forward_mode_twice():
    """Both differentiate the same formulas, so they agree to rounding (t0 shifts the steps: left out)."""

    def f(adjoint):
        return lambda ab: logistic(jnp.append(ab, 0.1), Tsit5(), adjoint)

    twice = jax.jit(jax.jacfwd(jax.jacfwd(f(diffrax.ForwardMode()))))(P[:2])
    np.testing.assert_allclose(jax.jit(jax.hessian(f(StoredAdjoint())))(P[:2]), twice, rtol=1e-10)


@pytest.mark.slow
def test_batches_of_second_derivatives():
    """Members of a batch wait for the slowest one: their second derivatives are those they have alone."""

    def second(p, v):
        return jax.jvp(jax.grad(lambda p: logistic(p, Tsit5(), StoredAdjoint())), (p,), (v,))[1]

    many = jnp.stack([P, jnp.array([15.0, 0.01, 0.3]), jnp.array([0.1, 0.9, 0.0])])
    v = jnp.array([1.0, -0.5, 0.25])
    found = jax.jit(jax.vmap(second, (0, None)))(many, v)
    alone = jax.jit(second)
    for row, p in zip(found, many, strict=True):
        np.testing.assert_allclose(row, alone(p, v), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Rodas5P(), BDF()], ids=["rodas5p", "bdf"])
def test_differential_algebraic(solver):
    """x' = −a·x·z, z² = x: x(1) = (1 + a/2)⁻²."""
    term = DAETerm(lambda t, x, z, a: -a * x * z, lambda t, x, z, a: z**2 - x)
    start = jnp.ones(1), jnp.ones(1)

    def final(a):
        return solve_dae(term, 1.0, start, solver=solver, args=a, rtol=1e-9, atol=1e-11, throw=False).ys[0][0, 0]

    found = eqx.filter_jit(jax.jacfwd(jax.grad(final)))(0.7)
    assert found == pytest.approx(1.5 * (1 + 0.35) ** -4, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Rodas5P(), BDF()], ids=["rodas5p", "bdf"])
def test_of_algebraic_unknowns(solver):
    """z³ + z = a·x, x' = 0 from a start that solves for z: z'' as above."""
    term = DAETerm(lambda t, x, z, a: 0 * x, lambda t, x, z, a: z**3 + z - a * x)

    def end(a):
        y0 = consistent_start(term, (jnp.ones(1), jnp.ones(1)), args=a)
        return solve_dae(term, 1.0, y0, args=a, ts=jnp.array([0.5]), solver=solver, rtol=1e-8, atol=1e-8).ys[1][0, 0]

    np.testing.assert_allclose(jax.jit(jax.hessian(end))(10.0), -6 * 2 / 13**3, rtol=1e-9)


@pytest.mark.parametrize("twice", [lambda f: jax.grad(jax.grad(f)), lambda f: jax.grad(jax.jacfwd(f))])
@pytest.mark.parametrize("staged", [False, True])
def test_reverse_mode_outside_says_what_to_write(twice, staged):
    """JAX's own errors spoke of `lax.while_loop` and of `custom_vjp`."""

    def end(a):
        return solve_dae(diffrax.ODETerm(lambda t, y, a: -a * y), 1.0, jnp.ones(1), args=a).ys[-1, 0]

    second = twice(end)
    with pytest.raises(ModelError, match=r"jax\.jacfwd\(jax\.grad\(f\)\)"):
        (jax.jit(second) if staged else second)(1.0)
