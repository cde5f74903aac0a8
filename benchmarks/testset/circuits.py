"""Electrical circuits: a transistor amplifier by its nodes, a Cauer filter by its components."""

from types import SimpleNamespace

import numpy as np
import scipy.linalg
import sympy

from jaxonomy_dae import AcausalDiagram, Component, Electrical, EqnEnv, der
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor

from .index_one import IndexOne
from .problem import Problem, Table, alone, load, named

# --- transistor amplifier ----------------------------------------------------------------------------------------

NODES = tuple(f"U{k}" for k in range(1, 9))
FREE = ("U2", "U3", "U5", "U6", "U8")  # five degrees of freedom; the sums of paired equations give the other three


def _amplifier(t, y, p, m):
    """C·dU/dt = i: the eight nodes' currents."""
    u1, u2, u3, u4, u5, u6, u7, u8 = (y[k] for k in range(8))
    ue = 0.1 * m.sin(200 * m.pi * t)

    def emitter(v):
        return p.beta * (m.exp(v / p.UF) - 1)

    first, second = emitter(u2 - u3), emitter(u5 - u6)
    return [
        (u1 - ue) / p.R0,
        -p.Ub / p.R2 + u2 * (1 / p.R1 + 1 / p.R2) + (1 - p.alpha) * first,
        u3 / p.R3 - first,
        (u4 - p.Ub) / p.R4 + p.alpha * first,
        -p.Ub / p.R6 + u5 * (1 / p.R5 + 1 / p.R6) + (1 - p.alpha) * second,
        u6 / p.R7 - second,
        (u7 - p.Ub) / p.R8 + p.alpha * second,
        u8 / p.R9,
    ]


def _capacitances(p) -> list[list]:
    """The matrix C: each of C1, C3, C5 joins two nodes, C2 and C4 are grounded."""
    c = [[0] * 8 for _ in range(8)]
    for capacitor, (a, b) in ((p.C1, (0, 1)), (p.C3, (3, 4)), (p.C5, (6, 7))):
        c[a][a] = c[b][b] = -capacitor
        c[a][b] = c[b][a] = capacitor
    c[2][2], c[5][5] = -p.C2, -p.C4
    return c


class TransistorAmplifier(Component):
    """Two transistors, eight nodes, C·dU/dt = i(t, U) (Hairer, Lubich & Roche 1989; Mazzia & Magherini 2008, II-14).

    Three pairs of equations contain the same combination of derivatives: structurally an ODE with eight degrees of
    freedom, in truth of index 1 with five.
    """

    def __init__(self, ev: EqnEnv, name: str = "transamp"):
        super().__init__(ev, name)
        facts = load("transamp")
        p = SimpleNamespace(**{k: self.parameter(k, v) for k, v in facts["parameters"].items()})
        starts = facts["initial"]["y0"]
        u = [self.variable(n, start=u0, fixed=n in FREE) for n, u0 in zip(NODES, starts, strict=True)]
        currents = _amplifier(ev.t, u, p, sympy)
        for row, current in zip(_capacitances(p), currents, strict=True):
            self.add_equations(sum(c * der(v) for c, v in zip(row, u, strict=True)) - current)


def transamp() -> Problem:
    """Stiff in short phases; the exponentials overflow for wrong iterates."""
    facts = load("transamp")
    names = tuple(f"transamp.{n}" for n in NODES)
    return Problem(
        name="transamp",
        build=alone(TransistorAmplifier),
        reference=named("transamp", NODES, facts["reference"]["y"]),
        scale=dict.fromkeys(names, 1.0),
        digits=13.0,
        origin="published",
        t1=facts["time"]["t_end"],
        index_one=lambda: IndexOne(
            _amplifier,
            np.array(_capacitances(SimpleNamespace(**facts["parameters"])), float),
            np.array(facts["initial"]["y0"]),
            facts["parameters"],
            names,
            linear=False,
        ),
        given=True,
        atol=1.0,
    )


# --- Cauer filter ------------------------------------------------------------------------------------------------


class StepVoltage(Component):
    """A source of `V` volt from the time `start` on, and of none before."""

    def __init__(self, ev: EqnEnv, name: str, V: float = 1.0, start: float = 0.0):
        super().__init__(ev, name)
        height, begin = self.parameter("V", V, unit="V"), self.parameter("start", start, unit="s")
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        self.add_equations(p.v - n.v - sympy.Piecewise((0, ev.t < begin), (height, True)), p.i + n.i)


def _cauer_diagram() -> tuple[EqnEnv, AcausalDiagram]:
    p = SimpleNamespace(**load("msl_cauer")["parameters"])
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = StepVoltage(ev, "V", start=p.t_step), Ground(ev, "G")
    r1, r2 = Resistor(ev, "R1", p.R1), Resistor(ev, "R2", p.R2)
    c1, c3, c5 = (Capacitor(ev, f"C{k}", c, initial_voltage=0.0) for k, c in ((1, p.c1), (3, p.c3), (5, p.c5)))
    c2, c4 = Capacitor(ev, "C2", p.c2), Capacitor(ev, "C4", p.c4)
    l1, l2 = Inductor(ev, "L1", p.l1, initial_current=0.0), Inductor(ev, "L2", p.l2, initial_current=0.0)
    diagram.connect(source.p, r1.p)
    diagram.connect(r1.n, c1.p, l1.p, c2.p)
    diagram.connect(l1.n, c2.n, c3.p, l2.p, c4.p)
    diagram.connect(l2.n, c4.n, c5.p, r2.p)
    diagram.connect(source.n, c1.n, c3.n, c5.n, r2.n, ground.p)
    return ev, diagram


CAUER = ("C1.v", "C3.v", "C5.v", "L1.i", "L2.i")


def _cauer_matrices() -> tuple[np.ndarray, np.ndarray]:
    """(A, b) of d/dt(vC1, vC3, vC5, iL1, iL2) = A·x + b·V, the capacitor loops eliminated by hand."""
    p = SimpleNamespace(**load("msl_cauer")["parameters"])
    # vC2 = v1 − v3 and vC4 = v3 − v5, so that charges are a full capacitance matrix times (v1, v3, v5).
    charge = np.array([[p.c1 + p.c2, -p.c2, 0.0], [-p.c2, p.c2 + p.c3 + p.c4, -p.c4], [0.0, -p.c4, p.c4 + p.c5]])
    current = np.array([[-1 / p.R1, 0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0], [0.0, 0.0, -1 / p.R2, 0.0, 1.0]])
    voltage = np.array([[1.0, -1.0, 0.0, 0.0, 0.0], [0.0, 1.0, -1.0, 0.0, 0.0]])
    a = np.vstack([np.linalg.solve(charge, current), voltage / np.array([[p.l1], [p.l2]])])
    b = np.concatenate([np.linalg.solve(charge, [1 / p.R1, 0.0, 0.0]), [0.0, 0.0]])
    return a, b


def cauer_exact(ts) -> np.ndarray:
    """(vC1, vC3, vC5, iL1, iL2) at the times `ts` after the step, shape `(len(ts), 5)`: by the matrix exponential."""
    a, b = _cauer_matrices()
    step = load("msl_cauer")["parameters"]["t_step"]
    rest = -np.linalg.solve(a, b)
    return np.array([rest - scipy.linalg.expm(a * (t - step)) @ rest for t in ts])


def _cauer(t, y, p, m):
    """The filter with currents, and the loops differentiated once: index 1."""
    v1, v2, v3, v4, v5, j1, j2, i1, i2, i3, i4, i5, ir = (y[k] for k in range(13))
    return [
        i1 / p.c1,
        i2 / p.c2,
        i3 / p.c3,
        i4 / p.c4,
        i5 / p.c5,
        v2 / p.l1,
        v4 / p.l2,
        i1 / p.c1 - i2 / p.c2 - i3 / p.c3,
        i3 / p.c3 - i4 / p.c4 - i5 / p.c5,
        p.R1 * ir - (1 - v1),  # the source after the step
        ir - i1 - i2 - j1,
        i2 + j1 - i3 - i4 - j2,
        i4 + j2 - i5 - v5 / p.R2,
    ]


def msl_cauer() -> Problem:
    """Linear; index 2 by two loops of capacitors. All is at rest until the source steps at t = 1, so we start there."""
    facts = load("msl_cauer")
    step, end = facts["parameters"]["t_step"], facts["time"]["t_end"]
    rows = np.array(facts["reference_trajectory"]["rows"])
    names = ("C1.v", "C2.v", "C3.v", "C4.v", "C5.v", "L1.i", "L2.i", *(f"C{k}.i" for k in range(1, 6)), "R1.i")
    charge = _cauer_matrices()[1][:3]  # dv/dt at the step, where the source drives the empty filter
    p = SimpleNamespace(**facts["parameters"])
    slopes = np.array([charge[0], charge[0] - charge[1], charge[1], charge[1] - charge[2], charge[2]])
    currents = slopes * np.array([p.c1, p.c2, p.c3, p.c4, p.c5])
    return Problem(
        name="msl_cauer",
        build=_cauer_diagram,
        reference=dict(zip(CAUER, cauer_exact([end])[0].tolist(), strict=True)),
        scale=dict.fromkeys(CAUER, 1.0),
        digits=13.0,
        origin="exact: matrix exponential of the reduced system",
        t0=step,
        t1=end,
        index_one=lambda: IndexOne(
            _cauer,
            np.array([1.0] * 7 + [0.0] * 6),
            np.concatenate([np.zeros(7), currents, [1 / p.R1]]),
            facts["parameters"],
            names,
        ),
        given=False,
        breaks=(),
        published=dict(zip(CAUER, facts["reference"]["values"], strict=True)),
        published_digits=4.8,
        table=Table(rows[:, 0], dict(zip(CAUER, rows[:, 1:].T, strict=True)), digits=3.5),
    )
