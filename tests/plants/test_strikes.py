"""Several contacts that close at one instant, beside the linear complementarity problem of their impulses."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import Component, EqnEnv, der, simulate
from jaxonomy_dae.run.simulation.hybrid_problem import problem_for
from jaxonomy_dae.write.events import EventFlag

G = 9.81


class Body(Component):
    """q'' = Jᵀf with gaps 1 + J·q ≥ 0, as many as coordinates; the first gives nothing back."""

    def __init__(self, ev, name, n):
        super().__init__(ev, name)
        q = [self.variable(f"q{k}", start=0.0, fixed=True) for k in range(n)]
        v = [self.variable(f"v{k}", start=self.parameter(f"start{k}", -1.0), fixed=True) for k in range(n)]
        f = [self.variable(f"f{i}") for i in range(n)]
        j = [[self.parameter(f"j{i}{k}", float(i == k)) for k in range(n)] for i in range(n)]
        for k in range(n):
            self.add_equations(der(q[k]) - v[k], der(v[k]) - sum(j[i][k] * f[i] for i in range(n)))
        for i in range(n):
            gap = 1 + sum(j[i][k] * q[k] for k in range(n))
            back = {"restitution": self.parameter(f"e{i}", 0.0)} if i else {}
            self.complementary(gap, f[i], f"on{i}", order=2, **back)


def after_impact(j, v, e):
    """v + Jᵀp of p ≥ 0, w = J·v⁺ + e·J·v ≥ 0 and p·w = 0, by looking at all sets of contacts that act."""
    a, b, n = j @ j.T, (1 + e) * (j @ v), len(j)
    for acting in itertools.chain.from_iterable(itertools.combinations(range(n), k) for k in range(n + 1)):
        s, p = list(acting), np.zeros(n)
        p[s] = np.linalg.solve(a[np.ix_(s, s)], -b[s])
        if (p >= -1e-12).all() and (a @ p + b >= -1e-12).all():
            return v + j.T @ p
    raise AssertionError("no set of contacts acts")


def cases(n, count):
    """Jacobians of gaps that all close at speed 1, the speeds and the restitutions."""
    rng, found = np.random.default_rng(0), []
    while len(found) < count:
        j, v = rng.normal(size=(n, n)), rng.normal(size=n)
        j /= -(j @ v)[:, None]
        if np.linalg.cond(j) < 100:
            found.append((j, v, np.array([0.0, *rng.choice([0.0, 0.3, 0.9], n - 1)])))
    return [jnp.asarray(np.stack(column)) for column in zip(*found, strict=True)]


def given(j, v, e):
    n = len(v)
    values = {f"b.j{i}{k}": j[i, k] for i in range(n) for k in range(n)}
    return values | {f"b.start{k}": v[k] for k in range(n)} | {f"b.e{i}": e[i] for i in range(1, n)}


@pytest.mark.long("the response to an impulse, in a loop and with its derivative")
@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_impacts_are_the_complementarity_problems(n):
    """They were taken one after another, in the order in which they had been declared: two supports on one side of a
    falling rod left it with −0.6 and 0.6, or, declared the other way round, with −0.5 and 0.5."""
    system = compiled(Body(EqnEnv(), "b", n))
    t = jnp.zeros(())

    def strike(j, v, e):
        problem = problem_for(system.with_parameters(given(j, v, e)), t, t + 1, False, None, 1e-6)
        at = dict(zip([f"b.q{k}" for k in range(n)], jnp.linalg.solve(j, -jnp.ones(n)), strict=True))
        at |= {f"b.v{k}": v[k] for k in range(n)}
        x, q = jnp.stack([at[name] for name in system.states]), system.discrete_values
        after, _ = problem.written(t, x, x, q, q, jnp.asarray(problem.facts.are(EventFlag.STRIKE)), {})
        return jnp.stack([after[system.states.index(f"b.v{k}")] for k in range(n)])

    j, v, e = cases(n, 200)
    found = jax.jit(jax.vmap(strike))(j, v, e)
    expected = np.stack([after_impact(*map(np.asarray, case)) for case in zip(j, v, e, strict=True)])
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
def test_a_run_through_such_impacts():
    n = 2
    system = compiled(Body(EqnEnv(), "b", n))

    def run(j, v, e):
        # Before the next impact of any: gaps open at speeds of some ten at most.
        solution = simulate(system.with_parameters(given(j, v, e)), 1 + 1e-6, throw=False)
        return jnp.stack([solution[f"b.v{k}"][-1] for k in range(n)])

    j, v, e = cases(n, 60)
    found = jax.jit(jax.vmap(run))(j, v, e)
    expected = np.stack([after_impact(*map(np.asarray, case)) for case in zip(j, v, e, strict=True)])
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


LEGS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


class Table(Component):
    """A plate on four legs that falls flat, with small angles a and b: one leg more than it needs to stand.
    (It ended with values that are not finite.)"""

    def __init__(self, ev, name, order):
        super().__init__(ev, name)
        h, e = self.parameter("h", 1.0), self.parameter("e", 0.5)
        y, a, b = (self.variable(n, start=s, fixed=True) for n, s in (("y", h), ("a", 0.0), ("b", 0.0)))
        v, p, q = (self.variable(n, start=0.0, fixed=True) for n in "vpq")
        f = [self.variable(f"f{k}") for k in range(len(LEGS))]
        self.add_equations(der(y) - v, der(a) - p, der(b) - q, 2 * der(v) - sum(f) + 2 * G)
        self.add_equations(0.3 * der(p) - sum(s * x for (s, _), x in zip(LEGS, f, strict=True)))
        self.add_equations(0.4 * der(q) - sum(u * x for (_, u), x in zip(LEGS, f, strict=True)))
        for k in order:
            s, u = LEGS[k]
            self.complementary(y + s * a + u * b, f[k], f"on{k}", order=2, restitution=e)


@pytest.mark.slow
@pytest.mark.parametrize("order", [(2, 0, 3, 1)])
def test_a_table_that_falls_flat_does_not_turn(order):
    system, t1 = compiled(Table(EqnEnv(), "t", order)), 0.6

    def run(h, e):
        solution = simulate(system.with_parameters({"t.h": h, "t.e": e}), t1, throw=False)
        return jnp.stack([solution[name][-1] for name in ("t.v", "t.p", "t.q")])

    h, e = 1.1, 0.4
    first = np.sqrt(2 * h / G)
    np.testing.assert_allclose(jax.jit(run)(h, e), [-G * (t1 - first) + e * G * first, 0, 0], atol=1e-9)
    by_h, by_e = jax.jit(jax.jacfwd(run, argnums=(0, 1)))(h, e)
    np.testing.assert_allclose(by_h, [G * (1 + e) * first / (2 * h), 0, 0], atol=1e-8)
    np.testing.assert_allclose(by_e, [G * first, 0, 0], atol=1e-8)
    assert len(simulate(system, t1).events) == len(LEGS)


class Rod(Component):
    """A rod that falls flat on two supports, both on one side of its middle: the far one parts."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        h, e = self.parameter("h", 1.0), self.parameter("e", 0.5)
        y, a = self.variable("y", start=h, fixed=True), self.variable("a", start=0.0, fixed=True)
        v, p = (self.variable(n, start=0.0, fixed=True) for n in "vp")
        far, near = self.variable("far"), self.variable("near")
        self.add_equations(der(y) - v, der(a) - p, der(v) - far - near + G, der(p) - 2 * far - near)
        self.complementary(y + 2 * a, far, "on_far", order=2, restitution=e)
        self.complementary(y + a, near, "on_near", order=2, restitution=e)


@pytest.mark.slow
def test_derivatives_of_an_impact_of_which_one_contact_parts():
    """Of the near support alone, at the speed c: v⁺ + p⁺ = e·c, and p⁺ = v⁺ + c, so v⁺ = (e − 1)·c/2."""
    system, t1 = compiled(Rod(EqnEnv(), "r")), 0.5

    def run(h, e):
        solution = simulate(system.with_parameters({"r.h": h, "r.e": e}), t1, throw=False)
        return jnp.stack([solution["r.v"][-1], solution["r.p"][-1]])

    h, e = 1.1, 0.4
    first = np.sqrt(2 * h / G)  # c = G·first
    np.testing.assert_allclose(
        jax.jit(run)(h, e), [(e - 1) * G * first / 2 - G * (t1 - first), (e + 1) * G * first / 2]
    )
    slope = first / (2 * h)  # of `first`
    expected = [[((e - 1) / 2 + 1) * G * slope, (e + 1) * G * slope / 2], [G * first / 2, G * first / 2]]
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(derivative(run, argnums=(0, 1)))(h, e), expected, rtol=1e-7)
