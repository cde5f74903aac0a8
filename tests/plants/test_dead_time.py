"""Dead times of inputs and of sensors, by closed forms: x' = −k x + u(t − τ), which y = x(t − σ) shows."""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component
from sympy import Eq

from jaxonomy_dae import der, learning
from jaxonomy_dae.base.errors import by_name
from jaxonomy_dae.errors import ModelError

K, TAU, SIGMA = 1.3, 0.37, 0.23
AT, HEIGHTS = np.array([0.0, 1.0, 2.6, 4.1]), np.array([0.5, 1.5, -0.7, 1.1])
TS = np.linspace(0.11, 6.0, 60)


def lagging(self, ev):
    x, k, u = self.variable("x", start=0.2, fixed=True), self.parameter("k", K), self.input("u", default=0.0)
    self.add_equations(Eq(der(x), -k * x + u))


@functools.cache
def system():
    return compiled(component(lagging))


def shown(kind: str, tau=TAU, sigma=SIGMA):
    """(y, ∂y/∂τ, ∂y/∂σ) at the samples: what steps, or ramps, of the input that begin at s add is w(t − s)."""
    t = np.maximum(TS - sigma, 0.0)
    y, by_tau, slope = 0.2 * np.exp(-K * t), 0 * t, -0.2 * K * np.exp(-K * t)
    y, slope = y + HEIGHTS[0] * (1 - np.exp(-K * t)) / K, slope + HEIGHTS[0] * np.exp(-K * t)
    if kind == "held":
        parts = [
            (s, d, lambda r: (1 - np.exp(-K * r)) / K, lambda r: np.exp(-K * r))
            for s, d in zip(AT[1:], np.diff(HEIGHTS), strict=True)
        ]
    else:
        rates = np.append(np.diff(HEIGHTS) / np.diff(AT), 0.0)
        parts = [
            (s, d, lambda r: r / K - (1 - np.exp(-K * r)) / K**2, lambda r: (1 - np.exp(-K * r)) / K)
            for s, d in zip(AT, np.diff(rates, prepend=0.0), strict=True)
        ]
    for s, d, w, rate in parts:
        r = np.maximum(t - s - tau, 0.0)
        y, slope, by_tau = y + d * w(r), slope + d * rate(r) * (r > 0), by_tau - d * rate(r) * (r > 0)
    return y, by_tau, np.where(TS > sigma, -slope, 0.0)


def posed(kind, y, delay: Any, train: Any = ("c.k",), **given):
    inputs = {"c.u": (np.append(AT, 7.0), np.append(HEIGHTS, HEIGHTS[-1]), kind)}
    data = learning.Experiment(TS, {"c.x": y}, sigma=0.01, inputs=inputs)
    return learning.Problem(system(), data, train=list(train), delay=delay, **given)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["held", "linear"])
def test_derivatives_by_dead_times_are_those_of_closed_forms(kind):
    problem = posed(kind, np.zeros(60), {"c.u": TAU, "c.x": SIGMA}, rtol=1e-10, atol=1e-12)

    def outputs(delays, adjoint):
        delay = {"c.u": delays[0], "c.x": delays[1]}
        return 0.01 * problem.residuals(delay=delay, adjoint=adjoint)["experiment 0"]["c.x"]

    at = jnp.array([TAU, SIGMA])
    forwards = jax.jit(jax.jacfwd(lambda d: outputs(d, diffrax.ForwardMode())))(at)
    y, by_tau, by_sigma = shown(kind)
    np.testing.assert_allclose(outputs(at, None), y, atol=1e-8)
    np.testing.assert_allclose(forwards, np.stack([by_tau, by_sigma], axis=1), atol=1e-6)
    backwards = jax.jit(jax.grad(lambda d: jnp.sum(outputs(d, None) ** 2)))(at)
    np.testing.assert_allclose(backwards, 2 * y @ np.asarray(forwards), rtol=1e-6)


@pytest.mark.slow
def test_dead_times_are_estimated():
    """The interval holds the truth, of an input that starts late and of a sensor; a wrong one is no `ok`."""
    rng = np.random.default_rng(0)
    y = shown("held", sigma=0.0)[0] + 0.01 * rng.standard_normal(60)
    fit = posed("held", y, {"c.u": learning.Unknown(0.1)}).fit(warn=False)
    row = fit.table()["delay of c.u"]
    assert fit.ok and row.low < TAU < row.high and row.high - row.low < 0.05
    assert not posed("held", y, {"c.u": 0.1}).fit(warn=False).ok
    y = shown("linear", tau=0.0)[0] + 0.01 * rng.standard_normal(60)
    fit = posed("linear", y, {"c.x": learning.Unknown(0.1)}).fit(warn=False)
    row = fit.table()["delay of c.x"]
    assert fit.ok and row.low < SIGMA < row.high
    np.testing.assert_allclose(fit.predict("c.x").mean["c.x"], y, atol=0.04)


def test_dead_times_that_cannot_be():
    for delay, text in [
        ({"c.u": 7.0}, r"delay of 'c.u' is 7 s, and experiment 0 lasts 6 s"),
        ({"c.u": -0.1}, r"delay of 'c.u' is a time ≥ 0 in seconds, or Unknown\(guess\); got -0.1"),
        ({"c.w": 0.1}, r"delay: 'c.w' is neither an input of the experiments nor measured"),
    ]:
        with pytest.raises(ModelError, match=text):
            posed("held", np.zeros(60), delay)
    with pytest.raises(ModelError, match=r"delay= goes with runs, not with method=Shooting"):
        posed("held", np.zeros(60), {"c.u": 0.1}, method=learning.Shooting())


def test_keywords_that_others_hand_on_are_checked_where_they_are_written():
    """`cross_validate` spoke for `Problem.fit`, and of names that it gives itself."""
    problem = posed("held", np.zeros(60), {"c.u": 0.1})
    for call, text in [
        (
            lambda: learning.cross_validate(problem, fold=2),
            "cross_validate: there is no argument 'fold': did you mean 'folds'",
        ),
        (lambda: learning.ensemble(problem, step=2), "ensemble: there is no argument 'step': did you mean 'steps'"),
        (lambda: problem.residuals(delays={}), "residuals: there is no argument 'delays': did you mean 'delay'"),
        (lambda: posed("held", np.zeros(60), {}, max_step=1), "did you mean 'max_steps' or 'max_events'"),
    ]:
        with pytest.raises(ModelError, match=text):
            call()


def test_what_is_by_name_and_what_is_not():
    """A list in place of a dictionary, and a keyword of `Data`, were raw TypeErrors."""
    with pytest.raises(ModelError, match=r"delay is a dictionary by names, delay=\{'m.u': 0.1\}; got \[0.1\]"):
        by_name("delay", [0.1], "'m.u': 0.1")
    assert by_name("delay", None, "") == {} and by_name("delay", {"m.u": 1.0}, "") == {"m.u": 1.0}
    with pytest.raises(ModelError, match=r"Data: there is no argument 'experiments': write Data\(first, second\)"):
        learning.Data(experiments=[])  # pyright: ignore[reportCallIssue]
    with pytest.raises(ModelError, match="Data: there is no argument 'name': it takes none by name"):
        learning.Data(name="a")  # pyright: ignore[reportCallIssue]


@pytest.mark.slow
def test_a_dead_time_of_zero_is_no_fault():
    """Half of such records end at the bound, which was a reason against the fit."""
    ends = 0
    for seed in range(6):
        y = shown("linear", tau=0.0, sigma=0.0)[0] + 0.01 * np.random.default_rng(seed).standard_normal(60)
        fit = posed("linear", y, {"c.u": learning.Unknown(0.1)}).fit(warn=False)
        row = fit.table()["delay of c.u"]
        ends += row.value == 0
        assert fit.ok and row.low == 0 and 0 < row.high < 0.05
    assert ends
