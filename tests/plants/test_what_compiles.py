"""What compiles again, as the page on saving and caching says."""

import pickle
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq, sin

from jaxonomy_dae import Component, EqnEnv, assign, der, pre, simulate
from jaxonomy_dae.host.cache import PROGRAMS

pytestmark = pytest.mark.slow  # a dozen programs
TS = jnp.linspace(0.0, 2.0, 5)


class Lag(Component):
    """x' = k (u − x)."""

    def __init__(self, ev, name, k=1.0):
        super().__init__(ev, name)
        k, u = self.parameter("k", k), self.input("u")
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), k * (u - x)))


def lag(k=1.0):
    return compiled(Lag(EqnEnv(), "c", k))


def run(system: Any, t1: Any = 2.0, u: Any = 1.0, **given: Any):
    return simulate(system, t1, **({"ts": TS, "inputs": {"c.u": u}, "solver": diffrax.Tsit5()} | given))


def samples(n, factor=1.0, *kind):
    return (jnp.linspace(0.0, 2.0, n), factor * jnp.ones(n), *kind)


def sine(a):
    return lambda t: a * jnp.sin(t)


SYSTEM = lag()
# (what was run before, what nothing is compiled for then)
SAME = [
    (dict(), dict(system=SYSTEM.with_parameters({"c.k": 3.0}))),
    (dict(), dict(rtol=1e-9, atol=1e-11)),
    (dict(), dict(t1=3.0, ts=jnp.linspace(0.0, 3.0, 5))),
    (dict(), dict(ts=jnp.linspace(0.0, 2.0, 6))),  # filled up to 8
    (dict(), dict(u=2.0)),
    (dict(initial={"c.x": 0.3}), dict(initial={"c.x": 0.4})),
    (dict(u=samples(9)), dict(u=samples(9, 2.0))),
    (dict(u=sine(1.0)), dict(u=sine(2.0))),
    (dict(), dict(system=lag(5.0))),
    (dict(), dict(system=pickle.loads(pickle.dumps(SYSTEM)))),
]
OTHER = [
    (dict(), dict(ts=jnp.linspace(0.0, 2.0, 9))),
    (dict(u=samples(9)), dict(u=samples(12))),
    (dict(u=samples(9)), dict(u=samples(9, 1.0, "held"))),
    (dict(), dict(initial={"c.x": 0.3})),
    (dict(), dict(max_steps=5000)),
    (dict(), dict(dtmax=0.1)),
    (dict(), dict(solver=diffrax.Dopri5())),
]


def compiled_for(first, then):
    """How many programs the second call adds to those of the first."""
    PROGRAMS.clear()
    run(**({"system": SYSTEM} | first))
    count = len(PROGRAMS)
    found = run(**({"system": SYSTEM} | then))
    assert np.isfinite(np.asarray(found["c.x"])).all()
    return len(PROGRAMS) - count


@pytest.mark.parametrize("first, then", SAME)
def test_nothing(first, then):
    assert compiled_for(first, then) == 0


@pytest.mark.parametrize("first, then", OTHER)
def test_again(first, then):
    assert compiled_for(first, then) == 1


def test_records_of_five_lengths_are_one_program():
    """Times are filled up to few different numbers. Values are those of a longer record, to the last bit, and those of
    a program of their own length."""
    PROGRAMS.clear()
    longest = np.linspace(0.0, 2.0, 127)
    whole = np.asarray(run(SYSTEM, ts=longest, u=sine(1.0))["c.x"])
    for n in (65, 80, 100, 126):
        found = run(SYSTEM, ts=longest[:n], u=sine(1.0))
        assert found.ts.shape == found.states.shape[:1] == (n,)
        np.testing.assert_array_equal(found["c.x"], whole[:n])
    assert len(PROGRAMS) == 1
    alone = jax.jit(lambda ts: run(SYSTEM, ts=ts, u=sine(1.0))["c.x"])(longest[:65])
    np.testing.assert_array_equal(alone, whole[:65])


def test_a_first_call_is_few_programs():
    """Reading, other parameters, other values at the start and other inputs run no small programs of their own."""
    counted = []

    def count(event: str, seconds: float, **what: Any) -> None:
        if event.endswith("backend_compile_duration"):
            counted.append(what)

    jax.monitoring.register_event_duration_secs_listener(count)  # pyright: ignore[reportArgumentType]
    PROGRAMS.clear()
    system = lag(2.0)
    assert np.isfinite(run(system, u=1.0)["c.x"]).all()
    assert len(counted) == 1
    del counted[:]
    found = run(system.with_parameters({"c.k": 3.0}), u=2.0)
    read = found[["c.x", "time"]], found.events, found.at(-1), found["c.x"], system.parameters["c.k"]
    assert len(read) == 5 and not counted
    run(system, u=1.0, initial={"c.x": 0.3})
    assert len(counted) == 1
    del counted[:]
    run(system, u=3.0, initial={"c.x": 0.4})
    assert not counted
    x = found.at(0).x
    slopes = found["der(c.x)"], system.observe("der(c.x)", 0.0, x, {"c.u": 2.0})
    assert len(slopes) == 2 and len(counted) == 2
    del counted[:]
    found_at, inputs = system.observe(["c.u"], 0.5, x, {"c.u": 1.0}), found["c.u"]
    assert not counted
    assert np.asarray(found_at) == 1.0 and (np.asarray(inputs) == 2.0).all()


class Driven(Component):
    """x' = k (sin(ωt) − x), counted by a clock and whenever x rises through a level."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        k, w, level = self.parameter("k", 1.0), self.parameter("w", 4.0), self.parameter("level", 0.1)
        x, n = self.variable("x", start=0.0, fixed=True), self.discrete("n", 0.0)
        m = self.discrete("m", 0.0)
        self.add_equations(Eq(der(x), k * (sin(w * ev.t) - x)))
        self.when(x > level, assign(n, pre(n) + 1))
        self.when(self.sampled(0.7), assign(m, pre(m) + 1))


def test_a_gradient_is_few_programs():
    """Waves by which a model is driven, parameters that equations read, and cotangents that are zero each ran small
    programs: a bridge rectifier's first gradient was 56. Derivatives against differences of runs."""
    counted = []

    def count(event: str, seconds: float, **what: Any) -> None:
        if event.endswith("backend_compile_duration"):
            counted.append(what)

    system = compiled(Driven(EqnEnv(), "c"))
    value = float(system.parameters["c.k"])

    def end(k):
        return simulate(system.with_parameters({"c.k": k}), 2.0, ts=TS, rtol=1e-9, atol=1e-11)["c.x"][-1]

    jax.monitoring.register_event_duration_secs_listener(count)  # pyright: ignore[reportArgumentType]
    slope = float(jax.grad(end)(value))
    # Two each for the run and the parameter; one reads x; the others are `[-1]` and the seed of `jax.grad`.
    assert len(counted) <= 11, counted
    h = 1e-4
    assert slope == pytest.approx(float(end(value + h) - end(value - h)) / (2 * h), rel=1e-5)


def test_a_jitted_function_takes_systems():
    traced = []

    @jax.jit
    def end(system):
        traced.append(None)
        return run(system)["c.x"][-1]

    for k, system in ((1.0, SYSTEM), (2.5, lag(2.5)), (2.0, SYSTEM.with_parameters({"c.k": 2.0}))):
        assert float(end(system)) == pytest.approx(1 - np.exp(-2 * k), abs=1e-5)  # rtol 1e-6
    assert len(traced) == 1
