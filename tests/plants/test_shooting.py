"""Multiple shooting: where nothing diverges it ends where single shooting does, with the same intervals; and a double
pendulum whose truth is Lagrange's equations, integrated by SciPy."""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from swinging import compiled_pendulum, record

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, learning, simulate
from jaxonomy_dae.host.cache import PROGRAMS
from jaxonomy_dae.write import Component, Eq, der

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "learning"))
import double_pendulum  # noqa: E402


def same_outcome(one, other):
    """The same optimum and intervals, as far as both converge: the remaining step is a thousandth of a region's
    radius."""
    assert one.minimum.converged and other.minimum.converged
    known = (one.spread > 0) & np.isfinite(one.spread) & (one.spread < 1)
    assert known.any()
    np.testing.assert_allclose((one.point - other.point)[known] / one.spread[known], 0, atol=5e-3)
    np.testing.assert_allclose(other.spread[known], one.spread[known], rtol=2e-3)
    np.testing.assert_allclose(
        other.correlation[np.ix_(known, known)], one.correlation[np.ix_(known, known)], atol=5e-3
    )
    np.testing.assert_allclose(other.chi2, one.chi2, rtol=1e-5)
    for label, by_name in one.residuals.items():
        for name, residual in by_name.items():
            np.testing.assert_allclose(other.residuals[label][name], residual, atol=5e-3)


# --- a constrained model ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pendulum():
    return compiled_pendulum()


@pytest.mark.slow
def test_a_constrained_model(pendulum):
    """The nodes move along x² + y² = L², and L changes: four states with two degrees of freedom."""
    release = "pend.initial_theta"
    data = learning.Data(
        record(0, 50, -1.0, initial={release: learning.Unknown(-0.9)}),
        record(1, 30, -0.4, initial={release: learning.Unknown(-0.5)}),
        record(2, 40, -0.7, initial={release: learning.Unknown(-0.9)}, holdout=True, name="kept"),
    )
    given = dict(train=["pend.L", "pend.m", "drag"], regularize=None, rtol=1e-9, atol=1e-11)
    single = learning.Problem(pendulum, data, **given).fit(freeze=["pend.m"])
    problem = learning.Problem(pendulum, data, method=learning.Shooting(nodes=4), **given)
    shot = problem.fit(freeze=["pend.m"])
    same_outcome(single, shot)
    assert shot.minimum.states.shape == (2, 4, 4) and np.abs(shot.minimum.gaps).max() < 1e-6
    x, y = shot.minimum.states[..., [pendulum.states.index(f"pend.{n}") for n in "xy"]].transpose(2, 0, 1)
    np.testing.assert_allclose(np.hypot(x, y), shot.values["pend.L"], rtol=1e-9)
    row = shot.table()["pend.L"]
    np.testing.assert_allclose(shot.profile("pend.L")["pend.L"], [row.low, row.high], atol=0.1 * (row.high - row.low))
    free = problem.fit()  # the mass cancels: what rounding leaves of its column took it to 1e-9 and 2e8 times its start
    assert free.table()["pend.m"].note == "not determined"
    assert free.values["pend.m"] == pytest.approx(float(pendulum.parameters["pend.m"]), rel=1e-3)
    assert shot.holdout_score == pytest.approx(single.holdout_score, rel=1e-4)


# --- an input, a network, a sensor law, starts that are shared and own ------------------------------------------------


class Driven(Component):
    """v' = −k·x − f(v) + u, x' = v, with f learned."""

    def __init__(self, ev, name="cart"):
        super().__init__(ev, name)
        k = self.parameter("k", 2.0)
        u = self.input("u")
        x, v = self.variable("x", start=0.5, fixed=True), self.variable("v", start=0.0, fixed=True)
        (f,) = self.learned("friction", eqx.nn.MLP(1, 1, 4, 1, jnp.tanh, key=jax.random.key(0)), inputs=[v])
        self.add_equations(Eq(der(x), v), Eq(der(v), -k * x - f + u))


class Gauge(eqx.Module):
    gain: jax.Array

    def __call__(self, solution):
        return self.gain * solution["cart.x"]


def driven(seed, span, x0):
    times = np.linspace(0, span, 61)[1:]
    grid = np.linspace(0, span, 21)
    push = np.sin(2.3 * grid) + 0.5 * np.cos(5.1 * grid)

    def field(t, s):
        return [s[1], -3.0 * s[0] - 0.4 * np.tanh(2 * s[1]) + np.interp(t, grid, push)]

    x = scipy.integrate.solve_ivp(
        field, (0, span), [x0, 0.3], t_eval=times, rtol=1e-10, atol=1e-12, max_step=span / 40
    ).y[0]
    noise = np.random.default_rng(seed).standard_normal(len(times))
    start = {"cart.x": learning.Unknown(x0 + 0.1, spread=0.5), "cart.v": learning.Unknown(0.0, shared=True)}
    return learning.Experiment(
        times, {"gauge.y": 1.2 * x + 0.01 * noise}, sigma=0.01, inputs={"cart.u": (grid, push)}, initial=start
    )


@pytest.mark.slow
def test_inputs_networks_sensor_laws_and_starts():
    """The prior of the network's weights is the one that the data choose."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Driven(ev))
    system = AcausalCompiler(ev, diagram)()
    data = learning.Data(driven(0, 6.0, 0.5), driven(1, 4.0, -0.3))
    given = dict(train=["cart.k", "cart.friction"], observe={"gauge.y": Gauge(jnp.array(1.2))}, rtol=1e-9, atol=1e-11)
    shot = learning.Problem(system, data, method=learning.Shooting(nodes=5), **given).fit()
    assert shot.minimum.converged and 0.6 < shot.chi2 / shot.freedom < 1.4
    assert abs(shot.values["cart.k"] - 3.0) < 4 * 3.0 * shot.spread[0]
    # At that point, one run of each experiment gives the same residuals and derivatives.
    alone = shot.objective.evaluate(shot.minimum.z)
    np.testing.assert_allclose(shot.minimum.found.residual, alone.residual, atol=1e-6)
    size = np.abs(alone.jacobian).max(axis=0)
    np.testing.assert_allclose(shot.minimum.found.jacobian / size, alone.jacobian / size, atol=1e-5)
    # Again, with other data and another frozen set: the same programs.
    count = len(PROGRAMS)
    other = learning.Data(driven(2, 5.0, 0.4), driven(3, 6.0, 0.2))
    again = learning.Problem(system, other, method=learning.Shooting(nodes=5), **given).fit(freeze={"cart.k": 3.0})
    assert len(PROGRAMS) == count and again.values["cart.k"] == 3.0


# --- chaos ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_double_pendulum_over_twelve_seconds():
    """Disturbances grow a millionfold; single shooting stays far away, with the same data and guesses."""
    assert double_pendulum.growth() > 5e5
    system = double_pendulum.pendulum()
    truth = double_pendulum.TRUTH
    problem = learning.Problem(system, double_pendulum.record(1), train=list(truth), method=learning.Shooting(nodes=30))
    for seed in (1, 2, 3):
        fit = problem.fit(double_pendulum.record(seed))
        assert fit.minimum.converged and 0.8 < fit.chi2 / fit.freedom < 1.2
        assert (np.abs(double_pendulum.deviations(fit)) < 4).all()
        np.testing.assert_allclose([fit.values[name] for name in truth], list(truth.values()), rtol=0.01)
        table = fit.table()
        assert all(table[name].note == "" for name in truth)
    single = learning.Problem(system, double_pendulum.record(1), train=list(truth)).fit(starts=1)
    assert single.chi2 / single.freedom > 100


# --- starting at a whole state ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_goes_on_from_a_state(pendulum):
    """Where the first half ends the second one begins: on the constraints, with the same derivatives."""
    ts = jnp.linspace(0.0, 2.0, 5)
    tight = dict(rtol=1e-9, atol=1e-11)
    whole = simulate(pendulum, 2.0, ts=ts, **tight)
    again = simulate(pendulum, 2.0, t0=1.0, ts=ts[2:], initial=whole.states[2], **tight)
    np.testing.assert_allclose(again.states, whole.states[2:], atol=1e-7)
    off = simulate(pendulum, 2.0, t0=1.0, ts=ts[2:], initial=1.01 * whole.states[2], **tight)
    x, y, vx, vy = (off[f"pend.{n}"][0] for n in ("x", "y", "vx", "vy"))
    np.testing.assert_allclose([x**2 + y**2 - 1, x * vx + y * vy], 0, atol=1e-12)
