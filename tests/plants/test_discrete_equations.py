"""Equations of discrete variables in components of our own: the event iteration of the Modelica Language Specification
3.6 (sections 3.7.5, 8.5, appendix B), with answers by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component
from sympy import And, Eq, Not, Or, Piecewise

from jaxonomy_dae import assign, der, pre, simulate
from jaxonomy_dae.errors import ModelError, SimulationError


def refused(write):
    """What is said of a component with these declarations."""

    def build(self, ev):
        x, m = self.variable("x", start=0.0, fixed=True), self.discrete("m")
        self.add_equations(Eq(der(x), 1.0))
        write(self, x, m)

    with pytest.raises(ModelError) as error:
        compiled(component(build))
    return str(error.value)


def test_what_no_discrete_equation_is():
    assert "changes with 'x' between events" in refused(lambda c, x, m: c.discrete_equation(m, 2 * x))
    assert "takes a discrete variable" in refused(lambda c, x, m: c.discrete_equation(x, x > 1))
    assert "write x for what it is" in refused(lambda c, x, m: c.discrete_equation(m, pre(x) > 1)).lower()
    assert "an equation reads x" in refused(lambda c, x, m: c.output("y", pre(x)))
    assert "a condition is on the present" in refused(lambda c, x, m: c.when(pre(x) > 1, assign(m, 1)))
    assert "has an equation already" in refused(lambda c, x, m: [c.discrete_equation(m, x > k) for k in (1, 2)])

    def also_assigned(c, x, m):
        c.discrete_equation(m, x > 1)
        c.when(x > 2, assign(m, 0))

    assert "assigns 'm'" in refused(also_assigned)

    def circle(c, x, m):
        n = c.discrete("n")
        c.discrete_equation(m, Eq(n, 0))
        c.discrete_equation(n, Eq(m, 1))

    assert "depend on each other" in refused(circle)


def rises(b):
    return And(Eq(b, 1), Eq(pre(b), 0))


def counted(n, condition):
    return Piecewise((pre(n) + 1, condition), (pre(n), True))


def truths(self, ev):
    """A latch, an iteration to a fixed point, values that pre(…) hands on, and counts of what is true for one iteration
    only, as in the texts of Modelica of these names."""
    names = "set reset latch many a b c rose falls fell".split()
    s, r, q, n, a, b, c, rose, f, fell = map(self.discrete, names)
    self.discrete_equation(rose, counted(rose, rises(c)))  # before those that it reads
    self.discrete_equation(s, And(ev.t > 0.2, ev.t < 0.3))
    self.discrete_equation(r, ev.t > 0.6)
    self.discrete_equation(q, And(Or(Eq(s, 1), Eq(pre(q), 1)), Not(Eq(r, 1))))
    self.discrete_equation(n, Piecewise((pre(n) + 1, And(ev.t > 0.5, pre(n) < 4)), (pre(n), True)))
    self.discrete_equation(a, ev.t > 0.5)
    self.discrete_equation(b, Eq(pre(a), 1))
    self.discrete_equation(c, Eq(pre(b), 1))
    self.discrete_equation(f, And(Eq(pre(s), 1), Eq(s, 0)))
    self.discrete_equation(fell, counted(fell, rises(f)))
    x = self.variable("x", start=0.0, fixed=True)
    self.add_equations(Eq(der(x), Piecewise((2.0, Eq(b, 1)), (1.0, True))))


@pytest.mark.slow
def test_discrete_equations_are_iterated_until_nothing_changes():
    run = simulate(compiled(component(truths)), 1.0, ts=jnp.array([0.1, 0.25, 0.4, 0.55, 0.7, 1.0]), rtol=1e-9)
    wanted = {
        "latch": [0, 1, 1, 1, 0, 0], "many": [0, 0, 0, 4, 4, 4], "c": [0, 0, 0, 1, 1, 1], "rose": [0, 0, 0, 1, 1, 1],
        "falls": [0, 0, 0, 0, 0, 0], "fell": [0, 0, 1, 1, 1, 1], "x": [0.1, 0.25, 0.4, 0.6, 0.9, 1.5],
    }  # fmt: skip
    for name, values in wanted.items():
        np.testing.assert_allclose(run[f"c.{name}"], values, atol=1e-8, err_msg=name)


def thermostat(self, ev):
    low, high = self.parameter("low", 19.0), self.parameter("high", 21.0)
    T, on, starts = self.variable("T", start=20.0, fixed=True), self.discrete("on"), self.discrete("starts")
    last, ticks = self.discrete("last"), self.discrete("ticks")
    self.discrete_equation(starts, counted(starts, rises(on)))
    self.discrete_equation(on, Or(T < low, And(Eq(pre(on), 1), T < high)))
    self.when(self.sampled(1.0, 0.5), assign(ticks, pre(ticks) + 1))
    self.discrete_equation(last, Piecewise((T, Not(Eq(ticks, pre(ticks)))), (pre(last), True)))  # at a tick
    self.add_equations(Eq(der(T), Piecewise((2.0, Eq(on, 1)), (-1.0, True))))


@pytest.mark.slow
def test_derivatives_pass_through_the_iteration():
    """T falls by 1 and rises by 2 a second between its levels: at t = 7.4 it is low + 2·(7.4 − t₃), where it has met
    the lower one for the third time at t₃ = 20 − low + 3·(high − low)."""
    system = compiled(component(thermostat))

    def found(levels):
        changed = system.with_parameters({"c.low": levels[0], "c.high": levels[1]})
        run = simulate(changed, 8.0, ts=jnp.array([2.7, 7.4]), rtol=1e-9)
        return jnp.stack([run["c.T"][1], run["c.last"][0], run["c.starts"][1], run["c.ticks"][1]])

    levels = jnp.array([19.0, 21.0])
    np.testing.assert_allclose(found(levels), [19.8, 20.5, 3, 7], atol=1e-8)
    slopes = jax.jacrev(found)(levels)
    np.testing.assert_allclose(slopes[0], [9.0, -6.0], rtol=1e-7)
    # At the tick at 2.5, T = high − (2.5 − (20 − low) − (high − low)/2).
    np.testing.assert_allclose(slopes[1], [-1.5, 1.5], rtol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(found)(levels), slopes, atol=1e-9)


@pytest.mark.slow
def test_a_circle_is_named():
    def ring(self, ev):
        x = self.variable("x", start=0.0, fixed=True)
        a, b, other = self.discrete("a"), self.discrete("b"), self.discrete("other")
        self.add_equations(Eq(der(x), 1.0))
        self.discrete_equation(a, And(x > 0.5, Eq(pre(b), 0)))
        self.discrete_equation(b, Eq(pre(a), 1))
        self.discrete_equation(other, x > 0.25)

    with pytest.raises(SimulationError, match=r"t=0\.5: .*'c\.a' and 'c\.b' go round in a circle"):
        simulate(compiled(component(ring)), 1.0)
