"""Names: every state can be read, observed, started and preferred by its name, whatever signs the model has."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der, simulate


class Signed(Component):
    """x' = a·v, v' = b·w, w' = c·g with signs a, b, c: v and w are derivatives of x but for their signs."""

    def __init__(self, ev, name, signs, fixed=()):
        super().__init__(ev, name)
        g = self.parameter("g", 3.0)
        x, v, w = (self.variable(n, start=s, fixed=n in fixed) for n, s in (("x", 1.0), ("v", 2.0), ("w", -0.5)))
        a, b, c = signs
        self.add_equations(Eq(der(x), a * v), Eq(der(v), b * w), Eq(der(w), c * g))


def exact(signs, t):
    """x, v, w at time t, from x = 1, v = 2, w = −0.5."""
    a, b, c = signs
    w = -0.5 + c * 3.0 * t
    v = 2.0 + b * (-0.5 * t + c * 1.5 * t**2)
    x = 1.0 + a * (2.0 * t + b * (-0.25 * t**2 + c * 0.5 * t**3))
    return {"c.x": x, "c.v": v, "c.w": w}


SIGNS = list(itertools.product((1, -1), repeat=3))


@pytest.fixture(scope="module")
def system():
    """c0, c1, …: one component for each choice of signs."""
    ev = EqnEnv()
    return compiled(*(Signed(ev, f"c{k}", signs, fixed=("x", "v", "w")) for k, signs in enumerate(SIGNS)))


@pytest.fixture(scope="module")
def found(system):
    """(the state at the start, what is observed there, the state at another start, slopes by name, the field)."""
    wanted = {name: 0.1 * (k + 1) for k, name in enumerate(system.states)}

    @jax.jit
    def values():
        state = system.initialize()
        slopes = system.observe([f"der({n})" for n in system.states], 0.0, state)
        observed = system.observe([*system.states, *system.variables], 0.0, state)
        return state, observed, system.initialize(initial=wanted), slopes, system.vector_field(0.0, state)

    return [np.asarray(value) for value in values()]


def test_states_of_any_sign_have_names(system, found):
    state, observed, started, slopes, field = found
    assert len(system.states) == 3 * len(SIGNS) and not any("-" in name for name in system.states)
    # Every state is itself where it is observed, whether it is a variable or the derivative of one.
    np.testing.assert_allclose(observed[: len(state)], state, rtol=1e-12)
    # … and starts where it is told to.
    np.testing.assert_allclose(started, 0.1 * np.arange(1, len(state) + 1), rtol=1e-12)
    np.testing.assert_allclose(slopes, field, rtol=1e-12)


@pytest.mark.parametrize("k", range(len(SIGNS)), ids=lambda k: str(SIGNS[k]))
def test_variables_of_any_sign_start_as_declared(system, found, k):
    alone = compiled(Signed(EqnEnv(), "c", SIGNS[k], fixed=("x", "v", "w")))
    assert len(alone.states) == 3 and not any("-" in name for name in alone.states)
    values = dict(zip(system.variables, found[1][len(found[0]) :], strict=True))
    expected = exact(SIGNS[k], 0.0)
    assert {n: float(values[n.replace("c", f"c{k}", 1)]) for n in expected} == pytest.approx(expected)


@pytest.mark.slow
def test_solutions_of_any_sign(system):
    solution = simulate(system, 1.0, ts=jnp.array([0.0, 1.0]), adjoint=diffrax.ForwardMode())
    last = solution[system.variables][-1]
    values = dict(zip(system.variables, np.asarray(last), strict=True))
    for k, signs in enumerate(SIGNS):
        for name, value in exact(signs, 1.0).items():
            assert values[name.replace("c", f"c{k}", 1)] == pytest.approx(value, rel=1e-6)
    assert np.isfinite(solution[system.states]).all()
    assert "-c" not in str(system.report) and system.report.states == system.states


def test_the_report_lists_negative_variables_as_they_are_named():
    class Flow(Component):
        """q' = −i, i = q: the flow is the negative derivative of the charge."""

        def __init__(self, ev, name):
            super().__init__(ev, name)
            q, i = self.variable("q", start=1.0, fixed=True), self.variable("i")
            self.add_equations(Eq(der(q), -i), Eq(3 * i, q))

    system = compiled(Flow(EqnEnv(), "c"))
    assert system.report.states == ["c.q"] and system.report.algebraics == ["c.i"] == system.algebraics
    assert float(system.observe("c.i", 0.0, jnp.array([3.0]))) == pytest.approx(1.0)
