"""Sizes of unknowns of which nothing is declared, and starts that rest on them."""

import jax
import numpy as np
import pytest
from problems import compiled
from sympy import Abs, Eq, sign, sqrt

from jaxonomy_dae import Component, EqnEnv, der


class Branches(Component):
    """A turbulent pipe and an orifice from one reservoir to another, and a supply beside them; no guess anywhere."""

    def __init__(self, ev, name, pressure, flow):
        super().__init__(ev, name)
        p0, q0 = self.parameter("p0", pressure), self.parameter("q0", flow)
        k, c = self.parameter("k", pressure / flow**2), self.parameter("c", flow / pressure**0.5)
        middle, end, q, r, x = (self.variable(n) for n in ("middle", "end", "q", "r", "x"))
        self.add_equations(
            Eq(p0 - middle, k * q * Abs(q)),
            Eq(r, c * sign(middle - end) * sqrt(Abs(middle - end))),
            Eq(q, r),
            Eq(q + q0, x),
            Eq(end, -p0),
            Eq(der(self.variable("h", start=0.0, fixed=True)), x),
        )


SIZES = [(1e5, 1e-3), (2e7, 1e-4), (1.0, 1.0), (1e-9, 1e6)]


@pytest.mark.parametrize(("pressure", "flow"), SIZES)
def test_sizes_come_from_data(pressure, flow):
    system = compiled(Branches(EqnEnv(), "b", pressure, flow))
    for name, size in (("b.middle", pressure), ("b.q", flow)):
        quantity = system.plan.resolve([name])[0][0]
        assert 0.1 < system.typical_sizes[quantity] / size < 10


@pytest.mark.parametrize(
    ("pressure", "flow"), [SIZES[0], *(pytest.param(*s, marks=pytest.mark.slow) for s in SIZES[1:])]
)
def test_starts_rest_on_them(pressure, flow):
    """The pressures of reservoirs and flows of supplies are terms of their equations, and all else follows."""
    system = compiled(Branches(EqnEnv(), "b", pressure, flow))
    # p0 − m = k q², q² = c² (m + p0) with k c² = 1: m = 0, q = c √p0.
    found = jax.jit(lambda: system.observe(["b.middle", "b.q"], 0.0, system.initialize()))()
    np.testing.assert_allclose(found, [0.0, flow], rtol=1e-9, atol=1e-9 * pressure)
