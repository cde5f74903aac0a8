"""Models with events from end to end: times, states and gradients against closed forms.

Reference values are closed forms evaluated in extended precision: a ball is a chain of parabolas, a thermostat and a
sampled loop are chains of exponentials. Runs are made at rtol = atol = 1e-10; what is integrated is polynomial or
smooth, so that errors are a few tolerances. tests/kernels/test_hybrid_runs.py shows what events do; here it is that
components become such problems.
"""

import functools
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from component_references import checks, measured
from hybrid_models import Ball, Commensurate, Doubling, Gear, SampledPI, Stick, Thermostat, Twice, compiled
from hybrid_references import BOUNCES, HEIGHT, SIXTH_BY_E, SLOPES, commensurate_counts
from problems import compiled as joined
from sympy import Eq

from jaxonomy_dae import (
    AcausalSystem,
    Component,
    EqnEnv,
    ModelError,
    SimulationError,
    der,
    pre,
    reinit,
    simulate,
)  # fmt: skip
from jaxonomy_dae.library import signal
from jaxonomy_dae.solvers import BDF, Rodas5P

TIGHT = dict(rtol=1e-10, atol=1e-10)

# --- a ball ----------------------------------------------------------------------------------------------------------

EVENLY = jnp.linspace(0.0, 3.0, 31)
ROOM = dict(max_events=20, **TIGHT)
SPEED = 9.81 * BOUNCES[0]


@functools.cache
def ball():
    """It may be told to end after so many bounces."""
    return compiled(Ball, "ball", stop=1000)


def thrown(**parameters):
    return ball().with_parameters({f"ball.{name}": value for name, value in parameters.items()})


def of_a_ball(p, weights, **options):
    """A weighted sum of the height at the end, the sixth event's time and the speed before the first one; and the
    three."""
    changed = thrown(e=p[0], g=p[1], h0=p[2])
    solution = simulate(changed, 3.0, ts=EVENLY, save_events=True, throw=False, **ROOM, **options)
    events = solution.events
    found = jnp.stack([solution["ball.h"][-1], events.ts[5], events.before["ball.v"][0]])
    return weights @ found, found


AT = jnp.array([0.8, 9.81, 1.0])
LOOSE = {"bdf": 1e-5}  # BDF has order five and steps that add up their errors


def assert_right(found, by, solver=""):
    exact = LOOSE.get(solver, 1e-9)
    np.testing.assert_allclose(found, [HEIGHT, BOUNCES[-1], -SPEED], rtol=0, atol=exact)
    np.testing.assert_allclose(by[0], SLOPES, rtol=LOOSE.get(solver, 1e-8), atol=exact)
    np.testing.assert_allclose(by[1][0], SIXTH_BY_E, rtol=LOOSE.get(solver, 1e-8))
    # v = −√(2·g·h0)
    np.testing.assert_allclose(by[2][2], -np.sqrt(9.81 / 2), rtol=LOOSE.get(solver, 1e-9))


@pytest.mark.slow
@pytest.mark.long("the gradient of a model with events, as users get it by default")
def test_a_ball():
    gradient = jax.jit(jax.grad(of_a_ball, has_aux=True))
    by, found = zip(*(gradient(AT, weights) for weights in jnp.eye(3)), strict=True)
    assert_right(found[0], np.stack(by))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, solver, adjoint",
    [
        ("rodas5p", Rodas5P(), None),
        ("bdf", BDF(), None),
        ("kvaerno5", diffrax.Kvaerno5(), diffrax.ForwardMode()),
        ("dopri8", diffrax.Dopri8(), diffrax.RecursiveCheckpointAdjoint()),
    ],
)
def test_a_ball_by_other_solvers(name, solver, adjoint):
    """Backwards through the loops of BDF only StoredAdjoint goes."""
    by = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.jacrev

    def run(p):
        _, found = of_a_ball(p, jnp.zeros(3), solver=solver, adjoint=adjoint)
        return found, found

    slopes, found = jax.jit(by(run, has_aux=True))(AT)
    assert_right(found, slopes, name)


@pytest.fixture(scope="module")
def bounced():
    return simulate(ball(), 3.0, ts=EVENLY, **ROOM)


@pytest.mark.slow
def test_what_a_solution_says_of_events(bounced):
    events = bounced.events
    np.testing.assert_allclose(events.ts[:6], BOUNCES, rtol=0, atol=1e-10)
    assert np.isinf(events.ts[6:]).all()
    assert len(events) == 6 and set(events.names) == {"ball: when(h <= 0)"}
    assert events.terminated is None
    np.testing.assert_array_equal(bounced["ball.n"], np.searchsorted(BOUNCES, EVENLY))
    assert "ball.n" in bounced and bounced.to_dict()["ball.n"].shape == (31,)
    assert "when(h <= 0)" in repr(events)


def test_events_outside_of_the_saved_times_are_not_drawn(bounced):
    plt = pytest.importorskip("matplotlib.pyplot")
    first, last = 3, 9  # between two of six bounces
    rows = eqx.tree_at(
        lambda s: (s.ts, s.states, s.discrete),
        bounced,
        (bounced.ts[first:last], bounced.states[first:last], bounced.discrete[first:last]),
    )
    inside = [float(t) for t in BOUNCES if EVENLY[first] <= t <= EVENLY[last - 1]]
    assert 0 < len(inside) < 6
    (marks,) = rows.plot("ball.h").collections
    np.testing.assert_allclose([at[0, 0] for at in marks.get_segments()], inside, rtol=0, atol=1e-10)
    plt.close("all")


def test_both_sides_of_an_event(bounced):
    events = bounced.events
    np.testing.assert_allclose(events.before["ball.v"][0], -SPEED, rtol=1e-9)
    np.testing.assert_allclose(events.after["ball.v"][0], 0.8 * SPEED, rtol=1e-9)
    np.testing.assert_allclose(events.transversality[0], SPEED, rtol=1e-9)
    assert events.after["ball.n"][0] == 1 and np.isnan(events.before["ball.v"][6])
    with pytest.raises(ModelError, match="save_events=True"):
        jax.eval_shape(lambda h: simulate(ball(), 1.0, ts=h[None]).events.before["ball.v"][0], jnp.array(0.9))


def test_saved_at_an_event_is_what_comes_after(bounced):
    first = float(bounced.events.ts[0])
    ts = jnp.sort(jnp.concatenate([jnp.array([first - 1e-9, first]), jnp.linspace(0.0, 1.0, 29)]))
    solution = simulate(ball(), 1.0, ts=ts, **ROOM)
    k = int(jnp.searchsorted(ts, first))
    np.testing.assert_allclose(solution["ball.v"][k - 1 : k + 1], [-SPEED, 0.8 * SPEED], rtol=1e-7)


def test_a_run_that_ends():
    solution = simulate(thrown(stop=3.0), 3.0, ts=EVENLY, **ROOM)
    assert solution.events.terminated == "bounced enough"
    np.testing.assert_array_equal(np.isfinite(solution["ball.h"]), EVENLY < BOUNCES[2])
    np.testing.assert_allclose(solution.events.ts[2:4], [BOUNCES[2]] * 2, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("flat", ["h**3", "h**3 + 1e-9*h"])
def test_a_guard_that_meets_zero_flatly(flat):
    """The ball with its floor written so: times, and the height by the restitution, in closed form."""

    class FlatBall(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            e = self.parameter("e", 0.8)
            h, v = self.variable("h", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
            self.add_equations(Eq(der(h), v), Eq(der(v), -9.81))
            self.when(sympy.sympify(flat, {"h": h}) <= 0, reinit(v, -e * pre(v)), reinit(h, 0))

    system, falling = joined(FlatBall(EqnEnv(), "ball")), np.sqrt(2 / 9.81)

    def run(e):
        return simulate(system.with_parameters({"ball.e": e}), 2.0, ts=jnp.array([2.0]), **ROOM)

    found = run(0.8)
    np.testing.assert_allclose(found.events.ts[:3], falling * np.array([1.0, 2.6, 3.88]), rtol=1e-11)
    # After three bounces: h = e³·w·s − 9.81/2·s², w = 9.81·falling, s = 2 − falling·(1 + 2·e + 2·e²).
    e, w = 0.8, 9.81 * falling
    s, by_e = 2 - falling * (1 + 2 * e + 2 * e**2), -falling * (2 + 4 * e)
    np.testing.assert_allclose(found["ball.h"][0], e**3 * w * s - 9.81 / 2 * s**2, rtol=1e-10)
    slope = jax.grad(lambda e: run(e)["ball.h"][0])(0.8)
    np.testing.assert_allclose(slope, 3 * e**2 * w * s + (e**3 * w - 9.81 * s) * by_e, rtol=1e-9)


def test_accumulation_is_named():
    """The bounces accumulate at 4.06371276887158."""
    with pytest.raises(SimulationError, match=r"ball: when\(h <= 0\).*max_events") as raised:
        simulate(ball(), 5.0, ts=EVENLY, **ROOM)
    assert "4.06" in str(raised.value)


def test_steps_that_the_user_prescribes():
    with pytest.raises(ModelError, match="StepTo"):
        simulate(ball(), 1.0, stepsize_controller=diffrax.StepTo(ts=jnp.linspace(0.0, 1.0, 11)))


@pytest.mark.slow
def test_too_many_events_inside_jit():
    def run(e):
        return simulate(thrown(e=e), 5.0, ts=EVENLY, throw=True, **ROOM)["ball.h"]

    with pytest.raises(Exception, match="more than max_events=20 events"):
        jax.block_until_ready(jax.jit(run)(0.8))


@pytest.mark.slow
def test_every_step():
    """Also those that end at events."""
    steps = simulate(ball(), 1.0, **ROOM)
    assert steps["ball.h"].min() > -1e-12
    assert np.min(np.abs(steps.ts - BOUNCES[0])) < 1e-10


@pytest.mark.slow
def test_second_derivatives_are_refused():
    """The map at an event has the flow's first derivative only."""

    def height(e, adjoint=None):
        return simulate(thrown(e=e), 1.0, ts=EVENLY / 3, adjoint=adjoint)["ball.h"][-1]

    for twice in (jax.hessian(height), jax.jacfwd(jax.jacfwd(lambda e: height(e, diffrax.ForwardMode())))):
        with pytest.raises(ModelError, match="second derivatives through events"):
            jax.eval_shape(twice, 0.8)


@pytest.mark.slow
def test_memory_of_gradients_in_a_batch():
    """The log of events was part of each of 385 kept states: 1.65 MB for a ball. It is kept once, beside a state of 16
    numbers, in few rows where there are many members."""

    room, members = 1000, 1000

    def height(e):
        return simulate(thrown(e=e), 3.0, ts=EVENLY, max_events=room)["ball.h"][-1]

    program = jax.make_jaxpr(jax.vmap(jax.grad(height)))(jnp.full(members, 0.8))
    largest = max(sum(v.aval.size * v.aval.dtype.itemsize for v in loop.outvars) for loop in loops(program))
    assert largest / members <= 16e3 + room * 3 * 8


def loops(program):
    """The while loops of a program, those inside of others included."""
    for equation in program.eqns:
        if equation.primitive.name == "while":
            yield equation
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")):
            yield from loops(leaf) if hasattr(leaf, "eqns") else ()


# --- many parts, one run ---------------------------------------------------------------------------------------------


class Plant(NamedTuple):
    """Models with events that know nothing of each other, in one system: it, what is changed, and what is looked at."""

    system: AcausalSystem
    values: dict[str, float]
    names: list[str]


MIDDLES = (np.arange(25) + 0.5) * 0.1
TIMES = np.unique([
    *MIDDLES, *np.linspace(0.0, 20.0, 41), 0.4, 0.75, 1.0, 1.2, 1.3, 1.5, 1.95, 2.0, 2.2, 2.5, 2.55, 3.0,
])  # fmt: skip
RELAY, LEVEL = 0.5, 0.25  # s of the lag, half the width of the relay


@functools.cache
def few() -> Plant:
    ev = EqnEnv()
    step, lag = signal.Step(ev, "step", start_time=0.5), signal.FirstOrder(ev, "lag")
    system = joined(
        Thermostat(ev, "room"), SampledPI(ev, "loop"), Commensurate(ev, "clocks"), step, lag, connect=[(step.y, lag.u)]
    )
    values = {"room.P": 10.0, "loop.Kp": 2.0, "loop.Ki": 3.0, "loop.T": 0.1, "step.start_time": 0.5}
    names = ["room.T", "room.q", "room.on", "loop.x", "loop.u", "lag.y", "clocks.a", "clocks.b", "clocks.slow"]
    return Plant(system, values, names)


@functools.cache
def many() -> Plant:
    ev = EqnEnv()
    pulse = signal.Pulse(ev, "pulse", height=2.0, period=0.3, width=0.4, start_time=0.1)
    total, ramp = signal.Integrator(ev, "total"), signal.Ramp(ev, "ramp", 100.0, 100.0)
    # The second one of two holds in a row is added first.
    second, first = signal.SampleHold(ev, "h2", 0.1), signal.SampleHold(ev, "h1", 0.1)
    rings, back = signal.FirstOrder(ev, "rings", 1.0, RELAY), signal.Gain(ev, "back", -1.0)
    relay = signal.Hysteresis(ev, "relay", -LEVEL, LEVEL, -1.0, 1.0, initially_on=True)
    system = joined(
        Stick(ev, "block"), Gear(ev, "gear"), Twice(ev, "twice"), Doubling(ev, "double"), pulse, total, ramp, second,
        first, rings, back, relay,
        connect=[
            (pulse.y, total.u), (ramp.y, first.u), (first.y, second.u), (rings.y, back.u), (back.y, relay.u),
            (relay.y, rings.u),
        ],
    )  # fmt: skip
    values = {
        "block.mu": 3.0, "pulse.period": 0.3, "pulse.width": 0.4, "pulse.start_time": 0.1, "double.a": 1.5
    }  # fmt: skip
    names = [
        "block.x", "block.v", "block.mode", "total.y", "gear.child.n", "gear.other.n", "twice.k", "twice.x", "double.d",
        "double.y", "h2.y",
    ]  # fmt: skip
    return Plant(system, values, names)


@functools.cache
def compiled_run(plant):
    system, values, names = plant()

    def run(p):
        changed = system.with_parameters(dict(zip(values, p, strict=True)))
        solution = simulate(
            changed, 20.0, ts=TIMES, solver=diffrax.Tsit5(), adjoint=diffrax.ForwardMode(), throw=False,
            max_events=500, max_steps=20_000, **TIGHT,
        )  # fmt: skip
        found = jnp.stack([solution[name] for name in names])
        return found, (found, solution.events.ts, solution.events.which)

    return jax.jit(jax.jacfwd(run, has_aux=True))


@functools.cache
def ran(plant, **changed):
    """(values at TIMES by name, their derivatives by parameters by name, (time, name) of events)."""
    system, values, names = plant()
    given = values | {name.replace("__", "."): value for name, value in changed.items()}
    result = compiled_run(plant)(jnp.array([*given.values()]))
    slopes, (rows, ts, which) = jax.tree.map(np.asarray, result)
    all_names = system.plan.events.names
    happened = [(t, all_names[int(k)]) for t, k in zip(ts, which, strict=True) if k >= 0]
    by = {name: dict(zip(values, row.T, strict=True)) for name, row in zip(names, slopes, strict=True)}
    return dict(zip(names, rows, strict=True)), by, happened


def at(*times):
    """Where in TIMES they are."""
    return [int(np.argmin(np.abs(TIMES - t))) for t in times]


def events_of(plant, part):
    return np.array([t for t, name in ran(plant)[2] if name.startswith(part)])


@pytest.mark.slow
@pytest.mark.long("four models in one program")
def test_a_thermostat():
    values, by, _ = ran(few)
    (end,) = at(20.0)
    assert len(events_of(few, "room: ")) == 35
    assert values["room.T"][end] == pytest.approx(50.7088714113363, abs=1e-8)
    # Thirty-five switches add their errors up.
    assert by["room.T"]["room.P"][end] == pytest.approx(-3.51092853184108, rel=1e-8)
    np.testing.assert_array_equal(values["room.q"], 10.0 * values["room.on"])
    reached = TIMES > events_of(few, "room: ")[0]
    assert (values["room.T"][reached] > 48.9).all() and (values["room.T"] < 51.1).all()


@pytest.mark.slow
def test_a_sampled_controller():
    values, by, _ = ran(few)
    k, m = at(3.0, 2.55)
    assert values["loop.x"][k] == pytest.approx(1.01155947251977, abs=1e-9)
    found = [by["loop.x"][name][k] for name in ("loop.Kp", "loop.Ki")]
    np.testing.assert_allclose(found, [-0.00718258236586836, -0.00910828614834083], rtol=1e-8)
    assert by["loop.x"]["loop.T"][m] == pytest.approx(0.0155033203623, rel=1e-6)
    first, middle, later = values["loop.u"][at(0.0, 0.05, 0.15)]
    assert first == middle == 2.0 != later  # it samples at the start
    assert len(events_of(few, "loop: ")) == 0


@pytest.mark.slow
def test_it_sticks_and_slides():
    """m v' = push − μ from where 4(1 − s²) = 3, s = t − 1, on: s₀ = −1/2, and 2v = s − 4s³/3 + 1/3 is zero again where
    4s³ − 3s − 1 = (s − 1)(2s + 1)² vanishes: at s = 1."""
    values, by, _ = ran(many)
    k = at(0.4, 1.0, 2.2)
    np.testing.assert_allclose(events_of(many, "block: ")[:2], [0.5, 2.0], atol=1e-9)
    np.testing.assert_allclose(values["block.v"][k], [0.0, (1 / 3) / 2, 0.0], atol=1e-9)
    np.testing.assert_array_equal(values["block.mode"][k], [0.0, 1.0, 0.0])
    # x = ∫v over [s₀, s₁]; dx/dμ = ∫ dv/dμ with 2 dv/dμ = −(s − s₀): −(3/2)²/4.
    assert by["block.x"]["block.mu"][k[-1]] == pytest.approx(-((3 / 2) ** 2) / 4, rel=1e-8)


@pytest.mark.slow
def test_a_step_by_its_time():
    """x' = u − x with a step of u at t₀: x(2) = 1 − e^{t₀ − 2}. The derivative by t₀ was zero."""
    values, by, _ = ran(few)
    (k,) = at(2.0)
    assert values["lag.y"][k] == pytest.approx(1 - np.exp(-1.5), rel=1e-9)
    assert by["lag.y"]["step.start_time"][k] == pytest.approx(-np.exp(-1.5), rel=1e-8)
    over = ran(few, step__start_time=-1.0)[0]  # it is over when the run begins
    assert over["lag.y"][k] == pytest.approx(1 - np.exp(-2.0), rel=1e-9)
    # Outside of a run, the relation is as its sides say.
    observed = jax.jit(lambda t: few().system.observe("step.y", t, jnp.zeros(len(few().system.states))))
    assert (observed(0.4), observed(0.6)) == (0.0, 1.0)
    own = [name for name in few().system.parameters.names if name.startswith(("step.", "lag."))]
    assert own == ["step.height", "step.start_time", "step.offset", "lag.k", "lag.initial_y", "lag.T"]


@pytest.mark.slow
@checks(
    {signal.Pulse: ("integral of the pulses, and its derivatives by their times", "value", "slopes")},
    origin="rounding of a sum over edges",
)
def test_a_pulse_by_its_times():
    """The integral of pulses of width w·T from t₀ on, two of them whole at t = 0.75 and the third up to there:
    2·(2·w·T + t − t₀ − 2T)."""
    values, by, _ = ran(many)
    (k,) = at(0.75)
    slopes = [by["total.y"][f"pulse.{name}"][k] for name in ("period", "width", "start_time")]
    measured("value", values["total.y"][k], 2 * (0.24 + 0.05), 1e-12 * 0.58)
    measured("slopes", slopes, [2 * (2 * 0.4 - 2), 2 * 2 * 0.3, -2.0], 1e-12 * 1.2)
    assert not [name for name in many().system.discretes if "pulse" in name] and len(events_of(many, "pulse")) == 0


@pytest.mark.slow
def test_clocks_of_commensurate_periods():
    """What ticks at one instant reads new values, or with pre the ones before the instant, in whatever order it was
    declared."""
    values, _, _ = ran(few)
    found = np.stack([values[f"clocks.{name}"][at(*MIDDLES)] for name in ("a", "b", "slow")], axis=1)
    np.testing.assert_array_equal(found, commensurate_counts(len(MIDDLES)))


@pytest.mark.slow
def test_a_discrete_variable_as_the_parameter_of_a_child():
    """The child counts at the rate 2, from 1.25 on at 6; a second instance at its own."""
    values, _, _ = ran(many)
    sixth = 1.25 + 0.5 / 6 + np.arange(4) / 6
    found = events_of(many, "gear")
    np.testing.assert_allclose(found[found < 1.95], np.sort([0.5, 1.0, 1.0, 1.25, *sixth]), atol=1e-12)
    k = at(1.2, 1.3, 1.95)
    np.testing.assert_array_equal(values["gear.child.n"][k], [4, 4, 28])
    np.testing.assert_array_equal(values["gear.other.n"][k], [1, 1, 1])


@pytest.mark.slow
def test_two_events_with_one_condition_both_happen():
    """The reset of the first one kept the second one from happening."""
    values, _, _ = ran(many)
    k = at(0.5, 1.5, 2.5)
    np.testing.assert_array_equal(values["twice.k"][k], [0, 1, 2])
    np.testing.assert_allclose(values["twice.x"][k], 0.5, rtol=1e-9)


@pytest.mark.slow
def test_a_discrete_variable_whose_start_is_an_expression():
    """It begins at 2·a, is doubled at t = 1 and t = 2, and y is its integral: 2·a·(1 + 2 + 4/2) at t = 2.5. The start
    must not be computed again after events."""
    values, by, _ = ran(many)
    np.testing.assert_allclose(values["double.d"][at(0.5, 1.5, 2.5)], [3, 6, 12])
    (k,) = at(2.5)
    np.testing.assert_allclose([values["double.y"][k], by["double.y"]["double.a"][k]], [15, 10], rtol=1e-10)


@pytest.mark.slow
def test_sampled_blocks_do_not_depend_on_the_order_of_adding():
    """Two holds in a row are transparent to each other at an instant: the second one saw the first one's value of the
    sample before, if it had been added first."""
    values, _, _ = ran(many)
    np.testing.assert_allclose(values["h2.y"][at(0.05, 0.15, 0.25, 0.35)], [0.0, 0.1, 0.2, 0.3], atol=1e-12)


@pytest.mark.slow
def test_a_relay_and_a_lag():
    """τ·y' = u − y with u = ±1 from a relay of −y at ±b: it rings with a period of 2·τ·ln((1 + b)/(1 − b))."""
    found = events_of(many, "relay")
    first, half = RELAY * np.log(1 / (1 - LEVEL)), RELAY * np.log((1 + LEVEL) / (1 - LEVEL))
    found = found[found < 3.0]
    np.testing.assert_allclose(found, first + half * np.arange(len(found)), atol=1e-8)
    assert len(found) == 1 + int((3.0 - first) / half)
