"""Mechanisms with explicit masses and few constraints: two pendulums and a car axis, index 3."""

from types import SimpleNamespace

import numpy as np
import scipy.special
import sympy

from jaxonomy_dae import Component, EqnEnv, der

from .index_one import mechanical
from .problem import Problem, alone, load, named

# --- pendulums ---------------------------------------------------------------------------------------------------

COORDINATES = ("x", "y", "vx", "vy", "lam")


class Pendulum(Component):
    """x'' = −λx, y'' = −λy − g, 0 = x² + y² − 1: index 3."""

    def __init__(self, ev: EqnEnv, facts: dict):
        super().__init__(ev, facts["name"])
        g = self.parameter("g", facts["parameters"]["g"])
        x0, y0, vx0, vy0, lam0 = facts["initial"]["y0"]
        x, y = self.variable("x", start=x0), self.variable("y", start=y0, fixed=True)
        vx, vy = self.variable("vx", start=vx0), self.variable("vy", start=vy0, fixed=True)
        lam = self.variable("lam", start=lam0)
        self.add_equations(der(x) - vx, der(y) - vy, der(vx) + x * lam, der(vy) + y * lam + g, x**2 + y**2 - 1)


def _kinetics(t, q, v, p):
    x, y = q
    return sympy.eye(2), sympy.Matrix([0, -p.g]), sympy.Matrix([(x**2 + y**2 - 1) / 2])


def pendulum_exact(ts, psi0: float, omega0: float, g: float) -> np.ndarray:
    """(x, y, x', y', λ) at `ts`, shape `(len(ts), 5)`, by Jacobi's elliptic functions.

    ψ'' = −g·sin ψ from the lowest point, swinging (not circling): sin(ψ/2) = k·sn(√g·t + c, k²), with
    k² = sin²(ψ0/2) + ω0²/(4g).
    """
    k = np.sqrt(np.sin(psi0 / 2) ** 2 + omega0**2 / (4 * g))
    # Near a turning point the arcsine is ill conditioned, the arctangent of (sn, cn) is not: cn = ω0/(2·k·√g).
    phase = scipy.special.ellipkinc(np.arctan2(np.sin(psi0 / 2) / k, omega0 / (2 * k * np.sqrt(g))), k**2)
    sn, cn, dn, _ = scipy.special.ellipj(np.sqrt(g) * np.asarray(ts) + phase, k**2)
    sine, cosine, omega = k * sn, dn, 2 * k * np.sqrt(g) * cn
    x, y = 2 * sine * cosine, sine**2 - cosine**2
    return np.stack([x, y, -y * omega, x * omega, omega**2 - g * y], axis=-1)


def _pendulum(name: str, reference: list[float], digits: float, origin: str, **published) -> Problem:
    facts = load(name)
    start = facts["initial"]["y0"]
    g = facts["parameters"]["g"]
    names = tuple(f"{name}.{c}" for c in COORDINATES)
    return Problem(
        name=name,
        build=alone(lambda ev: Pendulum(ev, facts)),
        reference=named(name, COORDINATES, reference),
        scale=dict(zip(names, (1.0, 1.0, np.sqrt(g), np.sqrt(g), g), strict=True)),
        digits=digits,
        origin=origin,
        t1=facts["time"]["t_end"],
        index_one=lambda: mechanical(_kinetics, facts["parameters"], start[:2], start[2:4], names, accelerations=False),
        given=False,
        **published,
    )


def pendulum_cash() -> Problem:
    """From (1, 0) upwards at speed 1, to t = 1."""
    facts = load("pendulum_cash")
    return _pendulum(
        "pendulum_cash",
        pendulum_exact([facts["time"]["t_end"]], np.pi / 2, 1.0, facts["parameters"]["g"])[0].tolist(),
        14.0,
        "exact: Jacobi's elliptic functions",
        published=named("pendulum_cash", COORDINATES, facts["reference"]["y"]),
        published_digits=9.0,
    )


def pendulum_period2() -> Problem:
    """From rest at the horizontal, gravity chosen so that the period is 2: at t = 2 all is as at the start."""
    facts = load("pendulum_period2")
    return _pendulum("pendulum_period2", facts["reference"]["y"], 14.0, "exact: one period")


# --- car axis ----------------------------------------------------------------------------------------------------

AXIS = ("xl", "yl", "xr", "yr")


def _road(t, p, sin, sqrt):
    """The right wheel's contact (xb, yb)."""
    yb = p.h * sin(p.omega * t)
    return sqrt(p.L**2 - yb**2), yb


def _axis(t, q, v, p):
    """(k·1, f, c) of k·q'' = f − Gᵀλ, 0 = c(t, q)."""
    xl, yl, xr, yr = q
    xb, yb = _road(t, p, sympy.sin, sympy.sqrt)
    k = p.eps**2 * p.M / 2
    left, right = sympy.sqrt(xl**2 + yl**2), sympy.sqrt((xr - xb) ** 2 + (yr - yb) ** 2)
    force = sympy.Matrix(
        [
            (p.L0 - left) * xl / left,
            (p.L0 - left) * yl / left - k * p.g,
            (p.L0 - right) * (xr - xb) / right,
            (p.L0 - right) * (yr - yb) / right - k * p.g,
        ]
    )
    # Published with +Gᵀλ.
    constraint = -sympy.Matrix([xb * xl + yb * yl, (xl - xr) ** 2 + (yl - yr) ** 2 - p.L**2])
    return k * sympy.eye(4), force, constraint


class CarAxis(Component):
    """An axis on two springs, the right one on a bumpy road (Schneider 1994; Mazzia & Magherini 2008, II-17): index 3.

    The first constraint depends on time; the springs are stiff (k = 5e-4).
    """

    def __init__(self, ev: EqnEnv, name: str = "caraxis"):
        super().__init__(ev, name)
        facts = load("caraxis")
        p = SimpleNamespace(**{k: self.parameter(k, v) for k, v in facts["parameters"].items()})
        y0 = facts["initial"]["y0"]
        # The constraints determine xl and xr; the two heights and their speeds are free.
        q = [self.variable(n, start=y0[k], fixed=n in ("yl", "yr")) for k, n in enumerate(AXIS)]
        v = [self.variable("v_" + n, start=y0[4 + k], fixed=n in ("yl", "yr")) for k, n in enumerate(AXIS)]
        lam = [self.variable(f"lam{k}", start=y0[7 + k], nominal=1e-2) for k in (1, 2)]
        mass, force, constraint = _axis(ev.t, q, v, p)
        balance = mass * sympy.Matrix([der(s) for s in v]) - force + constraint.jacobian(q).T * sympy.Matrix(lam)
        self.add_equations(*(der(a) - b for a, b in zip(q, v, strict=True)), *balance, *constraint)


def caraxis() -> Problem:
    """Springs of 45 rad/s; the error grows along the way. 9.2 of the printed digits are right."""
    facts = load("caraxis")
    variables = (*AXIS, *("v_" + n for n in AXIS), "lam1", "lam2")
    names = tuple(f"caraxis.{n}" for n in variables)
    y0 = facts["initial"]["y0"]
    p = SimpleNamespace(**facts["parameters"])
    # In units of the spring's oscillation: lengths L, speeds L·sqrt(1/k), multipliers by the springs' unit stiffness.
    scale = [p.L] * 4 + [p.L / np.sqrt(p.eps**2 * p.M / 2)] * 4 + [1.0] * 2
    return Problem(
        name="caraxis",
        build=alone(CarAxis),
        reference=named("caraxis", variables, facts["reference"]["y"]),
        scale=dict(zip(names, scale, strict=True)),
        digits=9.2,
        origin="published",
        t1=facts["time"]["t_end"],
        index_one=lambda: mechanical(_axis, facts["parameters"], y0[:4], y0[4:8], names, accelerations=False),
        given=False,
    )
