"""Ideal switches that close onto conducting ideal diodes: equations are singular until the diodes block.

The reference is one linear mode after the other, by matrix exponentials: a boost converter whose current never stops.
"""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hybrid_models import Ball
from problems import compiled

from jaxonomy_dae import Component, Eq, EqnEnv, assign, der, simulate

pytestmark = pytest.mark.long("converters with events are compiled")
PERIOD, DUTY, L, C, R, V = 1e-2, 0.4, 0.1, 1e-2, 4.0, 12.0
END = 8.5 * PERIOD


class Boost(Component):
    """An inductor, a switch to ground and a diode onto a capacitor, of which there are `count`, with one clock."""

    def __init__(self, ev, name, count=1):
        super().__init__(ev, name)
        closed = self.discrete("closed", start=1)
        for k in range(count):
            i, v = self.variable(f"i{k}", start=5.0 + k, fixed=True), self.variable(f"v{k}", start=15.0 + k, fixed=True)
            node, through, switch = (self.variable(f"{n}{k}") for n in ("node", "through", "switch"))
            self.add_equations(Eq(L * der(i), V - node), Eq(C * der(v), through - v / R), Eq(i, through + switch))
            self.either(Eq(closed, 1), node, switch)
            self.complementary(v - node, through, f"conducts{k}")
        self.when(self.sampled(PERIOD), assign(closed, 1))
        self.when(self.sampled(PERIOD, DUTY * PERIOD), assign(closed, 0))


class Stop(Component):
    """A mass that falls onto a floor and stays there: a constraint that begins to hold."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        h, v = self.variable("h", start=1e-3, fixed=True), self.variable("v", start=0.0, fixed=True)
        f = self.variable("f")
        self.add_equations(Eq(der(h), v), Eq(der(v), f - 9.81))
        self.complementary(h, f, order=2)


def mode(closed):
    on = [[0, 0, V / L], [0, -1 / (R * C), 0], [0, 0, 0]]
    off = [[0, -1 / L, V / L], [1 / C, -1 / (R * C), 0], [0, 0, 0]]
    return np.array(on if closed else off)


@functools.cache
def known(k):
    """Current and voltage at the end."""
    x = np.array([5.0 + k, 15.0 + k, 1.0])
    for n in range(8):
        x = scipy.linalg.expm(mode(True) * DUTY * PERIOD) @ x
        x = scipy.linalg.expm(mode(False) * (1 - DUTY) * PERIOD) @ x
        assert x[0] > 0, n
    x = scipy.linalg.expm(mode(True) * DUTY * PERIOD) @ x
    return (scipy.linalg.expm(mode(False) * (0.5 - DUTY) * PERIOD) @ x)[:2]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("beside", [None, Ball, Stop])
def test_converters_beside_others(count, beside):
    """Three diodes that must block at once, as one clock closes three switches, and a contact in another part of the
    model: modes were looked for one and two at a time, and not at all in a model with a contact."""
    ev = EqnEnv()
    parts = [Boost(ev, "c", count)] + ([beside(ev, "other")] if beside else [])
    solution = simulate(compiled(*parts), END, ts=jnp.array([END]), rtol=1e-10, atol=1e-10)
    for k in range(count):
        np.testing.assert_allclose([solution[f"c.i{k}"][-1], solution[f"c.v{k}"][-1]], known(k), rtol=1e-8)
