"""Designs beside closed forms: decays, whose information is known, and a ball whose bounces tell of its restitution."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import EqnEnv, ModelError, pre, reinit
from jaxonomy_dae.errors import SimulationError
from jaxonomy_dae.learning import Experiment, Filter, Planned, Problem, Unknown, design_experiment, next_experiment
from jaxonomy_dae.learning.design import informations, known_of
from jaxonomy_dae.write import POSITIVE, Component, Eq, der

pytestmark = pytest.mark.slow  # residuals and their Jacobian compile for ten seconds each

K, A, SIGMA = 0.7, 2.0, 0.01


class Decay(Component):
    """x' = −k·x from x(0) = a."""

    def __init__(self, ev, name="d"):
        super().__init__(ev, name)
        k, a = self.parameter("k", K, bounds=POSITIVE), self.parameter("a", A, bounds=POSITIVE)
        x = self.variable("x", start=a, fixed=True)
        self.add_equations(Eq(der(x), -k * x))


@functools.cache
def system():
    return compiled(Decay(EqnEnv()))


def slopes(t):
    """Of x by ln k and ln a."""
    x = A * np.exp(-K * t)
    return np.stack([-K * t * x, x], axis=-1) / SIGMA


def plan(*times, **others):
    return Planned(list(times), {"d.x": SIGMA}, **others)


def problem(times=(0.4, 2.0), train=("d.k", "d.a"), **others):
    times = np.array(times)
    record = Experiment(times, {"d.x": A * np.exp(-K * times)}, sigma=SIGMA, **others)
    return Problem(system(), record, train=list(train), rtol=1e-9, atol=1e-11)


def expected_gains(known, plans):
    """Of experiments at the times in `plans`, with ½ ln det by NumPy."""

    def worth(m):
        return 0.5 * np.linalg.slogdet(m)[1]

    return np.array([worth(known + slopes(np.array(t)).T @ slopes(np.array(t))) - worth(known) for t in plans])


def test_one_time_constant_is_when_to_look_at_a_decay():
    """The information about k alone is (t·x/σ)², the greatest at t = 1/k."""
    times = np.linspace(0.2, 4.0, 39)
    advice = next_experiment(problem(train=["d.k"]), [plan(t) for t in times], alone=True)
    assert advice.best == int(np.argmin(np.abs(times - 1 / K)))
    np.testing.assert_allclose(advice.gain, 0.5 * np.log1p(slopes(times)[:, 0] ** 2), rtol=1e-6)
    np.testing.assert_allclose(advice.after["d.k"], 1 / np.sqrt(1 + slopes(times)[:, 0] ** 2), rtol=1e-6)
    found = design_experiment(problem(train=["d.k"]), lambda p: plan(p[0]), [0.5], [(0.1, 5.0)], alone=True)
    np.testing.assert_allclose(found.values, [1 / K], rtol=2e-3)


def test_two_times_for_two_parameters():
    """Box & Lucas (1959): with t₁ at the lowest admissible time, det is greatest at t₂ = t₁ + 1/k."""

    def make(p):
        return plan(p[0], p[0] + p[1])

    found = design_experiment(problem(), make, [0.8, 0.8], [(0.05, 2.0), (0.1, 4.0)], alone=True)
    np.testing.assert_allclose(found.values, [0.05, 1 / K], atol=5e-3)
    grid = [(a, a + b) for a in (0.05, 0.5) for b in (0.5, 1 / K, 3.0)]
    assert found.gain >= expected_gains(np.eye(2), grid).max() - 1e-6
    assert found.gain >= found.history[0]


def test_gains_beside_numpy_with_data_at_hand():
    plans = [(0.3,), (1.0, 2.0), (0.1, 1.4, 4.0), (5.0,)]
    advice = next_experiment(problem(), [plan(*t) for t in plans])
    data = slopes(np.array([0.4, 2.0]))
    known = data.T @ data + np.eye(2)
    np.testing.assert_allclose(advice.gain, expected_gains(known, plans), rtol=1e-5)
    assert advice.best == 2 and "* experiment 2" in repr(advice) and "(now)" in repr(advice)
    np.testing.assert_allclose(advice.before["d.a"], np.sqrt(np.linalg.inv(known)[1, 1]), rtol=1e-6)


def test_some_names_alone():
    """Ds-optimality: the spread of the chosen one after the experiment, by NumPy."""
    plans = [(0.01,), (1.0,), (2.5,)]
    data = slopes(np.array([0.4, 2.0]))
    known = data.T @ data + np.eye(2)
    for k, name in enumerate(["d.k", "d.a"]):
        advice = next_experiment(problem(), [plan(*t) for t in plans], names=name)

        def spread(m, k=k):
            return np.sqrt(np.linalg.inv(m)[k, k])

        told = [np.log(spread(known) / spread(known + slopes(np.array(t)).T @ slopes(np.array(t)))) for t in plans]
        np.testing.assert_allclose(advice.gain, told, rtol=1e-4, atol=1e-8)
        assert advice.best == int(np.argmax(told))


def test_several_are_chosen_one_after_the_other():
    plans = [(0.01,), (1.4,), (3.0,)]
    advice = next_experiment(problem(), [plan(*t) for t in plans], count=3, alone=True)
    known, chosen = np.eye(2), []
    for _ in range(3):
        chosen.append(int(np.argmax(expected_gains(known, plans))))
        s = slopes(np.array(plans[chosen[-1]]))
        known = known + s.T @ s
    assert list(advice.chosen) == chosen and "in this order" in repr(advice)


def test_an_unknown_start_has_to_be_determined_too():
    """A decay from an unknown start a·(1 + u), u of unit spread: the Schur complement by NumPy."""
    start = {"d.x": Unknown(A)}
    advice = next_experiment(
        problem(train=["d.k"], initial=start), [plan(0.5, initial=start), plan(0.5, 2.0, initial=start)], alone=True
    )
    for k, times in enumerate([(0.5,), (0.5, 2.0)]):
        s = slopes(np.array(times))
        m = s.T @ s + np.diag([0.0, 1.0])
        left = m[0, 0] - m[0, 1] ** 2 / m[1, 1]
        np.testing.assert_allclose(advice.gain[k], 0.5 * np.log1p(left), rtol=1e-5)


def test_a_start_that_all_share_is_learned_from_any():
    """x(0) = 2·z with z of unit spread, and frozen names tell nothing: the same information as with `a`, by NumPy."""
    shared = {"d.x": Unknown(A, shared=True)}
    p = problem(train=["d.k"], initial=shared)
    gains = [next_experiment(p, [plan(1.0, initial=i)], names=["d.x"]).gain[0] for i in (shared, {"d.x": A})]
    data = slopes(np.array([0.4, 2.0]))
    known = data.T @ data + np.eye(2)
    for k, columns in enumerate(([0, 1], [0])):  # the second starts at a value that is known
        s = slopes(np.array([1.0])) * np.isin([0, 1], columns)
        told = np.log(np.sqrt(np.linalg.inv(known)[1, 1] / np.linalg.inv(known + s.T @ s)[1, 1]))
        np.testing.assert_allclose(gains[k], told, rtol=1e-4)
    with pytest.raises(ModelError, match="candidates share the unknown start of 'd.x'"):
        next_experiment(problem(train=["d.k"]), [plan(1.0, initial=shared)])
    fit = problem(times=(0.2, 0.9, 1.9)).fit(freeze={"d.a": A})
    advice = next_experiment(fit, [plan(1.0)])
    known = np.sum(slopes(np.array([0.2, 0.9, 1.9]))[:, 0] ** 2) + 1
    np.testing.assert_allclose(advice.gain, 0.5 * np.log1p(slopes(1.0)[0] ** 2 / known), rtol=1e-4)
    with pytest.raises(ModelError, match="names: 'd.a' is not estimated"):
        next_experiment(fit, [plan(1.0)], names="d.a")


def test_an_estimate_advises_by_its_own_values():
    fit = problem(times=(0.2, 0.9, 1.9, 3.0)).fit(start={"d.k": 0.5})
    times = np.linspace(0.1, 4.0, 14)
    advice = next_experiment(fit, [plan(t) for t in times])
    data = slopes(np.array([0.2, 0.9, 1.9, 3.0]))
    np.testing.assert_allclose(advice.gain, expected_gains(data.T @ data + np.eye(2), times[:, None]), rtol=1e-4)


class Ball(Component):
    """A ball falls from h and bounces with restitution e."""

    def __init__(self, ev, name="b"):
        super().__init__(ev, name)
        e, h = self.parameter("e", 0.8, bounds=(0.1, 1.0)), self.parameter("h", 1.0, bounds=POSITIVE)
        y = self.variable("y", start=h, fixed=True)
        v = self.variable("v", start=0.0, fixed=True)
        self.add_equations(Eq(der(y), v), Eq(der(v), -9.81))
        self.when(y <= 0, reinit(v, -e * pre(v)), reinit(y, 0))


def test_before_the_first_bounce_nothing_is_told_of_the_restitution():
    """After one bounce at t₁ = √(2h/g), y = e·g·t₁·s − ½g s² with s = t − t₁: its slope by ln e is e·g·t₁·s."""
    ball = compiled(Ball(EqnEnv()))
    first = np.sqrt(2 / 9.81)
    times = np.array([0.2, 0.4, first + 0.1, first + 0.3, first + 0.6])
    record = Experiment([0.1], {"b.y": [1 - 0.5 * 9.81 * 0.01]}, sigma=1e-3)
    p = Problem(ball, record, train=["b.e"], rtol=1e-8, atol=1e-10)
    advice = next_experiment(p, [Planned([t], {"b.y": 1e-3}) for t in times], alone=True)
    slope = np.where(times > first, 0.8 * 9.81 * first * (times - first), 0.0) / 1e-3
    scale = 1.0 if p.nominal()[0].coordinates.log[0] else 0.8 / 0.8
    np.testing.assert_allclose(advice.gain, 0.5 * np.log1p((scale * slope) ** 2), rtol=1e-4, atol=1e-8)
    assert advice.best == 4


def test_bad_candidates():
    p = problem()
    with pytest.raises(ModelError, match="a list of learning.Planned"):
        next_experiment(p, [])
    with pytest.raises(ModelError, match="'d.z', which is not a variable"):
        next_experiment(p, [Planned([1.0], {"d.z": 1.0})])
    with pytest.raises(ModelError, match="needs a standard deviation > 0"):
        Planned([1.0], {"d.x": 0.0})
    with pytest.raises(ModelError, match="names: 'd.q' is not estimated"):
        next_experiment(p, [plan(1.0)], names=["d.q"])
    with pytest.raises(ModelError, match="count is a whole number"):
        next_experiment(p, [plan(1.0)], count=0)
    with pytest.raises(ModelError, match="bounds are finite pairs"):
        design_experiment(p, lambda q: plan(q[0]), [1.0], [(0.0, np.inf)])
    with pytest.raises(ModelError, match="must lie inside the bounds"):
        design_experiment(p, lambda q: plan(q[0]), [9.0], [(0.1, 5.0)])


class Gauge(eqx.Module):
    gain: jax.Array

    def __call__(self, solution):
        return self.gain * solution["d.x"]


def test_what_a_sensor_law_would_show():
    """Twice the signal with twice the noise tells the same."""
    times = np.array([0.4, 2.0])
    record = Experiment(times, {"gauge.y": 2 * A * np.exp(-K * times)}, sigma=2 * SIGMA)
    p = Problem(system(), record, train=["d.k"], observe={"gauge.y": Gauge(jnp.array(2.0))}, rtol=1e-9, atol=1e-11)
    advice = next_experiment(p, [Planned([1.4], {"gauge.y": 2 * SIGMA}), plan(1.4)])
    known = np.sum(slopes(times)[:, 0] ** 2) + 1
    np.testing.assert_allclose(advice.gain, 0.5 * np.log1p(slopes(1.4)[0] ** 2 / known), rtol=1e-5)


def test_candidates_whose_runs_fail_are_said():
    p = Problem(system(), Experiment([1.0], {"d.x": [1.0]}, sigma=SIGMA), train=["d.k"], max_steps=4)
    advice = next_experiment(p, [plan(1e-3), plan(1e3)])
    assert np.isnan(advice.gain[1]) and "its run fails" in repr(advice) and advice.best == 0
    with pytest.raises(SimulationError, match="no candidate can be simulated; the first"):
        next_experiment(p, [plan(1e3)])


def test_gains_are_those_of_random_models():
    """The information by jax.jacfwd of the closed form, for random times and noise levels."""
    rng = np.random.default_rng(0)
    sets = [np.sort(rng.uniform(0.05, 5.0, rng.integers(1, 7))) for _ in range(6)]
    sigma = 10.0 ** rng.uniform(-3, 0, 6)
    plans = [Planned(t, {"d.x": s}) for t, s in zip(sets, sigma, strict=True)]
    advice = next_experiment(problem(), plans, alone=True)
    for k, (t, s) in enumerate(zip(sets, sigma, strict=True)):
        j = np.asarray(jax.jacfwd(lambda z: jnp.exp(z[1] - jnp.exp(z[0]) * t) / s)(jnp.log(jnp.array([K, A]))))  # noqa: B023
        np.testing.assert_allclose(advice.gain[k], 0.5 * np.linalg.slogdet(np.eye(2) + j.T @ j)[1], rtol=1e-5)


def information_of_a_noisy_decay(times, k, a, noise, sigma):
    """Of (ln k, ln noise): the Fisher information of normal samples of x' = −k·x + noise, in closed form."""

    def moments(logs):
        k, noise = np.exp(logs)
        early = np.minimum.outer(times, times)
        covariance = noise**2 * np.exp(-k * np.abs(np.subtract.outer(times, times))) * (1 - np.exp(-2 * k * early))
        return a * np.exp(-k * times), covariance / (2 * k) + sigma**2 * np.eye(len(times))

    logs, h = np.log([k, noise]), 1e-5
    ends = [[moments(logs + s * h * np.eye(2)[j]) for s in (1, -1)] for j in range(2)]
    mean, cov = ([(up[i] - down[i]) / (2 * h) for up, down in ends] for i in (0, 1))
    inverse = np.linalg.inv(moments(logs)[1])
    both = [(i, j) for i in range(2) for j in range(2)]
    parts = [mean[i] @ inverse @ mean[j] + 0.5 * np.trace(inverse @ cov[i] @ inverse @ cov[j]) for i, j in both]
    return np.reshape(parts, (2, 2))


def test_a_filter_is_told_by_samples_through_its_variances_too():
    """Planned experiments of a filter were least squares of runs, without process noise, or crashed."""
    times = np.linspace(0.2, 4.0, 20)
    x = A * np.exp(-K * times) + 0.05 * np.random.default_rng(0).standard_normal(20)
    record = Experiment(times, {"d.x": x})
    fit = Problem(system(), record, train=["d.k"], method=Filter({"d.x": "estimate"})).fit(warn=False)
    known = known_of(fit, None, False)
    plans = [Planned(times, {"d.x": 0.05}) for times in ([0.5, 1.0, 1.5, 4.0], np.linspace(0.1, 2.0, 9))]
    found = informations(known, plans)[1]
    natural = fit.values["d.k"], fit.values["noise of d.x"]
    chosen = [k for k, name in enumerate(fit.objective.coordinates.names) if name in ("d.k", "noise of d.x")]
    for plan, got in zip(plans, found, strict=True):
        expected = information_of_a_noisy_decay(np.asarray(plan.times, float), natural[0], A, natural[1], 0.05)
        np.testing.assert_allclose(got[np.ix_(chosen, chosen)], expected, rtol=1e-5, atol=1e-7 * expected.max())
    assert np.isfinite(next_experiment(fit, plans).gain).all()
