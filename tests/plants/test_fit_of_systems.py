"""Training of systems: parameters, networks and bounds."""

import math

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import compiled, rc_circuit, rc_voltage
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, Interval, der, simulate
from jaxonomy_dae.learning import fit, fit_least_squares

TS = jnp.array([0.5, 1.0, 2.0])
SMALL = diffrax.Tsit5()  # its programs are small


def test_training_a_systems_parameters():
    system, traces = rc_circuit(), []

    def loss(system):
        traces.append(1)
        return jnp.mean((simulate(system, 2.0, ts=TS, solver=SMALL, throw=False)["c.v"] - rc_voltage(TS, R=1.0)) ** 2)

    result = fit(system, loss, optax.adam(0.1), 60, train=["r.R"], progress=False)
    assert float(result.model.parameters["r.R"]) == pytest.approx(1.0, abs=0.05)  # Adam's last steps of 0.1·ratio
    assert float(result.model.parameters["c.C"]) == 0.5
    assert jax.tree.structure(result.model) == jax.tree.structure(system)  # nothing is left set apart
    assert result.best_loss < 1e-3 * result.history[0] and len(traces) == 1


class Decay(Component):
    """dx/dt = −network(x)."""

    def __init__(self, ev, name, network):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        (law,) = self.learned("law", network, inputs=[x])
        self.add_equations(Eq(der(x), -law))


class Power(eqx.Module):
    """u ↦ k·u^n."""

    k: jax.Array
    n: jax.Array

    def __call__(self, u):
        return self.k * u**self.n


def test_by_default_a_systems_networks_are_trained():
    system = compiled(Decay(EqnEnv(), "c", Power(jnp.array(0.8), jnp.array(1.0))))

    def loss(system):
        return jnp.sum(system.vector_field(0.0, jnp.array([0.5])) ** 2)

    result = fit(system, loss, optax.sgd(0.1), 2, progress=False)
    assert float(result.model.neural["c.law"].k) != 0.8
    assert result.history[-1] < result.history[0]


class Forgotten(Component):
    """der(x) = −k·x with the number in the place of the parameter."""

    def __init__(self, ev, name, k=2.0):
        super().__init__(ev, name)
        self.parameter("k", k)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * x))


@pytest.mark.parametrize("how", ["gradient", "least squares"])
def test_training_what_nothing_reads_warns(how):
    system = compiled(Forgotten(EqnEnv(), "c"))

    def residual(system):
        return system.vector_field(0.0, jnp.array([1.0])) + 1.0

    with pytest.warns(RuntimeWarning, match=r"nothing in the model reads 'c\.k'.*instead of what self\.parameter"):
        if how == "gradient":
            fit(system, lambda s: jnp.sum(residual(s) ** 2), optax.sgd(0.1), 1, train=["c.k"], progress=False)
        else:
            fit_least_squares(system, residual, train=["c.k"])


# --- least squares ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_least_squares_recovers_parameters():
    """By forward mode, which it chooses itself."""
    system = rc_circuit(R=3.0, C=0.5)
    data = jnp.asarray(rc_voltage(TS, R=1.2, v0=0.4))

    def residuals(system, data):
        return simulate(system, 2.0, ts=TS, solver=SMALL, rtol=1e-9, atol=1e-11, throw=False)["c.v"] - data

    result = fit_least_squares(system, residuals, train=["r.R", "c.initial_voltage"], args=(data,))
    # The data are exact, so the fit is as good as the solves: 1e-9 and some.
    assert float(result.model.parameters["r.R"]) == pytest.approx(1.2, rel=1e-6)
    assert float(result.model.parameters["c.initial_voltage"]) == pytest.approx(0.4, rel=1e-6)
    assert float(result.model.parameters["c.C"]) == 0.5
    assert result.history[0] > 1e-2 and result.best_loss == result.history[-1] < 1e-12
    assert jax.tree.structure(result.model) == jax.tree.structure(system)


@pytest.mark.slow
def test_least_squares_recovers_a_law():
    """dx/dt = −k·xⁿ, from x(0) = 1: x = (1 + (n − 1)·k·t)^(1/(1 − n))."""
    system = compiled(Decay(EqnEnv(), "c", Power(jnp.array(0.3), jnp.array(1.2))))
    k, n = 0.9, 2.5
    data = (1 + (n - 1) * k * np.asarray(TS)) ** (1 / (1 - n))

    def residuals(system, data):
        return simulate(system, 2.0, ts=TS, rtol=1e-9, atol=1e-11, adjoint=diffrax.ForwardMode())["c.x"] - data

    law = fit_least_squares(system, residuals, args=(jnp.asarray(data),)).model.neural["c.law"]
    np.testing.assert_allclose([law.k, law.n], [k, n], rtol=1e-6)  # as above


# --- bounds ------------------------------------------------------------------------------------------------------


class Line(Component):
    """der(x) = −k: what is observed is the parameter itself."""

    def __init__(self, ev, name, k, bounds):
        super().__init__(ev, name)
        rate = self.parameter("k", k, bounds=bounds)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -rate))


def rate(system):
    return -system.observe("der(c.x)", 0.0, jnp.ones(1))


# (bounds, start, target, nearest admissible value)
BOUNDED = [
    ((0.0, 2.0), 1.0, 0.7, 0.7),
    ((0.0, 2.0), 1.0, 3.0, 2.0),
    ((0.0, 2.0), 2.0, 0.5, 0.5),
    ((0.0, math.inf), 1.0, -0.5, 0.0),
    ((0.0, math.inf), 0.0, 0.5, 0.5),
    ((-math.inf, 3.0), 1.0, 4.0, 3.0),
    ((-math.inf, math.inf), 1.0, -4.0, -4.0),
    (Interval(0.0, math.inf, open_low=True), 1.0, 5.0, 5.0),
    (Interval(-math.inf, 0.0, open_high=True), -2.0, -1e-3, -1e-3),
    (Interval(0.0, 2.0, open_low=True, open_high=True), 1.0, 1.9, 1.9),
]


OFTEN = (1, 3, 8, 9)  # a row of each kind of interval


@pytest.mark.parametrize(
    "bounds, start, target, expected",
    [pytest.param(*row, marks=() if k in OFTEN else pytest.mark.slow) for k, row in enumerate(BOUNDED)],
)
def test_least_squares_end_inside_bounds(bounds, start, target, expected):
    system = compiled(Line(EqnEnv(), "c", start, bounds))
    result = fit_least_squares(system, lambda s: jnp.stack([rate(s) - target, rate(s) - target]), train="c.k")
    assert float(result.model.parameters["c.k"]) == pytest.approx(expected, abs=1e-6)
    result.model.with_parameters({"c.k": result.model.parameters["c.k"]})  # raises outside the bounds


def test_gradient_steps_end_inside_bounds():
    """All at once: the squares of the parameters' distances from their targets know nothing of each other."""
    ev = EqnEnv()
    system = compiled(*(Line(ev, f"c{k}", start, bounds) for k, (bounds, start, *_) in enumerate(BOUNDED)))
    names, slopes = [f"c{k}.k" for k in range(len(BOUNDED))], [f"der(c{k}.x)" for k in range(len(BOUNDED))]
    targets, expected = (np.array([row[k] for row in BOUNDED]) for k in (2, 3))

    def loss(system):
        found = -jnp.stack(system.observe(slopes, 0.0, jnp.ones(len(system.states))))
        return jnp.sum((found - targets) ** 2)

    # A step of half the gradient of (k − target)² is the whole way; 1.5 times as much overshoots.
    model = fit(system, loss, optax.sgd(0.75), 30, train=names, progress=False).model
    found = {name: float(model.parameters[name]) for name in names}
    np.testing.assert_allclose([*found.values()], expected, rtol=0, atol=1e-6)
    model.with_parameters(found)  # raises outside the bounds


def test_an_open_end_is_approached_and_never_reached():
    system = compiled(Line(EqnEnv(), "c", 1.0, Interval(0.0, math.inf, open_low=True)))
    steps = fit(system, lambda s: (rate(s) + 1) ** 2, optax.sgd(0.5), 5, train="c.k", progress=False)
    # Each step would go to −1, and goes nine tenths of the way to 0.
    assert float(steps.model.parameters["c.k"]) == pytest.approx(1e-5, rel=1e-9)
    squares = fit_least_squares(system, lambda s: jnp.stack([rate(s) + 1]), train="c.k")
    assert 0 < float(squares.model.parameters["c.k"]) < 0.2
