"""Models are written with names of one place, and errors are caught by one class."""

import pytest
import sympy
from problems import run

import jaxonomy_dae
from jaxonomy_dae import EqnEnv, JaxonomyDaeError
from jaxonomy_dae.library.electrical import CurrentSource, VoltageSource


@pytest.mark.parametrize("name", ["sqrt", "Abs", "Max", "Min", "Piecewise", "exp", "sin", "tanh", "sign", "And", "pi"])
def test_functions_are_those_of_sympy(name):
    assert getattr(jaxonomy_dae, name) is getattr(sympy, name)


def test_names_are_read_when_they_are_asked_for():
    """Importing the package alone imports not even JAX; every way to a name finds it, and what is not there is said."""
    program = """
import sys
import jaxonomy_dae
assert "jax" not in sys.modules and jaxonomy_dae.__version__
assert jaxonomy_dae.library.__name__ == "jaxonomy_dae.library" and "jax" not in sys.modules
from jaxonomy_dae import *
assert der is jaxonomy_dae.der and simulate.__name__ == "simulate" and {"EqnEnv", "sqrt"} <= {*dir(jaxonomy_dae)}
from jaxonomy_dae import learning, run
assert learning.Problem and run.__name__ == "jaxonomy_dae.run"
try:
    from jaxonomy_dae import simulat
except ImportError as error:
    print(error)
try:
    jaxonomy_dae.simulat
except AttributeError as error:
    print(error)
"""
    first, second = run(program).splitlines()
    assert "cannot import name 'simulat' from 'jaxonomy_dae'" in first
    assert second == "module 'jaxonomy_dae' has no attribute 'simulat'"


def test_intervals_and_equations():
    assert 0.0 not in jaxonomy_dae.POSITIVE and 0.0 in jaxonomy_dae.NONNEGATIVE
    assert jaxonomy_dae.Eq(sympy.Symbol("x"), 1) == sympy.Eq(sympy.Symbol("x"), 1)


@pytest.mark.parametrize("kind", ["Model", "Structural", "Unit", "Initialization", "SteadyState", "Simulation"])
def test_errors_have_one_base(kind):
    error = getattr(jaxonomy_dae, f"{kind}Error")
    assert issubclass(error, JaxonomyDaeError) and issubclass(error, ValueError | RuntimeError)


def test_sources_take_the_names_of_their_parameters():
    """`VoltageSource(V=...)` was a TypeError: the argument was `v`, the parameter `V`."""
    ev = EqnEnv()
    assert VoltageSource(ev, "s", V=5.0).parameters["V"].value == 5.0
    assert CurrentSource(ev, "c", I=2.0).parameters["I"].value == 2.0
