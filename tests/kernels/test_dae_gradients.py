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
from problems import angle_solution, pendulum
from testset import PROBLEMS
from testset.problem import load

from jaxonomy_dae import ModelError, simulate
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, consistent_start, solve_dae

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
    "chemakzo": Case(30.0, ("k1", "k2", "klA", "Ks"), 1e-2),
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
        "direct": diffrax.DirectAdjoint(),
        "forward": diffrax.ForwardMode(),
    }[mode]
    solution = end(name, SOLVERS[solver], adjoint)

    def loss(change):
        return weighted(name, solution(change, 1e-8))

    differentiate = jax.jacfwd if mode == "forward" else jax.grad
    return np.asarray(jax.jit(differentiate(loss))(jnp.zeros(len(CASES[name].parameters))))


def each(quick):
    names = [(name, solver) for name in CASES for solver in SOLVERS]
    return [pytest.param(*pair, marks=() if pair in quick else slow, id="-".join(pair)) for pair in names]


@pytest.mark.parametrize("name, solver", each([("robertson", "bdf"), ("robertson", "rodas5p")]))
def test_reverse_is_forward(name, solver):
    reverse, forward = gradient(name, solver, "reverse"), gradient(name, solver, "forward")
    assert np.abs(reverse).min() > 0
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


@functools.cache
def differences(name):
    """Central differences of solutions by Rodas5P at a tolerance of 1e-11."""
    solution = jax.jit(end(name, Rodas5P(), diffrax.RecursiveCheckpointAdjoint()))
    found, step = [], 1e-4
    for k in range(len(CASES[name].parameters)):
        move = jnp.zeros(len(CASES[name].parameters)).at[k].set(step)
        after, before = weighted(name, solution(move, 1e-11)), weighted(name, solution(-move, 1e-11))
        found.append(float(after - before) / (2 * step))
    return np.array(found)


@slow
@pytest.mark.parametrize("name, solver", [(name, solver) for name in CASES for solver in SOLVERS])
def test_reverse_is_the_difference(name, solver):
    found = gradient(name, solver, "reverse")
    np.testing.assert_allclose(found, differences(name), rtol=1e-5, atol=1e-5 * np.abs(found).max())


@slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_direct_adjoint_agrees(solver):
    found = gradient("robertson", solver, "direct")
    np.testing.assert_allclose(found, gradient("robertson", solver, "forward"), rtol=1e-8)


@pytest.mark.parametrize("solver", ["bdf", pytest.param("rodas5p", marks=slow)])
def test_published_sensitivities(solver):
    # d(A, B, C)/dp at t = 40 by IDAS with full error control at rtol 1e-4, atol 1e-8, 1e-14, 1e-6: five digits printed,
    # and its errors are a few times its tolerance.
    table = np.array(load("robertson")["sensitivities"][0]["table"]["40.0"])
    solution = end("robertson", SOLVERS[solver], diffrax.ForwardMode())
    jacobian = jax.jit(jax.jacfwd(solution))(jnp.zeros(3), jnp.asarray(1e-8))
    parameters = np.array([PROBLEMS["robertson"].index_one().parameters[p] for p in CASES["robertson"].parameters])
    np.testing.assert_allclose(np.asarray(jacobian).T / parameters[:, None], table, rtol=1e-3)


def test_gradients_through_a_consistent_start():
    # x' = −k·x, z³ + z = x: ∂z(1)/∂x(0) = e^(−k)/(3z² + 1), whatever the guess of z(0), and ∂x(1)/∂k = −x(1).
    term = DAETerm(lambda t, x, z, k: -k * x, lambda t, x, z, k: z**3 + z - x)

    def final(x0, guess, k):
        start = consistent_start(term, (x0[None], guess[None]), args=k)
        solution = solve_dae(term, 1.0, start, args=k, rtol=1e-9, atol=1e-11)
        return solution.ys[0][0, 0], solution.ys[1][0, 0]

    point = jnp.asarray(2.0), jnp.asarray(0.3), jnp.asarray(0.7)
    (x, z), (dx, dz) = final(*point), jax.jit(jax.jacrev(final, argnums=(0, 1, 2)))(*point)
    decay = np.exp(-0.7)
    exact_z = np.real(np.roots([1, 0, 1, -2 * decay])[-1])
    # A hundred times rtol.
    np.testing.assert_allclose([x, z], [2 * decay, exact_z], rtol=1e-7)
    np.testing.assert_allclose(dx, [decay, 0, -2 * decay], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(dz, np.array([decay, 0, -2 * decay]) / (3 * exact_z**2 + 1), rtol=1e-7, atol=1e-12)


def final(system, names, starts, t1, variable, solver):
    """(parameters and starts, rtol, adjoint) to a variable at t1."""

    def at_end(v, rtol, adjoint):
        changed = system.with_parameters(dict(zip(names, v[: len(names)], strict=True)))
        start = dict(zip(starts, v[len(names) :], strict=True))
        return simulate(
            changed, t1, ts=jnp.array([t1]), solver=solver, rtol=rtol, atol=rtol * 1e-2, adjoint=adjoint, initial=start,
            max_steps=4000,
        )[variable][0]  # fmt: skip

    return at_end


def by_both_modes(at_end, values):
    reverse = jax.jit(jax.grad(lambda v: at_end(v, 1e-8, diffrax.RecursiveCheckpointAdjoint())))(values)
    forward = jax.jit(jax.jacfwd(lambda v: at_end(v, 1e-8, diffrax.ForwardMode())))(values)
    return np.asarray(reverse), np.asarray(forward)


def by_differences(function, values):
    """Central differences of a function of an array, with steps of 1e-4 relative."""
    found = []
    for k, value in enumerate(np.asarray(values)):
        move = np.zeros(len(values))
        move[k] = 1e-4 * abs(value)
        found.append(float(function(values + move) - function(values - move)) / (2 * move[k]))
    return np.array(found)


@pytest.mark.parametrize("solver", ["bdf", pytest.param("rodas5p", marks=slow)])
def test_gradients_of_a_constrained_model(solver):
    # The multiplier is not a state: its gradient goes through hidden constraints and the projection. The reference is
    # SciPy's solution for the angle, at 1e-13.
    names, values = ("pend.L", "pend.g_y", "pend.m", "pend.initial_theta"), np.array([1.3, -9.81, 0.6, -1.2])
    at_end = final(pendulum(), names, (), 0.7, "pend.lam", SOLVERS[solver])
    found = jax.jit(jax.grad(lambda v: at_end(v, 1e-8, diffrax.RecursiveCheckpointAdjoint())))(jnp.asarray(values))

    def exact(v):
        return angle_solution(v[3], 0.0, [0.7], g=-v[1], L=v[0], m=v[2]).lam[0]

    np.testing.assert_allclose(found, by_differences(exact, values), rtol=1e-5)


MODELS = {
    "chemakzo": (("k1", "klA"), {"FLB": 0.444, "ZLA": 0.007}, 20.0, "FLB_ZHU"),
    "andrews": (("mom", "c0"), {}, 0.002, "gamma"),  # index 3, seven bodies
}


@slow
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", MODELS)
def test_gradients_of_models(name, solver):
    parameters, starts, t1, variable = MODELS[name]
    system = PROBLEMS[name].compile()
    names = tuple(f"{name}.{p}" for p in parameters)
    initial = tuple(f"{name}.{v}" for v in starts)
    at_end = final(system, names, initial, t1, f"{name}.{variable}", SOLVERS[solver])
    values = jnp.array([float(system.parameters[n]) for n in names] + list(starts.values()))
    reverse, forward = by_both_modes(at_end, values)
    size = np.max(np.abs(reverse * values))
    np.testing.assert_allclose(reverse * values, forward * values, rtol=0, atol=1e-8 * size)
    tight = jax.jit(lambda v: at_end(v, 1e-11, diffrax.RecursiveCheckpointAdjoint()))
    expected = by_differences(lambda v: tight(jnp.asarray(v)), np.asarray(values))
    np.testing.assert_allclose(reverse, expected, rtol=1e-5)


def test_backsolve_is_refused():
    with pytest.raises(ModelError) as caught:
        simulate(pendulum(), 1.0, solver=BDF(), adjoint=diffrax.BacksolveAdjoint())
    assert str(caught.value) == (
        "adjoint=BacksolveAdjoint() is wrong for constrained systems: it integrates the state backwards without its "
        "constraints and leaves the algebraic variables out. Use the default StoredAdjoint(), "
        "RecursiveCheckpointAdjoint(), or ForwardMode() for few parameters"
    )
