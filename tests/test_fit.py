"""Training: the best iterate is kept, nothing is compiled twice, and what goes wrong is said."""

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

from jaxonomy_dae import Component, EqnEnv, Interval, ModelError, der, simulate
from jaxonomy_dae.learning import fit, fit_least_squares
from jaxonomy_dae.solvers import StoredAdjoint

TS = jnp.array([0.5, 1.0, 2.0])


class Bowl(eqx.Module):
    """A plain Equinox module: a point to be moved to a minimum, and a label that is not an array."""

    x: jax.Array
    y: jax.Array
    label: str = "bowl"


def bowl(x=3.0, y=-2.0):
    return Bowl(jnp.asarray(x), jnp.asarray(y))


def distance(model, target):
    return (model.x - target) ** 2 + 0.5 * model.y**2


# --- fit ---------------------------------------------------------------------------------------------------------


def test_gradient_descent_follows_its_closed_form():
    result = fit(bowl(), distance, optax.sgd(0.1), 4, args=(jnp.array(1.0),), progress=False)
    k = np.arange(5)
    # x − 1 shrinks by 1 − 2·0.1, y by 1 − 0.1 a step.
    np.testing.assert_allclose(result.history, (2.0 * 0.8**k) ** 2 + 0.5 * (2.0 * 0.9**k) ** 2, rtol=1e-12)
    assert (result.best_step, result.best_loss) == (4, result.history[4])
    assert float(result.model.x) == pytest.approx(1 + 2.0 * 0.8**4) and result.model.label == "bowl"
    assert "all 4 steps" in result.message


def test_the_best_iterate_is_kept():
    # The step 1.05 overshoots ever further in x (factor −1.1), from the first step on.
    result = fit(bowl(y=0.0), distance, optax.sgd(1.05), 6, args=(jnp.array(1.0),), progress=False)
    np.testing.assert_allclose(result.history, 4.0 * 1.21 ** np.arange(7), rtol=1e-12)
    assert result.best_step == 0 and float(result.model.x) == 3.0
    # A learning rate that shrinks, then explodes: the best is in the middle.
    rate = optax.piecewise_constant_schedule(0.25, {3: 10.0})
    result = fit(bowl(y=0.0), distance, optax.sgd(rate), 6, args=(jnp.array(1.0),), progress=False)
    assert result.best_step == 3
    assert float(result.model.x) == pytest.approx(1 + 2.0 * 0.5**3)
    assert result.best_loss == min(result.history) < result.history[-1]


def test_compiled_once():
    traces = []

    def loss(model, target):
        traces.append(1)
        return distance(model, target)

    fit(bowl(), loss, optax.adam(0.1), 20, args=(jnp.array(1.0),), progress=False)
    assert len(traces) == 1


def test_zero_steps_evaluate_the_model():
    result = fit(bowl(), distance, optax.adam(0.1), 0, args=(jnp.array(1.0),), progress=False)
    assert list(result.history) == [6.0] and eqx.tree_equal(result.model, bowl())


def test_a_filter_chooses_what_is_trained():
    only_x = eqx.tree_at(lambda m: m.x, jax.tree.map(lambda _: False, bowl()), True)
    result = fit(bowl(), distance, optax.sgd(0.5), 1, train=only_x, args=(jnp.array(1.0),), progress=False)
    assert (float(result.model.x), float(result.model.y)) == (1.0, -2.0)


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_what_is_not_finite_stops_the_run(what):
    def loss(model):
        # log(x): steps of 1/x from 1 go 1, 0, −∞; |x|^0.5: the derivative at 0 is infinite, the value is not.
        return jnp.log(model.x) if what == "loss" else jnp.sqrt(jnp.maximum(model.x, 0.0))

    start, rate = (1.0, 0.5) if what == "loss" else (4.0, 16.0)  # one or two steps to x ≤ 0
    with pytest.warns(RuntimeWarning, match=rf"stopped after \d updates: the {what}.*best iterate.*smaller"):
        result = fit(bowl(start), loss, optax.sgd(rate), 50, progress=False)
    assert len(result.history) < 51 and np.isfinite(result.history).all()
    assert result.best_loss == min(result.history)
    assert np.isfinite(float(loss(result.model))) and "stopped" in result.message


def test_progress_is_shown(capsys):
    fit(bowl(), distance, optax.sgd(0.1), 3, args=(jnp.array(1.0),), progress=True)
    assert "3/3" in capsys.readouterr().err


def test_training_a_systems_parameters():
    system, traces = rc_circuit(), []

    def loss(system):
        traces.append(1)
        return jnp.mean((simulate(system, 2.0, ts=TS)["c.v"] - rc_voltage(TS, R=1.0)) ** 2)

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


# --- least squares -----------------------------------------------------------------------------------------------


def test_least_squares_recovers_parameters():
    system = rc_circuit(R=3.0, C=0.5)
    data = rc_voltage(TS, R=1.2, v0=0.4)

    def residuals(system, data):
        adjoint = diffrax.ForwardMode()
        return simulate(system, 2.0, ts=TS, rtol=1e-9, atol=1e-11, adjoint=adjoint)["c.v"] - data

    result = fit_least_squares(system, residuals, train=["r.R", "c.initial_voltage"], args=(jnp.asarray(data),))
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


def test_least_squares_on_a_plain_module():
    data = jnp.array([1.0, 4.0])
    result = fit_least_squares(bowl(), lambda m, d: jnp.stack([m.x, m.y**2]) - d, args=(data,))
    assert float(result.model.x) == pytest.approx(1.0) and abs(float(result.model.y)) == pytest.approx(2.0)
    assert result.message.startswith("converged")


def test_least_squares_says_that_its_steps_were_used_up():
    result = fit_least_squares(bowl(), lambda m: jnp.stack([m.x - 1, 10 * (m.y - m.x**2)]), steps=2)
    assert "not yet converged" in repr(result)


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


@pytest.mark.parametrize("bounds, start, target, expected", BOUNDED)
def test_fits_end_inside_bounds(bounds, start, target, expected):
    system = compiled(Line(EqnEnv(), "c", start, bounds))
    squares = fit_least_squares(system, lambda s: jnp.stack([rate(s) - target, rate(s) - target]), train="c.k")
    assert float(squares.model.parameters["c.k"]) == pytest.approx(expected, abs=1e-6)
    # A step of half the gradient of (k − target)² is the whole way; 1.5 times as much overshoots.
    steps = fit(system, lambda s: (rate(s) - target) ** 2, optax.sgd(0.75), 30, train="c.k", progress=False)
    assert float(steps.model.parameters["c.k"]) == pytest.approx(expected, abs=1e-6)
    for result in (squares, steps):
        result.model.with_parameters({"c.k": result.model.parameters["c.k"]})  # raises outside the bounds


def test_an_open_end_is_approached_and_never_reached():
    system = compiled(Line(EqnEnv(), "c", 1.0, Interval(0.0, math.inf, open_low=True)))
    steps = fit(system, lambda s: (rate(s) + 1) ** 2, optax.sgd(0.5), 5, train="c.k", progress=False)
    # Each step would go to −1, and goes nine tenths of the way to 0.
    assert float(steps.model.parameters["c.k"]) == pytest.approx(1e-5, rel=1e-9)
    squares = fit_least_squares(system, lambda s: jnp.stack([rate(s) + 1]), train="c.k")
    assert 0 < float(squares.model.parameters["c.k"]) < 0.2


def test_least_squares_chooses_forward_mode():
    system = rc_circuit(R=3.0, C=0.5)
    data = jnp.asarray(rc_voltage(TS, R=1.2))

    def residuals(system, data, **options):
        return simulate(system, 2.0, ts=TS, rtol=1e-8, atol=1e-10, **options)["c.v"] - data

    result = fit_least_squares(system, residuals, train="r.R", args=(data,))
    assert float(result.model.parameters["r.R"]) == pytest.approx(1.2, rel=1e-6)
    with pytest.raises(ModelError, match="cannot be differentiated forwards.*ForwardMode"):
        fit_least_squares(system, lambda s, d: residuals(s, d, adjoint=StoredAdjoint()), train="r.R", args=(data,))


# --- wrong use ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: fit(rc_circuit(), lambda s: 0.0, optax.sgd(1.0), 1, progress=False), r"no networks.*train=\["),
        (
            lambda: fit(rc_circuit(), lambda s: 0.0, optax.sgd(1.0), 1, train=["r.r"], progress=False),
            r"'r\.r' is neither a network nor a parameter: did you mean 'r\.R'",
        ),
        (
            lambda: fit(bowl(), lambda m: jnp.stack([m.x, m.y]), optax.sgd(1.0), 1, progress=False),
            r"scalar; got shape \(2,\)",
        ),
        (lambda: fit(bowl(), lambda m: m.x, optax.sgd(1.0), -1, progress=False), r"updates ≥ 0; got -1"),
        (
            lambda: fit(bowl(x=np.nan), lambda m: m.x, optax.sgd(1.0), 3, progress=False),
            r"the loss is nan at the start: check the data",
        ),
        (lambda: fit(Bowl(1.0, 2.0), lambda m: m.x, optax.sgd(1.0), 1, progress=False), r"nothing is to be trained"),
        (
            lambda: fit(
                bowl(),
                lambda m, d: m.x * d["t"][0],
                optax.sgd(1.0),
                1,
                args=({"t": jnp.array([np.nan])},),
                progress=False,
            ),
            r"the data are not finite: args\[0\]\['t'\]",
        ),
        (
            lambda: fit_least_squares(bowl(x=np.nan), lambda m: jnp.stack([m.x])),
            r"not finite at the start: check the data",
        ),
    ],
)
def test_wrong_use(call, message):
    with pytest.raises(ModelError, match=message):
        call()
