"""Networks of pipes and orifices with turbulent laws, sources and tanks, whose solution is chosen first.

Pressures and flows are drawn at random, and the branches' coefficients are what they must be. As the law of every
branch rises strictly, the network has no other solution (Birkhoff & Diaz 1956).
"""

import numpy as np
import sympy

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.write import Domain

from .case import TOLERANCE, Case, Expected, diagram_of, log_uniform, names, signed

Hydraulic = Domain("Hydraulic", across=(("p", "Pa"),), through=(("q", "m3/s"),))


class _Branch(Component):
    def ends(self, guess):
        a, b = self.port("a", Hydraulic), self.port("b", Hydraulic)
        q, dp = self.variable("q", start=guess), self.variable("dp")
        self.add_equations(q - a.q, a.q + b.q, dp - a.p + b.p)
        return q, dp


class TurbulentPipe(_Branch):
    """dp = k·q·|q|."""

    def __init__(self, ev, name, k, guess):
        super().__init__(ev, name)
        q, dp = self.ends(guess)
        self.add_equations(sympy.Eq(dp, self.parameter("k", k) * q * sympy.Abs(q)))


class Orifice(_Branch):
    """q = c·sign(dp)·√|dp|."""

    def __init__(self, ev, name, k, guess):
        super().__init__(ev, name)
        q, dp = self.ends(guess)
        c = self.parameter("c", k**-0.5)
        self.add_equations(sympy.Eq(q, c * sympy.sign(dp) * sympy.sqrt(sympy.Abs(dp))))


class MixedPipe(_Branch):
    """dp = r·q + k·q·|q|."""

    def __init__(self, ev, name, k, r, guess):
        super().__init__(ev, name)
        q, dp = self.ends(guess)
        self.add_equations(sympy.Eq(dp, self.parameter("r", r) * q + self.parameter("k", k) * q * sympy.Abs(q)))


class LaminarPipe(_Branch):
    """dp = r·q."""

    def __init__(self, ev, name, r, guess):
        super().__init__(ev, name)
        q, dp = self.ends(guess)
        self.add_equations(sympy.Eq(dp, self.parameter("r", r) * q))


class Reservoir(Component):
    """A port at constant pressure."""

    def __init__(self, ev, name, p):
        super().__init__(ev, name)
        port = self.port("a", Hydraulic)
        self.add_equations(sympy.Eq(port.p, self.parameter("p", p)))


class Supply(Component):
    """A constant flow out of its port."""

    def __init__(self, ev, name, q):
        super().__init__(ev, name)
        port = self.port("a", Hydraulic)
        self.add_equations(sympy.Eq(port.q, -self.parameter("q", q)))


class Tank(Component):
    """area·dh/dt = a.q, p = w·h with the weight per volume w."""

    def __init__(self, ev, name, area, weight, level):
        super().__init__(ev, name)
        port = self.port("a", Hydraulic)
        h = self.variable("h", start=self.parameter("level", level), fixed=True)
        self.add_equations(
            sympy.Eq(self.parameter("area", area) * der(h), port.q),
            sympy.Eq(port.p, self.parameter("w", weight) * h),
        )


def make(seed: int) -> Case:
    """A tree with loops of 2 to 16 nodes; in SI units (1e5 Pa, 1e-3 m³/s), for hydraulics (2e7 Pa) or of size one."""
    rng = np.random.default_rng([seed, 6])
    ev = EqnEnv()
    n = int(round(log_uniform(rng, np.log10(2), np.log10(16))))
    edges = [(int(rng.integers(0, k)), k) for k in range(1, n)]
    edges += [tuple(map(int, rng.choice(n, 2, replace=False))) for _ in range(int(rng.integers(0, n)))]
    edges = [e if rng.random() < 0.5 else e[::-1] for e in edges]
    bar, liter = ((1e5, 1e-3), (1.0, 1.0), (2e7, 1e-4))[int(rng.integers(0, 3))]
    pressure = bar * rng.uniform(-2, 2, n)
    share = rng.dirichlet([1, 1, 1, 1])
    kinds = [("turbulent", "orifice", "mixed", "laminar")[j] for j in rng.choice(4, len(edges), p=share)]
    dp = np.array([pressure[a] - pressure[b] for a, b in edges])
    q = np.array([liter * np.sign(d) * log_uniform(rng, -1, 1) for d in dp])
    # At a junction one branch, whose other end is not yet done, closes the balance.
    boundary = ["reservoir", *rng.choice(["reservoir", "tank", "supply", "junction"], n - 1, p=[0.15, 0.15, 0.1, 0.6])]
    done: set[int] = set()
    for node in rng.permutation(n).tolist():
        if boundary[node] != "junction":
            continue
        done.add(node)
        out = [
            (e, 1.0 if a == node else -1.0, b if a == node else a) for e, (a, b) in enumerate(edges) if node in (a, b)
        ]
        for e, sign, other in out:
            closing = -sum(s * q[k] for k, s, _ in out if k != e) * sign
            if other not in done and closing * dp[e] > 0 and 1e-2 < abs(closing) / liter < 1e2:
                q[e] = closing
                break
        else:
            boundary[node] = "supply"
    guessed = rng.random() < 0.5
    label = names(rng, len(edges) + n)
    parts, expected, rates = [], {}, {}
    nodes: list[list] = [[] for _ in range(n)]
    leaving = np.zeros(n)
    much, high = float(np.max(np.abs(q))), float(np.max(np.abs(pressure)))
    for (a, b), kind, name, drop, flow in zip(edges, kinds, label, dp.tolist(), q.tolist(), strict=False):
        guess = float(liter * signed(rng, log_uniform(rng, -1, 1))) if guessed else None
        k = drop / (flow * abs(flow))
        if kind == "turbulent":
            part = TurbulentPipe(ev, name, k, guess)
        elif kind == "orifice":
            part = Orifice(ev, name, k, guess)
        elif kind == "mixed":
            laminar = float(rng.uniform(0.1, 0.9))
            part = MixedPipe(ev, name, k * (1 - laminar), laminar * drop / flow, guess)
        else:
            part = LaminarPipe(ev, name, drop / flow, guess)
        parts.append(part)
        nodes[a].append(part.a)
        nodes[b].append(part.b)
        leaving[a] += flow
        leaving[b] -= flow
        expected[f"{name}.q"] = Expected(flow, TOLERANCE * much)
        expected[f"{name}.dp"] = Expected(drop, TOLERANCE * high)
        expected[f"{name}.a.p"] = Expected(float(pressure[a]), TOLERANCE * high)
    for node, kind in enumerate(boundary):
        name, flow, p = label[len(edges) + node], float(leaving[node]), float(pressure[node])
        if kind == "junction":
            continue
        if kind == "supply":
            part = Supply(ev, name, flow)
        elif kind == "reservoir":
            part = Reservoir(ev, name, p)
            expected[f"{name}.a.q"] = Expected(-flow, TOLERANCE * much)
        else:
            area, weight = log_uniform(rng, -1, 1), bar * log_uniform(rng, -1, 1)
            part = Tank(ev, name, area, weight, p / weight)
            rates[f"{name}.h"] = Expected(-flow / area, TOLERANCE * much / area)
        parts.append(part)
        nodes[node].append(part.a)
    note = f"{n} nodes, {'/'.join(sorted(set(kinds)))}, {'with' if guessed else 'without'} guesses, {bar:g} Pa"
    return Case(ev, diagram_of(rng, parts, nodes), {}, expected, rates, note=note)
