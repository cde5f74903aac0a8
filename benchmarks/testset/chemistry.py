"""Chemical kinetics with conservation laws and equilibria as algebraic equations: index 1."""

from types import SimpleNamespace

import numpy as np
import sympy

from jaxonomy_dae import Component, EqnEnv, der

from .index_one import IndexOne
from .problem import Problem, Table, alone, load, named


def _declare(component: Component, facts: dict) -> SimpleNamespace:
    return SimpleNamespace(**{name: component.parameter(name, value) for name, value in facts["parameters"].items()})


# --- Robertson ---------------------------------------------------------------------------------------------------


def _robertson(t, y, p, m):
    a, b, c = y[0], y[1], y[2]
    slow, back, fast = p.p1 * a, p.p2 * b * c, p.p3 * b**2
    return [back - slow, slow - back - fast, a + b + c - 1]


class Robertson(Component):
    """Three species, rates from 0.04 to 3e7, the mass balance as an algebraic equation (Robertson 1966).

    A' = −p₁A + p₂BC, B' = p₁A − p₂BC − p₃B², 0 = A + B + C − 1.
    """

    def __init__(self, ev: EqnEnv, name: str = "robertson"):
        super().__init__(ev, name)
        facts = load("robertson")
        p = _declare(self, facts)
        a0, b0, c0 = facts["initial"]["y0"]
        a = self.variable("A", start=a0, fixed=True)
        b = self.variable("B", start=b0, fixed=True, nominal=1e-5)
        c = self.variable("C", start=c0)
        da, db, balance = _robertson(ev.t, (a, b, c), p, sympy)
        self.add_equations(der(a) - da, der(b) - db, balance)


def robertson() -> Problem:
    """Stiff, to 1e11 s: A falls to 2e-8 and B to 8e-14, so the absolute tolerance must be far smaller than A.

    Below 1e-15 the rounding of 0 = A + B + C − 1 counts as an error in C, which starts at zero.
    """
    facts = load("robertson")
    names = tuple(f"robertson.{s}" for s in "ABC")
    track, good = facts["reference_trajectory"], 8  # eight rows up to 4e6 have four digits or more
    return Problem(
        name="robertson",
        build=alone(Robertson),
        reference=named("robertson", "ABC", facts["reference"]["y"]),
        scale=dict.fromkeys(names, 0.0),
        digits=13.8,
        origin="published",
        t1=facts["time"]["t_end"],
        index_one=lambda: IndexOne(
            _robertson, np.array([1.0, 1.0, 0.0]), np.array(facts["initial"]["y0"]), facts["parameters"], names
        ),
        given=True,
        atol=1e-9,
        least_atol=1e-15,
        stiff=True,
        table=Table(
            np.array(track["t"][:good]), dict(zip(names, np.array(track["y"][:good]).T, strict=True)), digits=3.3
        ),
    )


# --- Chemical Akzo Nobel -----------------------------------------------------------------------------------------

SPECIES = ("FLB", "CO2", "FLBT", "ZHU", "ZLA", "FLB_ZHU")


def _akzo(t, y, p, m):
    flb, co2, flbt, zhu, zla, complexed = (y[k] for k in range(6))
    root = m.sqrt(co2)
    r1 = p.k1 * flb**4 * root
    r2 = p.k2 * flbt * zhu
    r3 = p.k2 / p.K * flb * zla
    r4 = p.k3 * flb * zhu**2
    r5 = p.k4 * complexed**2 * root
    inflow = p.klA * (p.pCO2 / p.H - co2)
    return [
        -2 * r1 + r2 - r3 - r4,
        -r1 / 2 - r4 - r5 / 2 + inflow,
        r1 - r2 + r3,
        -r2 + r3 - 2 * r4,
        r2 - r3 + r5,
        p.Ks * flb * zhu - complexed,
    ]


class AkzoNobel(Component):
    """Two species reacting under a constant inflow of carbon dioxide, one equilibrium (Mazzia & Magherini 2008, II-12).

    The rates take the root of [CO2], so that no step may go below zero.
    """

    def __init__(self, ev: EqnEnv, name: str = "chemakzo"):
        super().__init__(ev, name)
        facts = load("chemakzo")
        p = _declare(self, facts)
        starts = facts["initial"]["y0"]
        y = [self.variable(s, start=y0, fixed=s != "FLB_ZHU") for s, y0 in zip(SPECIES, starts, strict=True)]
        *slopes, equilibrium = _akzo(ev.t, y, p, sympy)
        self.add_equations(*(der(v) - slope for v, slope in zip(y[:5], slopes, strict=True)), equilibrium)


def chemakzo() -> Problem:
    """Mildly stiff, with an initial layer in [CO2] (t < 1e-2)."""
    facts = load("chemakzo")
    names = tuple(f"chemakzo.{s}" for s in SPECIES)
    return Problem(
        name="chemakzo",
        build=alone(AkzoNobel),
        reference=named("chemakzo", SPECIES, facts["reference"]["y"]),
        scale=dict.fromkeys(names, 0.0),
        digits=15.0,
        origin="published",
        t1=facts["time"]["t_end"],
        index_one=lambda: IndexOne(
            _akzo, np.array([1.0] * 5 + [0.0]), np.array(facts["initial"]["y0"]), facts["parameters"], names
        ),
        given=True,
        atol=1e-3,
    )
