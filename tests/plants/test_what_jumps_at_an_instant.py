"""What jumps at an instant is read there as it is after it: samples that are held, and what an event sets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled, component

from jaxonomy_dae import Eq, assign, der, pre, reinit, simulate


def test_a_clock_reads_the_sample_that_begins_with_its_tick():
    """Times of samples are sums or products, and ticks are multiples of a period: they differ by rounding."""

    def sampled(c, ev):
        u, s = c.input("u"), c.discrete("s", start=0.0)
        x = c.variable("x", start=0.0, fixed=True)
        c.add_equations(Eq(der(x), u))
        c.when(c.sampled(0.1), assign(s, pre(s) + u * u))

    system, values = compiled(component(sampled)), np.arange(1.0, 13.0)

    def total(values, times):
        inputs = {"c.u": (times, values, "held")}
        return simulate(system, 1.15, ts=jnp.array([1.15]), inputs=inputs)["c.s"][0]

    products, sums = np.arange(12) * 0.1, np.cumsum(np.r_[0, np.full(11, 0.1)])
    assert (products != sums).any()
    for times in (products, sums):
        found, gradient = jax.value_and_grad(total)(values, times)
        assert found == np.sum(values**2)
        np.testing.assert_array_equal(gradient, 2 * values)


@pytest.mark.parametrize("rate", [0.0, 1.0, -1.0])
def test_what_is_set_onto_a_level_has_reached_it(rate):
    """Whatever it does afterwards; conditions that are strict wait until it has passed the level."""

    def onto(c, ev):
        y, on = c.variable("y", start=5.0, fixed=True), c.discrete("on", start=0)
        c.add_equations(Eq(der(y), rate * on))
        x = c.variable("x", start=0.0, fixed=True)
        c.add_equations(Eq(der(x), 1))
        c.when(x >= 0.5, reinit(y, 2.0), assign(on, 1))
        for name, condition in (("at", y <= 2.0), ("below", y < 2.0)):
            count = c.discrete(name, start=0)
            c.when(condition, assign(count, pre(count) + 1))

    solution = simulate(compiled(component(onto)), 1.0, ts=jnp.array([1.0]))
    assert (solution["c.at"][0], solution["c.below"][0]) == (1, float(rate < 0))
