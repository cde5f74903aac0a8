"""Starts of models with many algebraic unknowns, against Newton's method in NumPy on the same equations."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import Component, EqnEnv, InitializationError, der
from jaxonomy_dae.compile.lowering import schedule
from jaxonomy_dae.run.start import initialize as initialization
from jaxonomy_dae.run.start import sparse_newton
from jaxonomy_dae.run.start.rows import initial_rows

pytestmark = pytest.mark.skipif(importlib.util.find_spec("klujax") is None, reason='needs the extra "sparse"')
N = 66  # cells: 132 unknowns
C = 40.0
CELLS = (np.arange(N) + 0.5) / N
U = 1 + 0.5 * np.cos(np.pi * CELLS)
LAPLACIAN = np.diag(np.r_[-1, np.full(N - 2, -2), -1.0]) + np.eye(N, k=1) + np.eye(N, k=-1)


class Reaction(Component):
    """u' = c Δu − u·w, 0 = c Δw − w − w³ + u on a line, no flux at its ends."""

    def __init__(self, ev, name, fixed=True, more=()):
        super().__init__(ev, name)
        c = self.parameter("c", C)
        u = [self.variable(f"u{k}", start=float(U[k]), fixed=fixed) for k in range(N)]
        w = [self.variable(f"w{k}", start=3.0, fixed=k in more) for k in range(N)]

        def laplacian(v, k):
            return v[max(k - 1, 0)] - 2 * v[k] + v[min(k + 1, N - 1)]

        for k in range(N):
            self.add_equations(der(u[k]) - c * laplacian(u, k) + u[k] * w[k])
            self.add_equations(c * laplacian(w, k) - w[k] - w[k] ** 3 + u[k])


def reference(c=C):
    w = np.full(N, 0.5)
    for _ in range(50):
        w = w - np.linalg.solve(c * LAPLACIAN - np.diag(1 + 3 * w**2), c * LAPLACIAN @ w - w - w**3 + U)
    return w


def whole(**options):
    """The model with its block whole, as it would be with more cells."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "WRITTEN_OUT", {True: 2, False: 2})
        return compiled(Reaction(EqnEnv(), "m", **options))


@pytest.fixture(scope="module")
def reaction():
    return whole()


def parts(system, x):
    u = [system.states.index(f"m.u{k}") for k in range(N)]
    w = [len(system.states) + system.carried.index(f"m.w{k}") for k in range(N)]
    return np.asarray(x)[u], np.asarray(x)[w]


def test_rows_of_a_large_start_are_sparse(reaction):
    rows = sparse_newton.sparse_rows(reaction.plan, initial_rows(reaction.plan, ()))
    assert rows is not None and rows.pattern.shape == (2 * N, 2 * N) and rows.pattern.n_colors <= 8


@pytest.mark.slow
def test_a_large_start_is_found_by_sparse_algebra(reaction):
    """The ladder, whose algebra is dense, is not climbed: 800 unknowns took 41 s."""
    u, w = parts(reaction, reaction.initialize())
    np.testing.assert_array_equal(u, U)
    np.testing.assert_allclose(w, reference(), rtol=1e-12)
    report = reaction.initialization_report()
    assert report.consistent and report.method == "Newton" and report.evaluations < 12


@pytest.mark.slow
def test_derivatives_of_a_large_start(reaction):
    def ends(c):
        x = reaction.with_parameters({"m.c": c}).initialize()
        return x[len(reaction.states) + reaction.carried.index("m.w0")]

    h = 1e-4 * C
    slope = (reference(C + h)[0] - reference(C - h)[0]) / (2 * h)
    (value, gradient), forward = jax.jit(lambda c: (jax.value_and_grad(ends)(c), jax.jacfwd(ends)(c)))(C)
    np.testing.assert_allclose(value, reference()[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, slope, rtol=1e-6)
    np.testing.assert_allclose(forward, gradient, rtol=1e-10)


@pytest.mark.slow
def test_batches_of_large_starts(reaction):
    found = jax.jit(jax.vmap(lambda c: reaction.with_parameters({"m.c": c}).initialize()))(jnp.array([C, 2 * C]))
    for c, x in zip((C, 2 * C), np.asarray(found), strict=True):
        np.testing.assert_allclose(parts(reaction, x)[1], reference(c), rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [False])
def test_where_it_fails_the_ladder_is_climbed(monkeypatch, fixed):
    """Starts that are guesses hold where they can."""
    monkeypatch.setattr(sparse_newton, "NEWTON_LIMIT", 2)
    system = whole(fixed=fixed)
    u, w = parts(system, jax.jit(lambda: initialization.initialize(system, 0.0, None, None).x)())
    np.testing.assert_allclose(u, U, rtol=1e-9)
    np.testing.assert_allclose(w, reference(), rtol=1e-9)


@pytest.mark.slow
def test_a_contradiction_in_a_large_start_is_named():
    with pytest.raises(InitializationError, match=r"m\.w7, m\.u\d+.* contradict each other"):
        whole(more=(7,)).initialize()
