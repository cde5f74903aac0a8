"""What the report says of declarations that change nothing, or not what was meant."""

import itertools

import pytest
from problems import compiled
from sympy import sin

from jaxonomy_dae import Component, EqnEnv, assign, der, pre, reinit
from jaxonomy_dae.write import Eq


class Declared(Component):
    """A state, and what a test writes beside it."""

    def __init__(self, ev, write):
        super().__init__(ev, "c")
        self.x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(self.x), -self.x))
        write(self)


def notes(write):
    return compiled(Declared(EqnEnv(), write)).report.notes


def test_a_parameter_that_nothing_reads():
    assert notes(lambda c: c.parameter("spare", 3.0)) == ["'c.spare': a parameter that nothing in the model reads"]


def test_a_parameter_that_is_read_by_such_a_parameter():
    found = notes(lambda c: c.parameter("b", 2 * c.parameter("a", 2.0)))
    assert found == ["'c.a' and 'c.b': parameters that nothing in the model reads"]


def start(c, p):
    y = c.variable("y", start=p, fixed=True)
    c.add_equations(Eq(der(y), -y))


def period(c, p):
    n = c.discrete("n")
    c.when(c.sampled(p), assign(n, pre(n) + 1))


def energy(c, p):
    c.declare_energy(p * c.x**2)


def another_parameter(c, p):
    c.add_equations(Eq(c.variable("z"), c.parameter("q", 2 * p) * c.x))


def condition(c, p):
    c.when(c.x < p, reinit(c.x, 1.0))


@pytest.mark.parametrize("read", [start, period, energy, another_parameter, condition])
def test_parameters_that_are_read(read):
    assert notes(lambda c: read(c, c.parameter("p", 0.5))) == []


# --- guesses -----------------------------------------------------------------------------------------------------


def branches(**guesses):
    """a = −2·b with a² = 4 + sin(z), which has two solutions; declared in this order."""

    def write(c):
        v = {name: c.variable(name, start=guess) for name, guess in guesses.items()}
        z = c.variable("z", start=0.0, fixed=True)
        c.add_equations(Eq(v["a"], -2 * v["b"]), Eq(v["a"] ** 2, 4 + sin(z)), Eq(der(z), 1))

    return compiled(Declared(EqnEnv(), write))


@pytest.mark.parametrize("order", list(itertools.permutations(["a", "b"])))
def test_guesses_that_differ(order):
    """The one that says more is taken, wherever it was declared."""
    guesses = {"a": 0.0, "b": 1.5}
    system = branches(**{name: guesses[name] for name in order})
    assert system.report.notes == ["guesses for one quantity differ, 'c.b = 1.5' and 'c.a = 0': the first is taken"]


def test_guesses_that_agree():
    assert branches(a=3.0, b=-1.5).report.notes == []
