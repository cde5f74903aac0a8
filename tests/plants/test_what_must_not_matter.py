"""Things that must not matter, and once did: found by `make attack FAMILY=invariance`."""

import diffrax
import numpy as np
import pytest
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, simulate
from jaxonomy_dae.solvers import BDF, Rodas5P


def model(build):
    """One component, whose declarations `build(component)` makes."""

    class Part(Component):
        def __init__(self, ev):
            super().__init__(ev, "c")
            build(self)

    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(Part(ev)))()


@pytest.mark.parametrize("solver", [diffrax.Tsit5, Rodas5P, BDF])
def test_the_solver_of_a_model_without_states(solver):
    """The solver: with BDF, a model without states was an error of JAX, since its Jacobian has no rows."""
    system = model(lambda c: c.add_equations(Eq(c.variable("y"), sympy.sin(c.ev.t))))
    solution = simulate(system, 1.0, ts=np.array([0.5, 1.0]), solver=solver())
    np.testing.assert_allclose(solution["c.y"], np.sin([0.5, 1.0]), rtol=1e-12)
