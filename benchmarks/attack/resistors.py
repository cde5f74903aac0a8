"""Networks of resistors whose values spread over eight decades.

The reference eliminates nodes one by one in extended precision. Every quantity of the elimination is a sum of positive
conductances, so that nothing cancels (Grassmann, Taksar & Heyman 1985): potentials are right to rounding, whatever the
values.
"""

import numpy as np

from jaxonomy_dae import EqnEnv
from jaxonomy_dae.library.electrical import CurrentSource, Ground, Resistor, VoltageSource

from .case import ROUNDING, TOLERANCE, Case, Expected, diagram_of, log_uniform, names, signed

TOPOLOGIES = ("ladder", "attenuator", "grid", "bridge", "tree", "random", "star", "chain")
LARGE = np.longdouble


def edges_of(rng: np.random.Generator, topology: str, n: int) -> list[tuple[int, int]]:
    """The edges of a connected graph on nodes 0 … n − 1; node 0 will be ground."""
    if topology in ("ladder", "attenuator"):
        return [(k, k + 1) for k in range(1, n - 1)] + [(k, 0) for k in range(1, n)]
    if topology == "chain":
        return [(k, k + 1) for k in range(n - 1)]
    if topology == "star":
        return [(0, k) for k in range(1, n)] + [(k, k % (n - 1) + 1) for k in range(1, n) if n > 3]
    if topology == "grid":
        width = max(1, int(np.sqrt(n)))
        right = [(k, k + 1) for k in range(n - 1) if (k + 1) % width]
        return right + [(k, k + width) for k in range(n - width)]
    if topology == "bridge":  # two rails, cross-connected: every section is a Wheatstone bridge
        edges = [(0, 1)]
        for k in range(2, n):
            edges += [(k - 2, k), (k - 1, k)]
        return edges
    edges = [(int(rng.integers(0, k)), k) for k in range(1, n)]
    if topology == "random":
        edges += [tuple(map(int, rng.choice(n, 2, replace=False))) for _ in range(int(rng.integers(1, 2 * n)))]
    return edges


def resistances(rng: np.random.Generator, topology: str, edges: list) -> list[float]:
    """Values over eight decades, at random or two kinds of them."""
    if topology == "attenuator":
        series, shunt = log_uniform(rng, 0, 4), log_uniform(rng, -4, 0)
        return [shunt if 0 in e else series for e in edges]
    middle = rng.uniform(-6, 6)
    if rng.random() < 0.2:
        kinds = [log_uniform(rng, middle - 4, middle + 4) for _ in range(2)]
        return [kinds[int(rng.integers(0, 2))] for _ in edges]
    return [log_uniform(rng, middle - 4, middle + 4) for _ in edges]


def potentials(n: int, branches: list[tuple[int, int, float]], held: dict[int, float], injected: dict[int, float]):
    """Node potentials: branches (a, b, R), nodes held at a potential, currents into nodes; in extended precision."""
    g = np.zeros((n, n), LARGE)
    for a, b, r in branches:
        if a != b:
            g[a, b] += LARGE(1) / LARGE(r)
            g[b, a] += LARGE(1) / LARGE(r)
    current = np.zeros(n, LARGE)
    for k, i in injected.items():
        current[k] += LARGE(i)
    free = [k for k in range(n) if k not in held]
    alive = np.ones(n, bool)
    kept = []
    for k in free:
        alive[k] = False
        row = np.where(alive, g[k], LARGE(0))
        total = row.sum()
        kept.append((k, row, total, current[k]))
        g += np.outer(g[:, k], row) / total
        np.fill_diagonal(g, 0)
        current = current + g[:, k] / total * current[k]
    v = np.zeros(n, LARGE)
    for k, value in held.items():
        v[k] = LARGE(value)
    for k, row, total, i in reversed(kept):
        v[k] = (row @ v + i) / total
    return v


def make(seed: int) -> Case:
    """A network of 3 to 400 nodes with one to three sources."""
    rng = np.random.default_rng([seed, 1])
    topology = TOPOLOGIES[int(rng.integers(0, len(TOPOLOGIES)))]
    n = int(round(log_uniform(rng, np.log10(3), np.log10(400 if rng.random() < 0.3 else 40))))
    edges = edges_of(rng, topology, n)
    values = resistances(rng, topology, edges)
    order = rng.permutation(n) if topology == "random" else np.arange(n)
    edges = [(int(order[a]), int(order[b])) for a, b in edges]
    ev = EqnEnv()
    label = names(rng, len(edges) + 5)
    ground = Ground(ev, label[-1])
    parts: list = [ground]
    nodes: list[list] = [[] for _ in range(n)]
    nodes[0].append(ground.p)
    branches = []
    for k, ((a, b), r) in enumerate(zip(edges, values, strict=True)):
        if rng.random() < 0.5:
            a, b = b, a
        part = Resistor(ev, label[k], r)
        parts.append(part)
        nodes[a].append(part.p)
        nodes[b].append(part.n)
        branches.append((a, b, r))
    held, injected, sources = {0: 0.0}, {}, []
    typical = float(np.median(values))
    height = log_uniform(rng, -3, 3)
    for s in range(int(rng.integers(1, 4))):
        at = int(rng.integers(1, n))
        strength = signed(rng, height * log_uniform(rng, -1, 1))
        if s and rng.random() < 0.5:
            source = CurrentSource(ev, label[-2 - s], strength / typical)
            injected[at] = injected.get(at, 0.0) + strength / typical
            nodes[0].append(source.p)
            nodes[at].append(source.n)
        elif at in held:
            continue
        else:
            source = VoltageSource(ev, label[-2 - s], strength)
            held[at] = strength
            nodes[at].append(source.p)
            nodes[0].append(source.n)
            sources.append((source, at))
        parts.append(source)
    v = potentials(n, branches, held, injected)
    height = float(np.max(np.abs(v)))
    currents = [(v[a] - v[b]) / LARGE(r) for a, b, r in branches]
    largest = float(max(map(abs, currents)))
    expected = {}
    out = np.zeros(n, LARGE)
    weight = np.zeros(n)
    for k, ((a, b, r), i) in enumerate(zip(branches, currents, strict=True)):
        rounding = ROUNDING * height / r
        expected[f"{label[k]}.v"] = Expected(float(v[a] - v[b]), TOLERANCE * height)
        expected[f"{label[k]}.p.v"] = Expected(float(v[a]), TOLERANCE * height)
        expected[f"{label[k]}.i"] = Expected(float(i), TOLERANCE * largest + rounding)
        for node, sign in ((a, 1), (b, -1)):
            out[node] += sign * i
            weight[node] += rounding
    for source, at in sources:
        true = float(-out[at] + LARGE(injected.get(at, 0.0)))
        expected[f"{source.name}.i"] = Expected(true, TOLERANCE * largest + weight[at])
    note = f"{topology} of {n} nodes"
    return Case(ev, diagram_of(rng, parts, nodes), {}, expected, freedom=0, note=note)
