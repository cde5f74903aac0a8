"""Mechanisms with closed loops: the slider-crank with its stabilised constraints, Andrews' squeezing mechanism."""

from types import SimpleNamespace

import numpy as np
import sympy

from jaxonomy_dae import Component, EqnEnv, der

from .index_one import mechanical
from .problem import Problem, Table, alone, load, named

# --- slider-crank ------------------------------------------------------------------------------------------------

CRANK = ("q", "x", "p", "v_q", "v_x", "v_p", "lam1", "lam2", "mu1", "mu2")


def _slider_crank(t, coordinates, velocities, p):
    """(M, f, c) of M·q'' = f − Gᵀλ, 0 = c(q): a spring-damper between the crank's and the rod's middle."""
    (q, x, r), (qd, xd, rd) = coordinates, velocities
    s1, c1, s2, c2 = sympy.sin(q), sympy.cos(q), sympy.sin(r), sympy.cos(r)
    s21, c21 = s2 * c1 - c2 * s1, c2 * c1 + s2 * s1
    length = sympy.sqrt(x**2 - x * (c2 + p.a * c1) + (1 + p.a**2) / 4 + p.a * c21 / 2)
    speed = (2 * x * xd - xd * (c2 + p.a * c1) + x * (s2 * rd + p.a * s1 * qd) - p.a * s21 * (rd - qd) / 2) / (
        2 * length
    )
    pull = (p.k * (length - p.l0) + p.c * speed) / length
    force = sympy.Matrix(
        [
            -pull * p.a * (s21 / 2 + x * s1) / 2,
            pull * (c2 / 2 - x + p.a * c1 / 2) + p.F,
            -pull * (x * s2 - p.a * s21 / 2) / 2 - p.F * s2,
        ]
    )
    return sympy.diag(p.J1, p.m2, p.J2), force, sympy.Matrix([x - c2 - p.a * c1, -s2 - p.a * s1])


class SliderCrank(Component):
    """A slider-crank with positions and speeds constrained: stabilised index 2 (Gear, Gupta & Leimkuhler 1985).

    q' = v − Gᵀμ, M·v' = f − Gᵀλ, 0 = c(q), 0 = G·v; μ is zero in the solution.
    """

    def __init__(self, ev: EqnEnv, name: str = "sundials_slcrank"):
        super().__init__(ev, name)
        facts = load("sundials_slcrank")
        p = SimpleNamespace(**{k: self.parameter(k, v) for k, v in facts["parameters"].items()})
        y = [
            self.variable(n, start=y0, fixed=n in ("q", "v_q"))
            for n, y0 in zip(CRANK, facts["initial"]["y0"], strict=True)
        ]
        q, v, lam, mu = y[:3], y[3:6], sympy.Matrix(y[6:8]), sympy.Matrix(y[8:])
        mass, force, constraint = _slider_crank(ev.t, q, v, p)
        jacobian = constraint.jacobian(q)
        self.add_equations(
            *(sympy.Matrix([der(s) for s in q]) - sympy.Matrix(v) + jacobian.T * mu),
            *(mass * sympy.Matrix([der(s) for s in v]) - force + jacobian.T * lam),
            *constraint,
            *(jacobian * sympy.Matrix(v)),
        )


def sundials_slcrank() -> Problem:
    """Not stiff, smooth. Published to five digits, 4.7 of them right."""
    facts = load("sundials_slcrank")
    known = CRANK[:8]
    names = tuple(f"sundials_slcrank.{n}" for n in known)
    track = facts["reference_trajectory"]
    y0 = facts["initial"]["y0"]
    return Problem(
        name="sundials_slcrank",
        build=alone(SliderCrank),
        reference=named("sundials_slcrank", known, facts["recomputed"]["y_end"][:8]),
        scale=dict.fromkeys(names, 1.0),
        digits=10.0,
        origin="recomputed: " + facts["recomputed"]["method"],
        t1=facts["time"]["t_end"],
        index_one=lambda: mechanical(_slider_crank, facts["parameters"], y0[:3], y0[3:6], names, accelerations=False),
        given=False,
        published=named("sundials_slcrank", CRANK, facts["reference"]["y"]),
        published_digits=4.5,
        table=Table(np.array(track["t"]), dict(zip(names[:3], np.array(track["y1_y2_y3"]).T, strict=True)), digits=4.2),
    )


# --- Andrews' squeezing mechanism --------------------------------------------------------------------------------

ANGLES = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")


def _squeezer(t, q, v, p):
    """(M, f, c) of M(q)·q'' = f − Gᵀλ, 0 = c(q) (Mazzia & Magherini 2008, II-13)."""
    q1, q2, q3, q4, q5, q6, q7 = q
    v1, v2, _, v4, v5, v6, v7 = v
    sin, cos = sympy.sin, sympy.cos
    near, far = p.e - p.ea, p.zf - p.fa
    m = sympy.zeros(7, 7)
    m[0, 0] = p.m1 * p.ra**2 + p.m2 * (p.rr**2 - 2 * p.da * p.rr * cos(q2) + p.da**2) + p.I1 + p.I2
    m[0, 1] = m[1, 0] = p.m2 * (p.da**2 - p.da * p.rr * cos(q2)) + p.I2
    m[1, 1] = p.m2 * p.da**2 + p.I2
    m[2, 2] = p.m3 * (p.sa**2 + p.sb**2) + p.I3
    m[3, 3] = p.m4 * near**2 + p.I4
    m[3, 4] = m[4, 3] = p.m4 * (near**2 + p.zt * near * sin(q4)) + p.I4
    m[4, 4] = p.m4 * (p.zt**2 + 2 * p.zt * near * sin(q4) + near**2) + p.m5 * (p.ta**2 + p.tb**2) + p.I4 + p.I5
    m[5, 5] = p.m6 * far**2 + p.I6
    m[5, 6] = m[6, 5] = p.m6 * (far**2 - p.u * far * sin(q6)) + p.I6
    m[6, 6] = p.m6 * (far**2 - 2 * p.u * far * sin(q6) + p.u**2) + p.m7 * (p.ua**2 + p.ub**2) + p.I6 + p.I7
    xd = p.sd * cos(q3) + p.sc * sin(q3) + p.xb
    yd = p.sd * sin(q3) - p.sc * cos(q3) + p.yb
    length = sympy.sqrt((xd - p.xc) ** 2 + (yd - p.yc) ** 2)
    pull = -p.c0 * (length - p.l0) / length
    fx, fy = pull * (xd - p.xc), pull * (yd - p.yc)
    force = sympy.Matrix(
        [
            p.mom - p.m2 * p.da * p.rr * v2 * (v2 + 2 * v1) * sin(q2),
            p.m2 * p.da * p.rr * v1**2 * sin(q2),
            fx * (p.sc * cos(q3) - p.sd * sin(q3)) + fy * (p.sd * cos(q3) + p.sc * sin(q3)),
            p.m4 * p.zt * near * v5**2 * cos(q4),
            -p.m4 * p.zt * near * v4 * (v4 + 2 * v5) * cos(q4),
            -p.m6 * p.u * far * v7**2 * cos(q6),
            p.m6 * p.u * far * v6 * (v6 + 2 * v7) * cos(q6),
        ]
    )
    x, y = p.rr * cos(q1) - p.d * cos(q1 + q2), p.rr * sin(q1) - p.d * sin(q1 + q2)
    constraint = sympy.Matrix(
        [
            x - p.ss * sin(q3) - p.xb,
            y + p.ss * cos(q3) - p.yb,
            x - p.e * sin(q4 + q5) - p.zt * cos(q5) - p.xa,
            y + p.e * cos(q4 + q5) - p.zt * sin(q5) - p.ya,
            x - p.zf * cos(q6 + q7) - p.u * sin(q7) - p.xa,
            y - p.zf * sin(q6 + q7) + p.u * cos(q7) - p.ya,
        ]
    )
    return m, force, constraint


class SqueezingMechanism(Component):
    """Seven bodies in three loops, driven by a constant torque (Manning 1981; Hairer & Wanner 1996, VII.7): index 3.

    q' = v, v' = w, 0 = M(q)·w − f(q, v) + Gᵀλ, 0 = g(q).
    """

    def __init__(self, ev: EqnEnv, name: str = "andrews"):
        super().__init__(ev, name)
        facts = load("andrews")
        p = SimpleNamespace(**{k: self.parameter(k, v) for k, v in facts["parameters"].items()})
        y0 = facts["initial"]["y0"]
        # Two degrees of freedom: one angle and its speed; the loops determine the others near the published starts.
        q = [self.variable(n, start=y0[k], fixed=n == "Theta", unit="rad") for k, n in enumerate(ANGLES)]
        v = [
            self.variable("v_" + n, start=y0[7 + k], fixed=n == "Theta", nominal=1e3, unit="rad/s")
            for k, n in enumerate(ANGLES)
        ]
        w = [self.variable("w_" + n, start=y0[14 + k], nominal=1e5, unit="rad/s2") for k, n in enumerate(ANGLES)]
        lam = [self.variable(f"lam{k + 1}", start=y0[21 + k], nominal=1e2) for k in range(6)]
        mass, force, constraint = _squeezer(ev.t, q, v, p)
        self.add_equations(
            *(der(a) - b for a, b in zip(q, v, strict=True)),
            *(der(a) - b for a, b in zip(v, w, strict=True)),
            *(mass * sympy.Matrix(w) - force + constraint.jacobian(q).T * sympy.Matrix(lam)),
            *constraint,
        )


def andrews() -> Problem:
    """Not stiff, strongly nonlinear; the published positions carry 9.6 digits, what moves faster fewer."""
    facts = load("andrews")
    variables = (*ANGLES, *("v_" + n for n in ANGLES), *("w_" + n for n in ANGLES), *(f"lam{k}" for k in range(1, 7)))
    y0 = facts["initial"]["y0"]
    return Problem(
        name="andrews",
        build=alone(SqueezingMechanism),
        reference=named("andrews", ANGLES, facts["reference"]["y"][:7]),
        scale={f"andrews.{n}": 1.0 for n in ANGLES},
        digits=9.5,
        origin="published",
        t1=facts["time"]["t_end"],
        index_one=lambda: mechanical(
            _squeezer,
            facts["parameters"],
            y0[:7],
            y0[7:14],
            tuple(f"andrews.{n}" for n in variables),
            accelerations=True,
        ),
        given=False,
    )
