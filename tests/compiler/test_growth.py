"""Compiling costs what a model's equations cost: twice the components, twice the lines of Python carried out."""

import sys

import numpy as np
import pytest

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, assign, der, pre, reinit
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.thermal import HeatCapacitor


class Ball(Component):
    def __init__(self, ev, name, h0=1.0):
        super().__init__(ev, name)
        h0 = self.parameter("h0", h0)
        h, v = self.variable("h", start=h0, fixed=True), self.variable("v", start=0.0, fixed=True)
        self.add_equations(der(h) - v, der(v) + 9.81)
        self.when(h <= 0, reinit(v, -0.8 * pre(v)))


class Controlled(Component):
    """A tank whose sampled controller reads the level through an equation, and a counter that reads the controller."""

    def __init__(self, ev, name, goal=1.0):
        super().__init__(ev, name)
        goal = self.parameter("goal", goal)
        x, error, u, n = (
            self.variable("x", start=0.0, fixed=True),
            self.variable("error"),
            self.discrete("u"),
            self.discrete("n"),
        )
        self.add_equations(der(x) - u + x, error - goal + x)
        self.when(self.sampled(0.1), assign(u, 3 * error))
        self.when(error < 0, assign(n, pre(n) + u))


def balls(n):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "ball", Ball, n, h0=np.linspace(1, 2, n))
    return ev, diagram


def controllers(n):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "tank", Controlled, n, goal=np.linspace(1, 2, n))
    return ev, diagram


def ladder(n):
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source"), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    before = source.p
    for k in range(n):
        r, c = Resistor(ev, f"r{k}"), Capacitor(ev, f"c{k}", initial_voltage=0.0)
        diagram.connect(before, r.p)
        diagram.connect(r.n, c.p)
        diagram.connect(c.n, ground.p)
        before = r.n
    return ev, diagram


def stuck(n):
    """Pairs of heat capacitors that touch each other: index two."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    cells = diagram.add_array(ev, "cell", HeatCapacitor, 2 * n)
    diagram.connect(cells[0::2].heat, cells[1::2].heat)
    return ev, diagram


def lines(model, n):
    """The lines of the package that are carried out while a model of this size is compiled."""
    count, (ev, diagram) = 0, model(n)

    def inside(frame, event, argument):
        nonlocal count
        count += event == "line"
        return inside

    def called(frame, event, argument):
        return inside if "jaxonomy_dae" in frame.f_code.co_filename else None

    before = sys.gettrace()
    sys.settrace(called)
    try:
        AcausalCompiler(ev, diagram)()
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("model", [balls, controllers, ladder, stuck])
def test_lines_grow_with_the_model(model):
    """Kind: quadratic loops. Each event looked at all others, so that 8,000 bouncing balls took 4.6 s and 4,000 took
    1.2 s."""
    lines(model, 20)  # what is found once for each template
    assert lines(model, 240) < 2.1 * lines(model, 120)
