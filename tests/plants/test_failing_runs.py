"""Runs that cannot succeed say why: the input, the equation, the jump, the escape, the stiffness; and what to write."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, ModelError, SimulationError, der, simulate, smooth
from jaxonomy_dae.solvers import BDF, Rodas5P, Tsit5


class Law(Component):
    """x' = f(x, u, t) from x0, with an input u."""

    def __init__(self, ev, name, rate, x0=1.0):
        super().__init__(ev, name)
        x, u = self.variable("x", start=x0, fixed=True), self.input("u", default=0.0)
        self.add_equations(Eq(der(x), rate(x, u, ev.t)))


def law(rate, x0=1.0):
    return compiled(Law(EqnEnv(), "c", rate, x0))


def failure(system, end=2.0, **options):
    with pytest.raises(SimulationError) as caught:
        simulate(system, end, ts=np.array([end]), max_steps=options.pop("max_steps", 400), **options)
    return str(caught.value)


def stopped_at(message):
    return float(message.split("stopped at t=")[1].split(":")[0])


class Step(eqx.Module):
    """u(t) = 1 until a time, another value from there."""

    time: jax.Array
    value: jax.Array

    def __call__(self, t):
        return jnp.where(t > self.time, self.value, 1.0)


def step(time, value):
    return {"c.u": Step(jnp.asarray(time), jnp.asarray(value))}


class Driven(Component):
    """x' = a·(u − x) + b·(1 + x²) from 1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, u = self.variable("x", start=1.0, fixed=True), self.input("u", default=0.0)
        a, b = self.parameter("a", 1.0), self.parameter("b", 0.0)
        self.add_equations(Eq(der(x), a * (u - x) + b * (1 + x**2)))


@pytest.fixture(scope="module")
def driven():
    return compiled(Driven(EqnEnv(), "c"))


@pytest.mark.parametrize("value, place", [(np.nan, 0.5), (np.inf, 1.0)])
def test_an_input_that_is_not_finite(driven, value, place):
    message = failure(driven, inputs=step(place, value))
    assert f"input 'c.u' is {value}" in message and "divi" not in message
    assert abs(stopped_at(message) - place) < 0.05
    assert abs(float(message.split(" at t=")[2].split(". ")[0]) - place) < 0.05


@pytest.mark.slow
def test_an_input_with_a_pole(driven):
    message = failure(driven, inputs={"c.u": lambda t: 1 / jnp.maximum(1.0 - t, 0.0)})
    assert "input 'c.u' is " in message and "divi" not in message
    assert abs(stopped_at(message) - 1) < 0.05
    assert abs(float(message.split(" at t=")[2].split(". ")[0]) - 1) < 0.05


def test_a_finite_escape(driven):
    """x' = 1 + x² from 1: x = tan(t + π/4), infinite at π/4."""
    message = failure(driven.with_parameters({"c.a": 0.0, "c.b": 1.0}), inputs=step(9.0, 1.0))
    assert "'c.x' is" in message and "no step was short enough" in message
    assert abs(float(message.split("becomes infinite near t=")[1].split(",")[0]) - np.pi / 4) < 5e-6


def test_a_constant_input_that_is_not_finite(driven):
    with pytest.raises(ModelError, match=r"input 'c\.u' must be finite; got nan"):
        simulate(driven, 2.0, inputs={"c.u": np.nan})


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Rodas5P()])
def test_a_root_that_leaves_its_domain(solver):
    """x' = −1 − √x from 1: x = 0 at t = ∫₀¹ dx/(1 + √x) = 2 − 2·log 2."""
    message = failure(law(lambda x, u, t: -1 - sympy.sqrt(x)), solver=solver)
    assert "'sqrt(c.x)' leaves its domain in c: 0 = der(x) + sqrt(x) + 1" in message
    assert abs(stopped_at(message) - (2 - 2 * np.log(2))) < 1e-3


@pytest.mark.slow
def test_a_jump_at_which_the_solution_stays():
    """x' = −1 above 0, 2 below, and no event: from t = 1 on the solution stays at 0, where no slope leads anywhere."""
    message = failure(law(lambda x, u, t: smooth(sympy.Piecewise((-1, x > 0), (2, True)))))
    assert "The derivative of 'c.x' jumps by 3 there" in message and "chatter" in message
    assert abs(stopped_at(message) - 1) < 0.05


@pytest.mark.slow
def test_a_stiff_model_with_an_explicit_solver():
    system = law(lambda x, u, t: -1e5 * (x - sympy.cos(t)))
    for solver in (Tsit5(), diffrax.Dopri5()):
        message = failure(system, solver=solver)
        assert "the system is stiff" in message.lower()
        assert "solver=jaxonomy_dae.solvers.Rodas5P()" in message


@pytest.mark.slow
def test_too_few_steps_for_a_smooth_solution():
    """Nothing is wrong but the number."""
    for solver in (None, BDF()):
        message = failure(law(lambda x, u, t: 50 * sympy.cos(50 * t), 0.0), solver=solver, max_steps=20)
        assert "max_steps=20 was reached. Changing fastest there: 'c.x'" in message and "Raise max_steps" in message
        for word in ("stiff", "jumps by", "infinite", "not finite"):
            assert word not in message
