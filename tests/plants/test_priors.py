"""Priors of parameters beside SciPy's least squares with the same rows: of runs, of multiple shooting, of a filter."""

import functools

import numpy as np
import pytest
import scipy.optimize
from sympy import Eq

from jaxonomy_dae import POSITIVE, AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, learning
from jaxonomy_dae.errors import ModelError

TIGHT = {"rtol": 1e-10, "atol": 1e-12}
TS = np.linspace(0.1, 2.0, 12)


class Driven(Component):
    """x' = −a·x + b + 0·k, with a > 0 and any b; nothing measured says much of k > 0."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a = self.parameter("a", 1.0, bounds=(0.01, 100.0))
        b, k = self.parameter("b", 0.0), self.parameter("k", 1.0, bounds=POSITIVE)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -a * x + b + 1 / (1 + k)))


@functools.cache
def system():
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Driven(ev, "c"))
    return AcausalCompiler(ev, diagram)()


def law(a, b):
    return np.exp(-a * TS) + b / a * (1 - np.exp(-a * TS))


def record(seed=0, sigma=0.2):
    y = law(1.4, 0.5) + sigma * np.random.default_rng(seed).standard_normal(12)
    return learning.Experiment(TS, {"c.x": y}, sigma=sigma)


def exactly(function, start):
    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return scipy.optimize.least_squares(function, start, method="lm", **options)


PRIORS = {"c.a": learning.LogNormal(2.0, 1.3), "c.b": learning.Normal(0.2, 0.1)}


def rows(q, y, sigma=0.2):
    a, b = np.exp(q[0]), q[1]
    return np.r_[(law(a, b) - y) / sigma, (q[0] - np.log(2.0)) / np.log(1.3), (b - 0.2) / 0.1]


@pytest.mark.long("residuals and their Jacobian")
@pytest.mark.parametrize("method", ["single", pytest.param(learning.Shooting(nodes=3), marks=pytest.mark.slow)])
def test_priors_of_parameters_are_rows_of_least_squares(method):
    """Parameters had no prior but bounds; that of a start moves with nothing, and so does this one."""
    data = record()
    frozen = {"c.k": 1e12}
    problem = learning.Problem(system(), data, train=["c.a", "c.b", "c.k"], priors=PRIORS, method=method, **TIGHT)
    best = exactly(lambda q: rows(q, data.data["c.x"]), [0.3, 0.2])
    for start in ({}, {"c.a": 0.4, "c.b": 1.0}):
        fit = problem.fit(freeze=frozen, start=start, warn=False)
        np.testing.assert_allclose([fit.values["c.a"], fit.values["c.b"]], [np.exp(best.x[0]), best.x[1]], rtol=1e-6)
        covariance = np.linalg.inv(best.jac.T @ best.jac)
        np.testing.assert_allclose(fit.spread[:2] * [1, 0.1], np.sqrt(np.diag(covariance)), rtol=1e-4)
    assert fit.problem.priors == PRIORS and fit.table()["c.a"].low > 0


@pytest.mark.slow
def test_priors_count_in_a_filter():
    """With next to no noise in the equations, a filter's estimate is that of runs."""
    data = record()
    problem = learning.Problem(
        system(), data, train=["c.a", "c.b", "c.k"], priors=PRIORS, method=learning.Filter(noise={"c.x": 1e-6})
    )
    fit = problem.fit(freeze={"c.k": 1e12}, warn=False)
    best = exactly(lambda q: rows(q, data.data["c.x"]), [0.3, 0.2])
    np.testing.assert_allclose([fit.values["c.a"], fit.values["c.b"]], [np.exp(best.x[0]), best.x[1]], rtol=1e-3)


@pytest.mark.long("residuals and their Jacobian")
def test_what_the_prior_alone_says_is_told_and_what_runs_away_is_kept():
    """A parameter of which the data want ever more ended at 5e108, in the system that the fit returns."""
    data = learning.Experiment(TS, {"c.x": law(1.4, -0.1)}, sigma=1e-3)
    train, fixed = ["c.a", "c.b", "c.k"], {"c.b": 0.0}
    fit = learning.Problem(system(), data, train=train, **TIGHT).fit(freeze=fixed, warn=False)
    assert fit.values["c.k"] <= 1.001e9 and fit.table()["c.k"].note == "ran away"
    assert np.isinf(fit.table()["c.k"].high) and not fit.ok
    assert any("nothing in the data keeps 'c.k' from running away" in reason for reason in fit.reasons)
    coarse = learning.Experiment(TS, {"c.x": law(1.4, 0.5)}, sigma=300.0)
    prior = {"c.k": learning.LogNormal(1.0, 30.0)}
    fit = learning.Problem(system(), coarse, train=train, priors=prior, **TIGHT).fit(freeze=["c.a", "c.b"], warn=False)
    assert fit.table()["c.k"].note == "by its prior" and abs(fit.values["c.k"] - 1) < 0.01
    fit = learning.Problem(system(), data, train=train, priors={"c.k": (0.5, 8.0)}, **TIGHT).fit(
        freeze=fixed, warn=False
    )
    assert fit.values["c.k"] == pytest.approx(8.0, rel=1e-12) and fit.table()["c.k"].note == "bound reached: 8"


def test_priors_that_do_not_fit():
    cases = [
        ({"c.z": learning.Normal(0.0, 1.0)}, "priors: 'c.z' is not a parameter that is estimated"),
        ({"c.b": learning.Normal(0.0, 1.0)}, "priors: 'c.b' is not a parameter that is estimated"),
        ({"c.a": learning.Normal(-1.0, 1.0)}, r"the centre of 'c.a' must lie in \[0.01, 100\], as declared; got -1"),
        ({"c.a": (0.001, 1.0)}, r"the range of 'c.a' must lie in \[0.01, 100\]"),
        ({"c.a": (1.0, 0.5)}, "the range of 'c.a'"),
        ({"c.a": 3.0}, r"'c.a' takes learning.Normal\(mean, spread\)"),
    ]
    for priors, text in cases:
        with pytest.raises(ModelError, match=text):
            learning.Problem(system(), record(), train=["c.a"], priors=priors)
    with pytest.raises(ModelError, match="spread is a standard deviation > 0"):
        learning.Normal(0.0, 0.0)
    with pytest.raises(ModelError, match="factor is a number > 1"):
        learning.LogNormal(1.0, 1.0)
    own = learning.Experiment(TS, {"c.x": law(1.4, 0.5)}, initial={"c.a": learning.Unknown(1.0, spread=0.1)})
    with pytest.raises(ModelError, match="'c.a, experiment 0' has a spread already, by Unknown"):
        learning.Problem(system(), own, train=["c.b"], priors={"c.a": learning.LogNormal(1.0, 2.0)}).fit()
