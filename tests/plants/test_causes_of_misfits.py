"""What a wrong model lacks is found in its equations: truths by SciPy, each with one term more than the model."""

import functools

import numpy as np
import pytest
import scipy.integrate
from problems import compiled, component
from sympy import Eq

from jaxonomy_dae import der, learning
from jaxonomy_dae.learning.linearized import Linearized

TS = np.linspace(0.1, 20, 200)


def oscillating(self, ev):
    """x'' = −k x − d x' + u."""
    x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
    k, d, u = self.parameter("k", 4.0), self.parameter("d", 0.3), self.input("u", default=0.0)
    self.add_equations(Eq(der(x), v), Eq(der(v), -k * x - d * v + u))


@functools.cache
def system():
    return compiled(component(oscillating))


def power(t):
    return np.sin(0.7 * t) + 0.6 * np.sin(1.9 * t)


def truth(extra=lambda t, x, v: 0.0, late=0.0):
    def field(t, s):
        return [s[1], -4 * s[0] - 0.3 * s[1] + power(t - late) + extra(t, *s)]

    return scipy.integrate.solve_ivp(field, (0, 20), [1, 0], t_eval=TS, rtol=1e-9, atol=1e-11, max_step=0.02).y[0]


def fitted(y, seed=0):
    grid = np.linspace(0, 20, 801)
    y = y + 0.01 * np.random.default_rng(seed).standard_normal(len(TS))
    data = learning.Experiment(TS, {"c.x": y}, sigma=0.01, inputs={"c.u": (grid, power(grid))})
    return learning.Problem(system(), data, train=["c.k", "c.d"]).fit(warn=False, starts=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (lambda t, x, v: -0.05 * np.tanh(v / 1e-3), "der(c.v) lacks a term with the sign of 'c.v'"),
        (lambda t, x, v: -0.3 * v * abs(v), "der(c.v) lacks a term with 'c.v' times its size"),
        (lambda t, x, v: -0.4 * x**3, "der(c.v) lacks a term with the cube of 'c.x'"),
        (lambda t, x, v: 0.3 * (t > 12), "der(c.v) lacks a constant from t ="),
    ],
)
def test_terms_that_equations_lack_are_named(extra, said):
    """They passed for a period, or for a signal of the sensor."""
    (reason,) = [r for r in fitted(truth(extra)).reasons if r.startswith("residuals are not white")]
    assert said in reason.split(":")[1]


@pytest.mark.slow
def test_an_input_that_is_late_is_named():
    (reason,) = [r for r in fitted(truth(late=0.1)).reasons if r.startswith("residuals are not white")]
    assert "input 'c.u' is late" in reason


@pytest.mark.slow
def test_answers_to_small_terms_are_those_of_the_equations():
    """Against runs by SciPy with the term at 1e-4 of its size. Terms are constant between samples: error 1e-3."""
    fit = fitted(truth())
    model = Linearized.of(fit.objective, fit.point)
    assert model is not None and model.driven == [1] and model.reads(1) == [0, 1]
    assert all(name in ("c.x", "c.v") for name in model.states)
    term = np.concatenate([[0.0], TS])[None]
    found = model.answers(1, ((term[:, 1:] + term[:, :-1]) / 2)[..., None])[:, 0]
    k, d = fit.values["c.k"], fit.values["c.d"]
    exact = scipy.integrate.solve_ivp(
        lambda t, s: [s[1], -k * s[0] - d * s[1] + t], (0, 20), [0, 0], t_eval=TS, rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(found, exact.y[0], atol=1e-3 * np.max(exact.y[0]))
