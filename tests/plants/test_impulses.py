"""What jumps where a mode begins, with storage that is not linear.

References: charge is conserved and voltages are equal, which SciPy's bracketing solves; and its derivatives.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from problems import compiled, component
from sympy import exp, sin

from jaxonomy_dae import Component, Eq, EqnEnv, SimulationError, assign, der, pre, reinit, simulate

TIGHT = dict(rtol=1e-10, atol=1e-10)


class Joined(Component):
    """Capacitors with charges q(v) = v + k·v³ that a switch joins at t = 0.5, those of `pairs` at once."""

    def __init__(self, ev, name, voltages=(2.0, 0.5), pairs=((0, 1),)):
        super().__init__(ev, name)
        k, closed = self.parameter("k", 1.0), self.discrete("closed", start=0)
        v = [self.variable(f"v{n}", start=u, fixed=True) for n, u in enumerate(voltages)]
        i = [self.variable(f"i{n}") for n in range(len(pairs))]
        for n, u in enumerate(v):
            flows = sum(((b == n) - (a == n)) * i[p] for p, (a, b) in enumerate(pairs))
            self.add_equations(Eq((1 + 3 * k * u**2) * der(u), flows))
        for p, (a, b) in enumerate(pairs):
            self.either(Eq(closed, 1), v[a] - v[b], i[p], order=1)
        self.when(ev.t >= 0.5, assign(closed, 1))


def common(charge, law):
    """The voltage at which several equal capacitors hold a charge each."""
    return scipy.optimize.brentq(lambda v: law(v) - charge, -10, 10, xtol=1e-15)


@pytest.mark.slow
def test_charge_is_conserved_where_capacitance_depends_on_voltage():
    """q = v + k·v³: the derivative of the common voltage by k follows from that of the charge."""
    system = compiled(Joined(EqnEnv(), "c"))

    def end(k):
        return simulate(system.with_parameters({"c.k": k}), 1.0, **TIGHT)["c.v1"][-1]

    value, slope = jax.value_and_grad(end)(1.0)
    v = common((2.0 + 2.0**3 + 0.5 + 0.5**3) / 2, lambda v: v + v**3)
    np.testing.assert_allclose(value, v, rtol=1e-9)
    np.testing.assert_allclose(slope, ((2.0**3 + 0.5**3) / 2 - v**3) / (1 + 3 * v**2), rtol=1e-8)


@pytest.mark.slow
def test_three_capacitors_are_joined_at_once():
    start = (2.0, 0.5, -1.0)
    system = compiled(Joined(EqnEnv(), "c", start, ((0, 1), (1, 2))))
    v = common(sum(u + u**3 for u in start) / 3, lambda v: v + v**3)
    np.testing.assert_allclose(simulate(system, 1.0, **TIGHT)[["c.v0", "c.v1", "c.v2"]][-1], v, rtol=1e-9)


class Held(Component):
    """Two charges with voltages `law(q)` that are joined at t = 0.5."""

    def __init__(self, ev, name, law, starts):
        super().__init__(ev, name)
        q = [self.variable(f"q{n}", start=s, fixed=True) for n, s in enumerate(starts)]
        i, closed = self.variable("i"), self.discrete("closed", start=0)
        self.add_equations(Eq(der(q[0]), -i), Eq(der(q[1]), i))
        self.either(Eq(closed, 1), law(q[0]) - law(q[1]), i, order=1)
        self.when(ev.t >= 0.5, assign(closed, 1))


LAWS = {"cube": lambda q: q**3, "exponential": lambda q: exp(q / 4) - 1, "wave": lambda q: q + 0.3 * sin(q)}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_equal_laws_share_the_charge(law):
    system = compiled(Held(EqnEnv(), "c", LAWS[law], (9.0, 1.0)))

    def ends(q):
        return simulate(system, 1.0, initial={"c.q0": q}, **TIGHT)[["c.q0", "c.q1"]][-1]

    np.testing.assert_allclose(ends(9.0), [5.0, 5.0], rtol=1e-9)
    np.testing.assert_allclose(jax.jacrev(ends)(9.0), [0.5, 0.5], rtol=1e-8)


class Limited(Component):
    """x' = 1/2 − f under a limit 1 − a·sin 2t that is a variable of its own."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, f, limit = self.variable("x", start=0.0, fixed=True), self.variable("f"), self.variable("limit")
        self.add_equations(Eq(limit, 1 - self.parameter("a", 0.8) * sin(2 * ev.t)), Eq(der(x), 0.5 - f))
        self.complementary(limit - x, f, "top", order=1)


@pytest.mark.slow
def test_a_limit_that_is_a_variable_is_met_whatever_rounding_leaves():
    system = compiled(Limited(EqnEnv(), "c"))
    a = np.linspace(0.6, 0.95, 40)
    run = jax.vmap(lambda a: simulate(system.with_parameters({"c.a": a}), 0.75, ts=jnp.array([0.75]))["c.x"][-1])
    np.testing.assert_allclose(run(jnp.asarray(a)), np.minimum(0.375, 1 - a * np.sin(1.5)), rtol=0, atol=1e-12)


class Beside(Component):
    """A nonlinear equation in what events write, beside a constraint that has not begun."""

    def __init__(self, ev, name, number):
        super().__init__(ev, name)
        v, u, i = (
            self.variable("v", start=0.1, fixed=True),
            self.variable("u", start=0.3, fixed=True),
            self.variable("i"),
        )
        joined = self.discrete("joined", start=0)
        self.add_equations(Eq(der(v), 2 - v - i), Eq(der(u), i - u))
        self.either(Eq(joined, 1), v - u, i, order=1)
        self.when(ev.t >= 0.5, assign(joined, 1))
        x, y, z = (
            self.variable("x", start=-0.2, fixed=True),
            self.variable("y", start=1.1, fixed=True),
            self.variable("z"),
        )
        w = 5.0 if number else self.parameter("w", 5.0)
        self.add_equations(Eq(der(x), y), Eq(der(y), -w * z), Eq(z + 0.6 * z**3, x + 0.15 * y))
        self.when(z >= 0.2, reinit(y, -0.85 * pre(y)), reinit(x, pre(x) - 0.1 * pre(z)))


@pytest.mark.slow
def test_a_constraint_that_does_not_begin_does_nothing():
    """Whether a coefficient is a parameter or a number."""
    ends = [simulate(compiled(Beside(EqnEnv(), "c", number)), 0.6, **TIGHT)["c.x"][-1] for number in (True, False)]
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-9)
    joined = simulate(compiled(Beside(EqnEnv(), "c", False)), 0.6, **TIGHT)[["c.v", "c.u"]][-1]
    # (v + u)' = 2 − (v + u), whatever joins them.
    np.testing.assert_allclose(joined, (2 + (0.4 - 2) * np.exp(-0.6)) / 2, rtol=1e-8)


@pytest.mark.slow
def test_a_gap_that_no_impulse_closes_is_named_where_it_is():
    """x = 1 − t²/2 is held at zero from t = 1/2 on. The run was said to stop at its last step before, of some pole."""

    def write(self, ev):
        x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        f, on = self.variable("f"), self.discrete("on")
        self.add_equations(Eq(der(x), v), Eq(der(v), f - 1))
        self.either(Eq(on, 1), x, f, order=2)
        self.when(ev.t >= 0.5, assign(on, 1))

    with pytest.raises(
        SimulationError, match=r"t=0\.5: .* hold there: 'c: x = 0 while Eq\(on, 1\)', where it is 0\.875"
    ):
        simulate(compiled(component(write)), 1.0)
