"""Circuits of resistors, capacitors, inductors and sources, with loops of capacitors and cut sets of inductors (index
2), against modified nodal analysis."""

from collections.abc import Mapping

import numpy as np
import sympy

from jaxonomy_dae import Component, EqnEnv
from jaxonomy_dae.library.electrical import Capacitor, CurrentSource, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.write import Electrical

from .case import UNCHANGED, Case, log_uniform, names, signed
from .linear_network import ORDER, LinearNetwork


class SineVoltage(Component):
    """v = amplitude·sin(w·t + phase)."""

    def __init__(self, ev, name, amplitude, w, phase):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v, i = self.variable("v"), self.variable("i")
        size, rate, shift = (self.parameter(k, x) for k, x in (("amplitude", amplitude), ("w", w), ("phase", phase)))
        self.add_equations(v - p.v + n.v, i - p.i, p.i + n.i, v - size * sympy.sin(rate * ev.t + shift))


def make(seed: int, factors: Mapping[str, float] = UNCHANGED) -> Case:
    """A circuit of 2 to 14 nodes around ground. `factors` change the values of parts, by name."""
    rng = np.random.default_rng([seed, 2])
    ev = EqnEnv()
    net = LinearNetwork(ev)
    n = int(rng.integers(2, 15))
    weights = rng.dirichlet([1.0, 1.0, 1.0])
    kinds = ["R", "C", "L"]

    def kind() -> str:
        return kinds[int(rng.choice(3, p=weights))]

    edges = [(kind(), int(rng.integers(0, k)), k) for k in range(1, n)]
    constant = rng.random() < 0.6
    for k in rng.permutation(len(edges))[: int(rng.integers(0, 3))]:
        edges[k] = ("V" if constant else "S", *edges[k][1:])
    for _ in range(int(rng.integers(0, n + 2))):
        if n > 2 or rng.random() < 0.5:
            edges.append((kind(), *map(int, rng.choice(n, 2, replace=False))))
    if rng.random() < 0.3:
        edges.append(("I", *map(int, rng.choice(n, 2, replace=False))))
    if rng.random() < 0.03:
        edges.append(("V", *map(int, rng.choice(n, 2, replace=False))))  # maybe in a loop of voltage sources
    label = names(rng, len(edges) + 1)
    ground = Ground(ev, label[-1])
    net.parts, net.nodes = [ground], [[] for _ in range(n)]
    net.nodes[0].append(ground.p)
    decades = rng.uniform(0, 3)

    def value() -> float:
        return log_uniform(rng, -decades / 2, decades / 2)

    v = [-1, *(net.unknown() for _ in range(1, n))]

    def drop(a: int, b: int, factor: float = 1.0) -> dict[int, float]:
        return {k: s * factor for k, s in ((v[a], 1.0), (v[b], -1.0)) if k >= 0}

    values: list[dict[int, float]] = [{} for _ in range(n)]
    rates: list[dict[int, float]] = [{} for _ in range(n)]
    right = np.zeros((n, ORDER + 1))

    def leave(table: list[dict[int, float]], a: int, b: int, terms: dict[int, float]):
        """A current from node a to node b."""
        for node, sign in ((a, 1.0), (b, -1.0)):
            for k, c in terms.items():
                table[node][k] = table[node].get(k, 0.0) + sign * c

    named = {}
    for (which, a, b), name in zip(edges, label, strict=False):
        if rng.random() < 0.5:
            a, b = b, a
        x = value() * factors.get(name, 1.0)
        current: tuple = ({}, {}, 0.0)
        if which == "R":
            part = Resistor(ev, name, x)
            leave(values, a, b, drop(a, b, 1 / x))
            current = (drop(a, b, 1 / x), {}, 0.0)
        elif which == "C":
            part = Capacitor(ev, name, x)
            leave(rates, a, b, drop(a, b, x))
            current = ({}, drop(a, b, x), 0.0)
        elif which == "I":
            part = CurrentSource(ev, name, x)
            right[a, 0] -= x
            right[b, 0] += x
            current = ({}, {}, x)
        else:
            j = net.unknown()
            leave(values, a, b, {j: 1.0})
            current = ({j: 1.0}, {}, 0.0)
            if which == "L":
                part = Inductor(ev, name, x)
                net.start_name[j] = f"{name}.i"
                net.equation({k: -c for k, c in drop(a, b).items()}, {j: x})
            elif which == "V":
                x = signed(rng, x)
                part = VoltageSource(ev, name, x)
                net.equation(drop(a, b), right=[x])
            else:
                w, phase = log_uniform(rng, -0.5, 0.5), rng.uniform(-3, 3)
                part = SineVoltage(ev, name, x, w, phase)
                net.equation(drop(a, b), right=[x * w**k * np.sin(phase + k * np.pi / 2) for k in range(ORDER + 1)])
        net.parts.append(part)
        net.nodes[a].append(part.p)
        net.nodes[b].append(part.n)
        net.read(f"{name}.v", "v", drop(a, b))
        net.read(f"{name}.i", "i", *current)
        for pin, node in (("p", a), ("n", b)):
            net.read(f"{name}.{pin}.v", "v", {v[node]: 1.0} if node else {})
            if node:
                named[v[node]] = f"{name}.{pin}.v"
        net.read(f"{name}.n.i", "i", *({k: -c for k, c in t.items()} for t in current[:2]), -current[2])
    net.start_name.update(named)
    for node in range(1, n):
        net.equation(values[node], rates[node], right[node])
    words = ["determine", "contradict", "singular", "redundant", "follow", "too many"]
    return net.case(rng, 2.0, words, f"{n} nodes, {len(edges)} parts", end=1.0)
