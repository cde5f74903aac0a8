"""Large simultaneous blocks stay whole and sparse: against nodal analysis in SciPy, and against torn blocks."""

import functools
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shared_models import Grid

from jaxonomy_dae import Component, ModelError
from jaxonomy_dae.compile.lowering import schedule
from jaxonomy_dae.compile.lowering.schedule import SparseStep
from jaxonomy_dae.solve.linear import sparse
from jaxonomy_dae.write import Electrical

needs_klu = pytest.mark.skipif(importlib.util.find_spec("klujax") is None, reason='needs the extra "sparse"')


class LearnedVaristor(Component):
    """The same law as a network that the compiler does not look into, in the block's matrix by its derivative."""

    def __init__(self, ev, name, G=1.0, a=0.5):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v, i = self.variable("v"), self.variable("i")
        law = self.learned("law", lambda u: G * (u + a * u**3), inputs=[v])
        self.add_equations(v - (p.v - n.v), i - p.i, p.i + n.i, i - law[0])


def currents(system):
    return jax.jit(lambda: system.observe([f"c{k}.i" for k in range(3)], 0.0, system.initialize()))()


def whole(system):
    return [step for step in system.plan.steps if isinstance(step, SparseStep)]


def torn(monkeypatch, grid):
    """The same grid with its blocks torn, whatever their size."""
    with monkeypatch.context() as patch:
        patch.setattr(schedule, "TORN", 10**6)
        patch.setattr(schedule, "WRITTEN_OUT", {True: 10**6, False: 10**6})
        return grid.system()


def whole_whatever_size(monkeypatch, grid):
    """The same grid with its blocks whole, however small."""
    with monkeypatch.context() as patch:
        patch.setattr(schedule, "WRITTEN_OUT", {True: 2, False: 2})
        return grid.system()


@pytest.mark.slow
@pytest.mark.parametrize("n", [6, pytest.param(60, marks=[needs_klu, pytest.mark.slow])])
def test_resistor_grid(n):
    grid = Grid(n)
    system = grid.system()
    (block,) = whole(system)
    assert block.linear and block.n > 2 * n * n and not system.carried
    # Both solve directly; the condition number of the larger grid is about 1e4.
    np.testing.assert_allclose(currents(system), grid.reference(), rtol=1e-9, atol=1e-12)
    assert f"linear block of {block.n}" in str(system.report) and "solved whole" in str(system.report)


def test_gradients_of_a_whole_block(monkeypatch):
    """Against central differences of nodal analysis."""
    grid = Grid(3)
    system = whole_whatever_size(monkeypatch, grid)
    assert whole(system)
    edges, weights = (3, 10), np.array([1.0, -2.0, 0.5])
    order = [system.states.index(f"c{k}.v") for k in range(3)]
    x = np.zeros(3)
    x[order] = grid.v0

    def loss(G, x):
        changed = system.with_parameters({f"r{k}.R": 1 / G[j] for j, k in enumerate(edges)})
        return changed.vector_field(0.0, x)[np.array(order)] @ weights

    def reference(G):
        other = Grid(3)
        other.G[list(edges)] = G
        return other.reference() @ weights

    at = np.array([0.8, 1.3])
    value, gradient = jax.jit(jax.value_and_grad(loss))(at, x)
    np.testing.assert_allclose(value, reference(at), rtol=1e-11)
    h = 1e-4  # the differences' error is h² ~ 1e-8
    slopes = [(reference(at + h * e) - reference(at - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_whole_and_torn_blocks_agree(monkeypatch):
    """Values, and gradients in both modes and by central differences."""
    grid = Grid(3)
    systems = whole_whatever_size(monkeypatch, grid), torn(monkeypatch, grid)
    assert whole(systems[0]) and not whole(systems[1])
    names = ("r3.R", "r10.R", "end.R")

    def loss(values, system):
        system = system.with_parameters(dict(zip(names, values, strict=True)))
        x = system.initialize()
        return jnp.sum(system.vector_field(0.0, x) * np.array([1.0, -2.0, 0.5]))

    at = np.array([0.8, 1.3, 0.6])

    @jax.jit
    def by_both(at):
        """Values and gradients in both modes, whole and torn."""
        losses = [functools.partial(loss, system=s) for s in systems]
        return [f(at) for f in losses], [(jax.jacrev(f)(at), jax.jacfwd(f)(at)) for f in losses]

    values, slopes = by_both(at)
    np.testing.assert_allclose(values[0], values[1], rtol=1e-11, atol=1e-13)
    for found in (slopes[0][1], *slopes[1]):
        np.testing.assert_allclose(slopes[0][0], found, rtol=1e-11, atol=1e-13)
    h = 1e-4  # the differences' error is h² ~ 1e-8
    for k, e in enumerate(np.eye(3)):
        up, down = (float(by_both(at + s * h * e)[0][0]) for s in (1, -1))
        np.testing.assert_allclose(slopes[0][0][k], (up - down) / (2 * h), rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_nonlinear_grid():
    """All unknowns of the block lie in the state array."""
    grid = Grid(7, cubic=0.5)
    system = grid.system()
    (block,) = whole(system)
    assert not block.linear and len(system.carried) == block.n > schedule.TORN
    found = currents(system)
    np.testing.assert_allclose(found, grid.reference(), rtol=1e-8)


@pytest.mark.slow
def test_learned_terms_in_a_whole_block(monkeypatch):
    grid = Grid(3, cubic=0.5, law=LearnedVaristor)
    system = whole_whatever_size(monkeypatch, grid)
    blocks = [block for block in whole(system) if not block.linear]
    assert blocks and len(system.carried) == sum(block.n for block in blocks)
    np.testing.assert_allclose(currents(system), grid.reference(), rtol=1e-8)


@pytest.mark.slow
def test_gradients_of_a_nonlinear_grid(monkeypatch):
    grid = Grid(3, cubic=0.5)
    system = whole_whatever_size(monkeypatch, grid)
    assert system.carried and whole(system)

    def read(G, x, k=5):
        """Read at the old state: the unknowns are refined from there."""
        return system.with_parameters({f"r{k}.G": G}).observe([f"c{k}.i" for k in range(3)], 0.0, x)

    def reference(G, k=5):
        other = Grid(3, cubic=0.5)
        other.G[k] = G
        return other.reference()

    @jax.jit
    def run(G):
        x = jax.lax.stop_gradient(system.initialize())
        return read(G, x), jax.jacfwd(read)(G, x), jax.jacrev(read)(G, x)

    at, h = float(grid.G[5]), 1e-4
    value, forward, reverse = (np.asarray(v) for v in run(at))
    np.testing.assert_allclose(value, grid.reference(), rtol=1e-8)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    differences = (reference(at + h) - reference(at - h)) / (2 * h)
    np.testing.assert_allclose(forward, differences, rtol=1e-6, atol=1e-9)  # h² ~ 1e-8


@pytest.mark.slow
def test_without_the_package_small_blocks_are_dense(monkeypatch):
    monkeypatch.setattr(sparse, "available", lambda: False)
    grid = Grid(6)
    np.testing.assert_allclose(currents(grid.system()), grid.reference(), rtol=1e-9, atol=1e-12)


def test_without_the_package_large_blocks_are_refused(monkeypatch):
    monkeypatch.setattr(sparse, "available", lambda: False)
    with pytest.raises(ModelError, match=r'simultaneous equations.*pip install "jaxonomy_dae\[sparse\]"'):
        Grid(20).system()
