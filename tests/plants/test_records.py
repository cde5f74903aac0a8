"""Fits beside SciPy's: what priors, weights, noise levels and starts of the search are worth, and what must not matter
to them. Models are linear or in closed form.

Shared: `benchmarks.attack.invariance.records` draws records and writes them differently.
"""

import functools

import numpy as np
import optax
import pytest
import scipy.optimize
import scipy.stats
import sympy
from sympy import Eq

from benchmarks.attack.invariance.records import WAYS, begun, written
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, learning
from jaxonomy_dae.errors import ModelError

TIGHT = {"rtol": 1e-10, "atol": 1e-12}
TS = np.linspace(0.1, 2.0, 12)


class Falling(Component):
    """x' = −a·x, z' = x."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        a = self.parameter("a", 1.0)
        x, z = (self.variable(n, start=s, fixed=True) for n, s in (("x", 1.0), ("z", 0.0)))
        self.add_equations(Eq(der(x), -a * x), Eq(der(z), x))


class Turning(Component):
    """x = sin(φ), φ' = ω."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        phi, x = self.variable("phi", start=0.3, fixed=True), self.variable("x")
        self.add_equations(Eq(der(phi), self.parameter("om", 1.0)), Eq(x, sympy.sin(phi)))


@functools.cache
def system(kind):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(kind(ev, "c"))
    return AcausalCompiler(ev, diagram)()


def exactly(function, start):
    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return scipy.optimize.least_squares(function, start, method="lm", **options).x


@pytest.fixture(scope="module")
def with_prior():
    """A problem with a prior that pulls, and SciPy's answer to it."""
    noise = np.random.default_rng(0).standard_normal(12)
    y = 2 * np.exp(-1.3 * TS) + 0.3 * noise
    one = learning.Experiment(TS, {"c.x": y}, sigma=0.3, initial={"c.x": learning.Unknown(1.0, spread=0.1)})
    best = exactly(lambda q: np.r_[(q[1] * np.exp(-q[0] * TS) - y) / 0.3, (q[1] - 1.0) / 0.1], [1.0, 1.0])
    return learning.Problem(system(Falling), one, train=["c.a"], **TIGHT), best


@pytest.mark.long("residuals and their Jacobian of one experiment")
def test_a_prior_stays_where_it_was_put(with_prior):
    """A search that begins elsewhere took the prior with it, so that fits repeated from their own values drifted away;
    and it ended wherever less than a thousandth of the interval was left."""
    problem, best = with_prior
    fit = problem.fit()
    steps = learning.GradientSteps(optax.adam(0.05), steps=20)
    begun = [fit.values, {"c.a": 0.3, "c.x, experiment 0": 1.4}, problem.train(steps), fit.system]
    for other in (fit, *(problem.fit(start=start) for start in begun), problem.fit(first=steps)):
        np.testing.assert_allclose(list(other.values.values()), best, rtol=1e-6)
        np.testing.assert_allclose(other.spread, fit.spread, rtol=1e-5)
    moved = learning.Experiment(TS, problem.data.experiments[0].data, sigma=0.3, initial={
        "c.x": learning.Unknown(2.0, spread=0.1)
    })  # fmt: skip
    assert problem.fit(moved).values["c.x, experiment 0"] > best[1] + 0.1  # other data bring their own prior


def restricted(parts):
    """(a, σ by output) of samples {output: (law, times, values, weight)}: least squares of which each output's noise
    level is that of its residuals, by degrees of freedom."""
    sigma = dict.fromkeys(parts, 1.0)
    for _ in range(200):

        def rows(q, sigma=sigma):
            return np.concatenate([np.sqrt(w) * (f(q[0], t) - y) / sigma[n] for n, (f, t, y, w) in parts.items()])

        (a,) = exactly(rows, [1.0])
        slope = {n: (f(a + 1e-6, t) - f(a - 1e-6, t)) / 2e-6 for n, (f, t, _, _) in parts.items()}
        information = sum(np.sum(w * slope[n] ** 2) / sigma[n] ** 2 for n, (_, _, _, w) in parts.items())
        sigma = {
            n: np.sqrt(np.sum(w * (f(a, t) - y) ** 2) / (np.sum(w * np.ones_like(t)) - np.sum(w * slope[n] ** 2)
               / sigma[n] ** 2 / information)) for n, (f, t, y, w) in parts.items()
        }  # fmt: skip
    return a, sigma


@pytest.mark.slow
def test_a_weight_counts_as_often_as_it_says():
    """Noise levels and degrees of freedom took every record once, whatever its weight."""
    rng = np.random.default_rng(0)
    late = np.linspace(0.1, 2.0, 7)
    x = np.exp(-1.3 * TS) + 0.02 * rng.standard_normal(12)
    z = (1 - np.exp(-1.3 * TS)) / 1.3 + 0.05 * rng.standard_normal(12)
    other = np.exp(-1.2 * late) + 0.1 * rng.standard_normal(7)
    heavy = learning.Experiment(TS, {"c.x": x, "c.z": z}, weight=3.0)
    fit = learning.Problem(
        system(Falling), learning.Data(heavy, learning.Experiment(late, {"c.x": other})), train=["c.a"], **TIGHT
    ).fit()

    def by_x(a, t):
        return np.exp(-a * t)

    a, sigma = restricted({
        "c.x": (by_x, np.r_[TS, late], np.r_[x, other], np.r_[np.full(12, 3.0), np.ones(7)]),
        "c.z": (lambda a, t: (1 - np.exp(-a * t)) / a, TS, z, 3.0),
    })  # fmt: skip
    np.testing.assert_allclose(fit.values["c.a"], a, rtol=1e-6)
    np.testing.assert_allclose([fit.sigma[n] for n in sigma], list(sigma.values()), rtol=1e-5)
    assert fit.freedom == pytest.approx(3 * 24 + 7 - 1, rel=1e-9) and fit.chi2 == pytest.approx(fit.freedom, rel=1e-4)
    expected = (x - np.exp(-a * TS)) / -sigma["c.x"]
    np.testing.assert_allclose(fit.residuals["experiment 0"]["c.x"], expected, rtol=1e-4)
    row = fit.table()["sigma of c.x"]  # 43 samples, of whose degrees of freedom `a` takes less than one
    assert row.value == fit.sigma["c.x"] and row.low < row.value < row.high
    ends = [np.sqrt(n / scipy.stats.chi2.ppf(q, n)) for q, n in ((0.975, 43), (0.975, 42), (0.025, 43), (0.025, 42))]
    assert ends[1] < row.low / row.value < ends[0] and ends[2] < row.high / row.value < ends[3]


@pytest.mark.slow
@pytest.mark.parametrize("held_out", [False, True])
def test_of_several_starts_the_most_likely_is_kept(held_out):
    """Each local minimum with its own noise level costs half its degrees of freedom, so that the best was drawn by
    chance."""
    rng = np.random.default_rng(0)
    ts = np.linspace(0.2, 20, 80)
    y, kept = (np.sin(0.3 + 2.2 * ts) + 0.1 * rng.standard_normal(80) for _ in range(2))
    data = learning.Data(learning.Experiment(ts, {"c.x": y}), learning.Experiment(ts, {"c.x": kept}, holdout=held_out))
    both = np.tile(ts, 1 if held_out else 2), y if held_out else np.r_[y, kept]

    def misfit(om):
        return np.sum((np.sin(0.3 + om * both[0]) - both[1]) ** 2)

    grid = np.linspace(0.3, 4.0, 2000)
    near = grid[np.argmin([misfit(om) for om in grid])]
    (best,) = exactly(lambda q: np.sin(0.3 + q[0] * both[0]) - both[1], [near])
    fit = learning.Problem(system(Turning), data, train=["c.om"], **TIGHT).fit(starts=10)
    assert fit.values["c.om"] == pytest.approx(best, rel=1e-6)
    assert fit.sigma["c.x"] == pytest.approx(np.sqrt(misfit(best) / (len(both[1]) - 1)), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("what", WAYS)
def test_how_records_are_written_does_not_matter(what):
    """Weights and padding changed intervals, noise levels and degrees of freedom; a sensor law saw the rows by which a
    record is padded to the length of another; a sample at the start was refused; a batch was weighed by its own number
    of samples."""
    names = list(WAYS)
    for number in (names.index(what), names.index(what) + len(names)):
        (outcome,) = written(number).outcomes
        assert outcome.kind == "right", outcome.text


@pytest.mark.slow
def test_where_a_search_began_does_not_matter():
    """Sizes and priors were those of the start, so that notes and intervals moved with it."""
    for outcome in begun(0).outcomes + begun(1).outcomes:
        assert outcome.kind == "right", outcome.text


@pytest.mark.long("residuals and their Jacobian")
def test_a_noise_level_for_each_sample():
    """Errors that grow with what is measured: the fit is that of SciPy with the same weights."""
    rng = np.random.default_rng(4)
    level = 0.002 + 0.05 * np.exp(-1.3 * TS)
    x = np.exp(-1.3 * TS) + level * rng.standard_normal(12)
    x[5] = np.nan
    level[5] = np.nan  # where nothing was measured, no level is needed
    data = learning.Experiment(TS, {"c.x": x, "c.z": (1 - np.exp(-1.3 * TS)) / 1.3}, sigma={"c.x": level, "c.z": 0.1})
    fit = learning.Problem(system(Falling), data, train=["c.a"], **TIGHT).fit()

    def residuals(a):
        e = np.exp(-a[0] * TS)
        return np.r_[((e - x) / level)[np.isfinite(x)], ((1 - e) / a[0] - data.data["c.z"]) / 0.1]

    best = scipy.optimize.least_squares(residuals, [1.0], xtol=1e-14, ftol=1e-14)
    np.testing.assert_allclose(fit.values["c.a"], best.x[0], rtol=1e-6)
    np.testing.assert_allclose(fit.spread[0], 1 / np.linalg.norm(best.jac), rtol=1e-4)
    assert fit.chi2 == pytest.approx(2 * best.cost, rel=1e-6) and not fit.sigma
    r = fit.residuals["experiment 0"]["c.x"]
    np.testing.assert_allclose(r[np.isfinite(x)], best.fun[:11], rtol=1e-4, atol=1e-6)
    assert np.isnan(r[5]) and len(r) == 12


def falling(a):
    return np.r_[np.exp(-a * TS), (1 - np.exp(-a * TS)) / a]


def noisy(draw, scale=1.0, **given):
    """Records of x and z with noise of one kind."""
    x, z = np.split(falling(1.3) + 0.03 * scale * draw, 2)
    sigma = {"c.x": learning.Noise(**given), "c.z": learning.Noise(**given)}
    return learning.Experiment(TS, {"c.x": x, "c.z": z}, sigma=sigma), np.r_[x, z]


@pytest.mark.long("residuals and their Jacobian")
def test_noise_with_outliers_is_that_of_scipy():
    """A few outliers moved a fit as far as they liked."""
    draw = np.random.default_rng(3).standard_normal(24)
    draw[[4, 15]] = [12.0, -9.0]
    reports = []
    data, y = noisy(draw, level=0.03, student=4.0)
    problem = learning.Problem(system(Falling), data, train=["c.a"], **TIGHT)
    fit = problem.fit(progress=reports.append)

    def surprise(a):
        return -np.sum(scipy.stats.t(4.0).logpdf((falling(a) - y) / 0.03) - np.log(0.03))

    exact = scipy.optimize.minimize_scalar(surprise, (1.2, 1.4), tol=1e-14).x
    assert fit.values["c.a"] == pytest.approx(exact, rel=1e-6)
    assert fit.log_likelihood == pytest.approx(-surprise(exact), rel=1e-8)
    slope = (falling(exact + 1e-5) - falling(exact - 1e-5)) / 2e-5
    information = 5 / 7 * np.sum(slope**2) / 0.03**2
    assert fit.spread[0] * fit.objective.coordinates.size[0] == pytest.approx(information**-0.5, rel=1e-4)
    assert [r.step for r in reports] == list(range(len(reports))) and reports[-1].cost <= reports[0].cost
    plain = problem.fit(noisy(draw, level=0.03)[0], warn=False)
    assert abs(plain.values["c.a"] - 1.3) > 2 * abs(fit.values["c.a"] - 1.3) and not plain.ok

    data, y = noisy(draw, level="estimate", huber=1.5, shared="both")
    fit = problem.fit(data, warn=False)

    def rho(u):
        return np.where(np.abs(u) <= 1.5, 0.5 * u**2, 1.5 * np.abs(u) - 1.125)

    sigma, a = fit.sigma["both"], fit.values["c.a"]
    best = scipy.optimize.minimize_scalar(lambda q: np.sum(rho((falling(q) - y) / sigma)), (1.2, 1.4), tol=1e-14).x
    u = (falling(a) - y) / sigma
    assert a == pytest.approx(best, rel=1e-5)
    bent = np.sqrt(2 * rho(u))
    flat = np.where(np.abs(u) <= 1.5, 1.0, 1.5 / np.where(bent > 0, bent, 1))
    taken = np.sum(slope**2) / np.sum((flat * slope) ** 2)
    assert np.sum(np.minimum(np.abs(u), 1.5) * np.abs(u)) == pytest.approx(24 - taken, rel=1e-3)
    assert fit.table()["sigma of both"].value == sigma


@pytest.mark.long("residuals and their Jacobian")
def test_sensors_share_a_level_and_errors_grow_with_what_is_measured():
    """Each name had a level of its own, the same for all of its samples."""
    draw = np.random.default_rng(5).standard_normal(24)
    unit = 0.2 + falling(1.3)
    x, z = np.split(falling(1.3) + 0.03 * unit * draw, 2)
    sigma = {n: learning.Noise(scale=u, shared="gauge") for n, u in zip(("c.x", "c.z"), np.split(unit, 2), strict=True)}
    data = learning.Experiment(TS, {"c.x": x, "c.z": z}, sigma=sigma)
    fit = learning.Problem(system(Falling), data, train=["c.a"], **TIGHT).fit()
    (a,) = exactly(lambda q: (falling(q[0]) - np.r_[x, z]) / unit, [1.0])
    level = np.sqrt(np.sum(((falling(a) - np.r_[x, z]) / unit) ** 2) / 23)
    assert fit.values["c.a"] == pytest.approx(a, rel=1e-6) and fit.sigma == {"gauge": pytest.approx(level, rel=1e-6)}
    assert fit.table(white=False)["c.a"].high > fit.table(white=False)["c.a"].low
    half = data.window(0.5, 2.0, initial={"c.x": learning.Unknown(1.0), "c.z": learning.Unknown(0.0)})
    np.testing.assert_array_equal(half.noise("c.x").scale, unit[:12][TS >= 0.5])
    own = {"c.x": learning.Noise(student=4.0), "c.z": 0.1}
    other = learning.Experiment(TS, {"c.x": x, "c.z": z}, sigma=own)
    with pytest.raises(ModelError, match="the noise of 'c.x' has tails, which method=Shooting does not take"):
        learning.Problem(system(Falling), other, train=["c.a"], method=learning.Shooting(2)).fit()
    mixed = learning.Data(data, learning.Experiment(TS, {"c.x": x}, sigma=0.1))
    with pytest.raises(
        ModelError, match="experiment 1: the noise of 'c.x' has another distribution, correlation or shared level"
    ):
        learning.Problem(system(Falling), mixed, train=["c.a"])


def test_noise_levels_that_do_not_fit():
    cases = [
        (np.ones(11), r"shape \(12,\); got float64 of shape \(11,\)"),
        (-np.ones(12), r"entry \[0\] is -1"),
        (np.full(12, np.nan), r"entry \[0\] is nan"),
    ]
    for level, text in cases:
        with pytest.raises(ModelError, match=text):
            learning.Experiment(TS, {"c.x": TS}, sigma={"c.x": level})
    varying = learning.Experiment(TS, {"c.x": TS}, sigma=np.linspace(0.1, 0.2, 12))
    part, coarse = varying.window(0.5, 1.5), varying.detrend()
    assert isinstance(part.levels["c.x"], np.ndarray) and len(part.levels["c.x"]) == len(part.times)
    np.testing.assert_array_equal(coarse.levels["c.x"], np.linspace(0.1, 0.2, 12))
    with pytest.raises(ModelError, match="'c.x' has a noise level for each sample, which filters do not take"):
        learning.Problem(system(Falling), varying, train=["c.a"], method=learning.Filter(noise={"c.x": 0.1})).fit()
