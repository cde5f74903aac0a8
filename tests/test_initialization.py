"""Consistent initialization: what is fixed holds, what is a guess yields, what contradicts is named."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import RELEASE, compiled, oscillator, pendulum
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, InitializationError, der, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource


def start(system, *names, **options):
    """The initial values of variables."""
    return np.asarray(_start(system, list(names), options))


@eqx.filter_jit
def _start(system, names, options):
    return system.observe(names, 0.0, system.initialize(**options))


class Cubic(Component):
    """dx/dt = −x with y = x³ + x: a start of y determines x through a nonlinear equation."""

    def __init__(self, ev, name, x_start=None, x_fixed=False, y_start=10.0, y_fixed=True):
        super().__init__(ev, name)
        p = self.parameter("p", y_start)
        x = self.variable("x", start=x_start, fixed=x_fixed)
        y = self.variable("y", start=p, fixed=y_fixed)
        self.add_equations(Eq(der(x), -x), Eq(y, x**3 + x))


def test_a_fixed_start_of_an_algebraic_variable_holds():
    system = compiled(Cubic(EqnEnv(), "c"))
    np.testing.assert_allclose(start(system, "c.x", "c.y"), [2.0, 10.0], rtol=1e-12)  # 2³ + 2 = 10; Newton to rounding


def test_its_gradient_is_the_implicit_functions():
    system = compiled(Cubic(EqnEnv(), "c"))

    @jax.jit
    def x(p):
        return system.with_parameters({"c.p": p}).initialize()[0]

    # dx/dp = 1/(3x² + 1) at x = 2 and, by the same program, at x = 1.
    assert float(jax.grad(x)(10.0)) == pytest.approx(1 / 13, rel=1e-10)
    assert float(jax.grad(x)(2.0)) == pytest.approx(1 / 4, rel=1e-10)
    assert float(jax.jvp(x, (2.0,), (1.0,))[1]) == pytest.approx(1 / 4, rel=1e-10)


def test_a_guess_yields_to_what_is_fixed():
    system = compiled(Cubic(EqnEnv(), "c", x_start=5.0))
    np.testing.assert_allclose(start(system, "c.x", "c.y"), [2.0, 10.0], rtol=1e-12)


def test_a_guess_of_a_state_is_taken_where_nothing_else_determines_it():
    system = compiled(Cubic(EqnEnv(), "c", x_start=1.5, y_fixed=False))
    np.testing.assert_allclose(start(system, "c.x"), [1.5], rtol=1e-12)


def test_without_any_start_the_state_is_zero():
    class Bare(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x")
            self.add_equations(Eq(der(x), 1 - x))

    np.testing.assert_array_equal(start(compiled(Bare(EqnEnv(), "c")), "c.x"), [0.0])


def test_redundant_starts_that_agree_are_accepted():
    system = compiled(Cubic(EqnEnv(), "c", x_start=2.0, x_fixed=True))
    np.testing.assert_allclose(start(system, "c.x", "c.y"), [2.0, 10.0], rtol=1e-12)
    # The pendulum fixes four numbers of two degrees of freedom.
    pend = start(pendulum(), "pend.x", "pend.y", "pend.vx", "pend.vy", "pend.lam")
    x, y = np.cos(RELEASE), np.sin(RELEASE)
    np.testing.assert_allclose(pend, [x, y, 0, 0, -9.81 * y / 2], rtol=1e-12, atol=1e-12)


def test_contradicting_starts_are_named():
    system = compiled(Cubic(EqnEnv(), "c", x_start=3.0, x_fixed=True))
    with pytest.raises(InitializationError, match=r"(?s)c\.[xy].*off by.*fixed=False"):
        system.initialize()
    with pytest.raises(InitializationError, match=r"start of c\.y, 10: off by"):
        simulate(system, 1.0, ts=jnp.array([1.0]))


def test_contradicting_starts_across_a_connection():
    """Two capacitors in parallel that are to start at different voltages."""
    ev = EqnEnv()
    a, b, r = Capacitor(ev, "a", 1.0, initial_voltage=1.0), Capacitor(ev, "b", 1.0, initial_voltage=2.0), Resistor(
        ev, "r"
    )  # fmt: skip
    g = Ground(ev, "g")
    system = compiled(a, b, r, g, connect=[(a.p, b.p, r.p), (a.n, b.n, r.n, g.p)])
    with pytest.raises(
        InitializationError,
        match=r"(?s)start of b\.v, 2: off by 1.*b\.v and a\.v are fixed at 2 and 1.*values that agree",
    ):
        system.initialize()
    # New values that agree mend it: nothing is wrong with the model.
    mended = system.with_parameters({"b.initial_voltage": 1.0})
    np.testing.assert_allclose(start(mended, "a.v", "b.v"), [1.0, 1.0], rtol=1e-12)


def test_contradiction_inside_jit():
    system = compiled(Cubic(EqnEnv(), "c", x_start=3.0, x_fixed=True))

    def run(throw):
        solution = simulate(system, 1.0, ts=jnp.array([1.0]), throw=throw)
        return solution.states, diffrax.is_okay(solution.result)

    states, okay = jax.jit(lambda: run(None))()
    assert np.isnan(states).all() and not okay
    with pytest.raises(Exception, match="no consistent initial point"):
        jax.block_until_ready(jax.jit(lambda: run(True))())


def test_values_given_outrank_declared_starts():
    system = compiled(Cubic(EqnEnv(), "c", x_start=2.0, x_fixed=True))
    np.testing.assert_allclose(start(system, "c.x", "c.y", initial={"c.x": 1.0}), [1.0, 2.0], rtol=1e-12)
    np.testing.assert_allclose(start(system, "c.x", "c.y", initial={"c.y": 30.0}), [3.0, 30.0], rtol=1e-12)


def test_values_given_outrank_starts_that_follow_from_others():
    """A pendulum given an x alone: y and the velocities follow, from the declared side of the circle."""
    system = pendulum()
    found = start(system, "pend.x", "pend.y", "pend.vx", "pend.vy", initial={"pend.x": 0.6, "pend.vx": 1.6})
    np.testing.assert_allclose(found, [0.6, -0.8, 1.6, 1.2], rtol=1e-10)  # x·vx + y·vy = 0


def test_a_derivative_may_be_given():
    names = ("mass.s", "mass.v", "spring.f")
    np.testing.assert_allclose(start(oscillator(), *names, initial={"der(mass.s)": 2.5}), [0.7, 2.5, 3.5], rtol=1e-12)


def test_an_alias_may_be_given_with_its_sign():
    """The current of a discharging capacitor determines its voltage: v = −R·i, and r.i = −c.i."""
    ev = EqnEnv()
    c, r, g = Capacitor(ev, "c", 1.0), Resistor(ev, "r", 4.0), Ground(ev, "g")
    system = compiled(c, r, g, connect=[(c.p, r.p), (c.n, r.n, g.p)])
    np.testing.assert_allclose(start(system, "c.v", "r.i", initial={"c.i": -0.5}), [2.0, 0.5], rtol=1e-12)
    np.testing.assert_allclose(start(system, "c.v", "c.i", initial={"r.n.i": -0.5}), [2.0, -0.5], rtol=1e-12)


def test_values_given_that_contradict_each_other_are_named():
    with pytest.raises(InitializationError, match=r"start of pend\.[xy]"):
        pendulum().initialize(initial={"pend.x": 0.9, "pend.y": -0.9})


def test_underdetermined_starts_keep_the_guesses():
    """A capacitor without a given voltage starts at its guess, 0; one that a source determines starts there."""
    ev = EqnEnv()
    s, r, g = VoltageSource(ev, "s", 3.0), Resistor(ev, "r"), Ground(ev, "g")
    free, tied = Capacitor(ev, "free", 1.0), Capacitor(ev, "tied", 1.0)
    system = compiled(s, r, free, tied, g, connect=[(s.p, r.p, tied.p), (r.n, free.p), (free.n, tied.n, s.n, g.p)])
    np.testing.assert_allclose(start(system, "free.v", "tied.v", "r.i"), [0.0, 3.0, 3.0], atol=1e-12)


def test_inputs_and_time_enter():
    class Follows(Component):
        """x + y = u(t), dx/dt = y, y fixed at the start."""

        def __init__(self, ev, name):
            super().__init__(ev, name)
            u = self.input("u")
            x, y = self.variable("x"), self.variable("y", start=1.0, fixed=True)
            self.add_equations(Eq(x + y, u), Eq(der(x), y))

    system = compiled(Follows(EqnEnv(), "c"))
    for inputs in ({"c.u": 10.0}, {"c.u": lambda t: 5 * t}):
        x = system.initialize(2.0, inputs)
        np.testing.assert_allclose(system.observe(["c.x", "c.y"], 2.0, x, inputs), [9.0, 1.0], rtol=1e-12)
