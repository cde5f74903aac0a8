"""A minimal set of states that becomes a singular choice: the run ends there and says so, or is right."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import angle_solution, compiled, pendulum
from scipy.integrate import solve_ivp

from jaxonomy_dae import Component, EqnEnv, SimulationError, der, simulate
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.solvers import BDF, Rodas5P, Tsit5
from jaxonomy_dae.write import Eq

TS = np.linspace(0.05, 2.0, 40)
ANGLES = (0.5, 1.2, 2.5, -0.5, -1.2, -2.8)
SOLVERS = [
    pytest.param(Tsit5(), id="ours"),
    pytest.param(diffrax.Tsit5(), id="Diffrax's", marks=pytest.mark.slow),
    pytest.param(Rodas5P(), id="Rodas5P", marks=pytest.mark.slow),
    pytest.param(BDF(), id="BDF", marks=pytest.mark.slow),
]


@pytest.fixture(scope="module")
def minimal():
    options = {"state_selection": "dummy_derivatives", "prefer_states": ["pend.x", "pend.vx"]}
    system = pendulum(initial_theta=0.5, compiler=options)
    assert system.states == ["pend.x", "pend.vx"]
    return system


def released(system, theta, L=1.0):
    return system.with_parameters({"pend.initial_theta": theta, "pend.L": L})


@pytest.mark.slow
@pytest.mark.long("a run for each way to end it")
@pytest.mark.parametrize("solver", SOLVERS)
def test_right_or_refused(minimal, solver):
    for theta in ANGLES:
        reference = angle_solution(theta, 0.0, TS)
        expected = np.stack([reference.x, reference.y])
        crosses = (np.sign(reference.y) != np.sign(np.sin(theta))).any()
        if crosses:
            with pytest.raises(SimulationError, match=r"'pend\.x', 'pend\.vx' have become a singular.*'pend\.y'"):
                simulate(released(minimal, theta), 2.0, ts=TS, solver=solver)
        solution = simulate(released(minimal, theta), 2.0, ts=TS, solver=solver, throw=False)
        assert bool(diffrax.is_okay(solution.result)) != crosses
        found = np.stack([solution["pend.x"], solution["pend.y"]])
        done = np.isfinite(found).all(axis=0)
        before = np.cumprod(np.sign(reference.y) == np.sign(np.sin(theta))).astype(bool)
        assert (done == before).all()
        np.testing.assert_allclose(found[:, done], expected[:, done], rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("rtol, atol", [(1e-3, 1e-6), (1e-3, 1e-3)])
def test_loose_tolerances_do_not_reflect_the_motion(minimal, rtol, atol):
    rng = np.random.default_rng(3)
    for theta, L in zip(rng.uniform(-3, 3, 12), 10 ** rng.uniform(-0.5, 1.5, 12), strict=True):
        ts = TS * np.sqrt(L)
        reference = angle_solution(theta, 0.0, ts, L=L)
        solution = simulate(
            released(minimal, theta, L), ts[-1], ts=ts, solver=Tsit5(), rtol=rtol, atol=atol, throw=False
        )
        found = np.stack([solution["pend.x"], solution["pend.y"]])
        done = np.isfinite(found).all(axis=0)
        # A hundred times the tolerance; the reflected motion is off by 2 L.
        np.testing.assert_allclose(
            found[:, done] / L, np.stack([reference.x, reference.y])[:, done] / L, rtol=0, atol=100 * rtol
        )


@pytest.mark.slow
def test_steps_of_a_fixed_size_are_refused_too(minimal):
    solution = simulate(
        released(minimal, 0.5), 2.0, ts=TS, solver=Tsit5(), throw=False,
        stepsize_controller=diffrax.StepTo(ts=jnp.linspace(0.0, 2.0, 101)),
    )  # fmt: skip
    assert not bool(diffrax.is_okay(solution.result))


@pytest.mark.slow
def test_inside_jit(minimal):
    @eqx.filter_jit
    def run(theta):
        solution = simulate(released(minimal, theta), 2.0, ts=TS, throw=False)
        return solution["pend.x"], diffrax.is_okay(solution.result)

    x, okay = run(0.5)
    assert not okay and np.isnan(x[-1])
    x, okay = run(-0.5)
    assert okay
    np.testing.assert_allclose(x, angle_solution(-0.5, 0.0, TS).x, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_the_one_of_two_that_is_singular_is_named():
    ev = EqnEnv()
    pair = [PlanarPendulum(ev, name, initial_theta=theta) for name, theta in (("a", -1.2), ("b", 0.5))]
    options = {"state_selection": "dummy_derivatives", "prefer_states": ["a.x", "a.vx", "b.x", "b.vx"]}
    system = compiled(*pair, **options)
    with pytest.raises(SimulationError, match=r"no longer determine 'b\.y'"):
        simulate(system, 2.0)


class Steep(Component):
    """A mass on a spring in x that pulls a light one in y along, some forty times as far."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        m, heavy, k = (self.parameter(*each) for each in (("m", 2.0), ("M", 0.001), ("k", 3.0)))
        x, y, pull = self.variable("x", start=0.1, fixed=True), self.variable("y"), self.variable("pull")
        vx, vy = self.variable("vx", start=0.0, fixed=True), self.variable("vy")
        self.add_equations(
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(m * der(vx), -k * x - 40 * pull),
            Eq(heavy * der(vy), pull),
            Eq(y, 40 * sympy.sin(x)),
        )


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [["c.x", "c.vx"], ["c.y", "c.vy"]])
def test_a_preference_is_followed_where_sizes_differ(wanted):
    """The constraint's slopes are 40 and 1. Against x with the force along the constraint in closed form, by SciPy at
    rtol 1e-11; both runs at rtol 1e-9."""
    system = compiled(Steep(EqnEnv(), "c"), state_selection="dummy_derivatives", prefer_states=wanted)
    assert system.states == wanted
    assert not system.report.notes

    def motion(t, z):
        x, v = z
        slope, bend = 40 * np.cos(x), -40 * np.sin(x)
        # 2 x″ = −3 x − 40·pull, pull = 0.001·(slope·x″ + bend·v²)
        return [v, (-3 * x - 0.04 * bend * v**2) / (2 + 0.04 * slope)]

    reference = solve_ivp(motion, (0, 2), [0.1, 0.0], method="DOP853", rtol=1e-11, atol=1e-13)
    found = simulate(system, 2.0, rtol=1e-9, atol=1e-12)["c.x"][-1]
    assert float(found) == pytest.approx(reference.y[0, -1], abs=1e-8)
