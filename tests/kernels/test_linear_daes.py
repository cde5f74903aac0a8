"""Linear DAEs of known index and solution: E·y' = A·y + f(t) in Weierstrass form, mixed.

A regular pencil is equivalent to x' = J·x and N·z' = z + g(t) with N nilpotent (Weierstrass 1868; Kunkel & Mehrmann
2006, Theorem 2.7): x = exp(J·t)·x₀, z = −Σ Nⁱ g⁽ⁱ⁾, and the index is that of N, the size of its largest block. With
y = Q·(x, z) and every equation replaced by a combination of all, E = P·diag(I, N)·Q⁻¹ is full: its rank shows in its
numbers, not in its structure.
"""

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pencils import pencils
from problems import compiled
from shared_models import MIXED, written


@eqx.filter_jit
def _at(system, initial, names):
    x = system.initialize(t0=0.4, initial=initial)
    return system.observe(names, 0.4, x), system.vector_field(0.4, x)


def check_point(pencil):
    """At a point of the exact solution, the compiled system has its values and its derivatives.

    All values are given at the start, consistent as they are: a state may be a derivative, which has no name to set.
    """
    system = compiled(written(pencil))
    y, dy = (a[0] for a in pencil.solution([0.4], np.linspace(0.5, 1.0, pencil.dynamic)))
    place = {f"dae.y{k}": k for k in range(pencil.n)}
    found, slope = _at(system, {name: jnp.asarray(v) for name, v in zip(place, y, strict=True)}, list(place))
    # Rounding times the condition of the mixing matrices, products of unit triangular ones: at most some thousands.
    np.testing.assert_allclose(np.asarray(found), y, rtol=1e-10, atol=1e-10)
    for name, rate in zip(system.states, slope, strict=False):
        if name in place:
            assert float(rate) == pytest.approx(dy[place[name]], rel=1e-10, abs=1e-10)


def test_a_point_of_a_mixed_pencil():
    """The state given, the derivative in it included."""
    system = compiled(written(MIXED))
    y, dy = (a[0] for a in MIXED.solution([0.4], np.array([0.5, 1.0])))
    names = [f"dae.y{k}" for k in range(MIXED.n)]
    known = dict(zip(names, y, strict=True)) | {f"der({name})": rate for name, rate in zip(names, dy, strict=True)}
    state = np.array([known[name] for name in system.states])
    found, slope = jax.jit(lambda x: (system.observe(names, 0.4, x), system.vector_field(0.4, x)))(state)
    np.testing.assert_allclose(found, y, rtol=1e-10, atol=1e-10)
    rates = [(rate, known[f"der({name})"]) for name, rate in zip(system.states, slope, strict=True) if name in names]
    assert rates
    np.testing.assert_allclose(*zip(*rates, strict=True), rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_the_start_of_a_mixed_pencil():
    check_point(MIXED)


@pytest.mark.slow
@hypothesis.settings(max_examples=6, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(pencils(largest=5))
def test_points_of_many_mixed_pencils(pencil):
    hypothesis.assume(pencil.dynamic or any(any(pair) for pair in pencil.g))  # something that is not always zero
    check_point(pencil)
