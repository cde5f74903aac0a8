"""Linear DAEs of known index and solution: E·y' = A·y + f(t) in Weierstrass form, mixed.

A regular pencil is equivalent to x' = J·x and N·z' = z + g(t) with N nilpotent (Weierstrass 1868; Kunkel & Mehrmann
2006, Theorem 2.7): x = exp(J·t)·x₀, z = −Σ Nⁱ g⁽ⁱ⁾, and the index is that of N, the size of its largest block. With
y = Q·(x, z) and every equation replaced by a combination of all, E = P·diag(I, N)·Q⁻¹ is full: its rank shows in its
numbers, not in its structure.
"""

import dataclasses

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from shared_models import MIXED, Pencil, written

from jaxonomy_dae import AcausalDiagram, Component, simulate
from jaxonomy_dae.compiler.flatten import flatten
from jaxonomy_dae.compiler.pipeline import compile_flat
from jaxonomy_dae.lowering.lower import lower
from jaxonomy_dae.system.report import SystemReport


@st.composite
def invertible(draw, n: int, mixed: bool):
    """A product of a permutation and, if mixed, triangular integer matrices with unit diagonals."""
    out = np.eye(n, dtype=int)[list(draw(st.permutations(range(n))))]
    if mixed:
        entry = st.integers(-1, 1)
        lower, upper = np.eye(n, dtype=int), np.eye(n, dtype=int)
        for i in range(n):
            for k in range(i):
                lower[i, k], upper[k, i] = draw(entry), draw(entry)
        out = lower @ out @ upper
    return tuple(map(tuple, out.tolist()))


@st.composite
def pencils(draw, mixed=True, largest=4):
    d = draw(st.integers(0, 2))
    blocks = draw(
        st.lists(st.integers(1, 3), min_size=0 if d else 1, max_size=2).filter(lambda b: d + sum(b) <= largest)
    )
    n = d + sum(blocks)
    small = st.integers(-1, 1)
    row = st.lists(small, min_size=d, max_size=d).map(tuple)
    return Pencil(
        tuple(draw(st.lists(row, min_size=d, max_size=d))),
        tuple(blocks),
        tuple(draw(st.lists(st.tuples(small, small), min_size=sum(blocks), max_size=sum(blocks)))),
        draw(invertible(n, mixed)),
        draw(invertible(n, mixed)),
        tuple(draw(st.permutations(range(n)))),
        tuple(draw(st.permutations(range(n)))),
    )


def plan_of(component: Component):
    """The plan, without anything compiled by XLA."""
    diagram = AcausalDiagram().add(component)
    return lower(compile_flat(flatten(diagram), "auto", ()))


# --- structure ---------------------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=40)
@hypothesis.given(pencils(mixed=False, largest=7))
def test_index_and_freedom_of_permuted_pencils(pencil):
    """Where nothing cancels, the structure tells the index and the degrees of freedom."""
    report = SystemReport(plan_of(written(pencil)))
    assert report.degrees_of_freedom == pencil.dynamic
    assert report.index == max(pencil.blocks, default=0)


@hypothesis.settings(max_examples=25)
@hypothesis.given(pencils(), st.randoms(use_true_random=False))
def test_freedom_of_mixed_pencils(pencil, rng):
    """Whatever cancels, there are as many states as dynamic modes; order and names of anything change nothing."""
    report = SystemReport(plan_of(written(pencil)))
    assert report.degrees_of_freedom == len(report.states) == pencil.dynamic
    shuffled = dataclasses.replace(
        pencil,
        rows=tuple(rng.sample(range(pencil.n), pencil.n)),
        columns=tuple(rng.sample(range(pencil.n), pencil.n)),
    )
    names = [f"{'zabq'[k % 4]}{rng.randrange(1000)}_{k}" for k in range(pencil.n)]
    other = SystemReport(plan_of(written(shuffled, "other", names)))
    assert other.degrees_of_freedom == len(other.states) == pencil.dynamic
    assert other.index == report.index


# --- solutions ---------------------------------------------------------------------------------------------------


@eqx.filter_jit
def _at(system, initial, names):
    x = system.initialize(t0=0.4, initial=initial)
    return system.observe(names, 0.4, x), system.vector_field(0.4, x)


def check_point(pencil):
    """At a point of the exact solution, the compiled system has its values and its derivatives.

    All values are given at the start, consistent as they are: a state may be a derivative, which has no name to set.
    """
    hypothesis.assume(pencil.dynamic or any(any(pair) for pair in pencil.g))  # something that is not always zero
    system = compiled(written(pencil))
    y, dy = (a[0] for a in pencil.solution([0.4], np.linspace(0.5, 1.0, pencil.dynamic)))
    place = {f"dae.y{k}": k for k in range(pencil.n)}
    found, slope = _at(system, {name: jnp.asarray(v) for name, v in zip(place, y, strict=True)}, list(place))
    # Rounding times the condition of the mixing matrices, products of unit triangular ones: at most some thousands.
    np.testing.assert_allclose(found, y, rtol=1e-10, atol=1e-10)
    for name, rate in zip(system.states, slope, strict=False):
        if name in place:
            assert float(rate) == pytest.approx(dy[place[name]], rel=1e-10, abs=1e-10)


@hypothesis.settings(max_examples=4)
@hypothesis.given(pencils())
@hypothesis.example(MIXED)
def test_points_of_mixed_pencils(pencil):
    check_point(pencil)


@pytest.mark.slow
@hypothesis.settings(max_examples=60, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(pencils(largest=5))
def test_points_of_many_mixed_pencils(pencil):
    check_point(pencil)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_trajectories_in_any_order_under_any_name(seed):
    rng = np.random.default_rng(seed)
    rows, columns = (tuple(rng.permutation(MIXED.n).tolist()) for _ in range(2))
    shuffled = dataclasses.replace(MIXED, rows=rows, columns=columns)
    names = [f"{'zyxw'[k]}{seed}" for k in range(MIXED.n)]
    system = compiled(written(shuffled, "other", names))
    ts = np.array([0.5, 1.0, 2.0])
    start = MIXED.solution([0.0], np.array([1.0, -0.5]))[0][0]
    initial = {f"other.{name}": value for name, value in zip(names, start, strict=True)}
    solution = simulate(system, 2.0, ts=ts, initial=initial, rtol=1e-9, atol=1e-11)
    expected = MIXED.solution(ts, np.array([1.0, -0.5]))[0]
    found = np.stack([solution[f"other.{n}"] for n in names], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)  # a hundred times the tolerance
