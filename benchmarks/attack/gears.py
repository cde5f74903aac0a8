"""Gear trains of inertias, springs, dampers and ideal gears, against the torques at every node."""

from collections.abc import Mapping

import numpy as np
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv
from jaxonomy_dae.library.rotational import Damper, FixedAngle, IdealGear, Inertia, Spring
from jaxonomy_dae.write import Rotational

from .case import UNCHANGED, Case, log_uniform, names, signed
from .linear_network import LinearNetwork

WORDS = ["determine", "contradict", "singular", "redundant", "follow", "too many", "nothing holds", "connected"]


class ConstantTorque(Component):
    """A torque that turns its flange forwards."""

    def __init__(self, ev, name, size):
        super().__init__(ev, name)
        flange = self.port("flange", Rotational)
        self.add_equations(Eq(flange.tau, -self.parameter("size", size)))


def make(seed: int, factors: Mapping[str, float] = UNCHANGED) -> Case:
    """A train or a tree of 2 to 9 shafts; sometimes a loop of gears, which locks or is one condition too many.
    `factors` change the values of parts, by name."""
    rng = np.random.default_rng([seed, 4])
    ev = EqnEnv()
    net = LinearNetwork(ev)
    n = int(rng.integers(2, 10))
    chain = rng.random() < 0.5
    probability = rng.dirichlet([1.5, 1.0, 1.0, 0.5])
    kinds = ["gear", "inertia", "spring", "damper"]

    def kind() -> str:
        return kinds[int(rng.choice(4, p=probability))]

    edges = [(kind(), k - 1 if chain else int(rng.integers(0, k)), k) for k in range(1, n)]
    for _ in range(int(rng.integers(0, n // 2 + 1))):
        a, b = map(int, rng.choice(n, 2, replace=False))
        edges.append((kind() if rng.random() < 0.15 else kinds[int(rng.integers(2, 4))], a, b))
    edges += [("disc", k, k) for k in range(n) if rng.random() < 0.5]
    edges += [("torque", k, k) for k in range(n) if rng.random() < 0.2]
    edges += [("fixed", k, k) for k in range(n) if rng.random() < 0.1]
    label = names(rng, len(edges))
    net.nodes = [[] for _ in range(n)]
    decades = rng.uniform(0, 3)

    def value() -> float:
        return log_uniform(rng, -decades / 2, decades / 2)

    phi, w = [net.unknown() for _ in range(n)], [net.unknown() for _ in range(n)]
    into: list[dict[int, float]] = [{} for _ in range(n)]  # torque into the components at a node: sums to zero
    rates: list[dict[int, float]] = [{} for _ in range(n)]
    right = np.zeros(n)

    def enter(node: int, terms: dict[int, float], sign: float = 1.0, constant: float = 0.0):
        for k, c in terms.items():
            into[node][k] = into[node].get(k, 0.0) + sign * c
        right[node] -= sign * constant

    for node in range(n):
        net.equation({w[node]: -1.0}, {phi[node]: 1.0})
    for (which, a, b), name in zip(edges, label, strict=True):
        if rng.random() < 0.5:
            a, b = b, a
        k = value() * factors.get(name, 1.0)
        angle = {phi[b]: 1.0, phi[a]: -1.0}
        if which == "gear":
            ratio = signed(rng, log_uniform(rng, -1, 1)) * factors.get(name, 1.0)
            part = IdealGear(ev, name, ratio)
            tau = net.unknown()
            enter(a, {tau: 1.0})
            enter(b, {tau: -ratio})
            net.equation({phi[a]: 1.0, phi[b]: -ratio})
            net.read(f"{name}.flange_a.tau", "tau", {tau: 1.0})
            net.read(f"{name}.flange_b.tau", "tau", {tau: -ratio})
        elif which in ("inertia", "disc"):
            part = Inertia(ev, name, k)
            if which == "inertia":
                tau = net.unknown()  # into flange_a; J·dw/dt = tau_a + tau_b
                enter(a, {tau: 1.0})
                enter(b, {tau: -1.0})
                rates[b][w[b]] = rates[b].get(w[b], 0.0) + k
                net.equation(angle)
                net.read(f"{name}.flange_a.tau", "tau", {tau: 1.0})
                net.read(f"{name}.flange_b.tau", "tau", {tau: -1.0}, {w[b]: k})
            else:
                rates[a][w[a]] = rates[a].get(w[a], 0.0) + k
            net.start_name[phi[b]], net.start_name[w[b]] = f"{name}.phi", f"{name}.w"
            net.read(f"{name}.phi", "phi", {phi[b]: 1.0})
            net.read(f"{name}.w", "w", {w[b]: 1.0})
            net.read(f"{name}.a", "a", {}, {w[b]: 1.0})
        elif which == "spring":
            rest = float(rng.uniform(-1, 1))
            part = Spring(ev, name, k, rest)
            terms = {phi[b]: k, phi[a]: -k}
            enter(b, terms, 1.0, -k * rest)
            enter(a, terms, -1.0, -k * rest)
            net.read(f"{name}.tau", "tau", terms, constant=-k * rest)
            net.read(f"{name}.phi_rel", "phi", angle)
        elif which == "damper":
            part = Damper(ev, name, k)
            terms = {w[b]: k, w[a]: -k}
            enter(b, terms)
            enter(a, terms, -1.0)
            net.read(f"{name}.tau", "tau", terms)
            net.read(f"{name}.w_rel", "w", {w[b]: 1.0, w[a]: -1.0})
        elif which == "torque":
            k = signed(rng, k)
            part = ConstantTorque(ev, name, k)
            right[a] += k
        else:
            where = float(rng.uniform(-1, 1))
            part = FixedAngle(ev, name, where)
            tau = net.unknown()
            enter(a, {tau: 1.0})
            net.equation({phi[a]: 1.0}, right=[where])
            net.read(f"{name}.flange.tau", "tau", {tau: 1.0})
        net.parts.append(part)
        if which in ("torque", "fixed"):
            net.nodes[a].append(part.flange)
            continue
        ends = ((part.flange_a, a), (part.flange_b, b)) if which != "disc" else ((part.flange_a, a),)
        for flange, node in ends:
            net.nodes[node].append(flange)
            net.start_name.setdefault(phi[node], f"{name}.{flange.name}.phi")
            net.read(f"{name}.{flange.name}.phi", "phi", {phi[node]: 1.0})
    for node in range(n):
        net.equation(into[node], rates[node], [right[node]])
    return net.case(rng, 1.0, WORDS, f"{n} shafts, {len(edges)} parts", end=1.0)
