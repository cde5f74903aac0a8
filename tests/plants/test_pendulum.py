"""The constrained pendulum: right physics, no singular chart, published numbers."""

import functools

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from component_references import checks, measured
from problems import (
    CASH,
    DRAG,
    EQUATION,
    HORIZONS,
    PERIOD_TWO_GRAVITY,
    RELEASE,
    angle_solution,
    drag_on,
    elliptic_angle,
    pendulum,
)

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, SimulationError, simulate
from jaxonomy_dae.library.planar import PlanarPendulum

TIGHT = dict(rtol=1e-11, atol=1e-12)
SMALL = dict(solver=diffrax.Tsit5(), adjoint=diffrax.ForwardMode(), **TIGHT)  # a small program
OFTEN = jnp.linspace(0.0, 2.0, 401)  # as many times as full swings are saved at: one program


MODES = pytest.mark.parametrize("mode", ["auto", pytest.param("dummy_derivatives", marks=pytest.mark.slow)])


def horizontal_drag(vx, vy):
    return -DRAG * vx * abs(vx), 0.0


@functools.cache
def with_drag(mode):
    """Drag as a true force on vx: the hidden constraint and the rod's tension must answer to it."""
    return pendulum(drag_on("vx"), compiler={"state_selection": mode})


@pytest.mark.long("the model is compiled, and a run of it")
@MODES
def test_truth_of_a_real_force(mode):
    solution = simulate(with_drag(mode), 1.5, ts=jnp.array(HORIZONS), **SMALL)
    found = np.stack([solution["pend.vx"], solution["pend.x"]], axis=1)
    np.testing.assert_allclose(found, EQUATION, rtol=0, atol=1e-7)  # 7 of the 8 decimals given


@MODES
@pytest.mark.parametrize("m, L, g", [(1.0, 1.0, 9.81), (0.6, 1.3, 3.7)])
def test_every_variable_under_a_real_force(mode, m, L, g):
    system = with_drag(mode).with_parameters({"pend.m": m, "pend.L": L, "pend.g_y": -g})
    solution = simulate(system, 1.5, ts=jnp.array(HORIZONS), **SMALL)
    reference = angle_solution(RELEASE, 0.0, HORIZONS, g=g, L=L, m=m, force=horizontal_drag)
    for name in ("x", "y", "vx", "vy"):
        # Some hundred times the tolerance of the solve; the reference is good to 1e-12.
        np.testing.assert_allclose(solution[f"pend.{name}"], getattr(reference, name), rtol=0, atol=1e-9)
    # The tension with the drag in it, to the 1e-6 that was asked for.
    np.testing.assert_allclose(solution["pend.lam"], reference.lam, rtol=0, atol=1e-6)
    np.testing.assert_allclose(solution["drag[0]"], -DRAG * reference.vx * np.abs(reference.vx), rtol=0, atol=1e-8)


@pytest.fixture(scope="module")
def plain():
    return pendulum()


@pytest.mark.slow
def test_full_swings_pass_both_charts_singular_points(plain):
    ts = np.linspace(0.0, 20.0, 401)
    system = plain.with_parameters({"pend.initial_theta": np.pi / 6})
    assert set(system.states) == {"pend.x", "pend.y", "pend.vx", "pend.vy"}
    solution = simulate(system, 20.0, ts=ts, rtol=1e-8, atol=1e-10)
    x, y = np.asarray(solution["pend.x"]), np.asarray(solution["pend.y"])
    angle = elliptic_angle(np.pi / 6, ts)
    assert np.min(np.abs(x)) < 0.05 and np.min(np.abs(y)) < 0.05  # x = 0 and y = 0 are passed
    assert np.max(np.abs(x**2 + y**2 - 1.0)) <= 1e-12  # projected at every saved time
    # 900 steps of local error 1e-8, some amplified by the pendulum's period error: 1e-4 as asked.
    np.testing.assert_allclose(np.stack([x, y]), np.stack([np.cos(angle), np.sin(angle)]), rtol=0, atol=1e-4)
    vx, vy = np.asarray(solution["pend.vx"]), np.asarray(solution["pend.vy"])
    assert np.max(np.abs(x * vx + y * vy)) <= 1e-11  # the constraint differentiated; speeds reach 5
    energy = 0.5 * (vx**2 + vy**2) + 9.81 * y
    np.testing.assert_allclose(energy, 9.81 * 0.5, rtol=0, atol=1e-4)
    assert np.max(np.abs(solution.constraint_residual())) <= 1e-11


@pytest.mark.slow
def test_projection_after_every_step_keeps_loose_solves_useful(plain):
    """Projecting the saved values alone, the states between having drifted, would leave an error of 0.6 m here."""
    ts = np.linspace(0.0, 20.0, 401)
    solution = simulate(plain.with_parameters({"pend.initial_theta": np.pi / 6}), 20.0, ts=ts, rtol=1e-4, atol=1e-6)
    angle = elliptic_angle(np.pi / 6, ts)
    distance = np.hypot(solution["pend.x"] - np.cos(angle), solution["pend.y"] - np.sin(angle))
    assert np.max(distance) < 0.05  # some hundred times the tolerance


@checks(
    {PlanarPendulum: ("J. Cash's published solution at t = 1", "x, y, vx, vy, 2·lam")},
    origin="nine of the published digits are right",
    plain=pendulum,
)
def test_cash(plain):
    system = plain.with_parameters({"pend.g_y": -1.0, "pend.initial_theta": 0.0, "pend.initial_omega": 1.0})
    solution = simulate(system, 2.0, ts=OFTEN, **TIGHT)
    names = ("pend.x", "pend.y", "pend.vx", "pend.vy", "pend.lam")
    found = np.array([solution[n][200] for n in names]) * np.array([1, 1, 1, 1, 2])  # y5 = 2·lam
    measured("x, y, vx, vy, 2·lam", found, CASH, 2e-9)  # nine published digits are right


def test_period_two(plain):
    system = plain.with_parameters({"pend.g_y": -PERIOD_TWO_GRAVITY, "pend.initial_theta": 0.0})
    solution = simulate(system, 2.0, ts=OFTEN, **TIGHT)
    # At half a period the bob rests on the other side, then it is back: exact, but for 100 steps at 1e-11.
    for name, expected in (("x", [-1, 1]), ("y", [0, 0]), ("vx", [0, 0]), ("vy", [0, 0]), ("lam", [0, 0])):
        np.testing.assert_allclose(
            solution[f"pend.{name}"][200::200], expected, rtol=0, atol=2e-9
        )  # 100 steps at 1e-11


@pytest.mark.slow
def test_period_two_does_not_drift(plain):
    system = plain.with_parameters({"pend.g_y": -PERIOD_TWO_GRAVITY, "pend.initial_theta": 0.0})
    solution = simulate(system, 200.0, ts=jnp.array([2.0, 20.0, 200.0]), rtol=1e-11, atol=1e-12, max_steps=200_000)
    np.testing.assert_allclose(solution["pend.x"], 1.0, rtol=0, atol=1e-9)
    # The period error grows with time: 1e-9 per period, 100 periods.
    np.testing.assert_allclose(solution["pend.y"], 0.0, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_forced_singular_chart_fails_loudly():
    # With (y, vy) as states x = ±√(L² − y²) cannot be followed through the lowest point, which a release from rest
    # reaches after a quarter of the period 4·K(sin²(A/2))·√(L/g), amplitude A = π/2 − 1.2.
    ev = EqnEnv()
    diagram = AcausalDiagram().add(PlanarPendulum(ev, "pend", initial_theta=-1.2))
    options = dict(state_selection="dummy_derivatives", prefer_states=["pend.vy", "pend.y"])
    system = AcausalCompiler(ev, diagram, **options)()
    assert system.states == ["pend.y", "pend.vy"]
    quarter = scipy.special.ellipk(np.sin((np.pi / 2 - 1.2) / 2) ** 2) / np.sqrt(9.81)
    times = np.linspace(0.0, 2.0, 401)
    with pytest.raises(SimulationError, match="singular choice"):
        simulate(system, 2.0, ts=times, rtol=1e-7, atol=1e-9, max_steps=2000)
    solution = simulate(system, 2.0, ts=times, rtol=1e-7, atol=1e-9, max_steps=2000, throw=False)
    reached = times[np.isfinite(np.asarray(solution["pend.y"]))]
    assert quarter - 0.01 < reached[-1] <= quarter


@pytest.mark.slow
@pytest.mark.parametrize("states", [("x", "vx"), ("y", "vy")])
def test_a_forced_singular_chart_is_right_as_far_as_it_goes(states):
    names = [f"pend.{s}" for s in states]
    compiler = {"state_selection": "dummy_derivatives", "prefer_states": names}
    system = pendulum(initial_theta=np.pi / 6, compiler=compiler)
    assert system.states == names
    ts = np.linspace(0.0, 3.0, 61)
    solution = simulate(system, 3.0, ts=ts, rtol=1e-8, atol=1e-10, max_steps=2000, throw=False)
    found = np.stack([solution["pend.x"], solution["pend.y"]])
    done = np.isfinite(found).all(axis=0)
    assert 5 < done.sum() < 61
    angle = elliptic_angle(np.pi / 6, ts[done])
    # As for full swings above; the last steps before the singular point are the hardest.
    np.testing.assert_allclose(found[:, done], np.stack([np.cos(angle), np.sin(angle)]), rtol=0, atol=1e-4)
