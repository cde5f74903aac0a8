"""Our operators and solvers in `lineax.linear_solve`, and Lineax' solvers in BDF and Rodas5P, against dense algebra."""

import importlib.util

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from sympy import Eq
from testset.heat import heat_exact, sundials_heat2d

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, ModelError, SimulationError, der, simulate
from jaxonomy_dae.linear import KLU, Dense, SparseLinearOperator, SparsePattern, WrittenOut
from jaxonomy_dae.solve.linear.choice import check_linear_solver, choose
from jaxonomy_dae.solve.linear.dense import least_squares
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, solve_dae

installed = pytest.mark.skipif(importlib.util.find_spec("klujax") is None, reason='needs the extra "sparse"')
TIGHT = dict(rtol=1e-11, atol=1e-11)


def sparse_example(n: int = 40):
    """Values, a pattern with a place that occurs twice, and a right-hand side; diagonally dominant."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([np.arange(n), rng.integers(0, n, 2 * n), [0]])
    cols = np.concatenate([np.arange(n), rng.integers(0, n, 2 * n), [0]])
    values = np.concatenate([rng.uniform(8, 10, n), rng.uniform(-1, 1, 2 * n), [0.5]])
    return values, SparsePattern(rows, cols, n), rng.normal(size=n)


# --- the operator --------------------------------------------------------------------------------------------------


def test_the_operator_is_its_matrix():
    rng = np.random.default_rng(1)
    pattern = SparsePattern(rng.integers(0, 5, 12), rng.integers(0, 7, 12), 7, 5)
    values, x, y = rng.normal(size=12), rng.normal(size=7), rng.normal(size=5)

    @jax.jit
    def everything(values, x, y):
        operator = SparseLinearOperator(values, pattern)
        assert (operator.in_size(), operator.out_size()) == (7, 5)
        assert lx.materialise(operator) is operator and lx.linearise(operator) is operator
        return (
            operator.as_matrix(), operator.T.as_matrix().T, (operator + operator).as_matrix() / 2,
            operator.mv(x), lx.conj(operator).mv(x), operator.T.mv(y),
        )  # fmt: skip

    matrix = np.zeros((5, 7))
    np.add.at(matrix, (pattern.rows, pattern.cols), values)
    *matrices, product, conjugated, transposed = everything(values, x, y)
    for found in matrices:
        np.testing.assert_allclose(found, matrix, rtol=1e-14)
    for found in (product, conjugated):
        np.testing.assert_allclose(found, matrix @ x, rtol=1e-14)
    np.testing.assert_allclose(transposed, matrix.T @ y, rtol=1e-14)
    with pytest.raises(ValueError, match=r"\(12,\)"):
        SparseLinearOperator(jnp.ones(3), pattern)


@pytest.mark.parametrize(
    "offsets, known",
    [
        ((0,), "is_diagonal is_tridiagonal is_lower_triangular is_upper_triangular"),
        ((-1, 0, 1), "is_tridiagonal"),
        ((0, 2), "is_upper_triangular"),
        ((-3, 0), "is_lower_triangular"),
        ((-2, 2), ""),
    ],
)
def test_what_the_pattern_says(offsets, known):
    n = 6
    rows, cols = np.array([(i, i + o) for o in offsets for i in range(n) if 0 <= i + o < n]).T
    operator = SparseLinearOperator(jnp.asarray(np.arange(1.0, len(rows) + 1)), SparsePattern(rows, cols, n))
    for name in ("is_diagonal", "is_tridiagonal", "is_lower_triangular", "is_upper_triangular"):
        assert getattr(lx, name)(operator) == (name in known.split())
    parts = jax.jit(lambda v: (lx.diagonal(o := SparseLinearOperator(v, operator.pattern)), *lx.tridiagonal(o)))
    matrix = np.zeros((n, n))
    matrix[rows, cols] = operator.values
    for found, k in zip(parts(operator.values), (0, 0, -1, 1), strict=True):
        np.testing.assert_array_equal(found, np.diag(matrix, k))
    assert lx.is_symmetric(SparseLinearOperator(operator.values, operator.pattern, lx.symmetric_tag))


# --- solvers -------------------------------------------------------------------------------------------------------


def dense_example(n: int):
    rng = np.random.default_rng(n)
    return rng.normal(size=(n, n)) + 3 * np.eye(n), rng.normal(size=n)


@pytest.mark.parametrize(
    "solver, n",
    [(WrittenOut(), 4), (Dense(), 20)]
    + [pytest.param(*case, marks=pytest.mark.slow) for case in ((WrittenOut(), 1), (Dense(), 3), (Dense(), 40))],
    ids=lambda v: v if isinstance(v, int) else type(v).__name__,
)
def test_dense_solvers(solver, n):
    matrix, b = dense_example(n)
    m_dot, b_dot = dense_example(n + 50)[0][:n, :n], b[::-1].copy()

    @jax.jit
    def everything(matrix, b, m_dot, b_dot):
        """A solution, a batch of two, a gradient, a derivative along a direction."""

        def solve(matrix, b):
            return lx.linear_solve(lx.MatrixLinearOperator(matrix), b, solver).value

        batch = jax.vmap(solve)(jnp.stack([matrix, 2 * matrix]), jnp.stack([b, b**2]))
        gradient = jax.jacrev(lambda m: solve(m, b).sum())(matrix)
        return solve(matrix, b), batch, gradient, jax.jvp(solve, (matrix, b), (m_dot, b_dot))[1]

    found, batch, gradient, forward = everything(matrix, b, m_dot, b_dot)
    x, adjoint = np.linalg.solve(matrix, b), np.linalg.solve(matrix.T, np.ones(n))
    np.testing.assert_allclose(found, x, **TIGHT)
    np.testing.assert_allclose(batch, [x, np.linalg.solve(2 * matrix, b**2)], **TIGHT)
    np.testing.assert_allclose(gradient, -np.outer(adjoint, x), **TIGHT)
    np.testing.assert_allclose(forward, np.linalg.solve(matrix, b_dot - m_dot @ x), **TIGHT)


@installed
def test_klu():
    values, pattern, b = sparse_example()

    @jax.jit
    def everything(values, b):
        def solve(values, b):
            return lx.linear_solve(SparseLinearOperator(values, pattern), b, KLU()).value

        batch = jax.vmap(solve, (None, 0))(values, jnp.stack([b, 2 * b]))
        return solve(values, b), batch, jax.grad(lambda v: solve(v, b).sum())(values)

    matrix = np.zeros((40, 40))
    np.add.at(matrix, (pattern.rows, pattern.cols), values)
    found, batch, gradient = everything(values, b)
    x, adjoint = np.linalg.solve(matrix, b), np.linalg.solve(matrix.T, np.ones(len(b)))
    np.testing.assert_allclose(found, x, **TIGHT)
    np.testing.assert_allclose(batch, [x, 2 * x], **TIGHT)
    np.testing.assert_allclose(gradient, -adjoint[pattern.rows] * x[pattern.cols], **TIGHT)
    with pytest.raises(ValueError, match="SparseLinearOperator"):
        lx.linear_solve(lx.MatrixLinearOperator(jnp.asarray(matrix)), jnp.asarray(b), KLU())


def test_iterative_solvers_take_the_operator():
    values, pattern, b = sparse_example()
    matrix = np.zeros((40, 40))
    np.add.at(matrix, (pattern.rows, pattern.cols), values)

    @jax.jit
    def solve(values, b):
        solver = lx.GMRES(rtol=1e-12, atol=1e-12)
        return lx.linear_solve(SparseLinearOperator(values, pattern), b, solver, throw=False).value

    np.testing.assert_allclose(solve(values, b), np.linalg.solve(matrix, b), rtol=1e-9, atol=1e-10)


def test_structures_and_scales():
    """Between pytrees; rows in other units; a singular matrix is reported."""
    matrix, b = dense_example(4)
    rows = np.array([1e-12, 1.0, 1e9, 1e-3])

    @jax.jit
    def everything(scaled, right):
        operator = lx.PyTreeLinearOperator(
            [[scaled[:1, :2], scaled[:1, 2:]], [scaled[1:, :2], scaled[1:, 2:]]],
            [jax.ShapeDtypeStruct((1,), b.dtype), jax.ShapeDtypeStruct((3,), b.dtype)],
        )
        found = []
        for solver in (WrittenOut(), Dense()):
            regular = lx.linear_solve(operator, [right[:1], right[1:]], solver, throw=False).value
            singular = lx.linear_solve(lx.MatrixLinearOperator(jnp.zeros((2, 2))), jnp.ones(2), solver, throw=False)
            found.append((jnp.concatenate(regular), singular.result == lx.RESULTS.singular))
        return found

    for found, is_singular in everything(rows[:, None] * matrix, rows * b):
        np.testing.assert_allclose(found, np.linalg.solve(matrix, b), **TIGHT)
        assert is_singular
    with pytest.raises(ValueError, match="Dense"):
        lx.linear_solve(lx.MatrixLinearOperator(jnp.eye(7)), jnp.ones(7), WrittenOut())


# --- in implicit steps ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_heat_on_a_plate_by_gmres():
    """heat2d with BDF and GMRES: the pattern is given, and no matrix is factorised."""
    problem = sundials_heat2d(m=8)
    one = problem.index_one()
    n = one.y0.shape[0]
    jacobian = np.asarray(jax.jit(jax.jacfwd(lambda y: one.F(0.0, y, one.args())))(one.y0))
    rows, cols = np.nonzero(jacobian)
    term = DAETerm(one.F, mass=one.mass, pattern=SparsePattern(rows, cols, n))
    solver = BDF(linear_solver=lx.GMRES(rtol=1e-10, atol=1e-12))
    found = solve_dae(term, problem.t1, jnp.asarray(one.y0), solver=solver, args=one.args(), rtol=1e-7, atol=1e-9)
    exact = heat_exact(8, [problem.t1])[0]
    names = [f"plate.u{k // 8}_{k % 8}" for k in range(64)]
    expected = np.array([exact[names.index(name)] for name in one.names])
    np.testing.assert_allclose(found.ys[0], expected, atol=2e-5)


ITERATIVE = lx.GMRES(rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method, linear_solver",
    [(BDF, ITERATIVE), (BDF, lx.LU()), (Rodas5P, ITERATIVE), (Rodas5P, Dense())],
    ids=lambda v: getattr(v, "__name__", type(v).__name__),
)
def test_any_lineax_solver(method, linear_solver):
    """x' = −a·x·z, z² = x: x(1) = (1 + a/2)⁻², with its derivative."""
    term = DAETerm(lambda t, x, z, a: -a * x * z, lambda t, x, z, a: z**2 - x)

    def final(a):
        solver = method(linear_solver=linear_solver)
        start = np.ones(1), np.ones(1)
        return solve_dae(term, 1.0, start, solver=solver, args=a, rtol=1e-8, atol=1e-10, throw=False).ys[0][0, 0]

    value, slope = jax.jit(jax.value_and_grad(final))(0.7)
    np.testing.assert_allclose([value, slope], [1.35**-2, -(1.35**-3)], rtol=1e-6)


def test_what_is_not_a_solver_is_refused():
    term = DAETerm(lambda t, y, a: -y, mass=[1.0])
    with pytest.raises(ModelError, match="lineax.GMRES"):
        choose("gmres", 1, None, term.mass)
    with pytest.raises(ModelError, match="pattern="):
        solve_dae(term, 1.0, jnp.ones(1), solver=Rodas5P(linear_solver=KLU()))


# --- least squares ------------------------------------------------------------------------------------------------


def test_rows_of_zeros_say_nothing():
    """In units of the smallest number there is, 1e-17 on the right of an empty row became 1e291: a mechanism of which a
    part is rigid started at 1e272."""
    rng = np.random.default_rng(3)
    matrix, right = rng.normal(size=(9, 6)), rng.normal(size=9)
    size = np.max(np.abs(matrix), axis=1, keepdims=True)
    expected = np.linalg.lstsq(matrix / size, right / size[:, 0])[0]
    full = np.insert(matrix, [0, 4, 9], 0.0, axis=0), np.insert(right, [0, 4, 9], [1e-17, -1e-16, 1.0])
    found = jax.jit(least_squares)(*full)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


# --- blocks of compiled models -------------------------------------------------------------------------------------


class Membrane(Component):
    """A grid of m × m points: 5u + cubic·u³ − Σ neighbours = load, and one state that follows the middle."""

    def __init__(self, ev, name, m, cubic):
        super().__init__(ev, name)
        load = self.parameter("load", 2.0)
        x = self.variable("x", start=0.0, fixed=True)
        u = np.array(self.vector("u", m * m)).reshape(m, m)
        near = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if abs(i) + abs(j) == 1]
        for i, j in np.ndindex(m, m):
            sides = [u[i + a, j + b] for a, b in near if 0 <= i + a < m and 0 <= j + b < m]
            self.add_equations(Eq(5 * u[i, j] + cubic * u[i, j] ** 3 - sum(sides), load * (1 + i + 2 * j)))
        self.add_equations(Eq(der(x), u[m // 2, m // 2] - x))


def membrane(m=5, cubic=0, **options):
    ev = EqnEnv()
    diagram = AcausalDiagram()
    diagram.add(Membrane(ev, "m", m, cubic))
    return AcausalCompiler(ev, diagram, **options)()


def membrane_by_hand(m, cubic):
    """The displacements, shape (m²,), by Newton's method."""
    line = np.eye(m, k=1) + np.eye(m, k=-1)
    matrix = 5 * np.eye(m * m) - np.kron(line, np.eye(m)) - np.kron(np.eye(m), line)
    right = 2.0 * np.array([1.0 + i + 2 * j for i, j in np.ndindex(m, m)])
    u = np.zeros(m * m)
    for _ in range(50):
        u = u - np.linalg.solve(matrix + 3 * cubic * np.diag(u**2), matrix @ u + cubic * u**3 - right)
    return u


GIVEN = {
    "gmres": lx.GMRES(rtol=1e-8, atol=1e-8, restart=40, max_steps=200),
    "rough": lx.GMRES(rtol=1e-3, atol=1e-3, restart=40, max_steps=200),  # corrected by solving again
    "lu": lx.LU(),
    "dense": Dense(),
    "klu": KLU(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", GIVEN)
def test_a_given_solver_for_blocks(name):
    if name == "klu":
        pytest.importorskip("klujax")
    system = membrane(linear_solver=GIVEN[name])
    exact = membrane_by_hand(5, 0)

    def middle(load):
        return system.with_parameters({"m.load": load}).observe([f"m.u[{k}]" for k in (11, 12, 13)], 0.0, jnp.zeros(1))

    # Equations hold to rounding, and the condition number is 9.
    value, slope = jax.jit(lambda load: (middle(load), jax.jacrev(middle)(load)))(2.0)
    np.testing.assert_allclose(value, exact[11:14], rtol=1e-13)
    np.testing.assert_allclose(slope, exact[11:14] / 2, rtol=1e-13)


@pytest.mark.slow
def test_a_given_solver_for_nonlinear_blocks():
    system = membrane(m=8, cubic=0.5, linear_solver=GIVEN["gmres"])
    assert len(system.carried) == 64
    found = jax.jit(lambda: system.observe([f"m.u[{k}]" for k in range(64)], 0.0, system.initialize()))()
    np.testing.assert_allclose(found, membrane_by_hand(8, 0.5), rtol=1e-12)  # the condition number is 20


def test_what_is_not_a_solver_for_blocks_is_refused():
    for wrong, text in ((lx.GMRES, "the class GMRES: write GMRES"), ("gmres", "got 'gmres'")):
        with pytest.raises(ModelError, match=text):
            check_linear_solver(wrong)


@pytest.mark.slow
def test_a_given_solver_that_fails_is_named():
    system = membrane(linear_solver=lx.GMRES(rtol=1e-8, atol=1e-8, restart=1, max_steps=1))
    with pytest.raises(SimulationError, match="was not solved .*, though it is not singular: linear_solver=GMRES"):
        simulate(system, 1.0)
