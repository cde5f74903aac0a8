"""Runs of problems with events written by hand: times, states and gradients against closed forms.

One compiled gradient runs them all; slow tests run them as one batch. What is integrated is polynomial or smooth, at
rtol = atol = 1e-10: values are right to a few tolerances.
"""

import dataclasses
import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from affine_events import CLOCKS, FACTS, GUARDS, MAX_EVENTS, RELATION, STATES, Affine, Event, Relation, affine, run
from hybrid_references import (
    BOUNCES,
    HEAVY,
    HEIGHT,
    LIGHT,
    SIXTH_BY_E,
    SLOPES,
    G,
    commensurate_counts,
    falling_balls,
)

from jaxonomy_dae.solve.events.control import ENDED
from jaxonomy_dae.solve.events.side import RESTS
from jaxonomy_dae.solve.events.solver import NOT_FINITE, STUCK, TOO_MANY
from jaxonomy_dae.solve.events.start import start
from jaxonomy_dae.solvers import StoredAdjoint
from jaxonomy_dae.write.events import NO_FLAG, EventFlag

SAVED = 60
OKAY = diffrax.RESULTS.successful._value

FIRST = BOUNCES[0]


def ball(e=0.8, **more):
    bounce = Event({"v": {"v": -e}, "h": {}, "n": {"pre n": 1.0, "1": 1.0}}, {"h": 1.0}, **more)
    return affine({"h": {"v": 1.0}, "v": {"1": -G}}, [bounce], at={"h": 1.0}, discrete={"n": 0.0})


def ball_that_stops():
    bounce = Event({"v": {"v": -0.8}, "h": {}, "n": {"pre n": 1.0, "1": 1.0}}, {"h": 1.0})
    enough = Event({}, {"1": 2.5, "n": -1.0}, ends=True)
    return affine({"h": {"v": 1.0}, "v": {"1": -G}}, [bounce, enough], at={"h": 1.0}, discrete={"n": 0.0})


def thermostat():
    """T' = 10·on − (T − 20)/10, on below 49 and off above 51."""
    events = [Event({"on": {"1": 1.0}}, {"T": 1.0, "1": -49.0}), Event({"on": {}}, {"T": -1.0, "1": 51.0})]
    rates = {"T": {"on": 10.0, "T": -0.1, "1": 2.0}}
    return affine(rates, events, at={"T": 20.0}, discrete={"on": 1.0})


def sampled_loop():
    """x' = u − x; every 0.1 s u = 2·(1 − x) + I and then I grows by 0.3·(1 − x)."""
    tick = {"u": {"1": 2.0, "x": -2.0, "pre I": 1.0}, "I": {"pre I": 1.0, "1": 0.3, "x": -0.3}}
    clock = Event(tick, clock=(0.1, 0.0))
    return affine({"x": {"x": -1.0, "u": 1.0}}, [clock], discrete={"u": 0.0, "I": 0.0})


def balls_on_balls(e=0.9):
    total = {"v0": HEAVY, "v1": LIGHT}
    weight = HEAVY + LIGHT

    def speed(sign, share):
        # (total + sign·share·e·(v0 − v1))/weight
        return {n: (total[n] + sign * share * e * (1 if n == "v0" else -1)) / weight for n in total}

    events = [
        Event({"v0": {"v0": -e}, "h0": {}}, {"h0": 1.0}),
        Event({"v0": speed(-1, LIGHT), "v1": speed(1, HEAVY)}, {"h1": 1.0, "h0": -1.0}),
    ]
    rates = {"h0": {"v0": 1.0}, "v0": {"1": -G}, "h1": {"v1": 1.0}, "v1": {"1": -G}}
    return affine(rates, events, at={"h0": 1.0, "h1": 1.5})


def commensurate_clocks():
    """0.1, 0.2 and 0.3 s; the second one reads the first one's new value, the third one the old one and the second
    one's new value."""
    events = [
        Event({"a": {"pre a": 1.0, "1": 1.0}}, clock=(0.1, 0.0)),
        Event({"b": {"a": 100.0, "pre b": 1.0}}, clock=(0.2, 0.0)),
        Event({"c": {"pre c": 1.0, "pre a": 1000.0, "b": 1.0}}, clock=(0.3, 0.0)),
    ]
    return affine({"x": {"1": 1.0}}, events, discrete={"a": 0.0, "b": 0.0, "c": 0.0})


def dip(depth):
    """x = (t − 1)² − depth is below zero for 2·√depth s only, and steps are as long as the run."""
    return affine(
        {"x": {"v": 1.0}, "v": {"1": 2.0}}, [Event({"n": {"pre n": 1.0, "1": 1.0}}, {"x": 1.0})],
        at={"x": 1 - depth, "v": -2.0}, discrete={"n": 0.0},
    )  # fmt: skip


def fast_guard(rate):
    """sin(ωt + 0.1) rises through zero; the state needs no steps."""
    counted = Event({"n": {"pre n": 1.0, "1": 1.0}}, {}, wave=(-1.0, rate, 0.1))
    return affine({"x": {"1": 1.0}}, [counted], discrete={"n": 0.0})


def two_of_one_condition():
    """The reset of the first one kept the second one from happening."""
    guard = {"x": -1.0, "1": 1.0}
    events = [Event({"x": {}}, guard), Event({"k": {"pre k": 1.0, "1": 1.0}}, guard)]
    return affine({"x": {"1": 1.0}}, events, discrete={"k": 0.0})


def growing_rate():
    """x' = u, and u grows by one every half second, from 0.5 on."""
    return affine({"x": {"u": 1.0}}, [Event({"u": {"pre u": 1.0, "1": 1.0}}, clock=(0.5, 0.5))], discrete={"u": 0.0})


def ending_clock():
    """A clock at 0.7 s sets a flag, which ends the run."""
    events = [Event({"flag": {"1": 1.0}}, clock=(1.0, 0.7)), Event({}, {"1": 0.5, "flag": -1.0}, ends=True)]
    return affine({"x": {"1": 1.0}}, events, discrete={"flag": 0.0})


def not_finite():
    return affine({"x": {"1": 1.0}}, [Event({"d": {"1": np.nan}}, {"x": -1.0, "1": 1.0})], discrete={"d": 0.0})


def held_ball(rate):
    """x'' = −u, u = 1 above zero and −1 below: the acceleration turns back and forth, x is made of parabolas."""
    turning = Relation({"u": {"1": -1.0}}, {"u": {"1": 1.0}}, {"x": 1.0})
    return affine({"x": {"v": 1.0}, "v": {"u": -1.0}}, [], at={"v": rate}, discrete={"u": 0.0}, relation=turning)


def led_back():
    """x' = 1/2 − u, u = 1 above zero and 0 below: on both sides it is led back to zero, from t = 2 on."""
    turning = Relation({"u": {}}, {"u": {"1": 1.0}}, {"x": 1.0})
    return affine({"x": {"u": -1.0, "1": 0.5}}, [], at={"x": 1.0}, discrete={"u": 0.0}, relation=turning)


def led_on():
    """x' = −2 + u, u = 1 above zero and 0 below: slope −1 up to t = 1, −2 from there."""
    turning = Relation({"u": {}}, {"u": {"1": 1.0}}, {"x": 1.0})
    return affine({"x": {"u": 1.0, "1": -2.0}}, [], at={"x": 1.0}, discrete={"u": 0.0}, relation=turning)


def dropped(e, floor=0.0):
    """A ball that is let go at 1 above a floor that moves at a constant speed, and is reset to it."""
    bounce = Event({"v": {"v": -e, "1": (1 + e) * floor}, "n": {"pre n": 1.0, "1": 1.0}}, {"x": 1.0, "floor": -1.0})
    rates = {"x": {"v": 1.0}, "v": {"1": -G}, "floor": {"1": floor}}
    return affine(rates, [bounce], at={"x": 1.0}, discrete={"n": 0.0})


EVENLY = np.linspace(0.0, 3.0, SAVED)
MIDDLES = (np.arange(SAVED) + 0.5) * 0.1
DROPS, FLOORS = (0.0, 0.1, 0.5, 0.8), (0.0, 0.7)
DEPTHS = (1e-2, 1e-3, 1e-6)
RATES = (30.0, 41.5, 60.0)
AT_AN_EVENT = np.sort(np.concatenate([[FIRST - 1e-9, FIRST], np.linspace(0.0, 1.0, SAVED - 2)]))
# name: (problem, end, saved times, weights of the last x, weight of the sixth event's time)
PROBLEMS = {
    "ball": (ball(), 3.0, EVENLY, [1.0, 0.0], 0.0),
    "sixth bounce": (ball(), 3.0, EVENLY, [0.0, 0.0], 1.0),
    "at an event": (ball(), 1.0, AT_AN_EVENT, [1.0, 0.0], 0.0),
    "too many": (ball(0.9), 9.0, EVENLY * 3, [1.0, 0.0], 0.0),
    "stops": (ball_that_stops(), 3.0, EVENLY, [1.0, 0.0], 0.0),
    "thermostat": (thermostat(), 20.0, EVENLY * 20 / 3, [1.0, 0.0], 0.0),
    "sampled loop": (sampled_loop(), 3.0, EVENLY, [1.0, 0.0], 0.0),
    "its period": (sampled_loop(), 2.55, EVENLY * 2.55 / 3, [1.0, 0.0], 0.0),
    "balls on balls": (balls_on_balls(), 2.0, EVENLY * 2 / 3, [0.0, 0.0, 1.0], 0.0),
    "clocks": (commensurate_clocks(), 6.0, MIDDLES, [1.0, 0.0], 0.0),
    **{f"dip {d:g}": (dip(d), 2.0, EVENLY * 2 / 3, [1.0, 0.0], 0.0) for d in DEPTHS},
    **{f"guard {w:g}": (fast_guard(w), 5.0, EVENLY * 5 / 3, [1.0, 0.0], 0.0) for w in RATES},
    "one condition": (two_of_one_condition(), 2.5, EVENLY * 2.5 / 3, [1.0, 0.0], 0.0),
    "growing rate": (growing_rate(), 2.0, EVENLY * 2 / 3, [1.0, 0.0], 0.0),
    "between ticks": (growing_rate(), 1.75, EVENLY * 1.75 / 3, [1.0, 0.0], 0.0),
    "ending clock": (ending_clock(), 2.0, EVENLY * 2 / 3, [1.0, 0.0], 0.0),
    "not finite": (not_finite(), 2.0, EVENLY * 2 / 3, [1.0, 0.0], 0.0),
    "turning": (held_ball(1.0), 9.0, EVENLY * 3, [1.0, 0.0], 0.0),
    "led back": (led_back(), 3.0, EVENLY, [1.0, 0.0], 0.0),
    "led on": (led_on(), 3.0, EVENLY, [1.0, 0.0], 0.0),
    **{f"dropped {e:g} {w:g}": (dropped(e, w), 9.0, EVENLY * 3, [1.0, 0.0], 0.0) for e in DROPS for w in FLOORS},
}


def aim(numbers, t1, ts, weights, weight, solver, adjoint):
    """A weighted sum of what a run gives, and all that it gives."""
    ran = run(numbers, t1, ts, solver, adjoint)
    sixth = jnp.where(jnp.isfinite(ran.times[5]), ran.times[5], 0.0)
    return weights @ ran.x[-1] + weight * sixth, ran


@functools.cache
def stacked():
    rows = [
        (numbers, t1, ts, np.pad(np.array(weights), (0, STATES - len(weights))), weight)
        for (numbers, _), t1, ts, weights, weight in PROBLEMS.values()
    ]
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf, float) for leaf in leaves]), *rows)


def value_and_gradient(numbers, t1, ts, weights, weight):
    def f(numbers, ts):
        return aim(numbers, t1, ts, weights, weight, diffrax.Tsit5(), StoredAdjoint())

    return jax.value_and_grad(f, argnums=(0, 1), has_aux=True)(numbers, ts)


@functools.cache
def compiled_gradient():
    return jax.jit(value_and_gradient)


@functools.cache
def found(name):
    """(run, gradient by the numbers, gradient by saved times) of a problem."""
    (_, ran), by = compiled_gradient()(*member(stacked(), list(PROBLEMS).index(name)))
    return jax.tree.map(np.asarray, (ran, *by))


def member(tree, k):
    return jax.tree.map(lambda leaf: leaf[k], tree)


def slope(name, event, target, factor):
    """By the number that an event writes."""
    (numbers, names), *_ = PROBLEMS[name]
    return found(name)[1].writes[numbers.place(names, event, target, factor)]


@eqx.filter_jit
def begun(numbers):
    """The state after the initial time, where all conditions happen that hold there and are not undone."""
    flags = (NO_FLAG,) * CLOCKS + (EventFlag.AT_START | EventFlag.REVOCABLE,) * RELATION
    facts = dataclasses.replace(FACTS, flags=flags + (NO_FLAG,) * (GUARDS - RELATION))
    problem = Affine(numbers, 1e-14, facts)
    return start(problem, jnp.zeros(()), numbers.x, numbers.q, None, 0, False)


def test_what_holds_at_the_start_happens_unless_undone():
    """Three conditions hold at the start. The first event leaves the second one's true, though its guard does not fall,
    and makes the third one's false: of two diodes of a bridge, one did not conduct."""
    events = [Event({"a": {"1": 1.0}}, {"1": -3.0}), Event({"b": {"1": 1.0}}, {"1": -3.0, "a": -3.0}),
              Event({"c": {"1": 1.0}}, {"1": -3.0, "a": 6.0})]  # fmt: skip
    numbers, _ = affine({"x": {}}, events, discrete={"a": 0.0, "b": 0.0, "c": 0.0})
    state = begun(jax.tree.map(jnp.asarray, numbers))
    assert state.q[:3].tolist() == [1.0, 1.0, 0.0] and state.stuck == -1


def test_what_is_undone_at_zero_may_happen_later():
    """x = 0 would fall, but the first event stops it: the diode of a converter, without a voltage while the switch is
    closed at the start, did not conduct when it opened."""
    events = [Event({"a": {"1": 1.0}}, {"1": -3.0}), Event({"b": {"1": 1.0}}, {"x": 1.0})]
    numbers, _ = affine({"x": {"1": -1.0, "a": 1.0}}, events, discrete={"a": 0.0, "b": 0.0})
    state = begun(jax.tree.map(jnp.asarray, numbers))
    assert state.q[:2].tolist() == [1.0, 0.0] and state.armed[1] == RESTS


@pytest.mark.slow
def test_a_ball():
    ran, by, _ = found("ball")
    assert ran.result == OKAY and ran.count == 6
    np.testing.assert_allclose(ran.x[-1, 0], HEIGHT, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ran.times[:6], BOUNCES, rtol=0, atol=1e-9)
    assert np.isinf(ran.times[6:]).all()
    by_e, by_g = -slope("ball", CLOCKS, "v", "v"), -by.rates[1, -1]
    np.testing.assert_allclose([by_e, by_g, by.x[0]], SLOPES, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(-slope("sixth bounce", CLOCKS, "v", "v"), SIXTH_BY_E, rtol=1e-8)
    np.testing.assert_array_equal(ran.q[:, 0], np.searchsorted(BOUNCES, EVENLY))


def test_saved_at_an_event_is_what_comes_after():
    ran, _, _ = found("at an event")
    k = int(np.searchsorted(AT_AN_EVENT, FIRST))
    np.testing.assert_allclose(ran.x[k - 1 : k + 1, 1], [-G * FIRST, 0.8 * G * FIRST], rtol=1e-7)


def test_more_events_than_there_is_room_for():
    """The bounces accumulate at 8.58 s, after more events than are allowed."""
    ran, _, _ = found("too many")
    assert ran.result == TOO_MANY._value and ran.count == MAX_EVENTS + 1
    intervals = np.diff(ran.times)
    np.testing.assert_allclose(intervals[1:20] / intervals[:19], 0.9, rtol=1e-6)


def test_a_run_that_ends():
    ran, _, _ = found("stops")
    assert ran.result == ENDED._value and ran.count == 4
    np.testing.assert_allclose(ran.times[2:4], [BOUNCES[2]] * 2, atol=1e-10)
    np.testing.assert_array_equal(np.isfinite(ran.x[:, 0]), EVENLY <= BOUNCES[2])
    ran, _, _ = found("ending clock")
    assert ran.result == ENDED._value
    assert abs(ran.last[0] - 0.7) < 1e-12


def test_a_thermostat():
    ran, by, _ = found("thermostat")
    assert ran.count == 35
    np.testing.assert_allclose(ran.x[-1, 0], 50.7088714113363, rtol=0, atol=1e-8)
    # Thirty-five switches add their errors up.
    np.testing.assert_allclose(by.rates[0, STATES], -3.51092853184108, rtol=1e-8)


def test_a_sampled_loop():
    ran, by, _ = found("sampled loop")
    assert ran.count == 0
    np.testing.assert_allclose(ran.x[-1, 0], 1.01155947251977, rtol=0, atol=1e-9)
    by_Kp = slope("sampled loop", 0, "u", "1") - slope("sampled loop", 0, "u", "x")
    by_Ki = 0.1 * (slope("sampled loop", 0, "I", "1") - slope("sampled loop", 0, "I", "x"))
    np.testing.assert_allclose([by_Kp, by_Ki], [-0.00718258236586836, -0.00910828614834083], rtol=1e-8)
    _, by, _ = found("its period")
    # Ki·T is what the integral grows by: the period counts there, too.
    by_T = by.clocks[0, 0] + 3 * (slope("its period", 0, "I", "1") - slope("its period", 0, "I", "x"))
    np.testing.assert_allclose(by_T, 0.0155033203623, rtol=1e-6)
    assert ran.q[0, 0] == 2.0  # it samples at the start


def test_balls_on_balls():
    ran, by, _ = found("balls on balls")
    heights, times = falling_balls(2.0, 0.9)
    np.testing.assert_allclose(ran.times[: len(times)], times, atol=1e-11)
    assert ran.count == len(times)
    np.testing.assert_allclose(ran.x[-1, [0, 2]], heights, atol=1e-11)
    base, more, less = (balls_on_balls(e)[0] for e in (0.9, 0.9 + 1e-6, 0.9 - 1e-6))
    by_e = np.sum(by.writes * (more.writes - less.writes)) / 2e-6  # affine in e
    # Central differences at 1e-6: 1e-10 of curvature, 1e-16/1e-6 of rounding.
    differences = (falling_balls(2.0, 0.9 + 1e-6)[0][1] - falling_balls(2.0, 0.9 - 1e-6)[0][1]) / 2e-6
    np.testing.assert_allclose(by_e, differences, rtol=1e-7)


def test_clocks_of_commensurate_periods():
    """What ticks at one instant reads new values, or the ones before the instant; the reference counts in integers."""
    ran, _, _ = found("clocks")
    np.testing.assert_array_equal(ran.q[:, :3], commensurate_counts(SAVED))


def test_a_guard_that_dips_below_zero_between_two_steps():
    for depth in DEPTHS:
        ran, _, _ = found(f"dip {depth:g}")
        assert ran.count == 1
        np.testing.assert_allclose(ran.times[0], 1 - np.sqrt(depth), rtol=0, atol=1e-9)


def test_guards_faster_than_the_states():
    for rate in RATES:
        ran, _, _ = found(f"guard {rate:g}")
        assert ran.q[-1, 0] == int((5 * rate + 0.1) / (2 * np.pi))


def test_two_events_with_one_condition_both_happen():
    ran, _, _ = found("one condition")
    np.testing.assert_allclose(ran.times[:4], [1.0, 1.0, 2.0, 2.0], atol=1e-9)
    assert ran.q[-1, 0] == 2
    np.testing.assert_allclose(ran.x[-1, 0], 0.5, rtol=1e-9)


def test_derivatives_by_saved_times():
    """A saved value goes along the solution after the time, that of an event too; its derivative was zero."""
    ran, _, by_ts = found("growing rate")
    assert ran.q[-1, 0] == 4 and by_ts[-1] == 4.0  # it ends with a tick
    assert not by_ts[:-1].any()
    np.testing.assert_allclose(found("between ticks")[2][-1], 3.0, rtol=1e-9)


def test_what_an_event_writes_is_finite():
    ran, _, _ = found("not finite")
    assert ran.result == NOT_FINITE._value
    assert np.isfinite(ran.x[stacked()[2][list(PROBLEMS).index("not finite")] < 1, 0]).all()


def test_a_relation_turns_both_ways():
    """Parabolas of 2·v for each sign: x = s·τ·(v − τ/2)."""
    ran, by, _ = found("turning")
    assert ran.result == OKAY and ran.count == 0
    pieces, within = np.divmod(EVENLY * 3, 2.0)
    expected = (-1) ** pieces * within * (1 - within / 2)
    np.testing.assert_allclose(ran.x[:, 0], expected, rtol=0, atol=1e-8)
    # By v at t = 9, in the fifth piece: τ = 9 − 8·v, ∂x/∂v = −8·(v − τ) + τ.
    np.testing.assert_allclose(by.x[1], 1.0, rtol=0, atol=1e-8)


def test_a_solution_that_a_relation_leads_back():
    """Stopped where no solution goes on, with the number of the event that would happen again and again."""
    ran, _, _ = found("led back")
    assert ran.result == STUCK._value
    finite = np.isfinite(ran.x[:, 0])
    np.testing.assert_array_equal(finite, EVENLY < 2.0)
    np.testing.assert_allclose(ran.x[finite, 0], 1 - EVENLY[finite] / 2, atol=1e-9)
    ran, _, _ = found("led on")
    np.testing.assert_allclose(ran.x[:, 0], np.where(EVENLY < 1, 1 - EVENLY, -2 * (EVENLY - 1)), atol=1e-9)


def test_nothing_falls_through_a_floor():
    """Up to the time at which bounces accumulate they are those of the closed form; from there on there is nothing."""
    for e in DROPS:
        for floor in FLOORS:
            ran, _, _ = found(f"dropped {e:g} {floor:g}")
            bounces, end = accumulating(e, floor)
            assert ran.result == STUCK._value
            finite = np.isfinite(ran.x[:, 0])
            ts = EVENLY * 3
            np.testing.assert_array_equal(finite, ts < end)
            assert (ran.x[finite, 0] >= floor * ts[finite] - 1e-9).all()
            n = min(6, int(ran.count))
            # A height that is right to 1e-10 gives times that are right to that by the speed.
            allowed = 1e-9 + 1e-10 / (np.sqrt(floor**2 + 2 * G) * e ** np.arange(n))
            assert (np.abs(ran.times[:n] - bounces[:n]) <= allowed).all()


def accumulating(e, floor):
    """The times of bounces on a floor that moves at a constant speed, and the time at which they accumulate."""
    first = (-floor + np.sqrt(floor**2 + 2 * G)) / G
    lasts = 2 * (G * first + floor) / G * e ** np.arange(1, 200)
    times = first + np.concatenate([[0.0], np.cumsum(lasts)])
    return times, times[-1]


def assert_as_alone(name, together):
    ran, *_ = found(name)
    accumulates = name.startswith("dropped")
    # Which bounce is the first one that rounding hides, 1e-12 high, hangs on the steps, and so on the program.
    assert together.result == ran.result and abs(together.count - ran.count) <= accumulates
    n = min(int(ran.count), 4 if accumulates else 40)
    np.testing.assert_allclose(together.times[:n], ran.times[:n], rtol=1e-11)
    if ran.result == OKAY:
        np.testing.assert_allclose(together.x, ran.x, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_members_of_a_batch_are_as_alone():
    def forward(*given):
        return aim(*given, diffrax.Tsit5(), diffrax.ForwardMode())[1]

    batch = jax.tree.map(np.asarray, jax.jit(jax.vmap(forward))(*stacked()))
    for k, name in enumerate(PROBLEMS):
        assert_as_alone(name, member(batch, k))


@pytest.mark.slow
def test_forward_is_reverse():
    """Along one direction of all numbers and times, by Diffrax' forward mode, all problems at once."""

    def along(given, direction):
        def f(numbers, ts):
            _, t1, _, weights, weight = given
            return aim(numbers, t1, ts, weights, weight, diffrax.Tsit5(), diffrax.ForwardMode())

        return jax.jvp(f, (given[0], given[2]), direction, has_aux=True)

    rng, given = np.random.default_rng(0), stacked()
    # Zeros stay: what a problem does not use must not begin to move.
    direction = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape) * leaf, (given[0], given[2]))
    _, moved, batch = jax.tree.map(np.asarray, jax.jit(jax.vmap(along))(given, direction))
    for k, name in enumerate(PROBLEMS):
        ran, *by = found(name)
        assert_as_alone(name, member(batch, k))
        if ran.result == OKAY:
            pairs = zip(jax.tree.leaves(tuple(by)), jax.tree.leaves(member(direction, k)), strict=True)
            expected = sum(np.sum(a * b) for a, b in pairs)
            np.testing.assert_allclose(moved[k], expected, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_gradients_of_a_batch_are_those_of_its_members():
    (_, ran), by = jax.tree.map(np.asarray, jax.jit(jax.vmap(value_and_gradient))(*stacked()))
    for k, name in enumerate(PROBLEMS):
        alone, *alone_by = found(name)
        assert ran.result[k] == alone.result
        # A dip of depth d falls through zero at a rate of 2·√d: the smaller it is, the more rounding moves its time.
        atol = 1e-9 * max([1.0, *(0.01 / np.sqrt(d) for d in DEPTHS if name == f"dip {d:g}")])
        if alone.result == OKAY:
            jax.tree.map(
                lambda together, one, k=k, a=atol: np.testing.assert_allclose(together[k], one, rtol=1e-8, atol=a),
                by, tuple(alone_by),
            )  # fmt: skip
