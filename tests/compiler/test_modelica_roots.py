"""Roots of functions, `solveOneNonlinearEquation`, and functions as arguments."""

import math

import pytest
import sympy

from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.graph.expressions.smooth import Smooth
from jaxonomy_dae.modelica import load
from jaxonomy_dae.modelica.interpret import Interpreter
from jaxonomy_dae.modelica.roots import ROOT, root

TEXT = """//! base 0.1.0
package 'm'
  function 'cubic' input Real 'u'; input Real 'a'; input Real 'b' = 0.0; output Real 'y';
  algorithm 'y' := 'u'^3 + log('u') - 'a' - 'b'; end 'cubic';
  function 'twice' input 'g' 'f'; input Real 'x'; output Real 'y'; algorithm 'y' := f(f('x')); end 'twice';
  function 'g' input Real 'u'; output Real 'y'; end 'g';
  function 'scaled' input Real 'u'; input Real 'k'; output Real 'y'; algorithm 'y' := 'k'*'u'; end 'scaled';
  model 'm'
    Real 'x' = CALL;
  end 'm';
end 'm';"""


class Unknowns:
    """Stands for a component: notes what is declared."""

    def __init__(self):
        self.variables, self.equations = {}, []

    def variable(self, name, start, nominal):
        self.variables[name] = sympy.Symbol("u", real=True), start
        return self.variables[name][0]

    def add_equations(self, equation):
        self.equations.append(equation.rhs - equation.lhs)


def evaluated(call: str, component: Unknowns, guards=(), **names):
    flat = load(TEXT.replace("CALL", call))
    found = {ROOT: lambda *arguments: root(component, guards, *arguments)}
    of = Interpreter(flat.classes, names.__getitem__, {}, found)
    return of.evaluate(flat.model.declarations[0].value)


def test_a_function_as_an_argument_with_some_of_its_arguments():
    assert evaluated("'twice'(function 'scaled'('k' = 3.0), 2.0)", Unknowns()) == 18.0


def test_a_root_of_numbers_is_a_number():
    found = evaluated(f"'{ROOT}'(function 'cubic'('a' = 2.0), 0.1, 5.0, 1e-9)", Unknowns())
    assert math.isclose(found**3 + math.log(found), 2.0, rel_tol=1e-12)
    with pytest.raises(ModelError, match="it has one sign"):
        evaluated(f"'{ROOT}'(function 'cubic'('a' = 2.0), 3.0, 5.0)", Unknowns())


def test_a_root_is_an_unknown_within_its_interval():
    """The equation has one root, in the interval, and a value everywhere, also where the logarithm has none."""
    a, on = sympy.symbols("a on", real=True)
    component = Unknowns()
    u = evaluated(f"'{ROOT}'(function 'cubic'('a' = a), 0.1, 5.0)", component, a=a)
    assert component.variables == {":root[0]": (u, 2.55)}
    (equation,) = component.equations
    residual = sympy.lambdify((u, a), equation.replace(Smooth, lambda e: e), "math")
    values = [residual(-3.0 + 0.01 * k, 2.0) for k in range(1200)]
    assert sum(x * y < 0 for x, y in zip(values, values[1:], strict=False)) == 1
    at = evaluated(f"'{ROOT}'(function 'cubic'('a' = 2.0), 0.1, 5.0)", Unknowns())
    assert abs(residual(at, 2.0)) < 1e-12
    evaluated(f"'{ROOT}'(function 'cubic'('a' = a), 0.1, 5.0)", component, [on > 0], a=a)
    guarded = sympy.lambdify((u, a, on), component.equations[1].replace(Smooth, lambda e: e), "math")
    assert guarded(1.7, 2.0, 1.0) == residual(1.7, 2.0)
    assert guarded(2.55, 2.0, -1.0) == 0.0
