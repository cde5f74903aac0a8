"""Every function of SymPy that a user would write: values and derivatives, explicit, in constraints that index
reduction differentiates twice, and in nonlinear equations."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import sympy
from function_table import FUNCTIONS
from problems import run
from sympy.codegen.cfunctions import hypot

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, ModelError, der
from jaxonomy_dae.graph.expressions.from_sympy import read
from jaxonomy_dae.graph.expressions.kernel import Kernel
from jaxonomy_dae.write import Eq

NAMES = list(FUNCTIONS)
POINTS = np.array([point for _, _, point in FUNCTIONS.values()])
SPEED = 0.3


class Written(Component):
    def __init__(self, ev, write):
        super().__init__(ev, "c")
        write(self, ev.t)


def compiled(write, **options):
    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(Written(ev, write)), **options)()


@pytest.fixture(scope="module")
def explicit():
    """y = f(x), y' and y″ for every function, while x″ = −x."""

    def write(c, t):
        for k, (f, _, point) in enumerate(FUNCTIONS.values()):
            x = c.variable(f"x{k}", start=point, fixed=True)
            v = c.variable(f"v{k}", start=SPEED, fixed=True)
            y, slope, curve = (c.variable(f"{n}{k}") for n in ("y", "s", "c"))
            c.add_equations(Eq(der(x), v), Eq(der(v), -x), Eq(y, f(x)), Eq(der(y), slope), Eq(der(slope), curve))

    names = [f"c.{n}{k}" for k in range(len(NAMES)) for n in ("x", "v")]
    return compiled(write, state_selection="dummy_derivatives", prefer_states=names)


def at_points(system, kinds):
    """Variables of these kinds for every function, as a function of all x."""
    names = [f"c.{kind}{k}" for kind in kinds for k in range(len(NAMES))]
    index = np.array([[system.states.index(f"c.{n}{k}") for k in range(len(NAMES))] for n in ("x", "v")])

    def at(x):
        state = jnp.zeros(len(system.states)).at[index[0]].set(x).at[index[1]].set(SPEED)
        return system.observe(names, 0.0, state).reshape(len(kinds), -1)

    return at


@pytest.fixture(scope="module")
def found(explicit):
    """y, y' and y″ for every function."""
    return np.asarray(jax.jit(at_points(explicit, "ysc"))(POINTS))


def reference(order):
    """(d/dt)^order f(x(t)) with x′ = v = SPEED and v′ = −x, in 40 digits."""
    out = []
    with mp.workdps(40):
        for _, f, point in FUNCTIONS.values():
            x, v = mp.mpf(float(point)), mp.mpf(SPEED)
            first, second = (mp.diff(f, x, n, h=mp.mpf("1e-10")) for n in (1, 2))
            out.append(float((f(x), first * v, second * v**2 - first * x)[order]))
    return np.array(out)


@pytest.mark.long("59 functions in one program, with its derivatives")
@pytest.mark.parametrize("order", [0, 1, 2])
def test_value_and_derivatives_in_time(found, order):
    values, expected = found[order], reference(order)
    wrong = [n for n, a, b in zip(NAMES, values, expected, strict=True) if not abs(a - b) <= 1e-10 * max(1.0, abs(b))]
    assert not wrong, [(n, values[NAMES.index(n)], expected[NAMES.index(n)]) for n in wrong]


@pytest.mark.slow
def test_reverse_is_forward(explicit):
    """The curvature, whose equation was differentiated twice, differentiated once more."""
    at = at_points(explicit, "c")
    both = jax.jit(lambda x: (jax.jvp(at, (x,), (jnp.ones_like(x),))[1][0], jax.grad(lambda x: at(x).sum())(x)))
    forward, reverse = map(np.asarray, both(POINTS))
    with mp.workdps(40):
        third = []
        for _, f, point in FUNCTIONS.values():
            d1, d2, d3 = (mp.diff(f, mp.mpf(float(point)), n, h=mp.mpf("1e-8")) for n in (1, 2, 3))
            third.append(float(d3 * mp.mpf(SPEED) ** 2 - d2 * point - d1))
    for name, a, b, c in zip(NAMES, forward, reverse, third, strict=True):
        scale = max(1.0, abs(c))
        assert abs(a - b) <= 1e-9 * scale, name
        assert abs(a - c) <= 1e-8 * scale, (name, float(a), c)


@pytest.mark.slow
def test_in_nonlinear_blocks():
    """z and w determine each other through f, for each function; value and both derivatives by a parameter, against
    mpmath."""
    n = len(NAMES)

    def write(c, t):
        for k, (f, _, point) in enumerate(FUNCTIONS.values()):
            p, x = c.parameter(f"p{k}", 0.1), c.variable(f"x{k}", start=point, fixed=True)
            z, w = c.variable(f"z{k}", start=0.0), c.variable(f"w{k}", start=0.0)
            c.add_equations(Eq(der(x), -x), Eq(w, p * f(x + 0.01 * z)), Eq(z + z**3, w + p))

    system = compiled(write)

    @jax.jit
    def solved(p):
        def z(p):
            there = system.with_parameters({f"c.p{k}": p[k] for k in range(n)})
            return there.observe([f"c.z{k}" for k in range(n)], 0.0, there.initialize())

        value, forward = jax.jvp(z, (p,), (jnp.ones(n),))
        return value, forward, jax.grad(lambda p: z(p).sum())(p)

    def root(g, point, p):
        return mp.findroot(lambda z: z + z**3 - p * g(mp.mpf(point) + mp.mpf(0.01) * z) - p, 0.1 * float(p))

    found = zip(NAMES, FUNCTIONS.values(), *map(np.asarray, solved(np.full(n, 0.1))), strict=True)
    for name, (_, g, point), value, forward, reverse in found:
        with mp.workdps(30):
            of = lambda p, g=g, point=point: root(g, point, p)  # noqa: E731
            true, slope = float(of(mp.mpf(0.1))), float(mp.diff(of, mp.mpf(0.1), h=mp.mpf("1e-8")))
        assert abs(value - true) <= 1e-10, name
        assert abs(forward - reverse) <= 1e-9 * max(1.0, abs(slope)), name
        assert abs(forward - slope) <= 1e-7 * max(1.0, abs(slope)), name


def maps(count, a, b, sin, sqrt, tanh):
    """`count` nested maps of two numbers."""
    for _ in range(count):
        a, b = sin(a + b) / sqrt(1 + a**2 + b**2), tanh(a * b) + a
    return a, b


SIXTY = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, mpmath as mp, numpy as np, sympy
from jaxonomy_dae import der
from test_functions import compiled, maps

def write(c, t):
    x, y = c.variable("x", start=0.3, fixed=True), c.variable("y", start=0.2, fixed=True)
    with sympy.evaluate(False):  # SymPy asks everything it makes for its sign, by way of all its parts
        a, b = maps(60, x, y, sympy.sin, sympy.sqrt, sympy.tanh)
    c.add_equations(der(x) + a, der(y) + b)

system = compiled(write)
point = jnp.array([0.3, 0.2])
# Operation by operation: XLA takes minutes to fuse them.
found, pull = jax.vjp(lambda x: system.vector_field(0.0, x), point)
slopes = np.stack([np.asarray(pull(unit)[0]) for unit in jnp.eye(2)])
with mp.workdps(40):
    at = [mp.mpf(float(v)) for v in point]
    exact = lambda k, *at: -maps(60, *at, mp.sin, mp.sqrt, mp.tanh)[k]
    value = [float(exact(k, *at)) for k in (0, 1)]
    gradient = [
        [float(mp.diff(lambda *at: exact(k, *at), at, n=n)) for n in ((1, 0), (0, 1))] for k in (0, 1)
    ]
np.testing.assert_allclose(found, value, rtol=1e-12)
np.testing.assert_allclose(slopes, gradient, rtol=1e-9)
print("done")
"""


@pytest.mark.slow
def test_sixty_nested_maps_in_one_equation():
    """2⁶⁰ terms if anything were written out; in a process without the tests' checks of types, which cost most."""
    assert run(SIXTY).strip() == "done"


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda x: sympy.LambertW(x), "c'.*LambertW cannot be evaluated in JAX"),
        (lambda x: sympy.Function("g")(x), "g is a function without a definition"),
        (lambda x: sympy.Integral(sympy.exp(-(sympy.Symbol("s") ** 2)), (sympy.Symbol("s"), 0, x)), "Integral"),
        (lambda x: sympy.Piecewise((x, x > 0), (sympy.zoo, True)), "division by zero"),
        (lambda x: sympy.besselj(2, x), "besselj cannot be evaluated in JAX"),
        (lambda x: sympy.DiracDelta(x), "DiracDelta cannot be evaluated"),
    ],
)
def test_what_jax_lacks_is_refused(f, message):
    def write(c, t):
        x = c.variable("x", start=0.5, fixed=True)
        c.add_equations(der(x) + f(x))

    with pytest.raises(ModelError, match=message):
        compiled(write)


def test_derivatives_of_steps_are_zero():
    ev = EqnEnv()

    class Steps(Component):
        def __init__(self):
            super().__init__(ev, "c")
            x = self.variable("x")
            assert der(sympy.sign(x)) == 0
            assert der(sympy.Heaviside(x)) == 0
            assert der(sympy.floor(x)) == 0
            assert der(der(sympy.Abs(x))) == sympy.sign(x) * der(der(x))
            slope = der(sympy.Max(x, 0))
            assert slope.subs({x: 2}) == der(x)
            assert slope.subs({x: -2}) == 0

    Steps()


def test_conditions_that_mix_time_and_variables():
    def write(c, t):
        x = c.variable("x", start=0.5, fixed=True)
        y = c.variable("y")
        c.add_equations(der(x) + x, Eq(y, sympy.Piecewise((x, (t > 1) & (x > 0)), (-x, (t > 2) | (x < 0)), (7, True))))

    system = compiled(write)
    at = jax.jit(lambda t, x: system.observe(["c.y"], t, x[None])[0])
    for t, x, y in ((0.5, 0.5, 7.0), (1.5, 0.5, 0.5), (1.5, -0.5, 0.5), (2.5, 0.0, 0.0)):
        assert float(at(t, x)) == y


@pytest.mark.slow
def test_an_arccotangent_has_a_slope_at_zero_and_large_binomials_a_value():
    x, n = sympy.symbols("x n", real=True)
    kernel = Kernel([read(sympy.acot(x), str), read(sympy.binomial(n, 3), str)], ["x", "n"])
    assert float(jax.grad(lambda v: kernel([v, 5.0])[0])(0.0)) == -1.0
    for count in (5.0, 170.0, 200.0):  # n·(n − 1)·(n − 2)/6
        value, slope = jax.value_and_grad(lambda v: kernel([0.0, v])[1])(count)
        np.testing.assert_allclose(value, count * (count - 1) * (count - 2) / 6, rtol=1e-12)
        np.testing.assert_allclose(slope, (3 * count**2 - 6 * count + 2) / 6, rtol=1e-11)


def test_slopes_that_jax_has_otherwise():
    """The first and second derivative of a kernel in JAX, against 30 digits."""
    x = sympy.Symbol("x", real=True)
    cases = {
        sympy.besseli(0, x): (0.0, 0.5),
        sympy.besseli(1, x): (0.0, 1e-9, 3.0),
        sympy.gamma(x): (-10.25, 2.5),
        sympy.digamma(x): (-10.25, 2.5),
        sympy.polygamma(2, x): (-10.25, 2.5),
    }
    kernels = [Kernel([read(f, str)], ["x"]) for f in cases]

    def at(kernel, point):
        value = lambda v: kernel([v])[0]  # noqa: E731
        return jax.jvp(lambda v: jax.jvp(value, (v,), (1.0,)), (point,), (1.0,))

    found = jax.jit(lambda: [[at(k, p) for p in points] for k, points in zip(kernels, cases.values(), strict=True)])()
    for (f, points), here in zip(cases.items(), found, strict=True):
        reference = sympy.lambdify(x, f, "mpmath")
        for point, ((value, slope), (_, curve)) in zip(points, here, strict=True):
            with mp.workdps(30):
                expected = [mp.diff(reference, mp.mpf(point), n) for n in range(3)]
            np.testing.assert_allclose([value, slope, curve], np.array(expected, float), rtol=1e-12, atol=1e-15)


def test_the_second_derivative_of_a_power_at_zero():
    """x^p at x = 0 with p = 1, 2 and 3 in forward mode twice, by x and by p; at x = −2 by x alone."""
    x, p = sympy.symbols("x p")
    kernel = Kernel([read(x**p, str)], ["x", "p"])

    def slope(x, p):
        return jax.jvp(lambda v: kernel([v, p])[0], (x,), (1.0,))[1]

    for exponent, curve in ((1.0, 0.0), (2.0, 2.0), (3.0, 0.0)):
        value, by_x = jax.jvp(slope, (0.0, exponent), (1.0, 0.0))
        assert (value, by_x) == (float(exponent == 1), curve)
        assert jnp.isfinite(jax.jvp(slope, (0.0, exponent), (0.0, 1.0))[1])
        assert jax.grad(lambda v, n=exponent: kernel([v, n])[0])(-2.0) == exponent * (-2.0) ** (exponent - 1)


def test_what_is_not_a_number_stays_so():
    x, y = sympy.symbols("x y")
    for f in (hypot(x, y), sympy.Heaviside(x)):
        kernel = Kernel([read(f, str)], ["x", "y"])
        assert np.isnan(kernel([np.nan, 2.0], "numpy")[0]) and np.isnan(kernel([jnp.nan, 2.0])[0])


def test_a_step_far_from_where_its_exponential_overflows():
    """exp(40x)/(1 + exp(40x − 800)), which is exp(40x) for x < 19 and exp(800) beyond, with a slope."""
    x = sympy.Symbol("x", real=True)
    kernel = Kernel([read(sympy.exp(40 * x) / (1 + sympy.exp(40 * x - 800)), str)], ["x"])
    at = np.array([-1.0, 0.0, 3.0, 17.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda v: kernel([v])[0])))(at)
    np.testing.assert_allclose(values, np.exp(40 * at), rtol=1e-12)
    np.testing.assert_allclose(slopes, 40 * np.exp(40 * at), rtol=1e-12)


def test_a_negative_base_is_not_a_number():
    """A fractional power of a negative number is NaN, at compile time too, where the test points are negative."""

    def write(c, t):
        p = c.variable("p", start=200.0, fixed=True)
        q, m = c.variable("q"), c.variable("m", start=100.0)
        c.add_equations(Eq(q, 0.1 * (p - m) ** 0.6), Eq(q, 0.1 * sympy.sqrt(m - 1)), Eq(der(p), -q))

    system = compiled(write)
    m, q = map(float, jax.jit(lambda: system.observe(["c.m", "c.q"], 0.0, system.initialize()))())
    assert abs(q - 0.1 * (200 - m) ** 0.6) < 1e-9
    assert abs(q - 0.1 * (m - 1) ** 0.5) < 1e-9


def test_a_whole_part_in_a_nonlinear_block():
    """It is no event there, and none is left; what its events would have written still stands in the program."""

    def write(c, t):
        x, z = c.variable("x", start=2.5, fixed=True), c.variable("z", start=0.0)
        c.add_equations(Eq(der(x), -x), Eq(z + z**3, sympy.floor(x + 0.01 * z) + c.parameter("p", 0.1)))

    system = compiled(write)
    assert system.plan.events is None
    z = float(system.observe(["c.z"], 0.0, system.initialize())[0])
    assert z + z**3 == pytest.approx(2.1, rel=1e-12)
