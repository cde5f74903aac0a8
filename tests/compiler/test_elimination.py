"""Null vectors of fractions, beside SymPy's; and cancellation in blocks of any size."""

from fractions import Fraction

import numpy as np
import pytest
import sympy
from problems import compiled, component

from jaxonomy_dae import StructuralError, der
from jaxonomy_dae.compile.model.group import Point
from jaxonomy_dae.compile.passes.elimination import null_vectors
from jaxonomy_dae.compile.passes.null_vectors import BlockMatrix
from jaxonomy_dae.compile.passes.null_vectors import null_vectors as of_block
from jaxonomy_dae.compile.passes.rounded import Rounded


def rounded(value):
    """A number that is given: off by one rounding."""
    return Rounded(float(value), 2.0**-52 * abs(float(value)))


@pytest.mark.parametrize("seed", range(40))
def test_null_vectors_of_random_matrices(seed):
    """Integer matrices with one or two rows that are combinations of others, or none, shuffled."""
    rng = np.random.default_rng(seed)
    n, dependent = int(rng.integers(2, 12)), int(rng.integers(0, 3))
    free = rng.integers(-3, 4, (n, n)) * (rng.random((n, n)) < 0.5) + np.diag(rng.integers(1, 4, n))
    rows = free.copy()
    for k in range(min(dependent, n - 1)):
        rows[n - 1 - k] = rng.integers(-2, 3, n - 1 - k) @ rows[: n - 1 - k]
    rows = rows[rng.permutation(n)]
    given = [{j: Fraction(int(v), 7) for j, v in enumerate(row) if v} for row in rows]
    found = null_vectors(given)
    null = sympy.Matrix(rows.tolist()).T.nullspace()
    assert len(found) == len(null)
    for vector in found:
        weights = np.array([vector.get(i, Fraction(0)) for i in range(n)], object)
        assert any(weights)
        assert not any(weights @ np.vectorize(Fraction)(rows))


def ring(n, closed=False):
    """v_k' − v_{k+1}' = f_k in a ring: the sum of all is 0 = Σ f_k, without a derivative."""

    def write(self, ev):
        with sympy.evaluate(False):
            v = [self.variable(f"v{k}", start=1.0) for k in range(n)]
            if closed:  # the sum is 0 = 0
                following = [*v[1:], v[0]]
                self.add_equations(*(der(a) - der(b) + a - b for a, b in zip(v, following, strict=True)))
            else:
                self.add_equations(*(der(v[k]) - der(v[(k + 1) % n]) + (1 + k % 3) * v[k] for k in range(n)))

    return component(write)


@pytest.mark.parametrize("n", [10, 201, *(pytest.param(n, marks=pytest.mark.slow) for n in (199, 1000))])
def test_a_ring_of_any_size(n):
    """Blocks of more than 200 equations were left as they were, without a word."""
    system = compiled(ring(n))
    assert len(system.states) == n - 1
    assert "highest derivatives cancel in a combination of" in system.plan.selection.notes[0]


@pytest.mark.parametrize("n", [5, 60, 250])
def test_a_ring_that_says_nothing(n):
    with pytest.raises(StructuralError, match="these equations depend on each other, or contradict each other"):
        compiled(ring(n, closed=True))


def in_units(n, seed, closing):
    """The same ring, every equation and every variable in a unit of its own; `closing` multiplies the last term, so
    that the ring closes with 1 only."""
    rng = np.random.default_rng(seed)
    rows, columns = (10.0 ** rng.uniform(-9, 9, n) for _ in range(2))

    def write(self, ev):
        with sympy.evaluate(False):
            v = [self.variable(f"v{k}", start=1.0) for k in range(n)]
            for k in range(n):
                j = (k + 1) % n
                back = rows[k] * columns[j] * (closing if k == n - 1 else 1.0)
                own = rows[k] * columns[k]
                self.add_equations(float(own) * der(v[k]) - float(back) * der(v[j]) + float(own * (1 + k % 3)) * v[k])

    return component(write)


@pytest.mark.parametrize("n", [40, 230])
@pytest.mark.parametrize("closing, lost", [(1.0, 1), (1.0 + 1e-6, 0), (-1.0, 0)])
def test_a_ring_in_any_units(n, closing, lost):
    """Numbers in units cancel to rounding. Blocks of more than 200 such equations were left as they were, and refused
    at the start."""
    assert len(compiled(in_units(n, 0, closing)).states) == n - lost


def with_capacities(n, closing=1.0):
    """C_k·(v_k' − v_{k+1}') = −g_k·v_k: around the ring, Σ g_k·v_k/C_k = 0. `closing` multiplies the last v'."""

    def write(self, ev):
        with sympy.evaluate(False):
            v = [self.variable(f"v{k}", start=1.0 if k else None) for k in range(n)]
            c = [self.parameter(f"c{k}", 1e-6 * (1 + k % 7)) for k in range(n)]
            for k in range(n):
                j = (k + 1) % n
                back = closing * der(v[j]) if k == n - 1 else der(v[j])
                self.add_equations(c[k] * (der(v[k]) - back) + 1e-3 * (1 + k % 3) * v[k])

    return component(write)


@pytest.mark.parametrize("n", [3, 40, 220])
@pytest.mark.parametrize("closing, lost", [(1.0, 1), (1.001, 0)])
def test_a_ring_of_parameters(n, closing, lost):
    """Weights that depend on the parameters took minutes for 200 equations, and more than 200 were left as they were,
    without a word."""
    system = compiled(with_capacities(n, closing))
    assert len(system.states) == n - lost
    if lost:
        (note,) = system.plan.selection.notes
        assert "highest derivatives cancel in a combination of" in note
        (group,) = (g for g in system.plan.model.groups if len(g) == 1 and not g.order.any())
        parameters = np.random.default_rng(0).uniform(1, 3, n)
        (partials,) = group.reading(group.variable).partials(Point.of(np.ones(n), parameters, 0.0))
        expected = 1e-3 * (1 + np.arange(n) % 3) / parameters
        found = np.zeros(n)
        found[group.variable[0]] = partials
        np.testing.assert_allclose(found / found[0], expected / expected[0], rtol=1e-12)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("n", [190, 210])
def test_null_vectors_of_blocks_of_any_size(seed, n):
    """Singular values up to 200 equations, an elimination above: a sparse matrix of random numbers and dependent rows,
    in units, has the same null space for both."""
    rng = np.random.default_rng(seed)
    dense = rng.normal(size=(n, n)) * (rng.random((n, n)) < 1.5 / n) + np.diag(rng.uniform(1, 2, n))
    dependent = int(rng.integers(0, 3))
    for k in range(dependent):
        chosen = rng.choice(n - 3, 4, replace=False)
        dense[n - 1 - k] = rng.normal(size=4) @ dense[chosen]
    dense = 10.0 ** rng.uniform(-6, 6, (n, 1)) * dense[rng.permutation(n)] * 10.0 ** rng.uniform(-6, 6, n)
    i, j = np.nonzero(dense)
    found = of_block(BlockMatrix((n, n), i, j, dense[i, j], 2.0**-46 * np.abs(dense[i, j])))
    assert len(found) == dependent
    for vector in found:
        weights = np.array([vector.get(k, 0.0) for k in range(n)])
        terms = weights[:, None] * dense
        assert (np.abs(terms.sum(axis=0)) <= 1e-11 * np.abs(terms).sum(axis=0)).all()


@pytest.mark.parametrize("seed", range(10))
def test_null_vectors_of_rounded_matrices(seed):
    """Rows and columns of integer matrices with dependent rows, scaled at random: the combination is the same one."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 12))
    plain = rng.integers(-3, 4, (n, n)) * (rng.random((n, n)) < 0.5) + np.diag(rng.integers(1, 4, n))
    plain[-1] = rng.integers(1, 3, n - 1) @ plain[:-1]
    rows, columns = (10.0 ** rng.uniform(-6, 6, n) for _ in range(2))
    scaled = rows[:, None] * plain * columns
    (found, *others) = null_vectors([{j: rounded(v) for j, v in enumerate(r) if v} for r in scaled], rounded(1.0))
    exact = null_vectors([{j: Fraction(int(v)) for j, v in enumerate(r) if v} for r in plain])
    assert 1 + len(others) == len(exact)
    weights = np.array([found[i].value if i in found else 0.0 for i in range(n)])
    terms = weights[:, None] * scaled
    assert (np.abs(terms.sum(axis=0)) <= 1e-12 * np.abs(terms).sum(axis=0)).all()


def test_numbers_that_are_known_to_their_roundings():
    tenth, fifth, third = map(rounded, (0.1, 0.2, 0.3))
    assert 0.1 + 0.2 != 0.3 and not tenth + fifth - third
    assert tenth + fifth - rounded(0.3 + 1e-14)
    assert not (tenth / third) * third - tenth and -tenth
