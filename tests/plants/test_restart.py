"""Runs that go on where another one stopped.

A run to t1 in one go is one to some time before, and another one from its whole state, `solution.at(k)`: continuous
states, discrete variables, modes, clocks that have ticked, and conditions that hold already. A run started from a row
of `solution.states` had the discrete variables as declared, without a word: a thermostat that was off was on again.

The two differ in their steps alone: states agree to some hundreds of tolerances of 1e-10.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from hybrid_models import Ball, SampledPI, Thermostat
from problems import compiled, component
from sympy import sqrt

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.rotational as rot
import jaxonomy_dae.library.signal as sig
from jaxonomy_dae import Component, Eq, EqnEnv, ModelError, assign, der, pre, reinit, simulate
from jaxonomy_dae.library.friction import Clutch

TIGHT = dict(rtol=1e-10, atol=1e-10)
pytestmark = pytest.mark.long("runs of models with events are compiled")


class Bob(Component):
    """A point on a string that goes slack and taut: constraints that come and go."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=0.0, fixed=True), self.variable("y", start=-1.0, fixed=True)
        vx, vy = self.variable("vx", start=5.2, fixed=True), self.variable("vy", start=0.0, fixed=True)
        pull = self.variable("pull")
        self.add_equations(Eq(der(x), vx), Eq(der(y), vy), Eq(der(vx), -pull * x), Eq(der(vy), -pull * y - 9.81))
        self.complementary(1 - sqrt(x**2 + y**2), pull, "taut", order=2, start=1)


class Counter(Component):
    """Conditions that become true once and stay so, on a state that goes on, and clocks that count."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=0.0, fixed=True), self.variable("y", start=0.0, fixed=True)
        n, k, d = self.discrete("n"), self.discrete("k"), self.discrete("d", start=1)
        # The square wave turns with time, floor and sign with states.
        wave = 1 - 2 * sympy.Mod(sympy.floor(2 * ev.t), 2)
        self.add_equations(Eq(der(x), 1), Eq(der(y), d + wave + sympy.floor(2 * x) * sympy.sign(x - 0.6)))
        self.when(x >= 1, assign(n, pre(n) + 1), reinit(y, y + 1))
        self.when(self.sampled(0.25, 0.05), assign(k, pre(k) + 1), assign(d, -pre(d)))


TIMES = np.unique([*np.linspace(0.0, 2.0, 21), 0.451523640985731, 0.487173065075081, 0.55, 1.0])
# Of rows: at the start, at a tick, at an event that stays true, at a bounce, and between events.
PLACES = np.array([0, *(int(np.argmin(np.abs(TIMES - t))) for t in (0.451523640985731, 0.487173065075081, 0.55, 1.0)),
                   int(np.argmin(np.abs(TIMES - 1.3))), len(TIMES) - 2])  # fmt: skip


@functools.cache
def plant():
    ev = EqnEnv()
    clutch, one, two = (
        Clutch(ev, "clutch", mu=0.8, fn_max=10.0),
        rot.Inertia(ev, "one", 1.0),
        rot.Inertia(ev, "two", 2.0),
    )
    push = sig.Constant(ev, "push", 1.0)
    source, diode = el.SineVoltage(ev, "source", 10.0, 2.0), el.IdealDiode(ev, "diode")
    series, tank, load = el.Resistor(ev, "series", 1.0), el.Capacitor(ev, "tank", 0.1), el.Resistor(ev, "load", 4.0)
    ground = el.Ground(ev, "g")
    return compiled(
        Thermostat(ev, "room"), Ball(ev, "ball"), SampledPI(ev, "loop"), Bob(ev, "bob"), Counter(ev, "counter"),
        clutch, one, two, push, source, diode, series, tank, load, ground,
        connect=[
            (one.flange_b, clutch.flange_a), (clutch.flange_b, two.flange_a), (push.y, clutch.u),
            (source.p, series.p), (series.n, diode.p), (diode.n, tank.p, load.p),
            (tank.n, load.n, source.n, ground.p),
        ],
    )  # fmt: skip


STARTS = {
    "one.phi": 0.0, "one.w": 10.0, "two.phi": 0.0, "two.w": 0.0, "tank.v": 0.0, "room.T": 20.0,
}  # fmt: skip


@functools.cache
def whole():
    return simulate(plant(), 2.0, ts=TIMES, initial=STARTS, max_events=100, **TIGHT)


@functools.cache
def from_there():
    """Jitted and mapped over states: (values at TIMES, those before the state's own NaN; times and names of events)."""
    names = tuple(whole())

    @jax.jit
    @functools.partial(jax.vmap)
    def run(state):
        again = simulate(plant(), 2.0, ts=jnp.maximum(TIMES, state.t), initial=state, max_events=100, **TIGHT)
        values = jnp.where((TIMES >= state.t)[:, None], again[names], jnp.nan)
        return values, again.events.ts, again.events.which

    states = jax.tree.map(lambda *parts: jnp.stack(parts), *(whole().at(int(k)) for k in PLACES))
    return names, jax.tree.map(np.asarray, run(states))


@pytest.mark.slow
@pytest.mark.parametrize("part", ["room", "ball", "loop", "bob", "counter", "clutch", "one", "tank", "diode"])
def test_a_run_in_two_parts_is_the_run_in_one_go(part):
    names, (values, _, _) = from_there()
    chosen = [k for k, name in enumerate(names) if name.startswith(f"{part}.")]
    known = np.asarray(whole()[[names[k] for k in chosen]])
    assert len(chosen)
    # A time of an event is on one side or on the other.
    apart = np.abs(TIMES[:, None] - np.asarray(whole().events.ts)).min(axis=1) > 1e-8
    for place, rows in zip(PLACES, values, strict=True):
        seen = (apart & (np.arange(len(TIMES)) > place)) | (np.arange(len(TIMES)) == place)
        np.testing.assert_allclose(rows[seen][:, chosen], known[seen], rtol=0, atol=1e-7, err_msg=f"from {place}")


@pytest.mark.slow
def test_events_go_on():
    """Those of the second run are those of the one run after the time at which it began. (One at that time, found some
    roundings later, is in the second run; that none happens twice is seen by the counters above.)"""
    _, (_, times, which) = from_there()
    events = whole().events
    for place, ts, numbers in zip(PLACES, times, which, strict=True):
        ours, known = ts > TIMES[place] + 1e-9, np.asarray(events.ts) > TIMES[place] + 1e-9
        ours, known = ours & (numbers >= 0), known & (np.asarray(events.which) >= 0)
        np.testing.assert_array_equal(numbers[ours], np.asarray(events.which)[known])
        np.testing.assert_allclose(ts[ours], np.asarray(events.ts)[known], atol=1e-8)


@functools.cache
def sampled():
    return compiled(SampledPI(EqnEnv(), "c"))


@pytest.mark.slow
def test_a_loop_of_restarts():
    """A scan whose carry is the whole state, with steps that begin at ticks and between them; and its gradient, which
    is that of the run in one go."""
    system = sampled()

    def in_parts(p):
        changed = system.with_parameters({"c.Kp": p[0], "c.T": p[1]})
        first = simulate(changed, 0.25, ts=jnp.array([0.25]), **TIGHT).at(-1)

        def step(state, _):
            end = state.t + 0.125
            state = simulate(changed, end, ts=end[None], initial=state, **TIGHT).at(-1)
            return state, state.x[0]

        return jax.lax.scan(step, first, length=6)[1][-1]

    def in_one(p):
        changed = system.with_parameters({"c.Kp": p[0], "c.T": p[1]})
        return simulate(changed, 1.0, ts=jnp.array([1.0]), **TIGHT)["c.x"][-1]

    p = jnp.array([2.0, 0.1])
    found, known = (jax.jit(jax.value_and_grad(f))(p) for f in (in_parts, in_one))
    np.testing.assert_allclose(found[0], known[0], rtol=1e-9)
    np.testing.assert_allclose(found[1], known[1], rtol=1e-8)


@pytest.mark.slow
def test_an_input_that_is_another_one_after_the_restart():
    """Relations that its value turns have turned when the run goes on, at the first row, too; conditions that it makes
    true are events."""

    def write(self, ev):
        x, u, n = self.variable("x", start=0.0, fixed=True), self.input("u"), self.discrete("n")
        y = self.variable("y")
        self.add_equations(Eq(y, sympy.Piecewise((2, u > 1), (1, True))), Eq(der(x), y + n))
        self.when(u > 1, assign(n, pre(n) + 10))

    system = compiled(component(write))
    first = simulate(system, 1.0, ts=jnp.array([1.0]), inputs={"c.u": 0.0})
    again = simulate(system, 2.0, ts=jnp.array([1.0, 2.0]), inputs={"c.u": 3.0}, initial=first.at(-1))
    np.testing.assert_allclose(again["c.y"], [2.0, 2.0])
    np.testing.assert_allclose(again["c.x"], [1.0, 13.0])
    assert len(again.events) == 1 and float(again.events.ts[0]) == 1.0


def built_of(name):
    def write(c, ev):
        c.add_equations(Eq(der(c.variable(name, start=1.0, fixed=True)), 0))

    return compiled(component(write))


def test_what_cannot_be_a_whole_state():
    """An array does not hold modes and discrete variables: declared starts took their places in silence."""
    system = sampled()
    solution = simulate(system, 1.0, ts=jnp.linspace(0.0, 1.0, 3))
    state = solution.at(1)
    with pytest.raises(ModelError, match=r"does not hold .*events.*'c\.u'.*solution\.at\(k\)"):
        simulate(system, 1.0, t0=0.5, initial=solution.states[1])
    with pytest.raises(ModelError, match=r"t0=0\.25, but the state given as initial is that of t=0\.5: leave t0 out"):
        simulate(system, 1.0, t0=0.25, initial=state)
    with pytest.raises(ModelError, match=r"needs t0 < t1; got t0=0\.5, t1=0\.2"):
        simulate(system, 0.2, initial=state)
    with pytest.raises(ModelError, match="has x of shape"):
        simulate(system, 1.0, initial=dataclasses.replace(state, x=jnp.zeros(2)))
    with pytest.raises(ModelError, match="entries that are not finite"):
        simulate(system, 1.0, initial=dataclasses.replace(state, x=state.x * jnp.nan))
    with pytest.raises(ModelError, match="3 saved times"):
        solution.at(3)
    # One of another model with as many states went on, with one model's numbers for the other's.
    foreign = dataclasses.replace(state, of=built_of("other").plan.digest_of_states)
    with pytest.raises(ModelError, match=r"one of another model: here, it has c\.\w"):
        simulate(system, 1.0, initial=foreign)
    # Inside jit, a time that is not the state's: not-a-number and a code.
    run = jax.jit(lambda t0: simulate(system, 1.0, t0=t0, ts=jnp.array([1.0]), initial=state).states)
    assert np.isfinite(run(0.5)).all() and np.isnan(run(0.25)).all()
    moved = simulate(system, 1.0, ts=jnp.array([1.0]), initial=dataclasses.replace(state, t=0.25))
    assert np.isfinite(moved.states).all()


@pytest.mark.slow
def test_another_time_where_constraints_come_and_go():
    """Kind: a verdict that a later one replaces. Inside jit, a time that was not the state's went unnoticed in models
    with such constraints, whose own check took its place."""
    ev = EqnEnv()
    system = compiled(Bob(ev, "bob"))
    state = simulate(system, 0.1, ts=jnp.array([0.05, 0.1])).at(0)
    run = jax.jit(lambda t0: simulate(system, 0.1, t0=t0, ts=jnp.array([0.1]), initial=state).states)
    assert np.isfinite(run(0.05)).all() and np.isnan(run(0.02)).all()


@pytest.mark.slow
def test_a_batch_of_states():
    """`filter_vmap` returns a batch of solutions, whose `at` is a batch of states."""
    system = sampled()
    ts = jnp.linspace(0.0, 1.0, 5)

    def run(gain):
        return simulate(system.with_parameters({"c.Kp": gain}), 1.0, ts=ts, **TIGHT)

    gains = jnp.array([1.0, 2.0, 3.0])
    batch = eqx.filter_vmap(run)(gains)
    states = batch.at(2)
    assert states.t.shape == (3,) and states.x.shape == (3, 1)

    def on(gain, state):
        return simulate(system.with_parameters({"c.Kp": gain}), 1.0, ts=ts[2:], initial=state, **TIGHT)

    np.testing.assert_allclose(eqx.filter_vmap(on)(gains, states)["c.x"], batch["c.x"][:, 2:], atol=1e-9)


class Rectified(Component):
    """A current through an ideal diode into a charge q, from a source sin(3t)."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        i, v, q = self.variable("i"), self.variable("v"), self.variable("q", start=0.0, fixed=True)
        self.add_equations(Eq(v + i, sympy.sin(3 * ev.t) - 0.3 * q), Eq(der(q), i))
        self.complementary(-v, i)


@pytest.mark.slow
def test_from_the_instant_at_which_a_diode_blocks():
    """Kind: a guard inside its band that falls was neither due nor below: a run that went on from the instant of the
    event, or a nanosecond before or after it, took steps of length zero."""
    system, tight = compiled(Rectified(EqnEnv(), "c")), {"rtol": 1e-9, "atol": 1e-11}
    whole = simulate(system, 2.5, ts=jnp.array([2.5]), **tight)
    instant = float(whole.events.ts[0])
    for t in (instant - 1e-9, instant, instant + 1e-9):
        first = simulate(system, t, ts=jnp.array([t]), **tight)
        second = simulate(system, 2.5, ts=jnp.array([2.5]), initial=first.at(-1), **tight)
        np.testing.assert_allclose(second["c.q"], whole["c.q"], rtol=1e-8)
