"""The heat equation on the unit square, boundary conditions as algebraic equations: index 1, any size."""

import numpy as np
import sympy

from jaxonomy_dae import Component, EqnEnv, der

from .index_one import IndexOne
from .problem import Problem, Table, alone, load


def _interior(m: int) -> np.ndarray:
    """Whether a point of the m × m grid is inside, row by row, shape `(m²,)`."""
    inside = np.zeros((m, m), bool)
    inside[1:-1, 1:-1] = True
    return inside.ravel()


def _start(m: int) -> np.ndarray:
    """16·x(1 − x)·y(1 − y), which is zero on the boundary."""
    s = np.linspace(0.0, 1.0, m)
    bump = s * (1 - s)
    return 16 * np.outer(bump, bump).ravel()


def heat_exact(m: int, ts) -> np.ndarray:
    """The exact solution of the discretised equation, shape `(len(ts), m²)`, by the discrete sine transform."""
    n, dx = m - 1, 1.0 / (m - 1)
    k = np.arange(1, n)
    modes = np.sin(np.pi * np.outer(k, k) / n)  # symmetric; modes @ modes = n/2
    rate = -4 / dx**2 * np.sin(np.pi * k / (2 * n)) ** 2
    inside = _start(m).reshape(m, m)[1:-1, 1:-1]
    amplitude = modes @ inside @ modes * (2 / n) ** 2
    out = np.zeros((len(ts), m, m))
    for row, t in enumerate(ts):
        decay = np.exp(np.add.outer(rate, rate) * t)
        out[row, 1:-1, 1:-1] = modes @ (amplitude * decay) @ modes
    return out.reshape(len(ts), -1)


class Plate(Component):
    """u' = Δu by second differences inside an m × m grid, 0 = u on its boundary."""

    def __init__(self, ev: EqnEnv, name: str = "plate", m: int = 10):
        super().__init__(ev, name)
        inside, start = _interior(m), _start(m)
        u = [self.variable(f"u{k // m}_{k % m}", start=float(start[k]), fixed=bool(inside[k])) for k in range(m * m)]
        rate = sympy.Integer((m - 1) ** 2)
        for k in range(m * m):
            if inside[k]:
                self.add_equations(der(u[k]) - rate * (u[k - 1] + u[k + 1] + u[k - m] + u[k + m] - 4 * u[k]))
            else:
                self.add_equations(u[k])


def _right_side(m: int):
    inside = _interior(m)
    order = np.concatenate([np.flatnonzero(inside), np.flatnonzero(~inside)])
    place = np.argsort(order)  # where each grid point is among the unknowns

    def right_side(t, y, p, module):
        if module.__name__ == "casadi":
            rows, columns, values = [], [], []
            for row, k in enumerate(order):
                near = [(k - 1, 1), (k + 1, 1), (k - m, 1), (k + m, 1), (k, -4)] if inside[k] else [(k, 1)]
                for other, weight in near:
                    rows.append(row)
                    columns.append(int(place[other]))
                    values.append(weight * float((m - 1) ** 2 if inside[k] else 1))
            sparsity = module.Sparsity.triplet(m * m, m * m, rows, columns)
            matrix = module.DM(sparsity, 0)
            for r, c, v in zip(rows, columns, values, strict=True):
                matrix[r, c] = v
            return matrix @ y
        u = y[place].reshape((m, m, *y.shape[1:]))
        near = u[:-2, 1:-1] + u[2:, 1:-1] + u[1:-1, :-2] + u[1:-1, 2:] - 4 * u[1:-1, 1:-1]
        slope = ((m - 1.0) ** 2 * near).reshape(((m - 2) ** 2, *y.shape[1:]))
        return module.concatenate([slope, y[(m - 2) ** 2 :]])

    return right_side, order


def sundials_heat2d(m: int = 10) -> Problem:
    """Linear, m² unknowns, the stiffer the finer.

    The published table has 1 to 4 digits; the exact discrete solution is known.
    """
    facts = load("sundials_heat2d")
    end = facts["time"]["t_end"]
    names = [f"plate.u{k // m}_{k % m}" for k in range(m * m)]
    exact = heat_exact(m, [end])[0]
    inside = _interior(m)

    def index_one():
        right_side, order = _right_side(m)
        return IndexOne(right_side, inside[order].astype(float), _start(m)[order], {}, tuple(names[k] for k in order))

    peak = names[np.argmax(_start(m))]
    ts, top = np.array(facts["reference"]["table"]).T
    return Problem(
        name="sundials_heat2d",
        build=alone(lambda ev: Plate(ev, m=m)),
        reference={n: float(v) for n, v, free in zip(names, exact, inside, strict=True) if free},
        scale=dict.fromkeys(names, 1e-2),
        digits=13.0,
        origin="exact: discrete sine transform",
        t1=end,
        index_one=index_one,
        given=True,
        atol=1e-3,
        stiff=m > 20,
        table=Table(ts, {peak: top}, digits=1.0) if m == 10 else None,
    )
