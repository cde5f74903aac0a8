"""Small inverses, values that are computed once, and scales by bits.

References: NumPy's inverse, closed forms, and sizes of compiled programs.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae.graph.structure.tearing import Tearing
from jaxonomy_dae.solve.linear.dense import over
from jaxonomy_dae.solve.linear.inverse import inverse
from jaxonomy_dae.solve.linear.once import joined, once, once_in_batches, stacked, stacked_in_batches
from jaxonomy_dae.solve.linear.torn import solve_torn

BACKENDS = ["cpu", "elsewhere"]


@pytest.fixture(params=BACKENDS)
def backend(request, monkeypatch):
    """The program made for this backend; what is made for others runs here as well. Tests trace functions of their
    own, so that none is found in JAX's cache that was traced for another backend."""
    if request.param != "cpu":
        monkeypatch.setattr(jax, "default_backend", lambda: request.param)
    return request.param


def by_entries(a):
    m = a.shape[0]
    rows = inverse([[a[r, c] for c in range(m)] for r in range(m)])
    return jnp.stack([jnp.stack(row) for row in rows])


QUICK = [("cpu", 5), ("elsewhere", 3)]


@pytest.mark.parametrize(
    "backend, m",
    [
        *QUICK,
        *(
            pytest.param(b, m, marks=pytest.mark.slow)
            for b in BACKENDS
            for m in range(1, 8)
            if (b, m) not in (*QUICK, ("elsewhere", 6), ("elsewhere", 7))
        ),
    ],
    indirect=["backend"],
)
def test_inverses(backend, m):
    rng = np.random.default_rng(m)
    a = rng.normal(size=(5, m, m)) * 10.0 ** rng.integers(-9, 9, (5, m, 1))
    for k in range(m):  # pivots are where they are not looked for first
        a[:, k, k] *= 1e-14 if m > 1 else 1
    # Errors of elimination with pivoting are eps times the condition of the scaled matrix.
    condition = np.linalg.cond(a / np.abs(a).max(axis=-1, keepdims=True)).max()
    tolerance = 50 * np.finfo(float).eps * condition
    true = np.linalg.inv(a / np.abs(a).max(axis=-1, keepdims=True)) / np.abs(a).max(axis=-1)[:, None, :]
    size = np.abs(true).max(axis=-2, keepdims=True)  # columns of an inverse have the units of the rows

    @jax.jit
    def everything(a):
        """One by one, mapped, as arrays, mapped twice."""
        as_arrays = jnp.moveaxis(by_entries(jnp.moveaxis(a, 0, -1)), -1, 0)
        return (
            jax.lax.map(by_entries, a),
            jax.vmap(by_entries)(a),
            as_arrays,
            jax.vmap(jax.vmap(by_entries))(a[None])[0],
        )

    for found in everything(a):
        np.testing.assert_allclose(found / size, true / size, atol=tolerance)


@pytest.mark.parametrize("m", [2, 5])
def test_singular_ones_are_not_finite(m):
    assert not np.any(np.isfinite(jax.jit(lambda a: by_entries(a))(np.ones((m, m)))))


def test_values_computed_once(backend):
    x, y = np.array([1.0, 2.0]), np.array([3.0, 4.0])

    @jax.jit
    def everything(x, y):
        def product(in_batches_only):
            def of(a, b):
                one, two = once([a, b], in_batches_only)
                return one * two

            return of(x[0], y[0]), jax.vmap(of)(x, y), jax.vmap(of, (None, 0))(x[1], y)

        return joined([x, y, x[:1]]), stacked([x, y]), [product(batches) for batches in (False, True)]

    row, rows, products = everything(x, y)
    np.testing.assert_array_equal(row, [1, 2, 3, 4, 1])
    np.testing.assert_array_equal(rows, [[1, 2], [3, 4]])
    for single, mapped, by_second in products:
        assert float(single) == 3
        np.testing.assert_array_equal(mapped, [3, 8])
        np.testing.assert_array_equal(by_second, [6, 8])


def test_only_cpus_get_calls_that_stay(backend):
    text = jax.jit(lambda a, b: once([a, b])).lower(1.0, 2.0).as_text()
    assert ("inlineable" in text) == (backend == "cpu")


def dense_torn(n, m):
    """A block that is full above and left of what is zero in a torn order, and its right-hand side."""
    rng = np.random.default_rng(n)
    a = rng.normal(size=(n, n))
    k = n - m
    a[:k, :k] = np.tril(a[:k, :k]) + 4 * np.eye(k)
    sequence = tuple((e, e) for e in range(k))
    return Tearing(sequence, tuple(range(k, n)), tuple(range(k, n))), a, rng.normal(size=n)


@pytest.mark.parametrize(
    ("n", "m"), [(9, 2), pytest.param(12, 4, marks=pytest.mark.slow), pytest.param(14, 5, marks=pytest.mark.slow)]
)
def test_programs_of_torn_blocks_do_not_grow_when_compiled(n, m):
    tearing, a, b = dense_torn(n, m)

    def solve(a, b):
        matrix = {(int(e), int(u)): a[e, u] for e, u in zip(*np.nonzero(dense_torn(n, m)[1]), strict=True)}
        return jnp.stack(solve_torn(tearing, matrix, list(b)))

    lowered = jax.jit(solve).lower(a, b)
    compiled = lowered.compile()
    np.testing.assert_allclose(compiled(a, b), np.linalg.solve(a, b), rtol=1e-10)
    written, made = (len(text.splitlines()) for text in (lowered.as_text(), compiled.as_text()))
    # Each operation once, and parameters of kernels: three times. Computed where they are read, ten to thirteen times.
    assert made < 5 * written


def test_scales_are_powers_of_two_near_one_over():
    for dtype in (np.float64, np.float32):
        kind = np.finfo(dtype)
        x = np.geomspace(kind.tiny * 8, kind.max / 8, 201).astype(dtype)
        odd = np.array([0, kind.smallest_subnormal, np.inf, np.nan], dtype)
        scale, of_odd = (np.asarray(v) for v in jax.jit(lambda x, odd: (over(x), over(odd)))(x, odd))
        assert scale.dtype == dtype
        mantissa, _ = np.frexp(scale)
        assert np.all(mantissa == 0.5)
        product = scale.astype(float) * x
        assert np.all((product >= 0.75) & (product <= 1.5))  # rounded to the nearest power of two
        np.testing.assert_array_equal(of_odd, np.ones(4))


def test_entries_of_a_vector_in_a_batch():
    """In a batch, XLA computed all slopes of a small system inside the loop that puts them together, what they share
    once for each of them and without vector instructions: a stage of 10,000 pendulums took five times as long."""

    def field(x):
        shared = jnp.tanh(x[0]) * jnp.tanh(x[1])
        return stacked_in_batches([x[1], shared * x[0], shared * x[1] + x[0]])

    def by_hand(x):
        a, b = np.asarray(x).T
        shared = np.tanh(a) * np.tanh(b)
        return np.stack([b, shared * a, shared * b + a], axis=1)

    x = jnp.asarray(np.random.default_rng(0).normal(size=(100, 2)))
    program = jax.jit(jax.vmap(field)).lower(x).compile()
    np.testing.assert_allclose(program(x), by_hand(x), rtol=1e-15)
    together = [c for c in program.as_text().split("\n\n") if " concatenate(" in c and " tanh(" in c]
    assert "inlineable" in program.as_text() and not [c for c in together if "ENTRY" not in c]
    given = np.array([0.3, -0.2, 0.7])
    slopes = jax.jit(jax.vmap(jax.grad(lambda x: field(x) @ given)))(x)
    both = jax.jit(jax.vmap(jax.jacfwd(field)))(x)
    np.testing.assert_allclose(slopes, given @ np.asarray(both), rtol=1e-13, atol=1e-15)
    step = np.array([0.4, -0.9]) * 1e-6
    moved = (by_hand(x + step) - by_hand(x - step)) / 2
    np.testing.assert_allclose(both @ step, moved, atol=1e-14)
    jax.jit(jax.vmap(jax.hessian(lambda x: field(x) @ given)))(x[:2])  # twice, and in a batch


def test_a_vector_in_a_batch():
    """The point of a stage was added up anew by each of its readers: 10,000 pendulums took 1.2 times as long."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(100, 3)))

    def read(x):
        point = once_in_batches(2.0 * x)
        return jnp.sin(point[0]) * point[1] + point[2] ** 2

    program = jax.jit(jax.vmap(jax.value_and_grad(read))).lower(x).compile()
    a, b, c = 2.0 * np.asarray(x).T
    value, slopes = program(x)
    np.testing.assert_allclose(value, np.sin(a) * b + c**2, rtol=1e-14, atol=1e-14)
    right = 2.0 * np.stack([np.cos(a) * b, np.sin(a), 2 * c], axis=1)
    np.testing.assert_allclose(slopes, right, rtol=1e-14, atol=1e-14)
    assert "inlineable" in program.as_text() and "custom" not in jax.jit(read).lower(x[0]).as_text()
