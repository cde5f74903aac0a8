"""Networks whose connections are written in other ways: in any order, from either side, as a chain, a star or a tree,
some of them twice, and with some of the parts inside a component of their own."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from sympy import Eq, sin

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Electrical, EqnEnv, der

from .said import POINT, Pairs, Said, at_start, said

WAYS = ("as drawn", "other order", "parts inside", "parts inside, again")
Edge = tuple[str, int, int, float]


class Part(Component):
    """A resistor, capacitor, inductor, or a source of voltage or current, by its letter."""

    def __init__(self, ev: EqnEnv, name: str, kind: str, value: float):
        super().__init__(ev, name)
        self.p, self.n = self.port("p", Electrical), self.port("n", Electrical)
        guess = {"C": {"v": value}, "L": {"i": -value}}.get(kind, {})
        v, i = (self.variable(n, start=guess.get(n)) for n in ("v", "i"))
        k = self.parameter("k", value)
        law = {
            "R": lambda: Eq(v, k * i),
            "C": lambda: Eq(i, k * der(v)),
            "L": lambda: Eq(v, k * der(i)),
            "V": lambda: Eq(v, k * sin(ev.t + 1)),
            "I": lambda: Eq(i, k * sin(ev.t + 1)),
        }[kind]()
        self.add_equations(law, Eq(v, self.p.v - self.n.v), Eq(i, self.p.i), Eq(self.p.i + self.n.i, 0))


class Ground(Component):
    def __init__(self, ev: EqnEnv):
        super().__init__(ev, "ground")
        self.p = self.port("p", Electrical)
        self.add_equations(Eq(self.p.v, 0))


class Inside(Component):
    """Some of the parts, with ports for the nodes that they touch."""

    def __init__(self, ev: EqnEnv, parts: Sequence[Part], ends: Sequence[tuple[int, Any]], rng: np.random.Generator):
        super().__init__(ev, "inside")
        self.nodes = {node: self.port(f"n{node}", Electrical) for node in sorted({node for node, _ in ends})}
        for part in parts:
            self.add(part)
        for node, port in self.nodes.items():
            joined(self.connect, [port, *(p for at, p in ends if at == node)], rng)


def joined(connect: Callable[[Any, Any], Any], ports: Sequence[Any], rng: np.random.Generator) -> None:
    """Connects all ports with each other, in one of several ways."""
    way = ("chain", "star", "tree", "twice")[int(rng.integers(4))]
    ports = [ports[k] for k in rng.permutation(len(ports))]
    pairs = []
    for k in range(1, len(ports)):
        other = {"chain": k - 1, "tree": int(rng.integers(k))}.get(way, 0)
        pairs.append((ports[other], ports[k]))
    pairs += pairs[:1] if way == "twice" else []
    for k in rng.permutation(len(pairs)):
        connect(*(pairs[k] if rng.random() < 0.5 else pairs[k][::-1]))


def drawn(rng: np.random.Generator) -> tuple[int, list[Edge]]:
    """A connected network: how many nodes it has, and its parts."""
    n = int(rng.integers(3, 7))

    def value() -> float:
        return round(float(rng.uniform(0.5, 2.0)), 2)

    edges = [(str(rng.choice(list("RRCL"))), int(rng.integers(0, k)), k, value()) for k in range(1, n)]
    for _ in range(int(rng.integers(2, 5))):
        a, b = map(int, rng.choice(n, 2, replace=False))
        edges.append((str(rng.choice(list("RRCLVI"))), a, b, value()))
    return n, edges


def found(n: int, edges: Sequence[Edge], rng: np.random.Generator, way: str) -> dict[str, Any]:
    """Voltages and currents of all parts at the start, and slopes, of the network written in some way."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    parts = [Part(ev, f"{kind}{k}", kind, value) for k, (kind, _, _, value) in enumerate(edges)]
    chosen = rng.random(len(edges)) < 0.5 if "inside" in way else np.zeros(len(edges), bool)
    ground = Ground(ev)
    outside: list[Component] = [ground, *(p for p, inside in zip(parts, chosen, strict=True) if not inside)]
    ends = [(node, port) for p, (_, a, b, _) in zip(parts, edges, strict=True) for node, port in ((a, p.p), (b, p.n))]
    nodes = [(0, ground.p), *(end for end, inside in zip(ends, np.repeat(chosen, 2), strict=True) if not inside)]
    if chosen.any():
        inner = [p for p, inside in zip(parts, chosen, strict=True) if inside]
        box = Inside(ev, inner, [end for end, i in zip(ends, np.repeat(chosen, 2), strict=True) if i], rng)
        outside.append(box)
        nodes += box.nodes.items()
    for k in rng.permutation(len(outside)) if way != WAYS[0] else range(len(outside)):
        diagram.add(outside[k])
    for node in rng.permutation(n) if way != WAYS[0] else range(n):
        joined(diagram.connect, [port for at, port in nodes if at == node], rng)
    system = AcausalCompiler(ev, diagram)()
    names = {
        f"{p.name}.{v}": f"{'inside.' if inside else ''}{p.name}.{v}"
        for p, inside in zip(parts, chosen, strict=True)
        for v in ("v", "i")
    }
    return at_start(system, names)


def connections(number: int) -> Pairs:
    """Part of letter c."""
    n, edges = drawn(np.random.default_rng([number, 24]))
    pairs = Pairs("c", "network " + " ".join(f"{kind}{a}{b}" for kind, a, b, _ in edges))
    sayings: dict[str, Said] = {
        way: said(lambda way=way, k=k: found(n, edges, np.random.default_rng([number, 24, k]), way))
        for k, way in enumerate(WAYS)
    }
    for way in WAYS[1:]:
        pairs.compare(way, sayings[WAYS[0]], sayings[way], POINT)
    return pairs
