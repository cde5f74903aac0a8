"""Expression graphs: cost, branches that are not taken, and functions that stand in equations as they are."""

from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import sympy
from test_functions import compiled

from jaxonomy_dae import der
from jaxonomy_dae.graph.expressions.branches import union
from jaxonomy_dae.graph.expressions.differentiate import directional_derivative, partial_derivative
from jaxonomy_dae.graph.expressions.from_sympy import read
from jaxonomy_dae.graph.expressions.functions import TABLE
from jaxonomy_dae.graph.expressions.kernel import Kernel
from jaxonomy_dae.graph.expressions.node import (
    ONE,
    constant,
    leaf,
    linear,
    make,
    multiply,
    number,
    postorder,
    power,
)
from jaxonomy_dae.write import Eq

X, Y = sympy.symbols("x y", real=True)


def graph(expression):
    return read(expression, lambda s: s.name)


def nested(depth):
    a, b = X, Y
    for _ in range(depth):
        a, b = sympy.sin(a) + b, sympy.cos(b) + a
    return a + b


def test_size_grows_with_depth_alone():
    """Graphs, their derivatives and their second derivatives of nested maps grow linearly with the depth."""
    sizes = []
    for depth in (5, 10, 20):
        g = graph(nested(depth))
        first = directional_derivative(g, {"x": leaf("v"), "y": leaf("w")})
        second = directional_derivative(first, {"x": leaf("v"), "y": leaf("w"), "v": leaf("a"), "w": leaf("b")})
        sizes.append([len(postorder([n])) for n in (g, first, second)])
    growth = np.diff(np.array(sizes), axis=0)
    assert (growth[1] <= 2.05 * growth[0]).all()


def test_a_long_equation_differentiated_twice():
    """Nested maps in a constraint of index 3: its curvature along the solution, by power series, is zero."""
    depth = 8

    def write(c, t):
        x, y = c.variable("x", start=0.3, fixed=True), c.variable("y", start=0.2)
        v, w, force = c.variable("v", start=0.1, fixed=True), c.variable("w"), c.variable("force")
        a, b = x, y
        for _ in range(depth):
            a, b = (sympy.sin(a) + b) / 2, (sympy.cos(b) + a) / 2
        c.add_equations(der(x) - v, der(y) - w, der(v) + force * x, der(w) + force * y + 1, x + 2 * y + (a + b) / 9 - 1)

    system = compiled(write)

    point = dict(zip(system.states, np.linspace(0.2, 0.5, len(system.states)), strict=True))
    slopes = jax.jit(lambda x: system.vector_field(0.0, x))(np.array(list(point.values())))
    slopes = dict(zip(system.states, np.asarray(slopes), strict=True))
    # The first three coefficients of x and y in time, carried through the same maps.
    x, y = (np.array([point[f"c.{q}"], point[f"c.{v}"], slopes[f"c.{v}"] / 2]) for q, v in ("xv", "yw"))
    a, b = x, y
    for _ in range(depth):
        a, b = (series(np.sin(a[0]), np.cos(a[0]), a) + b) / 2, (series(np.cos(b[0]), -np.sin(b[0]), b) + a) / 2
    assert abs(2 * (x + 2 * y + (a + b) / 9)[2]) < 1e-12


def series(value, slope, u):
    """The first three coefficients of f(u(t)) from those of u, where f″ = −f."""
    return np.array([value, slope * u[1], slope * u[2] - value * u[1] ** 2 / 2])


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, pytest.param(20, marks=pytest.mark.slow)])
def test_branches_not_taken_are_never_seen(count):
    """Random nested branches whose untaken side is not real: first and second derivatives, forward and reverse."""
    rng = np.random.default_rng(0)
    partial = [
        lambda u: sympy.sqrt(u),
        lambda u: sympy.log(u),
        lambda u: 1 / u,
        lambda u: u ** sympy.Rational(-3, 2),
        lambda u: sympy.acosh(u),
        lambda u: u**Y,
        lambda u: sympy.gamma(u),
        lambda u: sympy.exp(1000 * u) * sympy.exp(1000 * u + 300),
    ]

    def grown(depth, low):
        """An expression that is smooth for x < 0, in whose untaken branches partial functions stand."""
        if depth == 0:
            return sympy.sin(X * Y) + low
        bad = partial[rng.integers(len(partial))](X + int(rng.integers(3)) * 0)
        good = grown(depth - 1, low + 1)
        if rng.random() < 0.5:
            return sympy.Piecewise((bad + good * bad, X > 0), (good * X, True))
        return sympy.Piecewise((good + X, X <= 0), (bad * sympy.sqrt(bad), True))

    kernels, partials = [], []
    for k in range(count):
        kernels.append(Kernel([graph(grown(1 + k % 4, 0))], ["x", "y"]))
        partials.append(Kernel([partial_derivative(graph(grown(2, 0)), "x")], ["x", "y"]))

    @jax.jit
    def derivatives(z):
        fs = [lambda z, kernel=kernel: kernel([z[0], z[1]])[0] for kernel in kernels]
        by_symbols = [jax.grad(lambda x, p=p: p([x, 0.3])[0])(-0.7) for p in partials]
        return (
            jnp.stack([jax.jacfwd(f)(z) for f in fs]),
            jnp.stack([jax.jacrev(f)(z) for f in fs]),
            jnp.stack([jax.jacfwd(jax.jacrev(f))(z) for f in fs]),
            jnp.stack(by_symbols),
        )

    for z in (np.array([-0.7, 0.4]), np.array([0.0, 0.4])):
        forward, reverse, second, of_partials = derivatives(z)
        for one in (forward, second, of_partials):
            assert np.isfinite(one).all(), np.flatnonzero(~np.isfinite(np.reshape(one, (count, -1))).all(1))
        np.testing.assert_allclose(forward, reverse, rtol=1e-13, atol=1e-14)


def test_a_shared_part_outside_branches_is_not_changed():
    """√x stands outside the branch too: there it is the user's, and its value is not touched."""
    kernel = Kernel([graph(sympy.Piecewise((sympy.sqrt(X), X > 1), (X, True)) + sympy.sqrt(X))], ["x"])
    assert float(kernel([jnp.array(0.25)])[0]) == 0.75
    assert np.isnan(kernel([np.array(-0.25)], "numpy")[0])


EXP = sympy.exp
FINITE_EVERYWHERE = {
    "logistic": 1 / (1 + EXP(X)),
    "scaled and shifted": 3 / (2 + 5 * EXP(2 - X / 3)),
    "exp over 1 + exp": EXP(X) / (1 + EXP(X)),
    "other factors": EXP(X) / (2 + 5 * EXP(X)),
    "slope of the logistic": EXP(-2 * X) / (1 + EXP(-2 * X)) ** 2,
    "softplus": sympy.log(1 + EXP(X)),
    "softplus, base 2": sympy.log(3 + 2 * EXP(-X), 2),
    "log of cosh, written out": sympy.log(EXP(X) + EXP(-X)),
    "log of a sum": sympy.log(2 * EXP(X) + EXP(3 * X)),
    "reciprocal of cosh": 1 / sympy.cosh(X),
    "its square": sympy.cosh(2 * X) ** -2,
    "sech": sympy.sech(X),
    "reciprocal root": (1 + EXP(X)) ** sympy.Rational(-1, 2),
    "reciprocal root of cosh": sympy.cosh(X) ** sympy.Rational(-3, 2),
}


@pytest.mark.slow
def test_what_is_finite_though_its_parts_overflow():
    """Value, slope and curvature where exp(x) is beyond the largest number, by symbols, forward and in reverse."""
    nodes = [graph(expression) for expression in FINITE_EVERYWHERE.values()]
    slopes = [partial_derivative(node, "x") for node in nodes]
    kernel = Kernel([*nodes, *slopes, *(partial_derivative(slope, "x") for slope in slopes)], ["x"])
    value = Kernel(nodes, ["x"])
    values = lambda x: jnp.stack(value([x]))  # noqa: E731

    @jax.jit
    def differentiated(x):
        forward = jnp.stack([values(x), jax.jacfwd(values)(x), jax.jacfwd(jax.jacfwd(values))(x)])
        return forward, jnp.stack([values(x), jax.jacrev(values)(x), jax.jacrev(jax.jacrev(values))(x)])

    true = [sympy.lambdify(X, [f.diff(X, k) for f in FINITE_EVERYWHERE.values()], "mpmath") for k in range(3)]
    for x in (-900.0, -40.0, -1.3, 0.0, 0.7, 35.0, 200.0, 900.0):
        with mp.workdps(900):
            expected = np.array([[float(v) for v in f(mp.mpf(x))] for f in true])
        written = np.reshape(kernel([np.array(x)], "numpy"), expected.shape)
        for found in (written, *differentiated(np.array(x))):
            # atol: JAX's derivatives of the logistic function are differences of numbers of size 1
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
        assert np.isfinite(differentiated(np.array(x, np.float32))[1]).all()


def test_numpy_and_jax_agree():
    rng = np.random.default_rng(1)
    expression = sympy.Max(X, Y) ** 1.5 / (1 + X**2) - sympy.atan2(X, Y) * sympy.Mod(X, 0.3) + sympy.sqrt(Y) - 2
    kernel = Kernel([graph(expression)], ["x", "y"])
    x, y = rng.uniform(0.1, 2.0, (2, 50))
    expected = np.maximum(x, y) ** 1.5 / (1 + x**2) - np.arctan2(x, y) * (x % 0.3) + np.sqrt(y) - 2
    np.testing.assert_allclose(kernel([x, y], "numpy")[0], expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda x, y: kernel([x, y])[0])(x, y), expected, rtol=1e-13)


def test_a_function_is_found_by_its_name():
    """A graph that is loaded evaluates functions that the process has not read before."""
    kernel = Kernel([make("polygamma6", (leaf("x"),))], ["x"])
    partial = partial_derivative(make("polygamma6", (leaf("x"),)), "x")
    found = [*kernel([1.5], "numpy"), *kernel([1.5]), *Kernel([partial], ["x"])([1.5], "numpy")]
    sixth, seventh = (float(mp.polygamma(n, 1.5)) for n in (6, 7))
    np.testing.assert_allclose(found, [sixth, sixth, seventh], rtol=1e-12)
    assert "polygamma" not in TABLE and "gammas" not in TABLE


def test_the_derivatives_of_a_bessel_function():
    """At zero and beside it, where I₁(x)/x is 0/0 and cancels, and on both sides of where its series ends."""
    nodes = [graph(sympy.besseli(1, X))]
    for _ in range(3):
        nodes.append(partial_derivative(nodes[-1], "x"))
    kernel = Kernel(nodes, ["x"])
    for x in (0.0, 1e-9, -0.99, 1.01):
        expected = [float(mp.diff(lambda v: mp.besseli(1, v), x, k)) for k in range(4)]
        np.testing.assert_allclose(kernel([x], "numpy"), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(Kernel(nodes[:2], ["x"])([jnp.zeros(())]), [0.0, 0.5], rtol=1e-12)


def test_zero_times_infinity_is_no_number():
    kernel = Kernel([multiply(leaf("x"), leaf("y"))], ["x", "y"])
    with np.errstate(all="raise"):
        assert np.isnan(kernel([0.0, np.inf], "numpy")[0]) and np.isnan(kernel([jnp.zeros(()), jnp.array(jnp.inf)])[0])
        assert np.isnan(kernel([np.zeros(1), np.full(1, np.inf)], "numpy")[0]).all()


def test_numbers_beyond_the_largest_are_infinite():
    """As NumPy and JAX have them; Python raised its own errors."""
    numbers = [power(constant(1e200), 2), power(constant(-1e200), 3), power(constant(1e-200), -2), constant(-(10**400))]
    assert [number(n) for n in numbers] == [np.inf, -np.inf, np.inf, -np.inf]
    assert number(power(constant(10**400), Fraction(1, 2))) == np.inf
    x = leaf("x")
    assert Kernel([linear([(10**400, x)], 10**400)], ["x"])([2.0], "numpy") == [np.inf]
    assert number(power(constant(10**200), 1)) == 10**200  # exact


def test_equal_expressions_are_one_node():
    assert graph(X + 2 * Y) is graph(2 * Y + X)
    assert graph(sympy.sin(X * Y) ** 2) is graph(sympy.sin(Y * X) * sympy.sin(Y * X))
    assert partial_derivative(graph((X + Y) * (X - Y)), "y").leaves == {"y"}
    assert directional_derivative(graph(sympy.Abs(X)), {"x": ONE}).leaves == {"x"}


class Table(eqx.Module):
    nodes: np.ndarray | jax.Array
    values: np.ndarray | jax.Array

    def evaluate(self, x):
        return jnp.interp(x, self.nodes, self.values)


def test_a_table_in_an_equation():
    """A pytree's arrays are leaves of the system, and gradients reach them."""
    table = Table(np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 2.0]))

    def write(c, t):
        x = c.variable("x", start=0.5, fixed=True)
        (y,) = c.function("law", table.evaluate, inputs=[x])
        c.add_equations(Eq(der(x), -2 * y))

    system = compiled(write)
    trainable, frozen = system.partition("c.law")

    @jax.jit
    @jax.value_and_grad
    def field(trainable):
        return eqx.combine(trainable, frozen).vector_field(0.0, jnp.array([0.25]))[0]

    value, grad = field(trainable)
    assert float(value) == -3.0
    leaves = [np.asarray(g) for g in jax.tree.leaves(grad) if np.shape(g) == (3,)]
    assert any(np.allclose(g, [-1.5, -0.5, 0.0]) for g in leaves)


@pytest.mark.slow
def test_functions_in_a_constraint_differentiated_twice():
    """Two outputs of one function in a constraint of index 3, against its derivatives by JAX."""
    radii = np.array([1.0, 0.8])  # a constant in a closure

    def shape(x, y):
        return jnp.stack([(x / radii[0]) ** 2, (y / radii[1]) ** 2 + 0.1 * jnp.sin(x * y)])

    def write(c, t):
        x, y = c.variable("x", start=0.6, fixed=True), c.variable("y", start=-0.6)
        v, w, force = c.variable("v", start=0.2, fixed=True), c.variable("w"), c.variable("force")
        a, b = c.function("shape", shape, inputs=[x, y])
        c.add_equations(Eq(der(x), v), Eq(der(y), w), Eq(der(v), -force * x), Eq(der(w), -force * y - 9.81))
        c.add_equations(Eq(a + b, 1))

    system = compiled(write)

    @jax.jit
    def hidden():
        """The constraint and its two derivatives in time."""
        state = system.initialize()
        x, y, v, w = system.observe(["c.x", "c.y", "c.v", "c.w"], 0.0, state)
        f = lambda q: shape(q[0], q[1]).sum() - 1  # noqa: E731
        q, u = jnp.array([x, y]), jnp.array([v, w])
        slopes = dict(zip(system.states, system.vector_field(0.0, state)[: len(system.states)], strict=True))
        acceleration = jnp.array([slopes["c.v"], slopes["c.w"]])
        rate, second = jax.jvp(lambda q: jax.jvp(f, (q,), (u,))[1], (q,), (u,))
        return f(q), rate, second + jax.jvp(f, (q,), (acceleration,))[1]

    value, rate, second = hidden()
    assert abs(value) < 1e-10
    assert abs(rate) < 1e-10
    assert abs(second) < 1e-9


def test_what_is_zero_divides_where_its_branch_is_taken_only():
    """An unknown that is identically zero is the number 0.0 of a program."""
    kernel = Kernel([graph(X * sympy.Piecewise((1 / Y, Y > 0), (2, True))), graph(1 / Y)], ["x", "y"])
    value, slope = jax.value_and_grad(lambda x: kernel([x, 0.0])[0])(3.0)
    assert (value, slope) == (6.0, 2.0)
    assert kernel([3.0, 0.0])[1] == np.inf


def test_where_a_node_is_needed_does_not_depend_on_an_order():
    """Of c ∧ d, c ∧ ¬d and ¬c ∧ ¬d, the second makes c with the first and ¬d with the last."""
    (c, no_c), (d, no_d) = ([(name, holds) for holds in (True, False)] for name in "cd")
    first = frozenset([frozenset([c, d]), frozenset([no_c, no_d])])
    assert union(first, frozenset([frozenset([c, no_d])])) == frozenset([frozenset([c]), frozenset([no_d])])


def test_a_power_of_zero_has_a_slope_in_its_exponent():
    """∂(x^p)/∂p = x^p·log x is zero at x = 0 for p > 0, and has no value for p < 0."""
    kernel = Kernel([partial_derivative(graph(X**Y), "y")], ["x", "y"])
    at = np.array([[0.0, 2.0], [2.0, 3.0], [0.0, -1.0]])
    found = kernel(list(at.T), "numpy")[0]
    np.testing.assert_allclose(found[:2], [0.0, 8 * np.log(2)], rtol=1e-15)
    assert not np.isfinite(found[2])
    slope = jax.grad(lambda v: kernel([v, 2.0])[0])
    assert slope(0.0) == 0.0
