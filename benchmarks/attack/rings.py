"""Rings, chains and trees of differences der(v_a) − der(v_b), whose highest derivatives cancel around each cycle.

E·y' + A·y = b, where E is the incidence of a graph with signs, in any units: row e and column k are multiplied by
powers of ten or by random numbers. Around a cycle whose signs agree, the sum of the equations is without derivatives.
The number of states is the degree of det(s·E + A) for the integers behind the scales: rank E, if WᵀA·R is regular for
bases W and R of E's null spaces, which are known from the graph; up to SMALL unknowns, by interpolation in a prime
field.
"""

import dataclasses
import time
from fractions import Fraction

import numpy as np
import sympy

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, der

from .case import names
from .kernels import verdict
from .outcome import Outcome

SMALL = 40  # unknowns up to which the determinant is interpolated
PRIME = 2**31 - 1
LARGEST = 5000
SCALES = ("integers", "simple", "units")
SIMPLE = (1e-3, 0.01, 0.5, 3.6, 60.0, 1000.0, 1.0)
WORDS = ("depend on each other", "determine", "nothing is left", "contradict")


@dataclasses.dataclass(frozen=True)
class Skeleton:
    """Integers: rows {column: entry} of E and A, and bases of E's null spaces, from the left and from the right."""

    e: list[dict[int, int]]
    a: list[dict[int, int]]
    left: list[dict[int, int]]
    right: list[dict[int, int]]
    note: str


class Written(Component):
    """Σ e·der(y) + Σ a·y = b for each row."""

    def __init__(self, ev, name, variables, order, e, a):
        super().__init__(ev, name)
        for k in order:
            self.variable(variables[k])
        y = [self[v] for v in variables]
        equations = []
        with sympy.evaluate(False):
            for rates, values in zip(e, a, strict=True):
                terms = [sympy.Mul(c, der(y[k])) for k, c in rates.items()]
                terms += [sympy.Mul(c, y[k]) for k, c in values.items()]
                equations.append(sympy.Add(*terms))
        self.add_equations(*equations)


def skeleton(rng: np.random.Generator, n: int) -> Skeleton:
    """A graph on n nodes: paths or trees, each closed to a ring, grounded or twisted; and rungs with unknowns of their
    own."""
    parts = 1 if n < 20 or rng.random() < 0.6 else int(rng.integers(2, 5))
    cuts = (
        [0, *sorted(rng.choice(np.arange(2, n - 1, 2), parts - 1, replace=False).tolist()), n] if parts > 1 else [0, n]
    )
    path = rng.random() < 0.6
    e: list[dict[int, int]] = []
    left, right, kinds = [], [], []
    signs = rng.choice([-1, 1], n) if rng.random() < 0.5 else np.ones(n, int)
    rungs: list[tuple[int, int, dict[int, int]]] = []

    def edge(a: int, b: int, twist: int = 1) -> dict[int, int]:
        return {a: int(signs[a]), b: -twist * int(signs[b])}

    for low, high in zip(cuts[:-1], cuts[1:], strict=True):
        parent, row_of = {low: low}, {}
        for v in range(low + 1, high):
            parent[v] = v - 1 if path else int(rng.integers(max(low, v - 30), v))
            row_of[v] = len(e)
            e.append(edge(parent[v], v))

        def cycle(a: int, b: int, parent=parent, row_of=row_of, low=low) -> dict[int, int]:
            """The tree's edges from a to b as weights, whose sum is that of the edge (a, b)."""

            def up(v):
                out = []
                while v != low:
                    out.append(v)
                    v = parent[v]
                return out

            from_a, from_b = up(a), up(b)
            common = set(from_a) & set(from_b)
            return {row_of[v]: -1 for v in from_a if v not in common} | {
                row_of[v]: 1 for v in from_b if v not in common
            }

        kind = ("ring", "grounded", "twisted")[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
        kinds.append(kind)
        a, b = (low, high - 1) if path else map(int, rng.choice(np.arange(low, high), 2, replace=False))
        if kind == "grounded":
            e.append({a: 1})
        else:
            e.append(edge(b, a, 1 if kind == "ring" else -1))
        if kind == "ring":
            left.append(cycle(a, b) | {len(e) - 1: 1})
            right.append({v: int(signs[v]) for v in range(low, high)})
        for _ in range(int(rng.integers(0, 4)) if rng.random() < 0.4 else 0):
            a, b = map(int, rng.choice(np.arange(low, high), 2, replace=False))
            rungs.append((a, b, cycle(a, b)))
    a_rows = [{int(v): int(rng.choice([-3, -2, -1, 1, 2, 3])) for v in rng.choice(n, 2, replace=False)} for _ in e]
    for k, v in enumerate(rng.permutation(n)[: len(e)].tolist()):  # what is at an edge's ends is mostly in its equation
        a_rows[k][next(iter(e[k]))] = int(rng.integers(1, 4))
        if rng.random() < 0.1:
            a_rows[k][v] = 1
    for j, (a, b, weights) in enumerate(rungs):
        e.append(edge(b, a))
        left.append(weights | {len(e) - 1: 1})
        right.append({n + j: 1})
        a_rows.append({a: int(rng.integers(1, 4))})
        a_rows[-1 if rng.random() < 0.5 else int(rng.integers(len(e)))][n + j] = 1
    note = f"{n} nodes, {'paths' if path else 'trees'} {', '.join(kinds)}; {len(rungs)} rungs"
    return Skeleton(e, a_rows, left, right, note)


def states(of: Skeleton) -> int | None:
    """How many states there are; None where the equations have no unique solution, −1 where it is not known."""
    n = len(of.e)
    assert all(not _times(w, of.e) for w in of.left)
    product = [[_times(w, of.a).get(k, 0) for k in range(n)] for w in of.left]
    small = [[sum(row[k] * c for k, c in r.items()) for r in of.right] for row in product]
    if _rank(small) == len(of.left) == len(of.right):
        found = n - len(of.left)
        assert n > SMALL or found == degree(of)
        return found
    return degree(of) if n <= SMALL else -1


def _times(weights: dict[int, int], rows: list[dict[int, int]]) -> dict[int, int]:
    total: dict[int, int] = {}
    for i, w in weights.items():
        for k, c in rows[i].items():
            total[k] = total.get(k, 0) + w * c
    return {k: c for k, c in total.items() if c}


def _rank(rows: list[list[int]]) -> int:
    return sympy.polys.matrices.DomainMatrix(
        [[Fraction(c) for c in row] for row in rows], (len(rows), len(rows[0])), sympy.QQ
    ).rank() if rows else 0  # fmt: skip


def degree(of: Skeleton) -> int | None:
    """The degree of det(s·E + A) by its values at n + 1 points, in a prime field; None if it is zero."""
    n = len(of.e)
    e, a = np.zeros((2, n, n), np.int64)
    for matrix, rows in ((e, of.e), (a, of.a)):
        for i, row in enumerate(rows):
            for k, c in row.items():
                matrix[i, k] = c
    points = list(range(1, n + 2))
    table = [_determinant((s * e + a) % PRIME) for s in points]
    for order in range(1, n + 1):  # Newton's divided differences, in place
        for i in range(n, order - 1, -1):
            table[i] = (table[i] - table[i - 1]) * pow(points[i] - points[i - order], -1, PRIME) % PRIME
    return max((k for k, c in enumerate(table) if c), default=None)


def _determinant(matrix: np.ndarray) -> int:
    m, out = matrix.copy(), 1
    for k in range(len(m)):
        rows = np.flatnonzero(m[k:, k])
        if not len(rows):
            return 0
        if rows[0]:
            m[[k, k + rows[0]]] = m[[k + rows[0], k]]
            out = -out
        out = out * int(m[k, k]) % PRIME
        factors = m[k + 1 :, k] * pow(int(m[k, k]), -1, PRIME) % PRIME
        m[k + 1 :] = (m[k + 1 :] - factors[:, None] * m[k] % PRIME) % PRIME
    return out


def make(seed: int, largest: int = LARGEST) -> tuple[AcausalDiagram, int | None, str]:
    """A model, its number of states, and what it is."""
    rng = np.random.default_rng([seed, 14])
    n = int(10 ** rng.uniform(1, 2.3 if rng.random() < 0.85 else np.log10(largest)))
    while True:
        of = skeleton(rng, n)
        count = states(of)
        if count != -1:
            break
    scale = SCALES[int(rng.integers(3))]
    size = len(of.e)

    def scales() -> list[float]:
        if scale == "integers":
            return [1.0] * size
        return rng.choice(SIMPLE, size).tolist() if scale == "simple" else (10.0 ** rng.uniform(-9, 9, size)).tolist()

    rows, columns = scales(), scales()
    rows = [r * int(s) for r, s in zip(rows, rng.choice([-1, 1], size), strict=True)]

    def written(table):
        scaled = [{k: r * c * columns[k] for k, c in row.items()} for r, row in zip(rows, table, strict=True)]
        return [{k: int(c) if scale == "integers" else c for k, c in row.items()} for row in scaled]

    order = rng.permutation(size).tolist()
    e, a = ([table[k] for k in order] for table in (written(of.e), written(of.a)))
    part = Written(EqnEnv(), "sys", names(rng, size), rng.permutation(size).tolist(), e, a)
    return AcausalDiagram().add(part), count, f"{of.note}, {scale}"


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """What model it is, and its number of states."""
    diagram, count, note = make(seed)
    start = time.process_time()
    found = verdict(diagram)
    seconds = time.process_time() - start
    said = "refused" if found.states is None else f"{found.states} states"
    if found.states is None:
        kind = "refused" if count is None and any(word in found.text for word in WORDS) else "untrue"
        return note, [Outcome(kind, np.inf, f"expected {count}: {found.text[:400]}", seconds)]
    kind = "right" if found.states == count else "wrong"
    return note, [Outcome(kind, 0.0, f"{said}, expected {count}", seconds)]
