"""Blocks of simultaneous equations keep their digits whatever the values, units and order of what is in them.

References: closed forms, and dense solutions by NumPy of the same equations written down here.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from attack import circuits
from problems import compiled
from shared_models import attenuator, levers

from jaxonomy_dae import AcausalCompiler, Component, EqnEnv, der
from jaxonomy_dae.graph.structure.tearing import LINKS, BlockSizes, Tearing, tear
from jaxonomy_dae.solve.linear.dense import solve_dense
from jaxonomy_dae.solve.linear.torn import solve_torn
from jaxonomy_dae.solve.linear.written_out import solve

# --- the solver of torn blocks ------------------------------------------------------------------------------------


def ladder_block(rs, rp):
    """A·x = b of an attenuator between 1 V and 0 V: voltages of the nodes, series currents, shunt currents."""
    n = len(rp)
    a, b = np.zeros((3 * n + 1,) * 2), np.zeros(3 * n + 1)
    for k in range(n + 1):  # v[k − 1] − v[k] = rs[k] i[k]
        a[k, n + k] = -rs[k]
        if k > 0:
            a[k, k - 1] = 1
        if k < n:
            a[k, k] = -1
    b[0] = -1
    for k in range(n):
        a[n + 1 + k, [k, 2 * n + 1 + k]] = 1, -rp[k]
        a[2 * n + 1 + k, [n + k, n + k + 1, 2 * n + 1 + k]] = 1, -1, -1
    return a, b


def torn(a, numbers, bounded=True):
    """The tearing that a compiler chooses for the values in `a`; `numbers` tells which entries are not parameters."""
    contains = [frozenset(np.flatnonzero(row).tolist()) for row in a]
    places = [(e, u) for e, row in enumerate(contains) for u in sorted(row)]
    sizes = BlockSizes({p: np.abs(a[p])[None] for p in places}, frozenset(p for p in places if numbers[p]))
    return tear(contains, contains, sizes if bounded else None)


def entries(a, pattern):
    return {(int(e), int(u)): a[e, u] for e, u in zip(*np.nonzero(pattern), strict=True)}


def solved(tearing, pattern):
    return jax.jit(lambda a, b: jnp.stack(solve_torn(tearing, entries(a, pattern), list(b))))


@pytest.mark.parametrize("n", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_a_tearing_serves_parameters_it_was_not_chosen_for(n):
    """The order of elimination is fixed for resistors of 1 Ω; then they take values over eight decades."""
    rng = np.random.default_rng(n)
    ones, _ = ladder_block(np.ones(n + 1), np.ones(n))
    others, _ = ladder_block(np.full(n + 1, 2.0), np.full(n, 2.0))
    function = solved(torn(ones, ones == others), ones != 0)
    cases = [(np.full(n + 1, s), np.full(n, p)) for s, p in itertools.product((1e-4, 1e-2, 1.0, 1e2, 1e4), repeat=2)]
    cases += [(10 ** rng.uniform(-4, 4, n + 1), 10 ** rng.uniform(-4, 4, n)) for _ in range(20)]
    for rs, rp in cases:
        a, b = ladder_block(rs, rp)
        expected = np.linalg.solve(a, b)
        np.testing.assert_allclose(function(a, b)[:n], expected[:n], rtol=0, atol=1e-13)


def test_growth_is_bounded_when_a_block_is_torn():
    n = 12
    a, _ = ladder_block(np.full(n + 1, 100.0), np.ones(n))
    other, _ = ladder_block(np.full(n + 1, 50.0), np.full(n, 2.0))
    assert len(torn(a, a == other, bounded=False).tearing) == 1  # a march along the whole ladder
    assert len(torn(a, a == other).tearing) >= n // LINKS


def test_an_unstable_elimination_is_mended_or_loud_never_wrong():
    """A march along ladders with growing ratios Rs/Rp: right to 1e-9 while it can be mended, then not-a-number."""
    n = 5
    ones, _ = ladder_block(np.ones(n + 1), np.ones(n))
    function = solved(torn(ones, ones != 0, bounded=False), ones != 0)
    outcomes = []
    for ratio in 10.0 ** np.arange(0, 9):
        a, b = ladder_block(np.full(n + 1, ratio), np.ones(n))
        x = np.asarray(function(a, b))
        outcomes.append("nan" if np.isnan(x).any() else np.abs(x - np.linalg.solve(a, b))[:n].max())
    assert "nan" in outcomes  # otherwise this shows nothing
    assert all(o == "nan" or o < 1e-9 for o in outcomes), outcomes
    assert outcomes[0] < 1e-12 and outcomes[1] < 1e-12


def random_block(rng, n):
    """A sparse regular block, its solution known, its equations and unknowns in units of 1e-9 to 1e9."""
    while True:
        a = np.where(rng.random((n, n)) < 2.5 / n, rng.normal(size=(n, n)), 0.0)
        a[np.arange(n), rng.permutation(n)] = rng.normal(size=n)
        if np.linalg.cond(a) < 1e4:
            return a


@pytest.mark.parametrize("n", [pytest.param(3, marks=pytest.mark.slow), 6, pytest.param(12, marks=pytest.mark.slow)])
def test_random_blocks_in_random_units(n):
    """The unknowns are known beforehand; each entry is scaled by its equation's and its unknown's unit."""
    rng = np.random.default_rng(7 + n)
    a = random_block(rng, n)
    numbers = np.zeros(a.shape, bool)
    function = solved(torn(a, numbers), a != 0)
    for _ in range(30):
        x = rng.normal(size=n)
        rows, columns = 10.0 ** rng.uniform(-9, 9, n), 10.0 ** rng.uniform(-9, 9, n)
        found = function(a * rows[:, None] / columns, (a @ x) * rows)
        np.testing.assert_allclose(found / columns, x, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "n, order", [(3, 1), pytest.param(3, 2, marks=pytest.mark.slow), pytest.param(10, 1, marks=pytest.mark.slow)]
)
def test_derivatives_of_a_block(n, order):
    """∂x/∂a = −A⁻¹ ∂A x in forward and in reverse mode, and second derivatives."""
    rng = np.random.default_rng(n)
    a, b = ladder_block(10 ** rng.uniform(-2, 2, n + 1), 10 ** rng.uniform(-2, 2, n))
    other, _ = ladder_block(np.full(n + 1, 7.0), np.full(n, 3.0))
    pattern = a != 0
    tearing = torn(a, a == other)
    c = rng.normal(size=len(b))
    a_dot = np.where(pattern, rng.normal(size=a.shape), 0.0) * a

    def weighted(a):
        return c @ jnp.stack(solve_torn(tearing, entries(a, pattern), list(b)))

    def first(a):
        return jax.grad(weighted)(a), jax.jvp(weighted, (a,), (a_dot,))[1]

    gradient, forward = jax.jit(first)(a)
    expected = -c @ np.linalg.solve(a, a_dot @ np.linalg.solve(a, b))
    scale = np.abs(c) @ np.abs(np.linalg.solve(a, a_dot @ np.linalg.solve(a, b)))
    np.testing.assert_allclose(forward, expected, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(np.sum(gradient * a_dot), expected, rtol=0, atol=1e-12 * scale)
    if order == 1:
        return
    second = jax.jit(lambda a: jax.jvp(jax.grad(weighted), (a,), (a_dot,))[1])(a)
    inverse = np.linalg.inv(a)
    # gradient = −(A⁻ᵀ c)(A⁻¹ b)ᵀ on the pattern
    y, x = inverse.T @ c, inverse @ b
    exact = np.outer(inverse.T @ a_dot.T @ y, x) + np.outer(y, inverse @ a_dot @ x)
    exact = np.where(pattern, exact, 0.0)
    np.testing.assert_allclose(second, exact, rtol=0, atol=1e-10 * np.abs(exact).max())


def arrow(rng, n):
    """Equations that give unknowns from one tearing variable, some of them by plain numbers from others as well."""
    a, numbers = np.zeros((n, n)), np.zeros((n, n), bool)
    a[np.arange(n - 1), np.arange(n - 1)] = rng.normal(size=n - 1)
    a[:, -1] = rng.normal(size=n) * (rng.random(n) < 0.7)
    a[-1] = rng.normal(size=n)
    a[0, -1] = 1.3
    of_numbers: list[int] = []
    for e in range(1, n - 1):
        from_other = int(rng.choice(of_numbers)) if of_numbers else None
        if rng.random() < 0.5:
            numbers[e], a[e], a[e, e], a[e, -1] = True, 0.0, 1.0, rng.choice([-1.0, 1.0])
            of_numbers.append(e)
        if from_other is not None:
            a[e, from_other] = rng.choice([-1.0, 1.0, 0.5]) if numbers[e].all() else rng.normal()
    return a, numbers


def exact_solution(a, b):
    """x of A·x = b, and the change of x under relative changes of the entries by one (Skeel 1979)."""
    with mpmath.workdps(60):
        inverse = mpmath.inverse(mpmath.matrix(a.tolist()))
        x = inverse * mpmath.matrix(b.tolist())
        inverse, x = np.array(inverse.tolist(), float).reshape(a.shape), np.array(x.tolist(), float).ravel()
    return x, np.abs(inverse) @ (np.abs(a) @ np.abs(x) + np.abs(b))


@pytest.mark.parametrize("n", [pytest.param(3, marks=pytest.mark.slow), 4, pytest.param(7, marks=pytest.mark.slow)])
def test_one_tearing_variable_costs_no_digits(n):
    """Entries and right-hand sides over twelve decades, units over eighteen, and terms that cancel: the error is that
    of relative changes of the entries by some eps, in each unknown, for A and for its transpose."""
    rng = np.random.default_rng(n)
    a, numbers = arrow(rng, n)
    tearing = Tearing(tuple((e, e) for e in range(n - 1)), (n - 1,), (n - 1,))
    pattern = (a != 0) & ~numbers
    fixed = {(int(e), int(u)): float(a[e, u]) for e, u in zip(*np.nonzero(numbers & (a != 0)), strict=True)}

    def function(a, b):
        return jnp.stack(solve_torn(tearing, entries(a, pattern) | fixed, list(b)))

    @jax.jit
    def both(a, b):
        found, back = jax.vjp(lambda b: function(a, b), b)
        return found, back(b)[0]

    for _ in range(25):
        some, b = np.where(numbers, a, a * 10 ** rng.uniform(-6, 6, a.shape)), rng.normal(size=n)
        b *= 10 ** rng.uniform(-6, 6, n)
        if rng.random() < 0.5:  # the last equation is one of the others, or nearly
            u = rng.integers(n - 1)
            some[-1, -1] = some[-1, u] / some[u, u] * some[u, -1] * (1 + rng.choice([1e-3, 1e-8]))
        for found, matrix in zip(both(some, b), (some, some.T), strict=True):
            x, change = exact_solution(matrix, b)
            assert (np.abs(found - x) <= 20 * n * np.finfo(float).eps * change).all()


@pytest.mark.slow
def test_batches_members_of_which_need_different_pivots():
    n = 4
    ones, b = ladder_block(np.ones(n + 1), np.ones(n))
    other, _ = ladder_block(np.full(n + 1, 2.0), np.full(n, 2.0))
    function = solved(torn(ones, ones == other), ones != 0)
    batch = np.stack(
        [ladder_block(np.full(n + 1, s), np.full(n, p))[0] for s, p in ((1e4, 1e-4), (1e-4, 1e4), (1.0, 1.0))]
    )
    found = jax.jit(jax.vmap(function, in_axes=(0, None)))(batch, b)
    for a, x in zip(batch, np.asarray(found), strict=True):
        np.testing.assert_allclose(x[:n], np.linalg.solve(a, b)[:n], rtol=0, atol=1e-13)


def test_a_singular_block_is_not_a_number():
    a = np.array([[1.0, 1.0], [1.0, 1.0]])
    function = solved(torn(a, np.zeros((2, 2), bool)), a != 0)
    assert np.isnan(function(a, np.array([1.0, 2.0]))).all()


@pytest.mark.parametrize("n", [pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(5, marks=pytest.mark.slow)])
def test_pivots_do_not_depend_on_the_scale_of_an_equation(n):
    """Partial pivoting alone would take the row that is written in large units, whatever its pivot is worth."""
    rng = np.random.default_rng(n)
    a, x = rng.normal(size=(20, n, n)), rng.normal(size=(20, n))
    a[:, 0, 0] = 1e-14
    right = np.einsum("kij,kj->ki", a, x)
    exact = np.linalg.solve(a, right[..., None])[..., 0]
    scale = np.ones(n)
    scale[0] = 1e18

    @jax.jit
    @jax.vmap
    def both(rows, right):
        written = solve([[rows[e, u] for u in range(n)] for e in range(n)], [right[e] for e in range(n)])
        return jnp.stack(written), solve_dense(rows, right)

    tolerance = 10 * 1e-14 * np.linalg.cond(a) * n
    for found in both(a * scale[:, None], right * scale):
        assert (np.abs(found - exact) <= tolerance[:, None]).all()


# --- compiled models ----------------------------------------------------------------------------------------------


def node_voltages(rs, rp):
    """Nodal analysis of the attenuator."""
    n = len(rp)
    g = np.diag(1 / rs[:-1] + 1 / rs[1:] + 1 / rp) - np.diag(1 / rs[1:-1], 1) - np.diag(1 / rs[1:-1], -1)
    b = np.zeros(n)
    b[0] = 1 / rs[0]
    return np.linalg.solve(g, b)


def observed(system, n):
    return np.asarray(jax.jit(lambda x: system.observe([f"p{k}.v" for k in range(n)], 0.0, x))(np.zeros(1)))


RATIOS = ((100.0, 1.0), (1e-4, 1e4), (1.0, 1.0), (1.0, 100.0), (1e4, 1e-4))


@pytest.mark.parametrize(
    ("n", "rs", "rp"),
    [(12, *ratio) for ratio in RATIOS[:2]]
    + [pytest.param(12, *ratio, marks=pytest.mark.slow) for ratio in RATIOS[2:]]
    + [pytest.param(n, *ratio, marks=pytest.mark.slow) for n in (2, 40) for ratio in RATIOS],
)
def test_attenuators(n, rs, rp):
    found = observed(attenuator(n, rs, rp), n)
    np.testing.assert_allclose(found, node_voltages(np.full(n + 1, rs), np.full(n, rp)), rtol=0, atol=1e-12)


class Changed:
    """n sections compiled for 1 Ω everywhere: cases of other values, and their voltages by nodal analysis."""

    def __init__(self, n):
        rng = np.random.default_rng(n)
        self.names = [f"s{k}.R" for k in range(n)] + ["last.R"] + [f"p{k}.R" for k in range(n)]
        self.n, self.plain, self.weights = n, attenuator(n), rng.normal(size=n)
        cases = [np.concatenate([np.full(n + 1, s), np.full(n, p)]) for s, p in ((1e4, 1.0), (1.0, 1e4), (1e4, 1e-4))]
        cases += [10 ** rng.uniform(-4, 4, 2 * n + 1) for _ in range(10)] + [10 ** rng.uniform(-1, 1, 2 * n + 1)]
        self.cases = np.array(cases)

    def voltages(self, values):
        system = self.plain.with_parameters(dict(zip(self.names, values, strict=True)))
        return system.observe([f"p{k}.v" for k in range(self.n)], 0.0, jnp.zeros(1))

    def exact(self, values):
        return node_voltages(values[: self.n + 1], values[self.n + 1 :])


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 12])
def test_parameters_changed_after_compiling(n):
    changed = Changed(n)
    for values, found in zip(changed.cases, jax.jit(jax.vmap(changed.voltages))(changed.cases), strict=True):
        np.testing.assert_allclose(found, changed.exact(values), rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 12])
def test_gradients_by_changed_parameters(n):
    """Against central differences of nodal analysis."""
    changed = Changed(n)
    values = changed.cases[-1]
    gradient = jax.jit(jax.grad(lambda values: changed.weights @ changed.voltages(values)))(values)
    for k in range(2 * n + 1):
        h = 1e-5 * values[k] * np.eye(2 * n + 1)[k]
        change = changed.exact(values + h) - changed.exact(values - h)
        slope = changed.weights @ change / (2 * h[k])
        np.testing.assert_allclose(gradient[k], slope, rtol=1e-6, atol=1e-9)


# --- projection -----------------------------------------------------------------------------------------------------


RESCALED = ({"k": 1e9}, {"k": 1e-9}, {"k": 1e-12}, {"u": 1e-12}, {"u": 1e9}, {"order": (1, 0)})


@pytest.mark.parametrize(
    "options", [{}, {"k": 1e9, "u": 1e-6}, *(pytest.param(given, marks=pytest.mark.slow) for given in RESCALED)]
)
def test_projection_in_any_units(options):
    """The nearest point of x1 = 2 x0, x2 = 5/2 x1 in the norm of nominal values, in closed form; more constraints than
    the elimination written out takes would use LAPACK: both are compared."""
    start = np.array([0.31, 0.58, 1.52])
    along = np.array([1.0, 2.0, 5.0])
    nearest = along * (along @ start) / (along @ along)
    system = levers("projection", **options)
    u = options.get("u", 1.0)
    place = [system.states.index(f"c.x{i}") for i in range(3)]
    x = np.zeros(len(system.states))
    x[place] = start * u
    moved = np.asarray(jax.jit(lambda x: system.project(0.0, x))(x))
    np.testing.assert_allclose(moved[place] / u, nearest, rtol=1e-13)


# --- nonlinear blocks that are alike ----------------------------------------------------------------------------------


class Filter(Component):
    """x' = −2·z0 − x/10, z + z³ + c·Σ z³ = (k + 1)·x for z of number k: a block of `m` unknowns."""

    def __init__(self, ev, name, m, c=0.1):
        super().__init__(ev, name)
        x = self.variable("x")
        z = [self.variable(f"z{k}", start=0.3) for k in range(m)]
        c = self.parameter("c", c)
        self.add_equations(der(x) + 2 * z[0] + x / 10)
        self.add_equations(*(v + v**3 + c * sum(w**3 for w in z) - (k + 1) * x for k, v in enumerate(z)))


def filtered(x, m):
    """The unknowns z of a block, by Newton's method."""
    z, drive = np.full(m, 0.3), np.arange(1, m + 1) * x
    for _ in range(50):
        slopes = np.diag(1 + 3 * z**2) + 0.1 * 3 * z**2
        z = z - np.linalg.solve(slopes, z + z**3 + 0.1 * np.sum(z**3) - drive)
    return z


@pytest.mark.parametrize("m, n", [(2, 2), pytest.param(1, 7, marks=pytest.mark.slow)])
def test_the_field_of_nonlinear_blocks_that_are_alike(m, n):
    """`vector_field` failed with an `IndexError` where two blocks are alike. The rates of their unknowns are compared
    with those of the implicit function theorem."""
    ev = EqnEnv()
    system = compiled(*(Filter(ev, f"f{k}", m) for k in range(n)))
    names = (*system.states, *(system.plan.quantity_name[q] for q in system.plan.carried))
    z = [filtered(0.5 + k, m) for k in range(n)]
    state = {f"f{k}.x": 0.5 + k for k in range(n)} | {f"f{k}.z{j}": z[k][j] for k in range(n) for j in range(m)}
    found = jax.jit(lambda x: system.vector_field(0.0, x))(np.array([state[name] for name in names]))
    rates = dict(zip(names, np.asarray(found), strict=True))
    for k in range(n):
        slopes = np.diag(1 + 3 * z[k] ** 2) + 0.1 * 3 * z[k] ** 2
        rate = -2 * z[k][0] - (0.5 + k) / 10
        assert rates[f"f{k}.x"] == pytest.approx(rate, rel=1e-12)
        expected = np.linalg.solve(slopes, np.arange(1, m + 1) * rate)
        carried = [j for j in range(m) if f"f{k}.z{j}" in rates]
        assert carried
        np.testing.assert_allclose([rates[f"f{k}.z{j}"] for j in carried], expected[carried], rtol=1e-11)


@pytest.mark.slow
def test_equal_pivots():
    """A circuit with blocks whose pivots tie: XLA compares them anew in every loop, and where it rounds differently, as
    it does without optimization, some loops exchanged rows and others did not (a residual of 4, and not-a-number)."""
    case = circuits.make(391)
    system = AcausalCompiler(case.ev, case.diagram)()
    arrays, static = eqx.partition(system, eqx.is_array)
    x = jnp.asarray(np.cos(np.arange(len(system.states)) / 3))
    names = [name for name in system.plan.visible_variables if name.endswith(".v")]

    def voltages(arrays, x):
        return eqx.combine(arrays, static).observe(names, 0.0, x)

    compiled = jax.jit(voltages).lower(arrays, x).compile(compiler_options={"xla_backend_optimization_level": 0})
    np.testing.assert_allclose(compiled(arrays, x), jax.jit(voltages)(arrays, x), rtol=0, atol=1e-12)
