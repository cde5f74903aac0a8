"""Null vectors of fractions, beside SymPy's; and cancellation in blocks of any size."""

from fractions import Fraction

import numpy as np
import pytest
import sympy
from problems import compiled, component

from jaxonomy_dae import StructuralError, der
from jaxonomy_dae.compiler.exact_null_vectors import sparsest_null_vector
from jaxonomy_dae.compiler.rounded import rounded


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
    found = sparsest_null_vector(given)
    null = sympy.Matrix(rows.tolist()).T.nullspace()
    assert (found is None) == (not null)
    if found is not None:
        weights = np.array([found.get(i, Fraction(0)) for i in range(n)], object)
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


@pytest.mark.parametrize("seed", range(10))
def test_null_vectors_of_rounded_matrices(seed):
    """Rows and columns of integer matrices with dependent rows, scaled at random: the combination is the same one."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 12))
    plain = rng.integers(-3, 4, (n, n)) * (rng.random((n, n)) < 0.5) + np.diag(rng.integers(1, 4, n))
    plain[-1] = rng.integers(1, 3, n - 1) @ plain[:-1]
    rows, columns = (10.0 ** rng.uniform(-6, 6, n) for _ in range(2))
    scaled = rows[:, None] * plain * columns
    found = sparsest_null_vector([{j: rounded(float(v)) for j, v in enumerate(r) if v} for r in scaled], rounded(1.0))
    exact = sparsest_null_vector([{j: Fraction(int(v)) for j, v in enumerate(r) if v} for r in plain])
    assert found is not None and exact is not None
    weights = np.array([found[i].value if i in found else 0.0 for i in range(n)])
    terms = weights[:, None] * scaled
    assert (np.abs(terms.sum(axis=0)) <= 1e-12 * np.abs(terms).sum(axis=0)).all()


def test_numbers_that_are_known_to_their_roundings():
    tenth, fifth, third = map(rounded, (0.1, 0.2, 0.3))
    assert 0.1 + 0.2 != 0.3 and not tenth + fifth - third
    assert tenth + fifth - rounded(0.3 + 1e-14)
    assert not (tenth / third) * third - tenth and -tenth
