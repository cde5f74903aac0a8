"""Arrays of components: wrong input is refused by name, and symbolic work is done once for all entries."""

import numpy as np
import pytest
from cell_arrays import Cell, Gated, array_of, ladder, times
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, Component, ModelError, der, simulate
from jaxonomy_dae.compile.passes import read_equations
from jaxonomy_dae.library.thermal import HeatCapacitor


class Careless(Component):
    """Uses its argument without declaring it."""

    def __init__(self, ev, name, a=1.0):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), -a * x))


def wrong_shape():
    array_of(Cell, 4, R=np.ones(3))


def not_positive():
    array_of(Cell, 0)


def out_of_bounds():
    array_of(Cell, 3, R=np.array([1.0, 2.0, -1.0]), C=np.array([1.0, -1.0, 1.0]))


def not_finite():
    array_of(Cell, 2, R=np.array([1.0, np.nan]))


def undeclared():
    ev, diagram, _ = array_of(Careless, 2, a=np.array([1.0, 2.0]))
    AcausalCompiler(ev, diagram)()


def lengths_disagree():
    _, diagram, cells = array_of(Cell, 4)
    diagram.connect(cells[1:].a, cells[:-2].b)


def beyond():
    _, _, cells = array_of(Cell, 4)
    cells[4]


def itself():
    _, diagram, cells = array_of(Cell, 4)
    diagram.connect(cells.a, cells[:].a)


def other_domain():
    ev, diagram, cells = array_of(Cell, 4)
    nodes = diagram.add_array(ev, "node", HeatCapacitor, 4)
    diagram.connect(cells.a, nodes.heat)


def a_list():
    array_of(Gated, 2, times, limit=[1.0, 2.0])


class Choosing(Component):
    """Chooses an equation by its argument."""

    def __init__(self, ev, name, mode=1.0):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), 1.0 if mode is None else -x))


def unused():
    array_of(Choosing, 2, mode=np.array([0.0, 1.0]))


def texts():
    array_of(Cell, 2, R=np.array(["a", "b"]))


def expressions():
    array_of(Cell, 2, R=np.array([object(), object()]))


def started_twice():
    ladder(3, True).initialize(initial={"cell.c.v": 1.0, "cell[0].c.v": 2.0})


def used_twice():
    ev, diagram, _ = array_of(Cell, 4)
    diagram.add_array(ev, "cell", Cell, 2)


def wrong_values():
    ladder(3, True).with_parameters({"cell.r.R": np.ones(4)})


def value_out_of_bounds():
    ladder(3, True).with_parameters({"cell.c.C": np.array([1.0, 1.0, -2.0])})


def every_step_of_many():
    simulate(ladder(100, True), t1=1.0, max_steps=10_000_000)


def wrong_start():
    ladder(3, True).initialize(initial={"cell.c.v": np.zeros(2)})


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (wrong_shape, r"array 'cell' has shape \(4,\), but the values of R have shape \(3,\): give one for each"),
        (not_positive, r"array 'cell': its shape is a positive integer or a tuple of them; got 0"),
        (out_of_bounds, r"parameter 'cell\[1\].c.C' must lie in \(0, inf\); got -1"),
        (not_finite, r"array 'cell': the values of R must be finite; got nan at position 1"),
        (undeclared, r"array 'cell': 'a' has a value for each component, and Careless uses it in an equation"),
        (lengths_disagree, r"arrays of one shape join element by element.*'cell.a \(3\)', 'cell.b \(2\)'"),
        (beyond, r"array 'cell' has shape \(4,\): index 4 is out of bounds"),
        (itself, r"'cell.a' is connected to itself"),
        (other_domain, r"ports must have the same domain"),
        (a_list, r"must be a number; got list.*Values of limit for each component are given as a NumPy array"),
        (unused, r"'mode' has a value for each component, but Choosing does not use it in a parameter or an equation"),
        (texts, r"the values of R must be real numbers; got texts"),
        (expressions, r"the values of R must be real numbers; got entries of type object"),
        (started_twice, r"initial: 'cell\[0\].c.v' is given twice"),
        (used_twice, r"the diagram has 'cell' already: give the array another name"),
        (
            wrong_values,
            r"parameter 'cell.r.R' is an array of shape \(3,\): give a number or that shape; got shape \(4,\)",
        ),
        (value_out_of_bounds, r"parameter 'cell\[2\].c.C' must lie in \(0, inf\); got -2"),
        (every_step_of_many, r"reserves max_steps \+ 1 = 10000001 rows for 100 states, 7.5 GiB: say when to save, ts="),
        (wrong_start, r"initial: 'cell.c.v' is an array of shape \(3,\): give a number or an array of that shape"),
    ],
)
def test_bad_input(attempt, message):
    with pytest.raises(ModelError, match=message):
        attempt()


def test_symbolic_work_is_done_once(monkeypatch):
    """Ten and a thousand cells read as many expressions."""
    counts = []
    read = read_equations.read
    for n in (10, 1000):
        seen = []
        monkeypatch.setattr(read_equations, "read", lambda *a, seen=seen: (seen.append(a), read(*a))[1])
        ladder(n, True)
        counts.append(len(seen))
    assert counts[0] == counts[1]
