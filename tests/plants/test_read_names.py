"""Reading variables of large models: only what they need is computed, in blocks of times."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, compilations, der, simulate
from jaxonomy_dae.host import rows

N, TS = 60, jnp.linspace(0.0, 2.0, 30)


class Cell(Component):
    """x' = −a·x, and what follows from x: y = sin(x), z = exp(y), w = cosh(x)."""

    def __init__(self, ev, name, a=1.0):
        super().__init__(ev, name)
        a, x = self.parameter("a", a), self.variable("x", start=1.0, fixed=True)
        y, z, w = (self.variable(name) for name in "yzw")
        self.add_equations(der(x) + a * x, y - sympy.sin(x), z - sympy.exp(y), w - sympy.cosh(x))


@pytest.fixture(scope="module")
def solution():
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "c", Cell, N, a=np.linspace(0.5, 2.0, N))
    return simulate(AcausalCompiler(ev, diagram)(), t1=2.0, ts=TS, rtol=1e-9, atol=1e-12)


def test_names_of_a_large_model_have_the_values_of_their_equations(solution, monkeypatch):
    """One name and one array of 240 quantities, where all at all times do not fit: everything was computed for each."""
    monkeypatch.setattr(rows, "ROOM", 600)
    x = np.exp(-np.outer(TS, np.linspace(0.5, 2.0, N)))
    before = len(compilations())
    assert solution["c[7].z"] == pytest.approx(np.exp(np.sin(x[:, 7])), rel=1e-8)
    one = len(compilations())
    assert solution["c[9].z"] == pytest.approx(np.exp(np.sin(x[:, 9])), rel=1e-8)
    assert (one - before, len(compilations()) - one) == (1, 0)  # names of one step share a program
    assert np.asarray(solution["c.w"]) == pytest.approx(np.cosh(x), rel=1e-8)
    several = np.asarray(solution[["c[3].z", "c[3].x", "c[4].w", "time"]])
    expected = np.stack([np.exp(np.sin(x[:, 3])), x[:, 3], np.cosh(x[:, 4]), TS], axis=-1)
    assert several == pytest.approx(expected, rel=1e-8)
    assert np.asarray(jax.jit(lambda s: s["c[7].z"])(solution)) == pytest.approx(np.exp(np.sin(x[:, 7])), rel=1e-8)


def test_what_is_not_asked_for_is_not_computed(solution):
    plan = solution.system.plan
    quantity = {name: plan.resolve([f"c[7].{name}"])[0] for name in "xyzw"}
    read = {name: plan.owned(plan.owners(found)) for name, found in quantity.items()}
    assert all(quantity[name] in read[name] for name in "xyzw")
    width = {name: plan.width(read[name]) for name in "xyzw"}
    assert width == {"x": N, "y": 2 * N, "z": 3 * N, "w": 2 * N}
