"""Things that must not matter, and once did: found by `make attack FAMILY=invariance`."""

import fractions
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, ModelError, der, simulate
from jaxonomy_dae.solvers import BDF, Rodas5P


def model(build):
    """One component, whose declarations `build(component)` makes."""

    class Part(Component):
        def __init__(self, ev):
            super().__init__(ev, "c")
            build(self)

    ev = EqnEnv()
    return AcausalCompiler(ev, AcausalDiagram().add(Part(ev)))()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Tsit5, Rodas5P, BDF])
def test_the_solver_of_a_model_without_states(solver):
    """The solver: with BDF, a model without states was an error of JAX, since its Jacobian has no rows."""
    system = model(lambda c: c.add_equations(Eq(c.variable("y"), sympy.sin(c.ev.t))))
    solution = simulate(system, 1.0, ts=np.array([0.5, 1.0]), solver=solver())
    np.testing.assert_allclose(solution["c.y"], np.sin([0.5, 1.0]), rtol=1e-12)


@pytest.mark.slow
def test_rows_that_were_not_reached():
    """Whether a variable depends on the state: constants, functions of time and zeros had values in rows that a run did
    not reach, where all else is not-a-number."""

    def build(c):
        k, x = c.parameter("k", 1.0, bounds=(0.0, 10.0)), c.variable("x", start=1.0, fixed=True)
        constant, zero, wave = c.variable("constant"), c.variable("zero"), c.variable("wave")
        c.add_equations(Eq(der(x), -k * x), Eq(constant, 0.3), Eq(zero, 0), Eq(wave, sympy.cos(c.ev.t)))

    system, names = model(build), ["c.constant", "c.zero", "c.wave", "c.x"]

    def run(k):
        solution = simulate(system.with_parameters({"c.k": k}), 1.0, ts=np.array([0.0, 1.0]))
        return solution[names], [solution[name] for name in names]

    within, beyond = jax.vmap(jax.jit(run))(np.array([1.0, 20.0]))[0]
    np.testing.assert_allclose(within[1], [0.3, 0.0, np.cos(1.0), np.exp(-1.0)], rtol=1e-5)
    assert np.isnan(beyond).all()
    together, apart = jax.jit(run)(20.0)
    assert np.isnan(together).all() and np.isnan(apart).all()


@pytest.mark.slow
def test_how_a_number_is_written():
    """The type of a number: what a declaration takes for a number was an error of JAX in `with_parameters` and
    `initial`; an empty list of jumps was one of Diffrax."""
    system = model(lambda c: c.add_equations(Eq(der(c.variable("x", start=1.0, fixed=True)), -c.parameter("k", 1))))
    for number in (fractions.Fraction(3, 4), sympy.Rational(3, 4), sympy.Float(0.75), np.float32(0.75), 0.75):
        assert system.with_parameters({"c.k": number}).parameters["c.k"] == 0.75
    with pytest.raises(ModelError, match="must be a number; got Symbol"):
        system.with_parameters({"c.k": sympy.Symbol("a")})
    with pytest.raises(ModelError, match=r"'c.x' needs a scalar; got Fraction\(3, 4\): write float"):
        system.initialize(initial={"c.x": fractions.Fraction(3, 4)})
    with pytest.raises(ModelError, match="t1 must be a finite number"):
        simulate(system, 1j, ts=[0.5])  # pyright: ignore[reportArgumentType]
    none, empty = (simulate(system, 1.0, ts=[1.0], jump_ts=jumps)["c.x"] for jumps in (None, []))
    np.testing.assert_array_equal(none, empty)


def test_which_numbers_were_written_before():
    """The process: equations were remembered by their sides, and 2 == 2.0 and 1 == True in Python. So a model had the
    numbers of one compiled before it, with another digest, and `Eq(y, True)` was accepted or not."""

    def compiled(number):
        def build(c):
            x = c.variable("x", start=1.0, fixed=True)
            c.add_equations(Eq(der(x), -x), Eq(c.variable("y"), number))

        return model(build)

    written = [2.0, 2, 2.0, 1, 2]
    digests = [compiled(number).plan.digest for number in written]
    assert digests[0] == digests[2] != digests[1] == digests[4]
    with pytest.raises(ModelError, match="is not an equation"):
        compiled(True)


@pytest.mark.slow
def test_whose_arrays_weights_are():
    """The library of an array: weights of NumPy were an error of the programs that are kept for the next process."""

    class Law(eqx.Module):
        weight: Any

        def __call__(self, u):
            return (self.weight * u[0])[None]

    def run(weight):
        def build(c):
            x = c.variable("x", start=1.0, fixed=True)
            c.add_equations(Eq(der(x), -c.learned("law", Law(weight), inputs=[x])[0]))

        return simulate(model(build), 1.0, ts=[0.5, 1.0])["c.x"]

    values = [run(weight) for weight in (np.array(0.5), jnp.array(0.5))]
    np.testing.assert_array_equal(*values)
    np.testing.assert_allclose(values[0], np.exp([-0.25, -0.5]), rtol=1e-5)
