"""Gradients through `BDF` and `Rodas5P` on published problems, with respect to parameters and starts.

What an adjoint differentiates is the solver's own arithmetic: reverse and forward mode agree to rounding, 1e-8 of the
gradient's size allowing for its amplification over some hundred stiff steps. Differences of solutions at a tolerance of
1e-11 are exact to about 1e-6 (steps of 1e-4 relative: the truncation is the third derivative's); the gradient has
the error of a solution at its own tolerance of 1e-8: 1e-5 is asked of both together.
"""

import functools
from dataclasses import dataclass

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from testset import PROBLEMS
from testset.problem import load

from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, StoredAdjoint, consistent_start, solve_dae

SOLVERS = {"bdf": BDF(), "rodas5p": Rodas5P()}
slow = pytest.mark.slow


@dataclass(frozen=True)
class Case:
    """A problem over a time in which much happens, the parameters to differentiate by, atol in units of rtol."""

    t1: float
    parameters: tuple[str, ...]
    atol: float


CASES = {
    "robertson": Case(40.0, ("p1", "p2", "p3"), 1e-5),
    "transamp": Case(0.01, ("Ub", "R0", "R5", "beta"), 1.0),
}


def end(name, solver, adjoint):
    """(relative changes of the parameters, rtol) to y at the end, the start made consistent again."""
    problem, case = PROBLEMS[name], CASES[name]
    one = problem.index_one()
    term = DAETerm(one.F, mass=one.mass)

    def solution(change, rtol):
        args = one.args()
        for k, p in enumerate(case.parameters):
            args[p] = args[p] * (1 + change[k])
        start = consistent_start(term, jnp.asarray(one.y0), args=args)
        return solve_dae(
            term, case.t1, start, solver=solver, rtol=rtol, atol=jnp.maximum(rtol * case.atol, 1e-15), args=args,
            adjoint=adjoint, max_steps=4000,
        ).ys[0]  # fmt: skip

    return solution


def weighted(name, y):
    """A sum over all unknowns, each in units of its value at the end, with different weights."""
    size = np.abs(np.asarray(PROBLEMS[name].index_one().y0)) + 1e-2
    if name == "robertson":
        size = np.array([1.0, 1e-5, 1.0])
    return jnp.sum(y / size * jnp.arange(1.0, 1 + len(size)))


@functools.cache
def gradient(name, solver, mode):
    adjoint = {
        "reverse": diffrax.RecursiveCheckpointAdjoint(),
        "stored": StoredAdjoint(),
        "direct": diffrax.DirectAdjoint(),
        "forward": diffrax.ForwardMode(),
    }[mode]
    solution = end(name, SOLVERS[solver], adjoint)

    def loss(change):
        return weighted(name, solution(change, 1e-8))

    differentiate = jax.jacfwd if mode == "forward" else jax.grad
    return np.asarray(jax.jit(differentiate(loss))(np.zeros(len(CASES[name].parameters))))


PAIRS = [("robertson", "bdf"), ("robertson", "rodas5p")]


@slow
@pytest.mark.parametrize("name, solver", PAIRS)
def test_reverse_is_forward(name, solver):
    reverse, forward = gradient(name, solver, "reverse"), gradient(name, solver, "forward")
    assert np.abs(reverse).min() > 0
    # Without XLA's optimization, Diffrax' checkpointed loop loses 8e-8 of the derivative by p1 with Rodas5P, in sums of
    # what cancels between two equations; StoredAdjoint agrees with forward mode to 5e-10 there, see below.
    np.testing.assert_allclose(reverse, forward, rtol=1e-8 if solver == "bdf" else 2e-7)


@functools.cache
def differences(name):
    """Central differences of solutions by Rodas5P at a tolerance of 1e-11."""
    solution = jax.jit(end(name, Rodas5P(), diffrax.RecursiveCheckpointAdjoint()))
    found, step = [], 1e-4
    for k in range(len(CASES[name].parameters)):
        move = step * np.eye(len(CASES[name].parameters))[k]
        after, before = weighted(name, solution(move, 1e-11)), weighted(name, solution(-move, 1e-11))
        found.append(float(after - before) / (2 * step))
    return np.array(found)


@slow
@pytest.mark.parametrize("name, solver", [*PAIRS, ("transamp", "bdf")])
def test_reverse_is_the_difference(name, solver):
    found = gradient(name, solver, "reverse")
    np.testing.assert_allclose(found, differences(name), rtol=1e-5, atol=1e-5 * np.abs(found).max())


@slow
@pytest.mark.parametrize("solver, adjoint", [("bdf", "direct"), ("bdf", "stored"), ("rodas5p", "stored")])
def test_other_adjoints_agree(solver, adjoint):
    found = gradient("robertson", solver, adjoint)
    np.testing.assert_allclose(found, gradient("robertson", solver, "forward"), rtol=1e-8)


@slow
@pytest.mark.parametrize("solver, mode", [("bdf", "reverse"), ("bdf", "forward"), ("rodas5p", "forward")])
def test_published_sensitivities(solver, mode):
    # d(A, B, C)/dp at t = 40 by IDAS with full error control at rtol 1e-4, atol 1e-8, 1e-14, 1e-6: five digits printed,
    # and its errors are a few times its tolerance.
    table = np.array(load("robertson")["sensitivities"][0]["table"]["40.0"])
    adjoint, by = (None, jax.jacrev) if mode == "reverse" else (diffrax.ForwardMode(), jax.jacfwd)
    jacobian = jax.jit(by(end("robertson", SOLVERS[solver], adjoint)))(np.zeros(3), np.array(1e-8))
    parameters = np.array([PROBLEMS["robertson"].index_one().parameters[p] for p in CASES["robertson"].parameters])
    np.testing.assert_allclose(np.asarray(jacobian).T / parameters[:, None], table, rtol=1e-3)


@pytest.mark.long("the one gradient by Rodas5P of the default run")
def test_gradients_through_a_consistent_start():
    """x' = −k·x, z³ + z = x: ∂z(1)/∂x(0) = e^(−k)/(3z² + 1), whatever the guess of z(0), and ∂x(1)/∂k = −x(1)."""
    term = DAETerm(lambda t, x, z, k: -k * x, lambda t, x, z, k: z**3 + z - x)

    def final(x0, guess, k):
        start = consistent_start(term, (x0[None], guess[None]), args=k)
        solution = solve_dae(term, 1.0, start, args=k, rtol=1e-9, atol=1e-11, throw=False)
        end = jnp.stack([solution.ys[0][0, 0], solution.ys[1][0, 0]])
        return end, end

    slopes, (x, z) = jax.jit(jax.jacrev(final, argnums=(0, 1, 2), has_aux=True))(*np.array([2.0, 0.3, 0.7]))
    dx, dz = np.array(slopes).T
    decay = np.exp(-0.7)
    exact_z = np.real(np.roots([1, 0, 1, -2 * decay])[-1])
    # A hundred times rtol.
    np.testing.assert_allclose([x, z], [2 * decay, exact_z], rtol=1e-7)
    np.testing.assert_allclose(dx, [decay, 0, -2 * decay], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(dz, np.array([decay, 0, -2 * decay]) / (3 * exact_z**2 + 1), rtol=1e-7, atol=1e-12)
