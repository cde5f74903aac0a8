"""Least squares on large graphs: sizes of quantities took SuperLU's time of an order that one large node spoils."""

import numpy as np
import pytest
import scipy.sparse as sp

from jaxonomy_dae.solve.linear.graph_elimination import GraphElimination


def graph(kind: str, n: int):
    rng = np.random.default_rng(3)
    chain = [(k, k + 1) for k in range(n - 1)]
    if kind == "chain":
        return chain
    if kind == "tree":
        return [(k, (k - 1) // 2) for k in range(1, n)]
    if kind == "ladder":  # a chain of which each node also hangs on the last one
        return [*chain, *((k, n - 1) for k in range(n - 2))]
    if kind == "mesh":
        m = int(np.sqrt(n))
        return [(k, k + s) for k in range(m * m) for s in (1, m) if k + s < m * m and (s == m or (k + 1) % m)]
    if kind == "dense core":  # more neighbours than are eliminated at once
        return [*chain, *(tuple(map(int, rng.choice(400, 2, replace=False))) for _ in range(20_000))]
    return []  # nothing is connected


@pytest.mark.parametrize("kind", ["chain", "tree", "ladder", "mesh", "dense core", "apart"])
def test_solutions(kind):
    n = 900
    edges = np.array(graph(kind, n), int).reshape(-1, 2)
    rng = np.random.default_rng(1)
    places = np.tile(np.arange(len(edges)), 2), edges.T.ravel()
    differences = sp.csr_array((rng.uniform(0.5, 2.0, 2 * len(edges)), places), shape=(len(edges), n))
    matrix = differences.T @ differences + 1e-6 * sp.eye_array(n)
    right = matrix @ rng.normal(size=n)
    found = GraphElimination(matrix).solve(right)
    np.testing.assert_allclose(matrix @ found, right, rtol=1e-9, atol=1e-9)


def test_each_round_takes_a_share_of_the_unknowns():
    """The number of rounds grows with the logarithm of the number of unknowns, and what is left stays small."""
    for n in (2_000, 32_000):
        edges = np.array(graph("ladder", n), int)
        places = np.tile(np.arange(len(edges)), 2), edges.T.ravel()
        ends = sp.csr_array((np.repeat([1.0, -1.0], len(edges)), places), shape=(len(edges), n))
        factors = GraphElimination(ends.T @ ends + 1e-12 * sp.eye_array(n))
        assert len(factors._rounds) < 4 * np.log2(n / 300)
        assert sum(one.between.nnz for one in factors._rounds) < 8 * n
