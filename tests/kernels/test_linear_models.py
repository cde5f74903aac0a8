"""Which models count as linear with constant coefficients."""

import pytest
from sympy import Max, cos, sin, sqrt

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv
from jaxonomy_dae.learning.linear_models import is_linear
from jaxonomy_dae.write import Component, Eq, der


def compiled(slope):
    class One(Component):
        def __init__(self, ev, name="m"):
            super().__init__(ev, name)
            k, u = self.parameter("k", 1.0), self.input("u", default=0.0)
            x, v, z = (
                self.variable("x", start=1.0, fixed=True),
                self.variable("v", start=1.0, fixed=True),
                self.variable("z"),
            )
            self.add_equations(Eq(der(x), slope(x, v, u, k, ev.t)), Eq(der(v), -k * z), Eq(z, v + k * x))

    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(One(ev))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.parametrize(
    "slope, expected",
    [
        (lambda x, v, u, k, t: -k * x + sqrt(k) * v + u, True),
        (lambda x, v, u, k, t: -k * x + cos(k) + 3 * u - v, True),
        (lambda x, v, u, k, t: -k * x**k, False),  # linear for k = 1 only
        (lambda x, v, u, k, t: -x * v, False),
        (lambda x, v, u, k, t: -x * u, False),
        (lambda x, v, u, k, t: u**2 - x, False),
        (lambda x, v, u, k, t: sin(t) - x, False),
        (lambda x, v, u, k, t: -Max(x, 0), False),
    ],
)
def test_linear(slope, expected):
    assert is_linear(compiled(slope)) is expected
