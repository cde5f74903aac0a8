"""How large the terms of equations are: beside what zero is judged, whatever the units and however far away."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, component

from jaxonomy_dae import InitializationError, SteadyStateError, der, steady_state
from jaxonomy_dae.graph.expressions.from_sympy import read
from jaxonomy_dae.graph.expressions.kernel import Kernel
from jaxonomy_dae.graph.expressions.magnitude import magnitude
from jaxonomy_dae.write import Eq

X, Y = sympy.symbols("x y", real=True)
# Expressions, and their magnitudes by hand at x = -2, y = 3, where y stands for terms of the size 10.
BY_HAND = [
    (X + 1000000 - Y, 2 + 1e6 + 10),
    ((X + 2) * Y, (2 + 2) * 10),
    ((X + 1) ** 2, (2 + 1) ** 2),
    (1 / (X + 1), 1 / 1),
    (sympy.sin(1000 * X) - 2, abs(np.sin(2000.0)) + 2),
    (sympy.Abs(X + 2) + Y, (2 + 2) + 10),
    (sympy.sqrt(X + 3) - 1, 1 + 1),
    (sympy.Piecewise((X + 5, X < 0), (Y, True)), 2 + 5),
    (sympy.Max(X + 2, -Y), (2 + 2) + 10),
    (sympy.sin(X + 2), 0 + 1 * (4 - 0)),
    (sympy.exp(X * (X + 1)), np.exp(2.0) * (1 + 2 * 3 - 2)),
    (sympy.atan2(X + 2, Y), 0 + (4 - 0 + 10 - 3) / 3),
    (sympy.atan2(X + 2, X + 2), 0 + 8 / (8 * 2.0**-52)),
]


@pytest.mark.parametrize(("expression", "expected"), BY_HAND, ids=[str(e) for e, _ in BY_HAND])
def test_magnitudes_of_expressions(expression, expected):
    graph = magnitude(read(expression, lambda s: s.name), lambda label: "size" if label == "y" else None)
    kernel = Kernel([graph], ["x", "y", "size"])
    found = kernel([-2.0, 3.0, 10.0], "numpy")[0]
    assert float(found) == pytest.approx(expected, rel=1e-14)


def far(law, guess):
    """a' = sin(p) − a, with an angle p that a law determines."""

    def write(self, ev):
        a, p = self.variable("a", start=0.0, fixed=True), self.variable("p", start=guess)
        self.add_equations(Eq(der(a), sympy.sin(p) - a), law(p))

    return compiled(component(write))


@pytest.mark.slow
def test_far_away_nothing_is_a_root_that_is_none():
    """Terms of size one were judged beside |∂F/∂p|·|p|: at 1e13, sin(p) = 2 held."""
    for guess in (1e13, 1e17):
        with pytest.raises(InitializationError, match=r"0 = sin\(p\) - 2 .*, in c\.p: off by"):
            far(lambda p: Eq(sympy.sin(p), 2), guess).initialize()
    system = far(lambda p: Eq(sympy.sin(p), sympy.Rational(3, 10)), 1e10)
    p = float(system.observe("c.p", 0.0, system.initialize()))
    assert abs(p - 1e10) < 7
    assert np.sin(p) == pytest.approx(0.3, abs=4 * np.spacing(1e10))


def test_an_angle_of_a_difference_is_zero_to_the_digits_of_its_terms():
    """What no number q makes zero, atan2(2.311 q − 0.106 p, p), was judged beside itself: no start was found."""

    def write(self, ev):
        p, q = self.variable("p", start=1.3916, fixed=True), self.variable("q", start=1.0)
        self.add_equations(Eq(der(p), -p), Eq(der(q), -q))
        self.initially(Eq(sympy.atan2(2.311 * q - 0.106 * p, p), 0))

    system = compiled(component(write))
    assert float(system.observe("c.q", 0.0, system.initialize())) == pytest.approx(0.106 * 1.3916 / 2.311, rel=1e-15)


def test_far_away_nothing_is_an_equilibrium_that_is_none():
    def write(self, ev):
        p, w = self.variable("p", start=1.0), self.variable("w", start=0.0)
        self.add_equations(Eq(der(p), w), Eq(der(w), self.parameter("T", 2.0) - w - sympy.sin(p)))

    system = compiled(component(write))
    with pytest.raises(SteadyStateError):
        steady_state(system, initial={"c.p": 1e13})
    found = steady_state(system.with_parameters({"c.T": 0.5}), initial={"c.p": 1.0})
    assert float(found["c.p"]) == pytest.approx(np.pi / 6, rel=1e-12)


def binding(K, c):
    """x² + K x = K c, of a decaying c."""

    def write(self, ev):
        k, of = self.parameter("K", K), self.variable("c", start=c, fixed=True, nominal=c)
        x = self.variable("x", nominal=c)
        self.add_equations(Eq(der(of), -of), Eq(x**2 + k * x, k * of))

    return compiled(component(write))


@pytest.mark.parametrize(("K", "c"), [(1e-18, 1e-15), (1e-14, 1e-13), (1e-2, 1e-1), (1e12, 1e13)])
def test_blocks_in_small_units(K, c):
    """From x = 0, as after a jump, x of 1e-15 was off by 1507 %: a floor in SI units called its equation fulfilled."""
    system = binding(K, c)
    exact = 2 * c / (1 + np.sqrt(1 + 4 * c / K))  # without cancellation
    found = jax.jit(lambda z: system.observe("c.x", 0.0, z))(jnp.array([c, 0.0]))
    assert float(found) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("first", [0, 1])
def test_models_of_one_structure_keep_their_sizes(first):
    """Sizes belong to a model's values: compiled programs, shared by models of one structure, are given them."""
    small, large = binding(1e-18, 1e-15), binding(1e-2, 1e-1)
    assert small.plan == large.plan or small.plan.digest != large.plan.digest
    order = [(small, 1e-18, 1e-15), (large, 1e-2, 1e-1)]
    observe = jax.jit(lambda system, z: system.observe("c.x", 0.0, z))
    for system, K, c in order if first == 0 else order[::-1]:
        exact = 2 * c / (1 + np.sqrt(1 + 4 * c / K))
        assert float(observe(system, jnp.array([c, 0.0]))) == pytest.approx(exact, rel=1e-12)


class Cubic(eqx.Module):
    """u ↦ k·u³."""

    k: jax.Array

    def __call__(self, u):
        return self.k * u**3


@pytest.mark.slow
def test_forward_derivatives_by_the_weights_of_a_law_in_a_block():
    """Magnitudes read networks, too: not differentiated. z + k·z³ = 2 at k = 1: dz/dk = −z³/(1 + 3·z²) at z = 1."""

    def write(self, ev):
        a, z = self.variable("a", start=0.0, fixed=True), self.variable("z", start=0.5)
        (law,) = self.learned("law", Cubic(jnp.array(1.0)), inputs=[z])
        self.add_equations(Eq(der(a), z), Eq(z + law, 2))

    system = compiled(component(write))

    def start(k):
        changed = eqx.tree_at(lambda s: s.neural["c.law"].k, system, k)
        return changed.observe("c.z", 0.0, changed.initialize())

    value, slope = jax.jit(lambda k: jax.jvp(start, (k,), (jnp.ones(()),)))(jnp.array(1.0))
    assert float(value) == pytest.approx(1.0, rel=1e-12)
    assert float(slope) == pytest.approx(-0.25, rel=1e-12)
