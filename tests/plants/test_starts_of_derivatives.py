"""Starts of derivatives: guesses that choose among several slopes, and demands."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, ModelError, StructuralError, der, simulate


class Branches(Component):
    """(x')² = x from x = 1: x = (1 ± t/2)², as the guess for x' says."""

    def __init__(self, ev, name, guess):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        self.start(der(x), guess)
        self.add_equations(Eq(der(x) ** 2, x))


class SecondOrder(Component):
    """A pendulum of length 1 in Cartesian coordinates, whose velocities have no names of their own."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        speed = self.parameter("speed", 2.0)
        x = self.variable("x", start=0.0, fixed=True)
        y = self.variable("y", start=-1.0)
        tension = self.variable("tension")
        self.start(der(x), speed, fixed=True)
        self.add_equations(Eq(der(der(x)), -tension * x), Eq(der(der(y)), -tension * y - 9.81), Eq(x**2 + y**2, 1))


class Inside(Component):
    """x'' = −x."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x")
        self.add_equations(Eq(der(der(x)), -x))


class Outside(Component):
    """A parent that starts the derivative of its child."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        inside = self.add(Inside(ev, "inside"))
        self.start(der(inside.x), 2.0, fixed=True)


GUESSES = [1.0, 3.0, -1.0, -3.0]


@pytest.fixture(scope="module")
def solution():
    """`c0`, … start with the slopes of `GUESSES`, `o.inside` as its parent says."""
    ev = EqnEnv()
    system = compiled(*(Branches(ev, f"c{k}", guess) for k, guess in enumerate(GUESSES)), Outside(ev, "o"))
    ts = jnp.array([0.0, 1.0, np.pi / 2])
    return simulate(system, ts[-1], ts=ts, rtol=1e-9, atol=1e-12, adjoint=diffrax.ForwardMode())


@pytest.mark.slow
def test_guesses_choose_slopes_at_the_start():
    ev = EqnEnv()
    system = compiled(*(Branches(ev, f"c{k}", guess) for k, guess in enumerate(GUESSES)))
    names = [f"der(c{k}.x)" for k in range(len(GUESSES))]
    found = jax.jit(lambda: system.observe(names, 0.0, system.initialize()))()
    np.testing.assert_allclose(found, np.sign(GUESSES), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("k", range(len(GUESSES)), ids=lambda k: str(GUESSES[k]))
def test_a_guess_chooses_the_slope(solution, k):
    sign = np.sign(GUESSES[k])
    assert float(solution[f"der(c{k}.x)"][0]) == pytest.approx(sign, rel=1e-12)
    assert float(solution[f"c{k}.x"][1]) == pytest.approx((1 + sign / 2) ** 2, rel=1e-7)  # 100 times the tolerance


@pytest.mark.slow
def test_a_parent_starts_the_derivative_of_a_child(solution):
    assert float(solution["o.inside.x"][-1]) == pytest.approx(2.0, rel=1e-7)  # 2 sin t; a hundred times the tolerance


@pytest.mark.slow
def test_a_derivative_without_a_name_is_fixed():
    system = compiled(SecondOrder(EqnEnv(), "p"))
    assert system.variables == ["p.x", "p.y", "p.tension"]

    def tension(speed):
        faster = system.with_parameters({"p.speed": speed})
        return faster.observe("p.tension", 0.0, faster.initialize())

    value, slope = jax.jit(jax.value_and_grad(tension))(2.0)
    assert float(value) == pytest.approx(2.0**2 + 9.81, rel=1e-12)  # v²/l + g, at the bottom
    assert float(slope) == pytest.approx(4.0, rel=1e-12)


def test_a_slope_that_is_fixed_determines_the_variable():
    class Steady(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0)
            self.start(der(x), 0.0, fixed=True)
            self.add_equations(Eq(der(x), 27 - x**3))

    system = compiled(Steady(EqnEnv(), "c"))
    with pytest.warns(RuntimeWarning, match=r"far from what is guessed: 'c\.x' = 3, guessed 1\."):
        assert float(system.initialize()[0]) == pytest.approx(3.0, rel=1e-9)  # dx/dt = 0
    assert "der(c.x) = 0" in str(system.initialization_report())


def test_contradictions_name_the_derivative():
    class Decay(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.start(der(x), 2.0, fixed=True)
            self.add_equations(Eq(der(x), -x))

    with pytest.raises(StructuralError, match=r"the fixed starts of 'c\.x' and 'der\(c\.x\)' contradict the equation"):
        compiled(Decay(EqnEnv(), "c"))


def _twice(component, x):
    component.start(der(x), 0.0)
    component.start(der(x), 1.0)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda c, x: c.start(x, 0.0), "start takes a derivative such as der(x); got x; for the variable itself, say"),
        (lambda c, x: c.start(der(x) + 1, 0.0), "start takes a derivative such as der(x); got der(x) + 1"),
        (lambda c, x: c.start(der(x), "0"), "the start value of 'der(c.x)' must be a real number; got the string '0'"),
        (lambda c, x: c.start(der(x), float("nan")), "the start value of 'der(c.x)' must be finite"),
        (lambda c, x: c.start(der(x), x), "the start value of 'der(c.x)' may use parameters only"),
        (_twice, "component 'c': der(x) has a start already"),
    ],
)
def test_what_is_no_start_is_refused(wrong, text):
    class Wrong(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x")
            wrong(self, x)
            self.add_equations(Eq(der(x), -x))

    with pytest.raises(ModelError) as error:
        Wrong(EqnEnv(), "c")
    assert text in str(error.value)


class Observed(Component):
    """Two relaxations whose coupling also has the derivative of x, of which y is the negative: if der(y) is asked for,
    x and its derivative are states, and `slow` is none."""

    def __init__(self, ev, name, is_asked):
        super().__init__(ev, name)
        slow = self.variable("slow", start=0.432)
        x = self.variable("x", start=0.906, fixed=True)
        y, z = self.variable("y"), self.variable("z")
        self.add_equations(
            Eq(der(slow), 0.7 - slow), Eq(z, x - 1.907 * y), Eq(0.532 * z + 0.361 * slow + y, 0), Eq(der(x), -y)
        )
        if is_asked:
            curvature = self.variable("curvature")
            self.add_equations(Eq(curvature, der(y)))


def test_a_guess_outranks_a_zero_whatever_is_asked_for():
    """Kind: what is asked of a model changes which quantities are states, and so moved a declared guess of a quantity
    that was no state any more. Closed form: y = −(0.532 x + 0.361 slow)/(1 − 0.532·1.907)."""
    ev = EqnEnv()
    system = compiled(Observed(ev, "plain", False), Observed(ev, "asked", True))
    assert "der(asked.x)" in system.states and "asked.slow" not in system.states  # else nothing is tested
    start = system.initialize()
    right = -(0.532 * 0.906 + 0.361 * 0.432) / (1 - 0.532 * 1.907)
    for name in ("plain", "asked"):
        found = system.observe([f"{name}.slow", f"{name}.y"], 0.0, start)
        np.testing.assert_allclose(found, [0.432, right], rtol=1e-12)
    moved = {guess.name: guess.moved for guess in system.initialization_report().guesses}
    assert abs(moved["asked.slow"]) < 1e-12 and abs(moved["der(asked.x)"]) > 1
