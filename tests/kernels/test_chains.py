"""Chains of assignments, as many levels as links, against the recursions they are, written in NumPy.

Both sides do the same few operations in double precision, so they agree to about 1e-13 times the chain's length.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from shared_models import cascade, gain

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.compile.lowering import merge
from jaxonomy_dae.compile.lowering.program import PlannedLoop, PlannedSparse

TIGHT = dict(rtol=1e-12, atol=1e-13)


def cascade_slopes(t, x, a, law):
    """The recursion."""
    u, out = 1 + np.sin(t), []
    for xk, ak in zip(x, a, strict=True):
        out.append(u - xk)
        u = ak * law(u) + 0.2 * xk
    return np.array(out)


def kinds(system):
    return [type(step) for step in system.plan.derivative.steps]


def by_name(system, array, n):
    """The entries of a state array in the order of the cascade."""
    place = {name: k for k, name in enumerate(system.states)}
    return np.asarray(array)[..., [place[f"c.f{k}.x"] for k in range(n)]]


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [pytest.param(lambda u: u, marks=pytest.mark.slow), lambda u: u / (1 + u**2)],
    ids=["linear", "nonlinear"],
)
def test_cascade(law):
    """Values, and derivatives in both modes."""
    n, t = 16, 0.3
    system = cascade(n, law)
    assert PlannedLoop in kinds(system) and len(kinds(system)) < 6
    x = np.random.default_rng(0).normal(size=n)
    a = np.array([gain(k) for k in range(n)])
    reference = cascade_slopes(t, by_name(system, x, n), a, law)

    def last(gains, x):
        changed = system.with_parameters({f"c.f{k}.a": gains[k] for k in range(n)})
        return jnp.sum(changed.vector_field(t, x) ** 2)

    @jax.jit
    def everything(a, x):
        """Slopes, those of a batch, every output, derivatives in both modes."""
        outputs = system.observe([f"c.f{k}.y" for k in range(n - 1)], t, x)
        batch = jax.vmap(lambda x: system.vector_field(t, x))(jnp.stack([x, 2 * x]))
        slopes = [mode(last, argnums=(0, 1))(a, x) for mode in (jax.jacfwd, jax.jacrev)]
        return system.vector_field(t, x), batch, outputs, slopes

    field, batch, outputs, (forward, reverse) = jax.tree.map(np.asarray, everything(a, x))
    np.testing.assert_allclose(by_name(system, field, n), reference, **TIGHT)
    np.testing.assert_allclose(outputs, reference[1:] + by_name(system, x, n)[1:], **TIGHT)
    for one, other in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(one, other, **TIGHT)
    h = 1e-5  # the differences' errors: h² ~ 1e-10, and 1e-16 / h ~ 1e-11
    for k in (0, n - 2):
        e = h * np.eye(n)[k]
        values = [np.sum(cascade_slopes(t, by_name(system, x, n), a + s * e, law) ** 2) for s in (1, -1)]
        np.testing.assert_allclose(forward[0][k], (values[0] - values[1]) / (2 * h), rtol=1e-7, atol=1e-8)
    for member, at in zip(batch, (x, 2 * x), strict=True):
        expected = cascade_slopes(t, by_name(system, at, n), a, law)
        np.testing.assert_allclose(by_name(system, member, n), expected, **TIGHT)


@pytest.mark.parametrize("sizes", [(60, 120), pytest.param((100, 2000), marks=pytest.mark.slow)])
def test_the_program_does_not_grow_with_the_chain(sizes):
    def length(jaxpr):
        inner = [v for e in jaxpr.eqns for v in e.params.values() if hasattr(v, "jaxpr")]
        return len(jaxpr.eqns) + sum(length(v.jaxpr) for v in inner)

    lengths = []
    for n in sizes:
        system = cascade(n)
        jaxpr = jax.make_jaxpr(lambda x, system=system: system.vector_field(0.0, x))(np.zeros(n))
        lengths.append(length(jaxpr.jaxpr))
    assert lengths[0] == lengths[1]


class Recursion(Component):
    """y_k from those before, by `rule(k, y, x)`; der(x) = −y_{n−1}."""

    def __init__(self, ev, name, n, rule):
        super().__init__(ev, name)
        self.parameter("p", 0.8)
        x = self.variable("x", start=0.7, fixed=True)
        ys = []
        for k in range(n):
            ys.append(self.variable(f"y{k}"))
            self.add_equations(ys[k] - rule(k, ys, x, self.p))
        self.add_equations(der(x) + ys[-1])


def look_back(k, y, x, p):
    """Two terms, one and three links before."""
    return p * y[k - 1] - 0.3 * y[k - 3] + 0.1 * x**2 if k > 2 else x + k


def two_kinds(k, y, x, p):
    """Two recursions coupled crosswise: a repetition is more than one step."""
    if k < 2:
        return x + k
    return p * y[k - 1] * y[k - 2] / (1 + y[k - 2] ** 2) if k % 2 else y[k - 1] - 0.1 * y[k - 2] * x


def changing(k, y, x, p):
    """One rule up to the middle, another from there."""
    if k == 0:
        return x
    return p * y[k - 1] + 0.1 * x**2 if k < 22 else y[k - 1] / (1 + y[k - 1] ** 2) + x * p


def far_back(k, y, x, p):
    """Every link reads the first, which does not repeat what came before but is known when the run starts."""
    return p * y[k - 1] + 0.1 * y[0] * x if k else x**2


def check(system, rule, n):
    """Values and slopes in both modes, against the recursion written out."""

    def reference(x, p):
        y: list = []
        for k in range(n):
            y.append(rule(k, y, x, p))
        return y

    def slope(p, x):
        return system.with_parameters({"c.p": p}).vector_field(0.0, jnp.array([x]))[0]

    @jax.jit
    def everything(p, x):
        outputs = system.observe([f"c.y{k}" for k in range(n)], 0.0, x[None])
        return outputs, [mode(slope, argnums=(0, 1))(p, x) for mode in (jax.jacfwd, jax.jacrev)]

    outputs, slopes = everything(0.8, np.array(0.7))
    np.testing.assert_allclose(outputs, reference(0.7, 0.8), **TIGHT)
    h = 1e-30  # of complex steps: exact to rounding
    expected = [-np.imag(reference(*at)[-1]) / h for at in ((0.7, 0.8 + h * 1j), (0.7 + h * 1j, 0.8))]
    for found in slopes:
        np.testing.assert_allclose(found, expected, **TIGHT)


@pytest.mark.slow
@pytest.mark.parametrize("rule", [look_back, two_kinds, changing, far_back])
def test_recursions(rule):
    n = 44
    system = compiled(Recursion(EqnEnv(), "c", n, rule))
    assert PlannedLoop in kinds(system) and len(kinds(system)) < 24
    check(system, rule, n)


@pytest.mark.slow
def test_an_irregular_chain_is_one_sparse_system(monkeypatch):
    """Links at random, with two rules: no repetition, but affine in the links together."""
    monkeypatch.setattr(merge, "MANY", 20)
    monkeypatch.setattr(merge, "LEAST", 15)
    n = 40
    rng = np.random.default_rng(0)
    before = [int(rng.integers(max(0, k - 3), k)) if k else 0 for k in range(n)]
    first = rng.uniform(size=n) < 0.4

    def rule(k, y, x, p):
        if k == 0:
            return x
        return p * y[before[k]] + 0.1 * x if first[k] else 0.5 * y[before[k]] + x**2

    system = compiled(Recursion(EqnEnv(), "c", n, rule))
    assert PlannedSparse in kinds(system) and len(kinds(system)) < 10
    check(system, rule, n)
