"""Which variables become states is the same in all units, and a preference is heard."""

import pytest
from shared_models import levers

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der

RESCALED = [{"k": 1e9, "u": 1e-6}, {"k": 1e-12}, {"order": (1, 0)}]
MORE = [{"k": 1e9}, {"k": 1e-9}, {"u": 1e-12}, {"u": 1e9}]


@pytest.fixture(scope="module")
def plain():
    return levers("dummy_derivatives").states


@pytest.mark.parametrize("options", RESCALED + [pytest.param(given, marks=pytest.mark.slow) for given in MORE])
def test_scales_and_order_do_not_choose_states(options, plain):
    assert len(plain) == 2
    assert levers("dummy_derivatives", **options).states == plain


class Geared(Component):
    """Two speeds joined by A·v = D·w, a mass on a spring and a wheel that is driven."""

    def __init__(self, ev, name, A, D):
        super().__init__(ev, name)
        A, D = self.parameter("A", A), self.parameter("D", D)
        x, phi, q, p = (self.variable(k) for k in ("x", "phi", "q", "p"))
        v, w = self.variable("v", start=0.0), self.variable("w", start=0.0)
        self.add_equations(der(x) - v, der(phi) - w, q - A * v, q - D * w)
        self.add_equations(der(v) + x + A * p, der(w) - 1 - D * p)


@pytest.mark.parametrize("prefer", ["v", "w"])
@pytest.mark.parametrize(
    "ratio", [1e-6, 1.0, 1e6, *(pytest.param(ratio, marks=pytest.mark.slow) for ratio in (0.01, 100.0))]
)
def test_preferred_states_whatever_the_coefficients(prefer, ratio):
    """Which of two speeds is a state is a choice as good as the other, though their coefficients differ; a preference
    was ignored where they did by more than ten times."""
    ev = EqnEnv()
    diagram = AcausalDiagram().add(Geared(ev, "m", 1.0, ratio))
    assert f"m.{prefer}" in AcausalCompiler(ev, diagram, prefer_states=[f"m.{prefer}"])().states
