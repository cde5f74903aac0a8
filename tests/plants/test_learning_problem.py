"""Fits of a pendulum with drag, through its constraint: one program for all of this file's main problem.

The truth comes from the angle's equation, integrated by SciPy.
"""

import jax
import numpy as np
import pytest
from swinging import DRAG, LENGTH, RELEASE, SIGMA, compiled_pendulum, record

from jaxonomy_dae.errors import SimulationError
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.learning import Data, Problem, Unknown


def data(seed):
    unknown = {RELEASE: Unknown(-0.9)}
    return Data(
        record(seed, 50, -1.0, initial=unknown),
        record(seed + 1, 30, -0.4, initial={RELEASE: Unknown(-0.5)}, sigma="estimate"),
        record(seed + 2, 40, -0.7, initial=unknown, holdout=True, name="kept"),
    )


pytestmark = pytest.mark.slow  # the residuals and their Jacobian compile for 25 s


@pytest.fixture(scope="module")
def system():
    return compiled_pendulum()


@pytest.fixture(scope="module")
def problem(system):
    return Problem(system, data(0), train=["pend.L", "pend.m", "drag"], regularize=None)


@pytest.fixture(scope="module")
def fit(problem):
    return problem.fit()


def test_values_are_those_of_the_truth(fit):
    assert fit.minimum.converged
    deviation = fit.spread[[0, 2]]
    found = np.array([fit.values["pend.L"], fit.values["drag[0]"]])
    np.testing.assert_array_less(np.abs(found - [LENGTH, DRAG]), 4 * deviation * [LENGTH, 1])
    assert (deviation < [2e-3, 1e-2]).all()
    np.testing.assert_allclose(fit.starts[RELEASE], [-1.0, -0.4, -0.7], atol=5e-3)
    np.testing.assert_allclose(list(fit.sigma.values()), SIGMA, rtol=0.35)
    assert 0.6 < fit.chi2 / fit.freedom < 1.5
    assert fit.whiteness["experiment 0"]["pend.x"].probability > 1e-3


def test_what_the_data_do_not_tell_is_named(fit):
    """Positions alone say nothing of the mass: the drag is per mass."""
    row = fit.table()["pend.m"]
    assert row.note == "not determined" and np.isinf(row.high) and abs(row.value - 1.0) < 1e-3
    assert fit.table()["pend.L"].note == "" and "known" in repr(fit.identifiability())
    assert "nothing measured depends on 'pend.m'" in repr(fit.identifiability())


def test_experiments_held_out_are_scored_and_keep_their_start(fit):
    assert 0.7 < fit.holdout_score < 1.4
    assert fit.rms["kept"]["pend.x"] < 1.5 * SIGMA
    assert "kept" not in fit.residuals
    assert "held out" in fit.table()[f"{RELEASE}, kept"].note


def test_a_second_fit_compiles_nothing(problem, fit):
    count, compiled = len(PROGRAMS), []

    def listen(event, *_, **__):
        if "compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        # What is against a fit is found by a program of its own, the first time that something is.
        how = dict(freeze={"pend.m": 2.0}, start={"pend.L": 0.9}, bounds={"pend.L": (0.5, 1.05)}, warn=False)
        other = problem.fit(data(7), **how)
    finally:
        jax.monitoring.clear_event_listeners()
    assert len(PROGRAMS) == count and not compiled
    assert other.values["pend.L"] == 1.05 and other.table()["pend.L"].note == "bound reached: 1.05"
    assert other.values["pend.m"] == 2.0 and other.table()["pend.m"].note == "frozen"


def test_growing_horizons_and_gradient_steps_end_at_the_same_point(problem, fit):
    again = problem.fit(adam=5, horizons=(0.3, 1.0), starts=2, freeze=["pend.m"])
    deviation = fit.spread[2]
    assert abs(again.values["drag[0]"] - fit.values["drag[0]"]) < 0.05 * deviation


def test_profile_likelihood_agrees_with_linear_intervals_where_the_model_is_almost_linear(fit):
    low, high = fit.profile("pend.L")["pend.L"]
    row = fit.table()["pend.L"]
    np.testing.assert_allclose([low, high], [row.low, row.high], atol=0.1 * (row.high - row.low))


def test_public_residuals_are_those_that_were_minimised(problem, fit):
    found = problem.residuals(fit.system, starts=fit.starts)
    expected = fit.residuals["experiment 0"]["pend.y"]
    # Runs that are differentiated take shorter steps where something rests: both are right to ten times rtol, in σ.
    np.testing.assert_allclose(found["experiment 0"]["pend.y"], expected, rtol=0, atol=1e-5 / SIGMA)
    np.testing.assert_array_equal(found["experiment 0"]["pend.x"][3:6], 0.0)


def test_a_band_has_the_slope_and_spread_of_the_law(fit):
    grid = np.stack([np.linspace(-20, 20, 5), np.zeros(5)], axis=1)
    band = fit.band("drag", grid)
    np.testing.assert_allclose(band.mean, -fit.values["drag[0]"] * grid[:, 0], rtol=1e-10)
    np.testing.assert_allclose(band.spread, fit.spread[2] * np.abs(grid[:, 0]), rtol=1e-6, atol=1e-12)
    assert band.explored.shape == (2, 2) and band.inside.tolist() == [False, False, True, False, False]


def test_bands_of_variables_that_were_not_measured(fit):
    found = fit.predict(["pend.vx", "pend.x"], ts=[0.5, 1.0])
    step = 1e-4
    other = fit.problem.run(fit.objective, fit.point + np.eye(len(fit.point))[2] * step, 0, ts=np.array([0.5, 1.0]))
    plain = fit.problem.run(fit.objective, fit.point, 0, ts=np.array([0.5, 1.0]))
    np.testing.assert_allclose(found.mean["pend.vx"], plain["pend.vx"], rtol=1e-6)
    slope = (other["pend.vx"] - plain["pend.vx"]) / step
    assert (found.spread["pend.vx"] < 1.0).all() and (np.abs(slope) > 0).all()
    assert (found.low["pend.vx"] < found.mean["pend.vx"]).all()


def test_runs_that_all_fail_say_why(problem):
    with pytest.raises(SimulationError, match="no start can be simulated; from the first, experiment 0"):
        problem.fit(start={"pend.L": 1e-300})
