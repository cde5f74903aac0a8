"""The order in which a model is written decides neither its states nor what is said of it."""

import itertools

import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der


class Oscillator(Component):
    """x' = v, v' = −2.345·x, and y = x, in some order."""

    def __init__(self, ev, name, variables, equations):
        super().__init__(ev, name)
        x = {n: self.variable(n, start=1.0, fixed=True) for n in (("x", "v", "y"), ("y", "v", "x"))[variables]}
        written = (Eq(der(x["x"]), x["v"]), Eq(der(x["v"]), -2.345 * x["x"]), Eq(x["y"], x["x"]))
        self.add_equations(*(written[k] for k in equations))


@pytest.mark.parametrize("variables", [0, 1])
@pytest.mark.parametrize("equations", list(itertools.permutations(range(3))))
def test_a_position_is_not_named_by_an_acceleration(variables, equations):
    """Where the law of force came before v = x', it named the position by a multiple of the acceleration, and the
    states were v and der(v). A note named two variables in the order of their declaration."""
    system = compiled(Oscillator(EqnEnv(), "c", variables, equations))
    assert set(system.states) in ({"c.x", "c.v"}, {"c.y", "c.v"})
    (note,) = system.report.notes
    assert note.startswith("'c.x' and 'c.y' are one quantity")
