"""Events: times, states and gradients against closed forms.

Reference values are closed forms evaluated in extended precision: a ball is a chain of parabolas, a thermostat and a
sampled loop are chains of exponentials. Runs are made at rtol = atol = 1e-10; what is integrated is polynomial or
smooth, so that errors are a few tolerances.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from component_references import checks, measured
from hybrid_models import Ball, SampledPI, Stick, Thermostat, compiled

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, ModelError, SimulationError, simulate
from jaxonomy_dae.library import signal
from jaxonomy_dae.solvers import BDF, Rodas5P, Tsit5

BOUNCES = [0.451523640985731, 1.1739614665629, 1.75191172702464, 2.21427193539402, 2.58416010208954, 2.88007063544594]
HEIGHT = 0.0687074609657657  # at t = 3
SLOPES = [1.16388772098508, -0.00234772681723926, 0.0917386610428829]  # by e, g, h0
SIXTH_BY_E = 7.78065538147
TIGHT = dict(rtol=1e-10, atol=1e-10)
SOLVERS = {
    "tsit5": Tsit5(), "diffrax": diffrax.Tsit5(), "dopri8": diffrax.Dopri8(), "kvaerno5": diffrax.Kvaerno5(),
    "rodas5p": Rodas5P(), "bdf": BDF(),
}  # fmt: skip
ADJOINTS = {"stored": None, "checkpoints": diffrax.RecursiveCheckpointAdjoint(), "forward": diffrax.ForwardMode()}
# The issue of accuracy: BDF has order five and steps that add up their errors.
LOOSE = {"bdf": 1e-5}


@pytest.fixture(scope="module")
def ball():
    return compiled(Ball, "ball")


def height_and_sixth(ball, p, solver=None, adjoint=None):
    changed = ball.with_parameters({"ball.e": p[0], "ball.g": p[1], "ball.h0": p[2]})
    solution = simulate(changed, 3.0, ts=jnp.array([3.0]), solver=solver, adjoint=adjoint, **TIGHT)
    return jnp.stack([solution["ball.h"][-1], solution.events.ts[5]])


SOME = [("tsit5", "stored"), ("rodas5p", "stored"), ("kvaerno5", "forward")]
ALL = [
    pytest.param(s, a, marks=() if (s, a) in SOME else pytest.mark.slow)
    for s in SOLVERS
    for a in ADJOINTS
    # Backwards through the loops of BDF only StoredAdjoint goes.
    if (s, a) not in (("bdf", "checkpoints"), ("bdf", "forward"))
]


@pytest.mark.parametrize("solver, adjoint", ALL)
def test_a_ball(ball, solver, adjoint):
    def run(p):
        return height_and_sixth(ball, p, SOLVERS[solver], ADJOINTS[adjoint])

    p = jnp.array([0.8, 9.81, 1.0])
    values = run(p)
    by_p = jax.jit((jax.jacfwd if adjoint == "forward" else jax.jacrev)(run))(p)
    exact = LOOSE.get(solver, 1e-9)
    np.testing.assert_allclose(values, [HEIGHT, BOUNCES[-1]], rtol=0, atol=exact)
    np.testing.assert_allclose(by_p[0], SLOPES, rtol=LOOSE.get(solver, 1e-8), atol=LOOSE.get(solver, 1e-9))
    np.testing.assert_allclose(by_p[1, 0], SIXTH_BY_E, rtol=LOOSE.get(solver, 1e-8))


def test_what_a_solution_says_of_events(ball):
    solution = simulate(ball, 3.0, ts=jnp.linspace(0.0, 3.0, 31), **TIGHT)
    np.testing.assert_allclose(solution.events.ts[:6], BOUNCES, rtol=0, atol=1e-10)
    assert np.isinf(solution.events.ts[6:]).all()
    assert len(solution.events) == 6 and set(solution.events.names) == {"ball: when(h <= 0)"}
    assert solution.events.terminated is None
    counted = np.searchsorted(BOUNCES, np.linspace(0.0, 3.0, 31))
    np.testing.assert_array_equal(solution["ball.n"], counted)
    assert "ball.n" in solution and solution.to_dict()["ball.n"].shape == (31,)
    assert "when(h <= 0)" in repr(solution.events)


def test_saved_at_an_event_is_what_comes_after(ball):
    first = float(simulate(ball, 1.0, ts=jnp.array([1.0]), **TIGHT).events.ts[0])
    solution = simulate(ball, 1.0, ts=jnp.array([first - 1e-9, first, 1.0]), **TIGHT)
    impact = 9.81 * first
    np.testing.assert_allclose(solution["ball.v"][:2], [-impact, 0.8 * impact], rtol=1e-7)
    steps = simulate(ball, 1.0, **TIGHT)
    assert steps["ball.h"].min() > -1e-12


def test_a_thermostat():
    system = compiled(Thermostat, "room")
    ts = jnp.linspace(0.0, 20.0, 201)

    def last(power):
        return simulate(system.with_parameters({"room.P": power}), 20.0, ts=ts, **TIGHT)["room.T"][-1]

    solution = simulate(system, 20.0, ts=ts, **TIGHT)
    assert len(solution.events) == 35
    assert float(solution["room.T"][-1]) == pytest.approx(50.7088714113363, abs=1e-8)
    # Thirty-five switches add their errors up.
    assert float(jax.grad(last)(10.0)) == pytest.approx(-3.51092853184108, rel=1e-8)
    np.testing.assert_array_equal(solution["room.q"], 10.0 * solution["room.on"])
    reached = np.asarray(ts) > float(solution.events.ts[0])
    assert (solution["room.T"][reached] > 48.9).all() and (solution["room.T"] < 51.1).all()


def test_a_sampled_controller():
    system = compiled(SampledPI, "loop")

    def run(p, t1):
        changed = system.with_parameters({"loop.Kp": p[0], "loop.Ki": p[1], "loop.T": p[2]})
        return simulate(changed, t1, ts=jnp.array([t1]), **TIGHT)["loop.x"][-1]

    p = jnp.array([2.0, 3.0, 0.1])
    assert float(run(p, 3.0)) == pytest.approx(1.01155947251977, abs=1e-9)
    gradient = jax.jit(jax.grad(run), static_argnums=1)
    np.testing.assert_allclose(gradient(p, 3.0)[:2], [-0.00718258236586836, -0.00910828614834083], rtol=1e-8)
    assert float(gradient(p, 2.55)[2]) == pytest.approx(0.0155033203623, rel=1e-6)
    solution = simulate(system, 0.35, ts=jnp.array([0.0, 0.05, 0.1, 0.35]), **TIGHT)
    assert solution["loop.u"][0] == solution["loop.u"][1] == 2.0  # it samples at the start
    assert len(solution.events) == 0 and solution["loop.u"][2] != 2.0


def test_it_sticks_and_slides():
    """m v' = push − μ from where 4(1 − s²) = 3, s = t − 1, on: s₀ = −1/2, and 2v = s − 4s³/3 + 1/3 is zero again where
    4s³ − 3s − 1 = (s − 1)(2s + 1)² vanishes: at s = 1."""
    system = compiled(Stick, "block")
    solution = simulate(system, 2.2, ts=jnp.array([0.4, 1.0, 2.2]), **TIGHT)
    np.testing.assert_allclose(solution.events.ts[:2], [0.5, 2.0], atol=1e-9)
    np.testing.assert_allclose(solution["block.v"], [0.0, (1 / 3) / 2, 0.0], atol=1e-9)
    np.testing.assert_array_equal(solution["block.mode"], [0.0, 1.0, 0.0])
    by_mu = jax.grad(
        lambda mu: simulate(system.with_parameters({"block.mu": mu}), 2.2, ts=jnp.array([2.2]), **TIGHT)["block.x"][-1]
    )(3.0)
    # x = ∫v over [s₀, s₁]; dx/dμ = ∫ dv/dμ with 2 dv/dμ = −(s − s₀): −(3/2)²/4.
    assert float(by_mu) == pytest.approx(-((3 / 2) ** 2) / 4, rel=1e-8)


def test_a_run_that_ends():
    system = compiled(Ball, "ball", stop=3)
    solution = simulate(system, 3.0, ts=jnp.array([0.1, 1.75, 1.9]), **TIGHT)
    assert solution.events.terminated == "bounced enough"
    assert np.isfinite(solution["ball.h"][:2]).all() and np.isnan(solution["ball.h"][2])
    np.testing.assert_allclose(solution.events.ts[2:4], [BOUNCES[2]] * 2, atol=1e-10)


def test_accumulation_is_named(ball):
    """The bounces accumulate at 4.06371276887158."""
    with pytest.raises(SimulationError, match=r"ball: when\(h <= 0\).*max_events") as raised:
        simulate(ball, 5.0, ts=jnp.array([5.0]), max_events=20)
    assert "4.06" in str(raised.value)


def test_too_many_events_inside_jit(ball):
    def run(e):
        system = ball.with_parameters({"ball.e": e})
        return simulate(system, 5.0, ts=jnp.array([5.0]), max_events=20, throw=True)["ball.h"]

    with pytest.raises(Exception, match="more than max_events=20 events"):
        jax.block_until_ready(jax.jit(run)(0.8))


def test_members_of_a_batch_are_as_alone(ball):
    restitutions = jnp.linspace(0.7, 0.9, 5)

    def run(e):
        system = ball.with_parameters({"ball.e": e})
        solution = simulate(system, 2.0, ts=jnp.array([2.0]), max_events=12, **TIGHT)
        return solution["ball.h"][-1], solution.events.ts

    gradients = eqx.filter_jit(jax.vmap(jax.value_and_grad(run, has_aux=True)))(restitutions)
    alone = eqx.filter_jit(jax.value_and_grad(run, has_aux=True))
    for k, e in enumerate(restitutions):
        jax.tree.map(
            lambda both, one, k=k: np.testing.assert_allclose(both[k], one, rtol=1e-9, atol=1e-12), gradients, alone(e)
        )


def test_reverse_is_forward(ball):
    p = jnp.array([0.8, 9.81, 1.0])
    reverse = jax.jit(jax.jacrev(lambda p: height_and_sixth(ball, p)))(p)
    forward = jax.jit(jax.jacfwd(lambda p: height_and_sixth(ball, p, adjoint=diffrax.ForwardMode())))(p)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


def test_both_sides_of_an_event(ball):
    solution = simulate(ball, 1.0, ts=jnp.array([1.0]), **TIGHT)
    impact = 9.81 * BOUNCES[0]
    np.testing.assert_allclose(solution.events.before["ball.v"][0], -impact, rtol=1e-9)
    np.testing.assert_allclose(solution.events.after["ball.v"][0], 0.8 * impact, rtol=1e-9)
    np.testing.assert_allclose(solution.events.transversality[0], impact, rtol=1e-9)
    assert solution.events.after["ball.n"][0] == 1 and np.isnan(solution.events.before["ball.v"][1])

    def impact_speed(h0):
        changed = ball.with_parameters({"ball.h0": h0})
        return simulate(changed, 1.0, ts=jnp.array([1.0]), save_events=True, **TIGHT).events.before["ball.v"][0]

    # v = −√(2·g·h0)
    assert float(jax.grad(impact_speed)(1.0)) == pytest.approx(-np.sqrt(9.81 / 2), rel=1e-9)
    with pytest.raises(ModelError, match="save_events=True"):
        jax.grad(lambda h: simulate(ball, 1.0, ts=jnp.array([h])).events.before["ball.v"][0])(0.9)


def test_second_derivatives_are_refused(ball):
    def height(e):
        return simulate(ball.with_parameters({"ball.e": e}), 1.0, ts=jnp.array([1.0]))["ball.h"][-1]

    with pytest.raises(ModelError, match="second derivatives through events"):
        jax.hessian(height)(0.8)
    with pytest.raises(ModelError, match="second derivatives through events"):

        def forward(e):
            changed = ball.with_parameters({"ball.e": e})
            return simulate(changed, 1.0, ts=jnp.array([1.0]), adjoint=diffrax.ForwardMode())["ball.h"][-1]

        jax.jacfwd(jax.jacfwd(forward))(0.8)


def test_a_step_by_its_time():
    """x' = u − x with a step of u at t₀: x(2) = 1 − e^{t₀ − 2}. The derivative by t₀ was zero."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, lag = signal.Step(ev, "step", start_time=0.5), signal.FirstOrder(ev, "lag")
    diagram.add(source, lag)
    diagram.connect(source.y, lag.u)
    system = AcausalCompiler(ev, diagram)()

    def last(t0):
        changed = system.with_parameters({"step.start_time": t0})
        return simulate(changed, 2.0, ts=jnp.array([2.0]), **TIGHT)["lag.y"][-1]

    assert float(last(0.5)) == pytest.approx(1 - np.exp(-1.5), rel=1e-9)
    assert float(jax.grad(last)(0.5)) == pytest.approx(-np.exp(-1.5), rel=1e-8)
    assert float(last(-1.0)) == pytest.approx(1 - np.exp(-2.0), rel=1e-9)  # it is over when the run begins
    # Outside of a run, the relation is as its sides say.
    assert float(system.observe("step.y", 0.4, jnp.zeros(1))) == 0.0
    assert float(system.observe("step.y", 0.6, jnp.zeros(1))) == 1.0
    assert system.parameters.names == [
        "step.height",
        "step.offset",
        "step.start_time",
        "lag.k",
        "lag.initial_y",
        "lag.T",
    ]


@checks(
    {signal.Pulse: ("integral of the pulses, and its derivatives by their times", "value", "slopes")},
    origin="rounding of a sum over edges",
)
def test_a_pulse_by_its_times():
    """The integral of pulses of width w·T from t₀ on, two of them whole at t = 0.75 and the third up to there:
    2·(2·w·T + t − t₀ − 2T)."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source = signal.Pulse(ev, "pulse", height=2.0, period=0.3, width=0.4, start_time=0.1)
    total = signal.Integrator(ev, "total")
    diagram.add(source, total)
    diagram.connect(source.y, total.u)
    system = AcausalCompiler(ev, diagram)()

    def last(p):
        changed = system.with_parameters({"pulse.period": p[0], "pulse.width": p[1], "pulse.start_time": p[2]})
        return simulate(changed, 0.75, ts=jnp.array([0.75]), **TIGHT)["total.y"][-1]

    value, slopes = jax.value_and_grad(last)(jnp.array([0.3, 0.4, 0.1]))
    measured("value", value, 2 * (0.24 + 0.05), 1e-12 * 0.58)
    measured("slopes", slopes, [2 * (2 * 0.4 - 2), 2 * 2 * 0.3, -2.0], 1e-12 * 1.2)
    assert system.discretes == [] and len(simulate(system, 0.75).events) == 0
