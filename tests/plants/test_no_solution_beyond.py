"""Equations that stop having a solution: refused at the time, with the equation's name, by every solver; inside jit and
vmap the failing member is not-a-number with a result code."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, slow
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, SimulationError, der, simulate
from jaxonomy_dae.solvers import BDF, Rodas5P

PRESCRIBED = {"solver": diffrax.Tsit5(), "stepsize_controller": diffrax.StepTo(ts=jnp.linspace(0.0, 0.9, 46))}
WAYS = {"default": {}, "Rodas5P": {"solver": Rodas5P()}, "BDF": {"solver": BDF()}, "prescribed": PRESCRIBED}
TS = jnp.array([0.4, 0.9])


class Sine(Component):
    """sin(x) = c·t, whose last solution is at t = 1/c; w = der(x) makes the equation a hidden constraint."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        c, x, w = self.parameter("c", 2.0), self.variable("x", start=0.1), self.variable("w")
        self.add_equations(Eq(sympy.sin(x), c * ev.t), Eq(w, der(x)))


class Slider(Component):
    """A rod of length 1 whose end is drawn along the ground, and stretched out at t = 1/2."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y, v = self.variable("x", start=0.5), self.variable("y", start=0.8), self.variable("v")
        self.add_equations(Eq(x, 0.5 + ev.t), Eq(x**2 + y**2, 1), Eq(v, der(y)))


class Turning(Component):
    """z² = 1/2 − x, where x' = 1: the end of z is a turning point. x is a state itself, which a projection may hold
    back by less than the tolerance in each of many short steps."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, z, w = self.variable("x", start=0.0, fixed=True), self.variable("z", start=0.7), self.variable("w")
        self.add_equations(Eq(der(x), 1), Eq(z**2, 0.5 - x), Eq(w, der(z)))


class Root(Component):
    """y² = x, x' = y from x(0) = 1/2 along y < 0: the solution branches at t = √2, into x = 0 and y = (t − √2)/2."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=0.5, fixed=True), self.variable("y", start=-1.0)
        self.add_equations(Eq(der(x), y), Eq(y**2, x))


@pytest.mark.parametrize("way", slow(["default", "Rodas5P", "BDF"], "default", "Rodas5P"))
def test_a_branch_point_is_not_stepped_over(way):
    """Kind: a solver that goes on where others refuse. BDF extrapolated y through zero, and took one of the branches:
    the determinant of the block changed its sign within a step."""
    system = compiled(Root(EqnEnv(), "c"))
    with pytest.raises(SimulationError, match="no step was short enough") as raised:
        simulate(system, 2.5, ts=TS, **WAYS[way])
    stopped = float(str(raised.value).split("stopped at t=")[1].split(":")[0])
    np.testing.assert_allclose(stopped, np.sqrt(2), atol=1e-4)


@pytest.fixture(scope="module")
def sine():
    return compiled(Sine(EqnEnv(), "c"))


SAID = {Sine: "sin(x)", Slider: "x**2 + y**2", Turning: "z**2"}
QUICK = {(Turning, "default")}


@pytest.mark.parametrize(
    "kind, said, way",
    [
        pytest.param(kind, said, way, marks=() if (kind, way) in QUICK else pytest.mark.slow)
        for kind, said in SAID.items()
        for way in WAYS
    ],
)
def test_refused_at_the_time_by_its_equation(kind, said, way):
    """Kind: a run that goes on where its equations have no solution. The sine ended "successful" at x = 422 (Tsit5) and
    −67 (Rodas5P): one Gauss–Newton step after each step of the solver led somewhere, and nobody looked how far."""
    system = compiled(kind(EqnEnv(), "c"))
    with pytest.raises(SimulationError) as raised:
        simulate(system, 0.9, ts=TS, **WAYS[way])
    text = str(raised.value)
    assert "an equation has no solution beyond" in text and said in text
    stopped = float(text.split("stopped at t=")[1].split(":")[0])
    assert 0.399 < stopped < 0.5001 if way == "prescribed" else abs(stopped - 0.5) < 1e-4
    solution = simulate(system, 0.9, ts=TS, throw=False, **WAYS[way])
    assert not bool(diffrax.is_okay(solution.result)) and bool(jnp.isnan(solution.states[1]).all())
    assert solution.counts["num_rejected_steps"] < 1000  # one that steps in place rejects half of 16,384


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_members_fail_by_themselves(sine, way):
    """Kind: the same inside jit and vmap."""

    @jax.jit
    @jax.vmap
    def run(c):
        solution = simulate(sine.with_parameters({"c.c": c}), 0.9, ts=TS, **WAYS[way])
        return solution["c.x"], diffrax.is_okay(solution.result)

    x, okay = map(np.asarray, run(jnp.array([0.5, 2.0, 1.0])))
    assert okay.tolist() == [True, False, True]
    np.testing.assert_allclose(
        x[[0, 2]], np.arcsin(np.outer([0.5, 1.0], TS)), rtol=2e-4 if way == "prescribed" else 1e-5
    )
    np.testing.assert_allclose(x[1, 0], np.arcsin(0.8), rtol=1e-4)
    assert np.isnan(x[1, 1])


@pytest.mark.slow
def test_states_that_are_not_finite_are_no_success():
    """Kind: prescribed steps have no error that rejects them; a run of them through a pole was "successful"."""

    class Pole(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), sympy.sqrt(0.5 - ev.t)))

    solution = simulate(compiled(Pole(EqnEnv(), "c")), 0.9, ts=TS, throw=False, **PRESCRIBED)
    assert not bool(diffrax.is_okay(solution.result)) and bool(jnp.isfinite(solution["c.x"][0]))
