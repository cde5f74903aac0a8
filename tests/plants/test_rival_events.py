"""Events that write one variable at one instant: refused unless their values agree, whatever the order."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import Component, Eq, EqnEnv, SimulationError, assign, der, reinit, simulate

TS = jnp.array([0.5, 1.0, 1.5])


class Rivals(Component):
    """x' = 1 from x(0) = 0. At t = 1 two events write parameters to `k` or x; `order` is that of declaration."""

    def __init__(self, ev, name, kind, order):
        super().__init__(ev, name)
        x, k = self.variable("x", start=0.0, fixed=True), self.discrete("k", start=0)
        a, b = self.parameter("a", 1.0), self.parameter("b", 2.0)
        self.add_equations(Eq(der(x), 1))
        other = self.sampled(10.0, 1.0) if kind == "clock" else 2 * x >= 2
        write = (lambda v: reinit(x, -v)) if kind == "states" else functools.partial(assign, k)
        events = [lambda: self.when(x >= 1, write(a)), lambda: self.when(other, write(b))]
        for declare in events[::order]:
            declare()
        if kind == "start":
            self.when(x <= 0, assign(k, 3), at_start=True)
            self.when(x >= 0, assign(k, 4), at_start=True)
        if kind == "in turn":
            self.when(k >= 1, assign(k, 5))


@functools.cache
def system(kind, order=1):
    return compiled(Rivals(EqnEnv(), "c", kind, order))


@pytest.mark.parametrize(("kind", "what", "other"), [
    ("discretes", "c.k", "2*x >= 2"), ("states", "c.x", "2*x >= 2"), ("clock", "c.k", "sampled")
])  # fmt: skip
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.slow
def test_contradictions_are_refused(kind, what, other, order):
    """Kind: the order of declaration. The event that was handled last won."""
    with pytest.raises(
        SimulationError, match=r"at t=1: .* happen at one instant and give .* different values"
    ) as error:
        simulate(system(kind, order), 2.0, ts=TS)
    assert all(text in str(error.value) for text in (what, "c: when(x >= 1)", other))


@pytest.mark.slow
def test_at_the_start_too():
    """The instant is that of the start."""
    with pytest.raises(SimulationError, match=r"stopped at t=0: 'c: when\(x <= 0\)' and 'c: when\(x >= 0\)' happen"):
        simulate(system("start"), 0.5, ts=TS[:1])


@pytest.mark.slow
def test_events_in_turn_do_not_contradict_each_other():
    """What an event causes comes after it, and counts; so do two events that agree."""
    agreeing = system("in turn").with_parameters({"c.b": 1.0})
    np.testing.assert_array_equal(simulate(agreeing, 2.0, ts=TS)["c.k"], [0, 5, 5])


@pytest.mark.slow
def test_a_member_that_contradicts_itself_fails_alone():
    """In batches, the member is not-a-number from the instant on, and has a result code."""

    def run(b):
        return simulate(system("discretes").with_parameters({"c.b": b}), 2.0, ts=TS)

    with pytest.warns(RuntimeWarning, match="member 1 of 2: two events give one variable different values"):
        batch = eqx.filter_vmap(run)(jnp.array([1.0, 2.0]))
    np.testing.assert_array_equal(batch["c.k"], [[0, 1, 1], [0, np.nan, np.nan]])
    np.testing.assert_allclose(batch["c.x"][0], TS, rtol=1e-12)
    assert np.isnan(batch["c.x"][1, 1:]).all()
