"""How often `ok` is said of right models and of slightly wrong ones: an oscillator, with the truth by SciPy."""

import functools

import numpy as np
import pytest
import scipy.integrate
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der, learning

TS, NOISE = np.linspace(0.05, 10, 200), np.array([[0.01], [0.02]])


class Oscillator(Component):
    """x'' = −k x − d x'."""

    def __init__(self, ev):
        super().__init__(ev, "c")
        x, v = self.variable("x", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        k, d = self.parameter("k", 4.0), self.parameter("d", 0.2)
        self.add_equations(Eq(der(x), v), Eq(der(v), -k * x - d * v))


@functools.cache
def truth(cubic=0.0):
    """x and v of an oscillator whose spring hardens."""

    def field(t, s):
        return [s[1], -4 * s[0] - cubic * s[0] ** 3 - 0.2 * s[1]]

    return scipy.integrate.solve_ivp(field, (0, 10), [1, 0], t_eval=TS, rtol=1e-10, atol=1e-12).y


@pytest.mark.slow
def test_small_errors_of_a_model_are_noticed_and_right_models_are_not_doubted():
    """What a wrong spring leaves of 0.3 σ, or a slow input of 0.3 σ, passed in three of four fits, and a mode of half
    the noise in two of five."""
    system, problem = compiled(Oscillator(EqnEnv())), None

    def share(records, count):
        nonlocal problem
        said = 0
        for seed in range(count):
            x, v = records + NOISE * np.random.default_rng([1, seed]).standard_normal((2, 200))
            data = learning.Experiment(TS, {"c.x": x, "c.v": v}, sigma={"c.x": 0.01, "c.v": 0.02})
            problem = problem or learning.Problem(system, data, train=["c.k", "c.d"])
            said += problem.fit(data, warn=False).ok
        return said / count

    assert share(truth(), 100) >= 0.95
    assert share(truth(0.072), 20) < 0.3  # k and d fitted, 0.3 σ are left
    assert share(truth() + 0.42 * NOISE * np.sin(0.9 * TS + 1), 20) < 0.25
    assert share(truth() + 0.5 * NOISE * np.sin(13.3 * TS + 1), 20) < 0.25
