"""Parameters and networks of systems under losses of one's own, and bounds, there and in fits to records."""

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
from jaxonomy_dae.learning import Experiment, Problem, minimize

TS = jnp.array([0.5, 1.0, 2.0])
SMALL = diffrax.Tsit5()  # its programs are small


@pytest.mark.long("the gradient of a run")
def test_training_a_systems_parameters():
    system, traces = rc_circuit(), []

    def loss(system):
        traces.append(1)
        return jnp.mean((simulate(system, 2.0, ts=TS, solver=SMALL, throw=False)["c.v"] - rc_voltage(TS, R=1.0)) ** 2)

    result = minimize(system, loss, optax.adam(0.1), 60, train=["r.R"], progress=False)
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


class Forgotten(Component):
    """der(x) = −k·x with the number in the place of the parameter."""

    def __init__(self, ev, name, k=2.0):
        super().__init__(ev, name)
        self.parameter("k", k)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * x))


def test_training_what_nothing_reads_warns():
    system = compiled(Forgotten(EqnEnv(), "c"))

    def loss(system):
        return jnp.sum((system.vector_field(0.0, jnp.array([1.0])) + 1.0) ** 2)

    with pytest.warns(RuntimeWarning, match=r"nothing in the model reads 'c\.k'.*instead of what self\.parameter"):
        minimize(system, loss, optax.sgd(0.1), 1, train=["c.k"], progress=False)


def test_by_default_a_systems_networks_are_trained():
    system = compiled(Decay(EqnEnv(), "c", Power(jnp.array(0.8), jnp.array(1.0))))

    def loss(system):
        return jnp.sum(system.vector_field(0.0, jnp.array([0.5])) ** 2)

    result = minimize(system, loss, optax.sgd(0.1), 2, progress=False)
    assert float(result.model.neural["c.law"].k) != 0.8
    assert result.history[-1] < result.history[0]


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


def lines():
    """All of them, as one system, with the names of their parameters."""
    ev = EqnEnv()
    system = compiled(*(Line(ev, f"c{k}", start, bounds) for k, (bounds, start, *_) in enumerate(BOUNDED)))
    return system, [f"c{k}.k" for k in range(len(BOUNDED))]


TARGETS, EXPECTED = (np.array([row[k] for row in BOUNDED]) for k in (2, 3))


@pytest.mark.slow
def test_least_squares_end_inside_bounds():
    """x(1) = 1 − k tells each parameter, and is measured as if the parameter were at its target."""
    system, names = lines()
    record = Experiment([1.0], {f"c{k}.x": [1 - target] for k, target in enumerate(TARGETS)}, sigma=1e-3)
    found = Problem(system, record, train=names).fit()
    values = np.array([found.values[n] for n in names])
    at_end = TARGETS != EXPECTED
    np.testing.assert_array_equal(values[at_end], EXPECTED[at_end])
    # What the bounds leave over is 0.5 to 1, hundreds of deviations. The search ends at a thousandth of that.
    np.testing.assert_allclose(values[~at_end], EXPECTED[~at_end], rtol=0, atol=5e-4)
    found.system.with_parameters({n: found.values[n] for n in names})  # raises outside the bounds
    table = found.table()
    assert ["bound reached" in table[name].note for name in names] == at_end.tolist()


@pytest.mark.slow
def test_gradient_steps_end_inside_bounds():
    """All at once: the squares of the parameters' distances from their targets know nothing of each other."""
    system, names = lines()
    slopes = [f"der(c{k}.x)" for k in range(len(BOUNDED))]

    def loss(system):
        found = -jnp.stack(system.observe(slopes, 0.0, jnp.ones(len(system.states))))
        return jnp.sum((found - TARGETS) ** 2)

    # A step of half the gradient of (k − target)² is the whole way; 1.5 times as much overshoots.
    model = minimize(system, loss, optax.sgd(0.75), 30, train=names, progress=False).model
    found = {name: float(model.parameters[name]) for name in names}
    np.testing.assert_allclose([*found.values()], EXPECTED, rtol=0, atol=1e-6)
    model.with_parameters(found)  # raises outside the bounds


def test_an_open_end_is_approached_and_never_reached():
    system = compiled(Line(EqnEnv(), "c", 1.0, Interval(0.0, math.inf, open_low=True)))
    steps = minimize(system, lambda s: (rate(s) + 1) ** 2, optax.sgd(0.5), 5, train="c.k", progress=False)
    # Each step would go to −1, and goes nine tenths of the way to 0.
    assert float(steps.model.parameters["c.k"]) == pytest.approx(1e-5, rel=1e-9)
