"""Sparse solves and Jacobians against dense ones.

The solves are backward stable, so errors are about 1e-16 times the condition number, which is below 1e3 here: 1e-11 is
far from noise, and from any mistake.
"""

import importlib.util

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from problems import run

from jaxonomy_dae import SimulationError
from jaxonomy_dae.solve.linear import sparse
from jaxonomy_dae.solve.linear.sparse import MissingSparseSolver, SparsePattern, solve_sparse, sparse_jacobian
from jaxonomy_dae.solvers import DAETerm, Rodas5P, solve_dae

installed = pytest.mark.skipif(importlib.util.find_spec("klujax") is None, reason='needs the extra "sparse"')
TIGHT = dict(rtol=1e-11, atol=1e-11)


def random_matrix(n: int = 40, seed: int = 0):
    """A diagonally dominant matrix with random places, some of which occur twice, its values, and a right side."""
    rng = np.random.default_rng(seed)
    rows = np.concatenate([np.arange(n), rng.integers(0, n, 2 * n), [0]])
    cols = np.concatenate([np.arange(n), rng.integers(0, n, 2 * n), [0]])
    values = np.concatenate([rng.uniform(8, 10, n), rng.uniform(-1, 1, 2 * n), [0.5]])
    return SparsePattern(rows, cols, n), values, rng.normal(size=n)


# --- patterns ----------------------------------------------------------------------------------------------------


def test_patterns_are_compared_by_content():
    pattern, values, _ = random_matrix()
    same, other = random_matrix()[0], random_matrix(seed=1)[0]
    assert pattern == same and hash(pattern) == hash(same) and pattern != other
    single, inverse = pattern.coalesced
    assert single.coalesced is None and len(single) < len(pattern)
    summed = np.bincount(inverse, values, len(single))
    both = jax.jit(lambda summed, values: (single.dense(summed), pattern.dense(values)))
    np.testing.assert_allclose(*both(summed, values))
    for rows, cols, message in (([0, 3], [0, 0], "rows must lie"), ([0], [-1], "cols must lie"), ([0], [0, 1], "one")):
        with pytest.raises(ValueError, match=message):
            SparsePattern(np.array(rows), np.array(cols), 3)


@pytest.mark.parametrize("seed", range(3))
def test_columns_of_one_color_share_no_row(seed):
    pattern = random_matrix(60, seed)[0]
    filled = np.zeros((60, 60), bool)
    filled[pattern.rows, pattern.cols] = True
    for color in range(pattern.n_colors):
        assert filled[:, pattern.colors == color].sum(axis=1).max() <= 1


def test_banded_patterns_take_as_many_colors_as_the_band_is_wide():
    n = 20_000
    k = np.arange(n)
    pattern = SparsePattern(np.concatenate([k, k[1:], k[:-1]]), np.concatenate([k, k[:-1], k[1:]]), n)
    assert pattern.n_colors == 3


# --- Jacobians ---------------------------------------------------------------------------------------------------


def test_jacobian_is_the_dense_one():
    pattern, values, b = random_matrix()

    def fun(y):
        return jnp.sin(pattern.multiply(jnp.asarray(values), y)) + y**3

    single = pattern.coalesced[0]
    found, repeated = sparse_jacobian(fun, single), sparse_jacobian(fun, pattern)
    assert pattern.n_colors < 20  # of 40 columns

    @jax.jit
    def with_derivatives(b):
        """Both Jacobians, and their derivatives: second derivatives along a direction."""
        functions = lambda y: single.dense(found(y)), jax.jacfwd(fun)
        return [jax.jvp(f, (b,), (b,)) for f in functions], pattern.dense(repeated(b))

    ((values, second), (expected, expected_second)), added = with_derivatives(b)
    np.testing.assert_allclose(added, values, rtol=1e-15)  # values at one place add up
    np.testing.assert_allclose(values, expected, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(second, expected_second, rtol=1e-13, atol=1e-13)


def test_jacobian_of_a_dense_pattern():
    rows, cols = np.indices((7, 5)).reshape(2, -1)
    pattern = SparsePattern(rows, cols, 5, 7)
    matrix = np.random.default_rng(0).normal(size=(7, 5))
    found = jax.jit(lambda y: pattern.dense(sparse_jacobian(lambda y: matrix @ y, pattern)(y)))(np.ones(5))
    np.testing.assert_allclose(found, matrix, rtol=1e-15)


# --- solves ------------------------------------------------------------------------------------------------------


@installed
@pytest.mark.parametrize("transpose", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_solution_is_the_dense_one(transpose):
    pattern, values, b = random_matrix()

    def dense(values, b):
        matrix = pattern.dense(values)
        return jnp.linalg.solve(matrix.T if transpose else matrix, b)

    def found(values, b):
        return solve_sparse(pattern, jnp.asarray(values), jnp.asarray(b), transpose)

    many, right = np.stack([values, 1.3 * values, values + 0.1]), np.stack([b, -b, b**2])

    @jax.jit
    def everything(values, b, many, right):
        """By either solve: values, batches of each argument, Jacobians, gradients in a batch."""
        return [
            (
                f(values, b),
                [jax.vmap(f, axes)(*given) for axes, given in (
                    ((0, 0), (many, right)), ((0, None), (many, b)), ((None, 0), (values, right))
                )],
                jax.jacrev(f, argnums=(0, 1))(values, b),
                jax.vmap(jax.grad(lambda v, r, f=f: jnp.sum(f(v, r) ** 2)))(many, right),
            )
            for f in (found, dense)
        ]  # fmt: skip

    for one, other in zip(*(jax.tree.leaves(part) for part in everything(values, b, many, right)), strict=True):
        np.testing.assert_allclose(one, other, **TIGHT)


@installed
@pytest.mark.slow
@pytest.mark.parametrize("transpose", [False, True])
def test_derivatives_of_the_solution(transpose):
    """First and second ones in both modes, and outside of jit."""
    pattern, values, b = random_matrix()

    def found(values, b):
        return solve_sparse(pattern, jnp.asarray(values), jnp.asarray(b), transpose)

    matrix = np.asarray(pattern.dense(jnp.asarray(values)))
    np.testing.assert_allclose(found(values, b), np.linalg.solve(matrix.T if transpose else matrix, b), **TIGHT)
    check_grads(found, (jnp.asarray(values), jnp.asarray(b)), order=2, modes=["fwd", "rev"])


@installed
def test_solve_within_a_loop():
    pattern, values, b = random_matrix()

    def iterated(values, b):
        return jax.lax.fori_loop(0, 3, lambda k, x: solve_sparse(pattern, values, x), b)

    def expected(values, b):
        return jnp.linalg.solve(jnp.linalg.matrix_power(pattern.dense(values), 3), b)

    @jax.jit
    def both(values, b):
        return [jax.value_and_grad(lambda v, f=f: (jnp.sum(f(v, b)), f(v, b)), has_aux=True)(values) for f in pair]

    pair = (iterated, expected)
    ((_, found), slope), ((_, reference), reference_slope) = both(values, b)
    np.testing.assert_allclose(found, reference, **TIGHT)
    np.testing.assert_allclose(slope, reference_slope, **TIGHT)


@installed
def test_not_a_number_passes_through():
    pattern, values, b = random_matrix()
    values[0] = np.nan
    assert np.isnan(jax.jit(lambda v, b: solve_sparse(pattern, v, b))(values, b)).any()


def cells(n: int, g):
    """x' = −1, 0 = g(x, z) for n cells, as a sparse DAETerm: its unknowns are (x, z)."""
    k = np.arange(n)
    rows, cols = np.concatenate([n + k, n + k]), np.concatenate([k, n + k])

    def right(t, y, args):
        x, z = y[:n], y[n:]
        return jnp.concatenate([-jnp.ones_like(x), g(x, z)])

    return DAETerm(right, mass=np.repeat([1.0, 0.0], n), pattern=SparsePattern(rows, cols, 2 * n))


@installed
@pytest.mark.slow
def test_a_failure_among_128_to_300_unknowns_is_explained():
    with pytest.raises(SimulationError, match=r"stopped at t=(1|0\.99)"):
        solve_dae(cells(70, lambda x, z: z**2 - x), 2.0, np.ones(140), solver=Rodas5P())


@installed
@pytest.mark.slow
def test_a_pivot_of_zero_fails_its_own_member_alone():
    """max(z, 0) = x: from t = 1 on the column of z is zero."""
    term = cells(70, lambda x, z: jnp.maximum(z, 0) - x)

    def at(t1):
        solution = solve_dae(term, t1, np.ones(140), ts=np.array([0.4]), solver=Rodas5P(), throw=False)
        return solution.ys[0, 0], diffrax.is_successful(solution.result)

    x, fine = jax.jit(jax.vmap(at))(np.array([0.5, 2.0]))
    np.testing.assert_allclose(x, 0.6, rtol=1e-9)
    assert fine.tolist() == [True, False]


@installed
@pytest.mark.parametrize("deficiency", [1, 2, 3])
def test_pivots_that_cancel_to_zero(deficiency):
    """Integer matrices of deficient rank: no solve with the nudge aborts, and none looks like a solution."""
    rng = np.random.default_rng(deficiency)
    rows, cols = np.indices((6, 6)).reshape(2, -1)
    pattern = SparsePattern(rows, cols, 6)
    solve = jax.jit(lambda values, b: solve_sparse(pattern, values, b, nudged=True))
    for _ in range(50):
        low = rng.integers(-2, 3, (6, 6 - deficiency)) @ rng.integers(-2, 3, (6 - deficiency, 6))
        x = solve(low[rows, cols].astype(float), rng.normal(size=6))
        assert not np.isfinite(x).all() or np.abs(np.asarray(x)).max() > 1e8


def test_host_solve():
    """What accelerators use: SciPy from a callback."""
    pattern, values, b = random_matrix()
    single, inverse = pattern.coalesced
    values = np.bincount(inverse, values, len(single))
    matrix = np.zeros((40, 40))
    matrix[single.rows, single.cols] = values
    solve = jax.jit(jax.vmap(lambda v, b: sparse._on_host(single.rows, single.cols, v, b)))
    found = solve(np.stack([values, values, 0 * values]), np.stack([b, 2 * b, b]))
    np.testing.assert_allclose(found[0], np.linalg.solve(matrix, b), **TIGHT)
    np.testing.assert_allclose(found[1], 2 * np.asarray(found[0]), **TIGHT)
    assert np.isnan(found[2]).all()


# --- the package behind it ---------------------------------------------------------------------------------------


def test_missing_package_names_the_extra(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(sparse.importlib, "import_module", missing)
    sparse.klu.cache_clear()
    pattern, values, b = random_matrix()
    with pytest.raises(MissingSparseSolver, match=r'pip install "jaxonomy_dae\[sparse\]"'):
        solve_sparse(pattern, jnp.asarray(values), jnp.asarray(b))
    sparse.klu.cache_clear()


@pytest.mark.slow
@installed
def test_settings_are_left_alone():
    """Kind: effects of an import. KLU's package turns on 64-bit mode for the process; it is not imported without that,
    and a thread that has it for itself alone leaves it to itself."""
    printed = run(
        "import jax\n"
        "import sys\n"
        "from jaxonomy_dae.solve.linear import sparse\n"
        "assert 'klujax' not in sys.modules\n"
        "before = jax.config.values\n"
        "assert sparse.available() and 'klujax' not in sys.modules\n"
        "try:\n"
        "    sparse.solve_sparse(sparse.SparsePattern([0], [0], 1), jax.numpy.ones(1), jax.numpy.ones(1))\n"
        "except ValueError as error:\n"
        "    print(error)\n"
        "assert 'klujax' not in sys.modules\n"
        "with jax.enable_x64(True):\n"
        "    sparse.klu()\n"
        "assert 'klujax' in sys.modules and jax.config.values == before, jax.config.values\n"
    )
    assert "jax_enable_x64" in printed


def test_square_matrices_only(monkeypatch):
    monkeypatch.setattr(sparse, "klu", lambda: None)
    with pytest.raises(ValueError, match="2 × 1"):
        solve_sparse(SparsePattern(np.array([1]), np.array([0]), 1, 2), jnp.ones(1), jnp.ones(2))
