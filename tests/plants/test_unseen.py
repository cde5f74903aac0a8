"""A fit under new data, cross-validation and comparison, beside closed forms: x' = −a·x + b."""

import functools
from typing import Any

import numpy as np
import pytest
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, learning
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.learning import Unknown
from jaxonomy_dae.learning.unseen import Unseen

TS = np.linspace(0.1, 2.0, 12)
NOISE = 0.02
TIGHT: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12}


class Falling(Component):
    """x' = −a·x + b."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a, b = self.parameter("a", 1.0), self.parameter("b", 0.0)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -a * x + b))


@functools.cache
def system():
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Falling(ev, "c"))
    return AcausalCompiler(ev, diagram)()


def record(start, seed, **given):
    y = start * np.exp(-1.3 * TS) + NOISE * np.random.default_rng(seed).standard_normal(len(TS))
    return learning.Experiment(TS, {"c.x": y}, **({"sigma": NOISE, "initial": {"c.x": Unknown(1.0)}} | given))


RECORDS = [record(start, k) for k, start in enumerate((1.0, 2.0, 0.5))]


@functools.cache
def problem():
    return learning.Problem(system(), learning.Data(*RECORDS), train=["c.a"], **TIGHT)


@functools.cache
def fit():
    return problem().fit()


def of_start(a, y, rows=slice(None)):
    """The start of least squares for a given rate, its variance, and its derivative by the rate."""
    t = TS[rows]
    e, de = np.exp(-a * t), -t * np.exp(-a * t)
    x0 = y[rows] @ e / (e @ e)
    by_a = (y[rows] @ de - 2 * x0 * (e @ de)) / (e @ e)
    return x0, NOISE**2 / (e @ e), by_a


@pytest.mark.slow
@pytest.mark.parametrize("first", [None, 4])
def test_new_data_are_predicted_with_a_start_of_their_own(first):
    """The start is that of least squares with the rate as found; the band holds what it and the rate leave open."""
    new, a = record(1.5, 9), fit().values["c.a"]
    rows = slice(first)
    x0, variance, by_a = of_start(a, new.data["c.x"], rows)
    score = fit().score(new, first=first)
    error = x0 * np.exp(-a * TS) - new.data["c.x"]
    assert score.rms["c.x"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-5)
    assert score.relative == pytest.approx(score.rms["c.x"] / NOISE, rel=1e-9)
    likelihood = -0.5 * np.sum((error / NOISE) ** 2) - len(TS) * np.log(NOISE * np.sqrt(2 * np.pi))
    assert score.log_likelihood == pytest.approx(likelihood, rel=1e-6)

    ts = np.array([0.5, 3.0])
    found = fit().predict("c.x", ts, new, first=first)
    np.testing.assert_allclose(found.mean["c.x"], x0 * np.exp(-a * ts), rtol=1e-6)
    spread_a = fit().spread[0]  # in units of the 1.0 that the model declares
    # by Gauss and Newton: residuals' part in the start's derivative is left out
    e, de = np.exp(-a * TS[rows]), -TS[rows] * np.exp(-a * TS[rows])
    moved = -x0 * (e @ de) / (e @ e)
    slope = moved * np.exp(-a * ts) - ts * x0 * np.exp(-a * ts)
    expected = np.sqrt((slope * spread_a) ** 2 + variance * np.exp(-2 * a * ts))
    np.testing.assert_allclose(found.spread["c.x"], expected, rtol=1e-3)


@pytest.mark.slow
def test_a_known_start_is_taken():
    a = fit().values["c.a"]
    new = record(1.5, 9, initial={"c.x": 1.5}, sigma="estimate")
    other = fit().score(new)
    error = 1.5 * np.exp(-a * TS) - new.data["c.x"]
    assert other.rms["c.x"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    assert "Score(" in repr(other) and "c.x" in repr(other)


def test_what_cannot_be_asked_is_refused():
    with pytest.raises(ModelError, match="new data are an Experiment; got a dict"):
        Unseen.of(fit(), {"c.x": TS}, None)
    with pytest.raises(ModelError, match="first, the number of rows, is a whole number"):
        fit().score(RECORDS[0], first=0)
    with pytest.raises(ModelError, match="first= goes with a new experiment"):
        fit().predict("c.x", first=3)


@pytest.mark.slow
def test_cross_validation_leaves_each_out_once():
    """Each rate is that of a problem without the experiment; scores are those of new data."""
    found = learning.cross_validate(problem())
    assert found.folds == (("experiment 0",), ("experiment 1",), ("experiment 2",))
    without = learning.Problem(system(), learning.Data(RECORDS[0], RECORDS[2]), train=["c.a"], **TIGHT).fit()
    assert found.fits[1].values["c.a"] == pytest.approx(without.values["c.a"], rel=1e-7)
    score = without.score(RECORDS[1])
    assert found.scores["experiment 1"].rms["c.x"] == pytest.approx(score.rms["c.x"], rel=1e-6)
    squares = [one.rms["c.x"] ** 2 for one in found.scores.values()]
    assert found.rms["c.x"] == pytest.approx(np.sqrt(np.mean(squares)))
    assert "3 folds" in repr(found)
    assert found.fits[1].holdout_score == pytest.approx(score.relative, rel=1e-6)


def test_folds_that_do_not_do():
    with pytest.raises(ModelError, match="two experiments or more"):
        learning.cross_validate(learning.Problem(system(), RECORDS[0], train=["c.a"]))
    for folds, text in ((4, "too few for 4 folds"), ([["experiment 7"]], "no experiment 'experiment 7'"),
                        ([problem().data.labels], "leaves none"), (1, "whole number ≥ 2")):  # fmt: skip
        with pytest.raises(ModelError, match=text):
            learning.cross_validate(problem(), folds)


@pytest.mark.long("residuals and their Jacobian, with two parameters")
def test_models_are_compared_by_what_their_numbers_are_worth():
    """A parameter that is not needed costs ln n, less what it gains."""
    wide = learning.Problem(system(), learning.Data(*RECORDS), train=["c.a", "c.b"], **TIGHT).fit()
    table = learning.compare({"falling": fit(), "with a source": wide})
    gained = fit().chi2 - wide.chi2
    assert table["with a source"].bic - table["falling"].bic == pytest.approx(np.log(36) - gained, rel=1e-5)
    assert table["falling"].effective == pytest.approx(4.0, rel=1e-6)
    assert table.best == ("falling" if gained < np.log(36) else "with a source")
    assert table[table.best].behind == 0.0 and "BIC" in repr(table) and np.isnan(table["falling"].held_out)
    other = learning.Problem(system(), learning.Data(*RECORDS[:2]), train=["c.a"], **TIGHT).fit()
    with pytest.raises(ModelError, match="'fewer' was fitted to other data than 'falling'"):
        learning.compare({"falling": fit(), "fewer": other})
