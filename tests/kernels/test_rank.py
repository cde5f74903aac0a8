"""Error bounds of expressions, and the verdict on matrices whose entries have errors."""

import mpmath
import numpy as np
import pytest
import scipy.sparse as sp
import sympy

from jaxonomy_dae.base.tolerances import EPS, KNOWN
from jaxonomy_dae.graph.expressions.errors import KernelWithErrors
from jaxonomy_dae.graph.expressions.from_sympy import read
from jaxonomy_dae.graph.judgement.rank import rank_of, rounding
from jaxonomy_dae.graph.judgement.sparse_rank import sparse_rank_of

X, Y, Z = symbols = sympy.symbols("x y z")
EXPRESSIONS = [
    X + Y - Z,
    X * Y / Z - Y**3,
    sympy.sqrt(X * X + Y * Y) * sympy.cos(Z),
    sympy.exp(3 * X) - sympy.exp(Y) * sympy.log(Z + 3),
    (X - Y) ** 2 * sympy.sin(Z) + sympy.atan(X / Y),
    sympy.Max(X, Y) * sympy.tanh(X + Z) - sympy.Abs(Z) ** sympy.Rational(3, 2),
    sympy.Piecewise((X * Y, X > 0), (sympy.sinh(Y) / X, True)) + X ** (Y / 4 + 3) * 0.1,
    sympy.atan2(Y, X) - 1 / (1 + sympy.exp(-Z)),
]


def kernel(expression):
    return KernelWithErrors([read(expression, str)], ["x", "y", "z"])


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-9])
def test_bounds_hold(expression, size):
    """The exact value at the exact leaves is within the bound of what is computed from leaves that are off."""
    rng = np.random.default_rng(3)
    computed = kernel(expression)
    for _ in range(20):
        exact = rng.uniform(0.2, 2.0, 3) * np.array([1.0, 1.0, rng.choice([-1.0, 1.0])])
        seen = exact + size * rng.uniform(-1, 1, 3)
        (value,), (bound,) = computed(list(seen), [np.abs(seen - exact).max()] * 3)
        with mpmath.workdps(40):
            true = sympy.lambdify(symbols, expression, "mpmath")(*map(mpmath.mpf, exact))
            # Beyond the first order there are squares of errors: 1e-18 here, times a curvature.
            assert abs(mpmath.mpf(float(value)) - true) <= 2 * float(bound) + 2 * EPS + 1e3 * size**2
        assert bound <= 1e3 * (size + EPS) * (1 + abs(value)) * 10


@pytest.mark.parametrize(
    "expression, at",
    [
        (X + Y - Z, (0.1, 0.2, 0.3)),
        (X - Y, (0.3, 0.1 + 0.2)),
        (sympy.sin(X), (np.pi,)),
        (sympy.cos(X), (-7.5 * np.pi,)),
        (sympy.sin(X), (4 * EPS,)),
        (X * sympy.sin(Y) * Z, (1e12, 2 * np.pi, 1e-3)),
        (1 - sympy.tanh(X) ** 2, (40.0,)),
        (X * X - Y, (1.1, 1.1**2)),
    ],
    ids=str,
)
def test_what_cancels_is_zero(expression, at):
    point = [*at, 0.0, 0.0][:3]
    (value,), (bound,) = kernel(expression)(point, [KNOWN * abs(v) for v in point])
    assert abs(value) <= bound < 1e-11 * max(1.0, *map(abs, point))


@pytest.mark.parametrize(
    "expression, at",
    [
        (X - Y, (0.3, 0.3 + 1e-9)),
        (sympy.sin(X), (np.pi + 1e-9,)),
        (X * Y, (1e-200, 1e-90)),
        (sympy.exp(-X), (300.0,)),
        (X**2 - Y**2, (1e-20, 3e-20)),
    ],
    ids=str,
)
def test_what_is_small_is_not_zero(expression, at):
    point = [*at, 0.0, 0.0][:3]
    (value,), (bound,) = kernel(expression)(point, [KNOWN * abs(v) for v in point])
    assert abs(value) > 1e3 * bound


def test_errors_come_by_instances():
    x = np.array([0.0, np.pi, 1.0])
    (value,), (bound,) = kernel(sympy.sin(X) + Y)([x, 0.0, 0.0], [KNOWN * np.abs(x), 0.0, 0.0])
    np.testing.assert_array_equal(np.abs(value) <= bound, [True, True, False])


def test_a_branch_that_is_not_taken_has_no_errors():
    expression = sympy.Piecewise((1 / X, X > 1), (Y, True))
    _, (bound,) = kernel(expression)([0.0, 2.0, 0.0], [1e-3, 1e-6, 0.0])
    assert bound == 1e-6


# --- ranks -----------------------------------------------------------------------------------------------------------


def scaled(matrix, seed):
    rng = np.random.default_rng(seed)
    n, m = matrix.shape
    return 10.0 ** rng.uniform(-12, 9, (n, 1)), 10.0 ** rng.uniform(-12, 9, m)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (1, 3)])
def test_scales_do_not_decide(shape, seed):
    rng = np.random.default_rng(seed)
    regular = rng.normal(size=shape) * (rng.random(shape) < 0.8) + 2 * np.eye(*shape)
    singular = regular.copy()
    singular[0] = rng.normal(size=shape[0] - 1) @ regular[1:] if shape[0] > 1 else 0.0
    errors = 1e-12 * np.abs(regular)
    r, c = scaled(regular, seed)
    plain = rank_of(regular, errors)
    other = rank_of(r * regular * c, r * errors * c)
    assert plain.is_regular and other.is_regular
    if shape[0] == shape[1]:
        # The bound is of a spectral radius that no scaling changes.
        assert other.uncertainty == pytest.approx(plain.uncertainty, rel=0.05)
    assert not rank_of(singular, errors).is_regular and not rank_of(r * singular * c, r * errors * c).is_regular


def test_errors_decide():
    """[[1, 1], [1, 1 + d]] is singular for an entry that is off by d."""
    for d in (1e-3, 1e-7, 1e-11):
        matrix = np.array([[1.0, 1.0], [1.0, 1.0 + d]])
        assert rank_of(matrix, 0.2 * d * np.eye(2)).is_regular
        assert not rank_of(matrix, 1.5 * d * np.eye(2)).is_regular
        assert sparse_rank_of(sp.csr_array(matrix), sp.csr_array(0.05 * d * np.eye(2))).is_regular
        assert not sparse_rank_of(sp.csr_array(matrix), sp.csr_array(1.5 * d * np.eye(2))).is_regular


def test_entries_that_are_rounding_are_not_scaled_to_size_one():
    matrix = np.array([[1.0, 2.0, 0.0], [1e-17, -3e-17, 2e-17], [0.0, 1.0, 1.0]])
    errors = np.full((3, 3), 1e-15)
    assert not rank_of(matrix, errors).is_regular
    assert not sparse_rank_of(sp.csr_array(matrix), sp.csr_array(errors)).is_regular
    # The same numbers, known to a rounding of themselves, are an equation in another unit.
    assert rank_of(matrix, rounding(matrix)).is_regular
    assert sparse_rank_of(sp.csr_array(matrix), sp.csr_array(rounding(matrix))).is_regular


def test_entries_of_which_nothing_is_known():
    matrix = np.array([[1.0, 2.0], [3.0, 1.0]])
    assert rank_of(matrix, np.array([[np.nan, 0.0], [0.0, 0.0]])).is_regular  # x·1 − 2·3 is not zero for |x − 1| < 1
    assert not rank_of(np.diag([1.0, 2.0]), np.diag([np.inf, 0.0])).is_regular


def test_more_rows_than_columns():
    assert not rank_of(np.ones((3, 2)), np.zeros((3, 2))).is_regular


def test_a_verdict_draws_no_random_numbers_of_the_user():
    n = 400
    matrix = sp.diags_array([np.full(n - 1, -1.0), np.full(n, 2.5), np.full(n - 1, -1.0)], offsets=[-1, 0, 1]).tocsr()
    before = np.random.get_state()[1].copy()
    assert sparse_rank_of(matrix, EPS * abs(matrix)).is_regular
    assert np.array_equal(before, np.random.get_state()[1])
