"""The structural passes on random structures, against definitions and against other algorithms."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.optimize
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from jaxonomy_dae.graph.structure.incidence import Incidence, compress
from jaxonomy_dae.graph.structure.matching import maximum_matching
from jaxonomy_dae.graph.structure.pantelides import reduce_index
from jaxonomy_dae.graph.structure.tearing import tear

ABSENT = -1


def incidence_of(sigma: np.ndarray) -> Incidence:
    rows, columns = np.nonzero(sigma != ABSENT)
    return Incidence(*compress(rows, columns, sigma[rows, columns], sigma.shape[0]), sigma.shape[1])


def entries(n: int):
    """Sparse signature matrices: most entries absent, orders up to 2."""
    order = st.sampled_from([ABSENT] * 6 + [0, 0, 0, 1, 1, 2])
    return st.lists(st.lists(order, min_size=n, max_size=n), min_size=n, max_size=n)


@st.composite
def signatures(draw, largest=7):
    """Signature matrices with a perfect matching: random entries, and a random transversal."""
    n = draw(st.integers(1, largest))
    sigma = np.array(draw(entries(n)))
    transversal = draw(st.permutations(range(n)))
    orders = draw(st.lists(st.integers(0, 2), min_size=n, max_size=n))
    for i, (j, order) in enumerate(zip(transversal, orders, strict=True)):
        sigma[i, j] = max(sigma[i, j], order)
    return sigma


# --- index reduction ---------------------------------------------------------------------------------------------


def highest_value_transversal(sigma):
    """The perfect matching of the largest sum of orders, by the Hungarian method."""
    weights = np.where(sigma == ABSENT, -1000, sigma)
    rows, columns = scipy.optimize.linear_sum_assignment(weights, maximize=True)
    return columns, int(weights[rows, columns].sum())


def pryces_offsets(sigma, matching):
    """The canonical offsets by Pryce's fixed-point iteration (2001, Algorithm 3.1): the smallest there are."""
    n = len(sigma)
    c = np.zeros(n, int)
    while True:
        d = np.where(sigma == ABSENT, -1000, sigma + c[:, None]).max(axis=0)
        following = d[matching] - sigma[np.arange(n), matching]
        if (following == c).all():
            return c, d
        c = following


@hypothesis.settings(max_examples=150)
@hypothesis.given(signatures())
def test_offsets(sigma):
    n = len(sigma)
    offsets = reduce_index(incidence_of(sigma))
    c, d, matched = offsets.equation, offsets.variable, offsets.matched_variable
    assert (c >= 0).all() and sorted(matched) == list(range(n))
    present = sigma != ABSENT
    slack = d[None, :] - sigma - c[:, None]
    assert (slack[present] >= 0).all()
    assert present[np.arange(n), matched].all() and (slack[np.arange(n), matched] == 0).all()
    # Duality: Σd − Σc is the value of the best transversal; and no smaller offsets will do.
    transversal, value = highest_value_transversal(sigma)
    assert offsets.degrees_of_freedom == value
    smallest = pryces_offsets(sigma, transversal)
    np.testing.assert_array_equal((c, d), smallest)


@hypothesis.given(signatures(), st.randoms(use_true_random=False))
def test_offsets_do_not_depend_on_the_order(sigma, random):
    n = len(sigma)
    rows, columns = (random.sample(range(n), n) for _ in range(2))
    first, second = reduce_index(incidence_of(sigma)), reduce_index(incidence_of(sigma[np.ix_(rows, columns)]))
    np.testing.assert_array_equal(first.equation[rows], second.equation)
    np.testing.assert_array_equal(first.variable[columns], second.variable)


@pytest.mark.parametrize(
    "sigma, index, freedom, c",
    [
        # The pendulum x'' = −λx, y'' = −λy − g, x² + y² = L² (Pryce 2001, Example 1).
        ([[2, -1, 0], [-1, 2, 0], [0, 0, -1]], 3, 2, [0, 0, 2]),
        # x' = y, x = u(t): index 2 (Brenan, Campbell & Petzold 1996, Example 2.2.1).
        ([[1, 0], [0, -1]], 2, 0, [0, 1]),
        ([[1]], 0, 1, [0]),  # an ordinary differential equation
        ([[0]], 1, 0, [0]),  # an algebraic one
        # A chain x₁ = u, x₁' = x₂, x₂' = x₃, …: index 4 (its length).
        ([[0, -1, -1, -1], [1, 0, -1, -1], [-1, 1, 0, -1], [-1, -1, 1, 0]], 4, 0, [3, 2, 1, 0]),
    ],
)
def test_known_structures(sigma, index, freedom, c):
    offsets = reduce_index(incidence_of(np.array(sigma)))
    assert (offsets.structural_index, offsets.degrees_of_freedom) == (index, freedom)
    assert offsets.equation.tolist() == c


# --- matching ----------------------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=150)
@hypothesis.given(st.integers(1, 9).flatmap(lambda n: entries(n)), st.integers(1, 9))
def test_matchings_are_as_large_as_scipys(matrix, rows):
    present = np.array(matrix[:rows]) != ABSENT
    graph = csr_array(present)
    found = maximum_matching(graph.indptr.astype(np.int64), graph.indices.astype(np.int64), present.shape[1])
    expected = maximum_bipartite_matching(graph, perm_type="column")
    matched = np.flatnonzero(found >= 0)
    assert present[matched, found[matched]].all() and len(set(found[matched].tolist())) == len(matched)
    assert len(matched) == np.count_nonzero(expected >= 0)


@pytest.mark.parametrize("seed", range(8))
def test_large_matchings_are_as_large_as_scipys(seed):
    """Chains peel by one pair a round, stars and random patterns by many; some have no perfect matching."""
    rng, n = np.random.default_rng(seed), 4000
    k = np.arange(n)
    patterns = [
        (np.concatenate([k, k[1:]]), np.concatenate([k, k[:-1]])),  # a chain
        (np.concatenate([k, k]), np.concatenate([k, np.zeros_like(k)])),  # a star
        (np.repeat(k, 2), rng.integers(0, n, 2 * n)),
        (np.concatenate([k, rng.integers(0, n, n)]), np.concatenate([rng.permutation(n), rng.integers(0, n, n)])),
    ]
    row, column = patterns[seed % 4]
    graph = csr_array((np.ones(len(row)), (rng.permutation(n)[row], column)), shape=(n, n))
    graph.sum_duplicates()
    found = maximum_matching(graph.indptr.astype(np.int64), graph.indices.astype(np.int64), n)
    matched = np.flatnonzero(found >= 0)
    assert graph[matched, found[matched]].all() and len(set(found[matched].tolist())) == len(matched)
    assert len(matched) == np.count_nonzero(maximum_bipartite_matching(graph, perm_type="column") >= 0)


# --- tearing -----------------------------------------------------------------------------------------------------


@st.composite
def blocks(draw):
    """Blocks of n equations in n unknowns with a perfect matching; some unknowns can be solved for safely."""
    n = draw(st.integers(1, 7))
    subsets = st.frozensets(st.integers(0, n - 1))
    contains = [draw(subsets) | {k} for k in draw(st.permutations(range(n)))]
    return contains, [c & draw(subsets) for c in contains]


@hypothesis.given(blocks())
def test_tearing_leaves_one_unknown_at_a_time(block):
    contains, solvable = block
    n = len(contains)
    torn = tear(contains, solvable)
    known = set(torn.tearing)
    for equation, unknown in torn.sequence:
        assert unknown in solvable[equation] and unknown not in known
        assert contains[equation] - {unknown} <= known
        known.add(unknown)
    assert known == set(range(n))
    assert len(torn.residuals) == len(torn.tearing)
    assert sorted([e for e, _ in torn.sequence] + list(torn.residuals)) == list(range(n))


def test_tearing_a_chain_needs_one_guess():
    """x₀ + x₁, x₁ + x₂, …, xₙ + x₀: one guess gives the rest."""
    n = 20
    contains = [frozenset({k, (k + 1) % n}) for k in range(n)]
    assert len(tear(contains, contains).tearing) == 1
