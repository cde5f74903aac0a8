"""Arrays of components that several files compile."""

import numpy as np
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Electrical, EqnEnv, assign, der
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource


class Cell(Component):
    """A resistor in line and a capacitor to ground."""

    def __init__(self, ev, name, R=1.0, C=1.0, v0=0.0):
        super().__init__(ev, name)
        a, b, ground = (self.port(n, Electrical) for n in ("a", "b", "ground"))
        r, c = self.add(Resistor(ev, "r", R)), self.add(Capacitor(ev, "c", C, initial_voltage=v0))
        self.connect(a, r.p)
        self.connect(r.n, c.p, b)
        self.connect(c.n, ground)


def ladder(n: int, in_array: bool, R=1.0, C=1.0):
    """n cells on a source of 1 V; the cells as an array or as single components `cell0`, …"""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", V=1.0), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    if in_array:
        cells = diagram.add_array(ev, "cell", Cell, n, R, C=C)
        diagram.connect(source.p, cells[0].a)
        diagram.connect(cells[:-1].b, cells[1:].a)
        diagram.connect(cells.ground, ground.p)
        return AcausalCompiler(ev, diagram)()
    R, C = np.broadcast_to(R, n), np.broadcast_to(C, n)
    singles = [Cell(ev, f"cell{k}", float(R[k]), float(C[k])) for k in range(n)]
    diagram.connect(source.p, singles[0].a)
    for before, after in zip(singles, singles[1:], strict=False):
        diagram.connect(before.b, after.a)
    for cell in singles:
        diagram.connect(cell.ground, ground.p)
    return AcausalCompiler(ev, diagram)()


class Gated(Component):
    """x grows at the rate of a network until it reaches its limit, an event."""

    def __init__(self, ev, name, network, limit=1.0):
        super().__init__(ev, name)
        limit = self.parameter("limit", limit)
        x, u = self.variable("x", start=0.0, fixed=True), self.input("u", default=0.0)
        on = self.discrete("on", 1.0)
        (y,) = self.learned("rate", network, inputs=[x])
        self.add_equations(Eq(der(x), on * (1.0 + y) + u))
        self.when(x >= limit, assign(on, 0.0))


def times(weight, x):
    return weight * x


def array_of(kind, *args, **kwargs):
    ev, diagram = EqnEnv(), AcausalDiagram()
    array = diagram.add_array(ev, "cell", kind, *args, **kwargs)
    return ev, diagram, array
