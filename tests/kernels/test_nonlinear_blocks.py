"""Nonlinear blocks give a root of their equations or not-a-number.

References: closed forms, and the equations themselves evaluated in NumPy.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Abs, Max, Min, atan, exp

from jaxonomy_dae import Component, EqnEnv, der, smooth
from jaxonomy_dae.compile.lowering import schedule
from jaxonomy_dae.compile.lowering.schedule import SparseStep


class Implicit(Component):
    """x' = −1 from x0, and 0 = g(x, z, u) for z, which is read from the state."""

    def __init__(self, ev, name, law, x0, *starts):
        super().__init__(ev, name)
        x, u = self.variable("x", start=x0, fixed=True), self.input("u", default=0.0)
        c = [self.parameter(f"c{k}", 0.5) for k in range(5)]
        z = [self.variable(f"z{k}", start=s) for k, s in enumerate(starts)]
        self.add_equations(der(x) + 1, *law(x, u, *z, *(c if len(starts) == 1 else ())))


def implicit(law, x0, *starts):
    system = compiled(Implicit(EqnEnv(), "m", law, x0, *starts))
    assert len(system.carried) == len(starts)
    return system


# --- one equation: many laws by one program ------------------------------------------------------------------------

CUBIC = (1.0, 0.0, 0.0, -2.0, 2.0)  # z³ − 2z + 2 = x: Newton's method goes from 0 to 1 and back where x = 0
PARABOLA = (0.0, 1.0, 0.0, 0.0, 1.0)  # z² + 1 = x
SQUARE = (0.0, 1.0, 0.0, 0.0, 0.0)  # z² = x
N = 1000  # states that the program takes


@pytest.fixture(scope="module")
def laws():
    """c₀·z³ + c₁·z² + c₂·atan z + c₃·z + c₄ = x"""
    return implicit(lambda x, u, z, a, b, c, d, e: [a * z**3 + b * z**2 + c * atan(z) + d * z + e - x], 2.0, 1.0)


@pytest.fixture(scope="module")
def evaluate(laws):
    """(coefficients, x, z) to z as it is read, its rate, and what projections by 3 iterations and by few make of it."""

    @jax.jit
    @jax.vmap
    def program(c, state):
        system = laws.with_parameters({f"m.c{k}": c[k] for k in range(5)})
        rough = (system.project(0.0, state, iterations=3)[1], system.project(0.0, state)[1])
        return system.observe("m.z0", 0.0, state), system.vector_field(0.0, state)[1], *rough

    def of(c, x, z):
        c, x, z = np.broadcast_arrays(c, np.asarray(x, float)[..., None], np.asarray(z, float)[..., None])
        rows = np.arange(N) % len(c)
        found = program(c[rows], np.stack([x[rows, 0], z[rows, 0]], axis=1))
        return [np.asarray(v)[: len(c)] for v in found]

    return of


def test_what_does_not_converge_is_not_a_number(evaluate):
    """A cycle; no root, a minimum of |r|; the same from near the minimum. These came out as numbers: the fourth
    iterate, whatever it was."""
    found = evaluate([CUBIC, PARABOLA, PARABOLA], [0.0, 0.5, 0.5], [0.0, 1.0, 1e-9])
    for value in found[:3]:
        assert np.isnan(value).all()


def test_where_whole_steps_diverge_shorter_ones_find_the_root(evaluate):
    """atan z = 0 from 3: whole steps of Newton's method go away from the root, farther each time."""
    found = evaluate([(0, 0, 1, 0, 0)], [0.0], [3.0])
    for value in (found[0], found[2]):
        np.testing.assert_allclose(value, 0.0, atol=1e-12)


def test_branches_of_a_law_with_kinks_are_left_again():
    """z + clip(K z, −15, 15) = x = 10 from z = 20: whole steps go back and forth between −5 and 25, and a run whose
    input jumps ended in a value that is not a number."""
    gain = 15_000.0
    system = implicit(lambda x, u, z, *_: [z + smooth(Max(-15, Min(15, gain * z))) - x], 2.0, 1.0)
    found = jax.jit(lambda state: system.observe("m.z0", 0.0, state))(np.array([10.0, 20.0]))
    np.testing.assert_allclose(found, 10 / (1 + gain), rtol=1e-12)


def test_random_states_give_roots_or_nothing(evaluate):
    """1,000 states far from the root and near it, over twelve decades."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=N) * 10 ** rng.uniform(-6, 6, N)
    z = rng.normal(size=N) * 10 ** rng.uniform(-6, 6, N)
    found, _, _, rough = evaluate(CUBIC, x, z)
    good = np.isfinite(found)
    terms = np.abs(found) ** 3 + 2 * np.abs(found) + 2 + np.abs(x)
    assert (np.abs(found**3 - 2 * found + 2 - x) <= 1e-12 * terms)[good].all()
    assert 500 < good.sum() < 1000  # otherwise this shows nothing
    assert np.isnan(rough).sum() > 100
    root = np.array([min(np.roots([1, 0, -2, 2 - a]), key=lambda r: (abs(r.imag) > 1e-9, r.real)).real for a in x])
    again = evaluate(CUBIC, x, root * (1 + 1e-5 * rng.normal(size=N)))[0]
    np.testing.assert_allclose(again, root, rtol=1e-9)


def test_double_roots_are_reached():
    """z·|z| = x next to x = 0, where Newton's method halves its distance in a step."""
    system = implicit(lambda x, u, z, *_: [z * Abs(z) - x], 1.0, 1.0)
    x = np.array([1e-8, -1e-8, 1e-12])
    states = np.stack([x, np.copysign(1e-1, x)], axis=1)
    found = jax.jit(jax.vmap(lambda s: system.observe("m.z0", 0.0, s)))(states)
    np.testing.assert_allclose(found, np.copysign(np.sqrt(np.abs(x)), x), rtol=1e-6)


def test_small_terms_beside_constants():
    """A diode without current: exp(z) − 1 leaves rounding errors that are large beside z."""
    system = implicit(lambda x, u, z, *_: [exp(z) - 1 - x + u], 1.0, 0.5)
    x = np.array([0.0, 1e-18, 1e-12])
    found = jax.jit(jax.vmap(lambda s: system.observe("m.z0", 0.0, s)))(np.stack([x, x], axis=1))
    np.testing.assert_allclose(found, np.log1p(x), atol=1e-15)


def test_first_and_second_derivatives_of_a_root(laws):
    """z² = x read from a rough state: dz/dx = 1/(2z), d²z/dx² = −1/(4z³)."""
    system = laws.with_parameters({f"m.c{k}": c for k, c in enumerate(SQUARE)})

    def z(x):
        return system.observe("m.z0", 0.0, jnp.stack([x, jnp.asarray(1.3)]))

    first, second = jax.jit(lambda x: (jax.grad(z)(x), jax.jacfwd(jax.grad(z))(x)))(np.array(2.0))
    np.testing.assert_allclose(first, 0.5 / np.sqrt(2), rtol=1e-14)
    np.testing.assert_allclose(second, -0.25 / 2**1.5, rtol=1e-13)


# --- units ---------------------------------------------------------------------------------------------------------

UNITS = ((1, 1), (10**9, 1), (10**-9, 1), (1, 10**6), (10**9, 10**-6))


def parabola_in_units(k, u):
    """z² + 1 = x, the equation multiplied by k, z in units of u."""
    return implicit(lambda x, _, z, *unused: [k * ((z / u) ** 2 + 1 - x)], 2.0, u)


@pytest.mark.parametrize("k, u", [UNITS[-1], *(pytest.param(*v, marks=pytest.mark.slow) for v in UNITS[:-1])])
def test_units_decide_nothing(k, u):
    """A root where x > 1."""
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0, 2, 50), rng.uniform(0.5, 2, 50)
    expected = np.sqrt(np.where(x > 1, x - 1, np.nan))
    system = parabola_in_units(k, u)
    found = jax.jit(jax.vmap(lambda s: system.observe("m.z0", 0.0, s)))(np.stack([x, u * z], axis=1))
    np.testing.assert_allclose(np.asarray(found) / u, expected, rtol=1e-9)


# --- two equations -------------------------------------------------------------------------------------------------


def pair(x, u, a, b):
    """a² + b² = 2x, a·b = u: no solution where u > x."""
    return [a**2 + b**2 - 2 * x, a * b - u]


GUESS = (1.0, 1.3, 0.1)


def test_two_equations():
    system = implicit(pair, 1.0, 2.0, 0.1)

    @jax.jit
    @jax.vmap
    def values_and_rates(u):
        state, given = jnp.array(GUESS), {"m.u": u}
        return system.observe(["m.z0", "m.z1"], 0.0, state, given), system.vector_field(0.0, state, given)[1:]

    values, rates = values_and_rates(np.array([0.5, 1.5, 30.0]))
    # (a ± b)² = 2x ± 2u
    plus, minus = np.sqrt(3.0), np.sqrt(1.0)
    np.testing.assert_allclose(values[0], [(plus + minus) / 2, (plus - minus) / 2], rtol=1e-14)
    assert np.isnan(values[1:]).all() and np.isnan(rates[2]).all()


def test_whole_blocks(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(schedule, "WRITTEN_OUT", {True: 1, False: 1})
        system = implicit(pair, 1.0, 2.0, 0.1)
    assert any(isinstance(step, SparseStep) for step in system.plan.steps)
    read = jax.jit(lambda u: system.observe(["m.z0", "m.z1"], 0.0, jnp.array(GUESS), {"m.u": u}))
    np.testing.assert_allclose(read(0.5), [(np.sqrt(3) + 1) / 2, (np.sqrt(3) - 1) / 2], rtol=1e-14)
    assert np.isnan(read(1.5)).all()
