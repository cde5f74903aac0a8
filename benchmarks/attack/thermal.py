"""Thermal networks, against the heat flows at every node. Two capacities at one node give index 2."""

from collections.abc import Mapping

import numpy as np
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv
from jaxonomy_dae.library.thermal import FixedTemperature, HeatCapacitor, ThermalConductor
from jaxonomy_dae.write import Thermal

from .case import UNCHANGED, Case, log_uniform, names, signed
from .linear_network import LinearNetwork

WORDS = [
    "determine",
    "contradict",
    "singular",
    "redundant",
    "follow",
    "too many",
    "nothing holds",
    "connected",
    "both fix",
]


class Heater(Component):
    """A heat flow into its port."""

    def __init__(self, ev, name, size):
        super().__init__(ev, name)
        heat = self.port("heat", Thermal)
        self.add_equations(Eq(heat.Q_flow, -self.parameter("size", size)))


def make(seed: int, factors: Mapping[str, float] = UNCHANGED) -> Case:
    """A tree of 1 to 25 temperatures with further conductors. `factors` change the values of parts, by name."""
    rng = np.random.default_rng([seed, 5])
    ev = EqnEnv()
    net = LinearNetwork(ev)
    n = int(round(log_uniform(rng, 0, np.log10(25))))
    kinds = [("conductor", int(rng.integers(0, k)), k) for k in range(1, n)]
    for _ in range(int(rng.integers(0, n))):
        kinds.append(("conductor", *map(int, rng.choice(n, 2, replace=False))))
    capacity, fixed = rng.random(), rng.random() * 0.3
    for k in range(n):
        kinds += [("capacity", k, k)] * int(rng.binomial(2, capacity))
        kinds += [("fixed", k, k)] * int(rng.random() < fixed)
        kinds += [("heater", k, k)] * int(rng.random() < 0.2)
    if rng.random() < 0.05:
        kinds.append(("fixed", 0, 0))
    label = names(rng, len(kinds) + 1)
    if not kinds:
        kinds = [("capacity", 0, 0)]
    decades = rng.uniform(0, 4)

    def value() -> float:
        return log_uniform(rng, -decades / 2, decades / 2)

    net.nodes = [[] for _ in range(n)]
    temperature = [net.unknown() for _ in range(n)]
    into: list[dict[int, float]] = [{} for _ in range(n)]  # heat flows into the components at a node: sum to zero
    rates: list[dict[int, float]] = [{} for _ in range(n)]
    right = np.zeros(n)
    for (which, a, b), name in zip(kinds, label, strict=False):
        if rng.random() < 0.5:
            a, b = b, a
        k, ta, tb = value() * factors.get(name, 1.0), temperature[a], temperature[b]
        if which == "conductor":
            part = ThermalConductor(ev, name, k)
            for node, sign in ((a, 1.0), (b, -1.0)):
                for t, c in ((ta, k), (tb, -k)):
                    into[node][t] = into[node].get(t, 0.0) + sign * c
            net.read(f"{name}.Q_flow", "Q", {ta: k, tb: -k})
            net.read(f"{name}.dT", "T", {ta: 1.0, tb: -1.0})
        elif which == "capacity":
            part = HeatCapacitor(ev, name, k)
            rates[a][ta] = rates[a].get(ta, 0.0) + k
            net.read(f"{name}.T", "T", {ta: 1.0})
            net.read(f"{name}.heat.Q_flow", "Q", {}, {ta: k})
        elif which == "heater":
            k = signed(rng, k)
            part = Heater(ev, name, k)
            right[a] += k
        else:
            part = FixedTemperature(ev, name, 273.0 + 50 * float(rng.random()))
            q = net.unknown()
            into[a][q] = into[a].get(q, 0.0) + 1.0
            net.equation({ta: 1.0}, right=[part.parameters["T"].value])
            net.read(f"{name}.heat.Q_flow", "Q", {q: 1.0})
        net.parts.append(part)
        ends = ((part.port_a, a), (part.port_b, b)) if which == "conductor" else ((part.heat, a),)
        for port, node in ends:
            net.nodes[node].append(port)
            net.start_name[temperature[node]] = f"{name}.{port.name}.T"
            net.read(f"{name}.{port.name}.T", "T", {temperature[node]: 1.0})
    for node in range(n):
        net.equation(into[node], rates[node], [right[node]])
    return net.case(rng, 300.0, WORDS, f"{n} temperatures, {len(kinds)} parts", end=1.0)
