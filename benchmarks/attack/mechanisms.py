"""Point masses in the plane joined by rigid rods (index 3, Cartesian coordinates), against a solve for accelerations
and multipliers."""

import mpmath
import numpy as np
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.write import Domain

from .case import ROUNDING, TOLERANCE, Case, Expected, diagram_of, log_uniform, names

Planar = Domain("Planar", across=(("x", "m"), ("y", "m")), through=(("fx", "N"), ("fy", "N")))


class Body(Component):
    """A point mass under gravity."""

    def __init__(self, ev, name, m, g):
        super().__init__(ev, name)
        port = self.port("at", Planar)
        mass = self.parameter("m", m)
        x, y, vx, vy = (self.variable(k) for k in ("x", "y", "vx", "vy"))
        self.add_equations(
            Eq(x, port.x),
            Eq(y, port.y),
            Eq(der(x), vx),
            Eq(der(y), vy),
            Eq(mass * der(vx), port.fx),
            Eq(mass * der(vy), port.fy - mass * self.parameter("g", g)),
        )


class Link(Component):
    """A massless rigid rod; its force on `a` is 2·lam·(b − a)."""

    def __init__(self, ev, name, length):
        super().__init__(ev, name)
        a, b = self.port("a", Planar), self.port("b", Planar)
        lam = self.variable("lam")
        L = self.parameter("L", length)
        self.add_equations(
            Eq((b.x - a.x) ** 2 + (b.y - a.y) ** 2, L**2),
            Eq(a.fx, -2 * lam * (b.x - a.x)),
            Eq(a.fy, -2 * lam * (b.y - a.y)),
            Eq(a.fx + b.fx, 0),
            Eq(a.fy + b.fy, 0),
        )


class Pivot(Component):
    """A fixed point."""

    def __init__(self, ev, name, x, y):
        super().__init__(ev, name)
        port = self.port("at", Planar)
        self.add_equations(Eq(port.x, self.parameter("x", x)), Eq(port.y, self.parameter("y", y)))


def _solved(jacobian: np.ndarray, inverse: np.ndarray, weight: np.ndarray, gamma: np.ndarray):
    """Multipliers and accelerations, in fifty digits: what balances must not be rounding errors of the reference."""
    if not len(gamma):
        return np.zeros(0), weight
    with mpmath.workdps(50):
        j, w, s = mpmath.matrix(jacobian.tolist()), mpmath.matrix(weight.tolist()), mpmath.diag(inverse.tolist())
        lam = mpmath.lu_solve(j * s * j.T, j * w + mpmath.matrix(gamma.tolist()))
        a = w - s * (j.T * lam)
        return np.array(lam.T.tolist()[0], float), np.array(a.T.tolist()[0], float)


def make(seed: int) -> Case:
    """A tree of 1 to 6 masses with further rods in loops, at a random consistent point."""
    rng = np.random.default_rng([seed, 7])
    ev = EqnEnv()
    masses, pivots = int(rng.integers(1, 7)), int(rng.integers(1, 3))
    n = masses + pivots
    while True:
        place = rng.uniform(-1, 1, (n, 2))
        apart = [np.linalg.norm(place[i] - place[j]) for i in range(n) for j in range(i)]
        if min(apart) > 0.2:
            break
    edges = [(int(rng.integers(0, k)), k) for k in range(pivots, n) if k == pivots or rng.random() < 0.9]
    for _ in range(int(rng.integers(0, masses + 1))):
        a, b = map(int, rng.choice(n, 2, replace=False))
        if max(a, b) >= pivots and (a, b) not in edges and (b, a) not in edges:
            edges.append((a, b))
    m, g = np.array([log_uniform(rng, -1, 1) for _ in range(n)]), 9.81
    # J·v = 0 and J·a = −γ(v) for the masses' coordinates; the constraints are |r_b − r_a|² = L².
    jacobian = np.zeros((len(edges), 2 * n))
    for e, (a, b) in enumerate(edges):
        d = 2 * (place[b] - place[a])
        jacobian[e, 2 * b : 2 * b + 2], jacobian[e, 2 * a : 2 * a + 2] = d, -d
    moving = jacobian[:, 2 * pivots :]
    values = np.linalg.svd(moving, compute_uv=False) if len(edges) else np.ones(1)
    rank = int(np.sum(values > 1e-9))
    if rank == len(edges) and values[-1] < 0.05:  # close to a dead point: no reference is right there
        return make(seed + 100_000)
    free = np.linalg.svd(moving)[2][rank:].T
    v = np.zeros(2 * n)
    v[2 * pivots :] = free @ rng.uniform(-2, 2, free.shape[1]) if free.shape[1] else 0.0
    label = names(rng, n + len(edges))
    nodes: list[list] = [[] for _ in range(n)]
    parts: list[Component] = []
    for k in range(n):
        if k < pivots:
            part = Pivot(ev, label[k], *place[k].tolist())
        else:
            part = Body(ev, label[k], float(m[k]), g)
        parts.append(part)
        nodes[k].append(part.at)
    rods = []
    for e, (a, b) in enumerate(edges):
        if rng.random() < 0.5:
            a, b = b, a
        part = Link(ev, label[n + e], float(np.linalg.norm(place[b] - place[a])))
        parts.append(part)
        rods.append((a, b, part.name))
        nodes[a].append(part.a)
        nodes[b].append(part.b)
    diagram = diagram_of(rng, parts, nodes)
    note = f"{masses} masses, {pivots} pivots, {len(edges)} rods"
    initial = {}
    for k in range(pivots, n):
        for j, axis in enumerate("xy"):
            initial[f"{label[k]}.{axis}"] = float(place[k, j])
            initial[f"{label[k]}.v{axis}"] = float(v[2 * k + j])
    if rank < len(edges):
        words = ["depend", "determine", "contradict", "singular", "redundant", "follow", "too many"]
        return Case(ev, diagram, initial, {}, refusal=words, note=f"{note}; redundant")
    gamma = np.array([2 * np.sum((v[2 * b : 2 * b + 2] - v[2 * a : 2 * a + 2]) ** 2) for a, b in edges])
    inverse = np.repeat(1 / m[pivots:], 2)
    weight = np.tile([0.0, -g], masses)
    # a = weight − M⁻¹·Jᵀ·λ with the force −2·λ·(b − a) on b; J·a = −γ.
    lam, a = _solved(moving, inverse, weight, gamma)
    expected, rates = {}, {}
    strong, fast = max(np.max(np.abs(lam), initial=0), 1e-3), float(np.max(np.abs(a)))
    rounding = ROUNDING * (g + float(np.max(np.abs(inverse * (moving.T @ lam)))))  # where weight and rods balance
    for (_, _, name), value in zip(rods, lam.tolist(), strict=True):
        expected[f"{name}.lam"] = Expected(value, TOLERANCE * strong * 10)
    for k in range(pivots, n):
        for j, axis in enumerate("xy"):
            row = 2 * (k - pivots) + j
            expected[f"{label[k]}.{axis}"] = Expected(float(place[k, j]), TOLERANCE)
            expected[f"{label[k]}.v{axis}"] = Expected(float(v[2 * k + j]), 10 * TOLERANCE)
            rates[f"{label[k]}.{axis}"] = Expected(float(v[2 * k + j]), 10 * TOLERANCE)
            rates[f"{label[k]}.v{axis}"] = Expected(float(a[row]), 10 * TOLERANCE * fast + rounding)
            expected[f"{label[k]}.at.f{axis}"] = Expected(
                float(m[k] * (a[row] - weight[row])), (10 * TOLERANCE * fast + rounding) * float(m[k])
            )
    return Case(ev, diagram, initial, expected, rates, note=note)
