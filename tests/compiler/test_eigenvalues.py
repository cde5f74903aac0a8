"""How fast a compiled system decays at its declared start: eigenvalues of its equations, whatever the index."""

import numpy as np
import pytest
from problems import compiled, oscillator, pendulum, rc_circuit

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.system.solver_choice import fastest_decay as fastest_decay_of


class Follower(Component):
    """x' = −k·x."""

    def __init__(self, ev, k):
        super().__init__(ev, "f")
        k, x = self.parameter("k", k), self.variable("x", start=1.0, fixed=True)
        self.add_equations(der(x) + k * x)


def fastest_decay(system):
    return fastest_decay_of(system.plan.model, system.plan.flat.parameters.everything(system.parameters.known))


def test_eigenvalues_at_the_start():
    """Against closed forms: 1/(R·C), the larger root of an overdamped oscillator, none where all oscillates."""
    assert fastest_decay(rc_circuit(R=2e-3, C=0.5)) == pytest.approx(1e3, rel=1e-9)
    assert fastest_decay(compiled(Follower(EqnEnv(), 1e6))) == pytest.approx(1e6, rel=1e-9)
    overdamped = oscillator(M=2.0, D=600.0, K=5.0)
    assert fastest_decay(overdamped) == pytest.approx((600 + np.sqrt(600**2 - 4 * 2 * 5)) / 4, rel=1e-9)
    for system in (oscillator(), pendulum()):
        assert fastest_decay(system) == 0.0


def test_eigenvalues_are_those_of_the_values_not_the_structure():
    assert [fastest_decay(rc_circuit(R=r, C=1.0)) for r in (1.0, 1e-3)] == pytest.approx([1.0, 1e3], rel=1e-9)
