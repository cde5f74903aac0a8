"""Masses, springs, dampers and rigid rods along a line (index 3), against the forces at every node."""

from collections.abc import Mapping

import numpy as np

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Rod, Spring

from .case import UNCHANGED, Case, log_uniform, names
from .linear_network import LinearNetwork

WORDS = ["determine", "contradict", "singular", "redundant", "follow", "too many", "nothing holds", "connected"]


def make(seed: int, factors: Mapping[str, float] = UNCHANGED) -> Case:
    """A chain or a tree with further springs and dampers, of 2 to 9 nodes; some nodes have masses, some are fixed.
    `factors` change the values of parts, by name."""
    rng = np.random.default_rng([seed, 3])
    ev = EqnEnv()
    net = LinearNetwork(ev)
    n = int(rng.integers(2, 10))
    chain = rng.random() < 0.5
    probability = rng.dirichlet([1.5, 1.0, 0.6])
    kinds = ["rod", "spring", "damper"]

    def kind() -> str:
        return kinds[int(rng.choice(3, p=probability))]

    edges = [(kind(), k - 1 if chain else int(rng.integers(0, k)), k) for k in range(1, n)]
    for _ in range(int(rng.integers(0, n))):
        a, b = map(int, rng.choice(n, 2, replace=False))
        edges.append((kind() if rng.random() < 0.1 else kinds[int(rng.integers(1, 3))], a, b))
    label = names(rng, len(edges) + 2 * n)
    net.nodes = [[] for _ in range(n)]
    decades = rng.uniform(0, 3)

    def value() -> float:
        return log_uniform(rng, -decades / 2, decades / 2)

    x, v = [net.unknown() for _ in range(n)], [net.unknown() for _ in range(n)]
    force: list[dict[int, float]] = [{} for _ in range(n)]  # on each node, from springs, dampers and rods
    constant = np.zeros(n)
    inertia: list[dict[int, float]] = [{} for _ in range(n)]

    def pull(a: int, b: int, terms: dict[int, float], rest: float = 0.0):
        """A force that pulls nodes a and b together."""
        for node, sign in ((a, 1.0), (b, -1.0)):
            for k, c in terms.items():
                force[node][k] = force[node].get(k, 0.0) + sign * c
            constant[node] += sign * rest

    for node in range(n):
        net.equation({v[node]: -1.0}, {x[node]: 1.0})
    for (which, a, b), name in zip(edges, label, strict=False):
        if rng.random() < 0.5:
            a, b = b, a
        k, length = value() * factors.get(name, 1.0), float(rng.uniform(-1, 1))
        if which == "rod":
            part = Rod(ev, name, length)
            f = net.unknown()
            pull(a, b, {f: 1.0})
            net.equation({x[b]: 1.0, x[a]: -1.0}, right=[length])
            net.read(f"{name}.f", "f", {f: 1.0})
            net.read(f"{name}.flange_b.f", "f", {f: 1.0})
        elif which == "spring":
            part = Spring(ev, name, k, length)
            terms = {x[b]: k, x[a]: -k}
            pull(a, b, terms, -k * length)
            net.read(f"{name}.f", "f", terms, constant=-k * length)
            net.read(f"{name}.s_rel", "x", {x[b]: 1.0, x[a]: -1.0})
            net.read(f"{name}.flange_a.f", "f", {j: -c for j, c in terms.items()}, constant=k * length)
        else:
            part = Damper(ev, name, k)
            pull(a, b, {v[b]: k, v[a]: -k})
            net.read(f"{name}.f", "f", {v[b]: k, v[a]: -k})
            net.read(f"{name}.v_rel", "v", {v[b]: 1.0, v[a]: -1.0})
        net.parts.append(part)
        for flange, node in ((part.flange_a, a), (part.flange_b, b)):
            net.nodes[node].append(flange)
            net.start_name[x[node]] = f"{name}.{flange.name}.s"
            net.read(f"{name}.{flange.name}.s", "x", {x[node]: 1.0})
    heavy = rng.random()
    for node in range(n):
        name = label[len(edges) + node]
        choice = rng.random()
        if choice < heavy:
            m = value() * factors.get(name, 1.0)
            part = Mass(ev, name, m)
            inertia[node][v[node]] = m
            net.start_name[x[node]], net.start_name[v[node]] = f"{name}.s", f"{name}.v"
            net.read(f"{name}.s", "x", {x[node]: 1.0})
            net.read(f"{name}.v", "v", {v[node]: 1.0})
            net.read(f"{name}.flange.f", "f", {}, {v[node]: m})
        elif choice < heavy + 0.15:
            where = float(rng.uniform(-2, 2))
            part = FixedPosition(ev, name, where)
            reaction = net.unknown()
            force[node][reaction] = force[node].get(reaction, 0.0) - 1.0
            net.equation({x[node]: 1.0}, right=[where])
            net.read(f"{name}.flange.f", "f", {reaction: 1.0})
        else:
            continue
        net.parts.append(part)
        net.nodes[node].append(part.flange)
    for node in range(n):
        net.equation({k: -c for k, c in force[node].items()}, inertia[node], [constant[node]])
    return net.case(rng, 1.0, WORDS, f"{n} nodes, {len(edges)} links", end=1.0)
