"""Large simultaneous blocks stay whole and sparse: against nodal analysis in SciPy, and against torn blocks."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shared_models import Grid

from jaxonomy_dae import Component, ModelError, simulate
from jaxonomy_dae.linear import sparse
from jaxonomy_dae.lowering import schedule
from jaxonomy_dae.lowering.schedule import SparseStep
from jaxonomy_dae.modeling import Electrical

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


@pytest.mark.parametrize("n", [6, pytest.param(60, marks=needs_klu)])
def test_resistor_grid(n):
    grid = Grid(n)
    system = grid.system()
    (block,) = whole(system)
    assert block.linear and block.n > 2 * n * n and not system.carried
    # Both solve directly; the condition number of the larger grid is about 1e4.
    np.testing.assert_allclose(currents(system), grid.reference(), rtol=1e-9, atol=1e-12)
    assert f"linear block of {block.n}" in str(system.report) and "solved whole" in str(system.report)


def test_whole_and_torn_blocks_agree(monkeypatch):
    """Values, and gradients in both modes and by central differences."""
    grid = Grid(3)
    systems = whole_whatever_size(monkeypatch, grid), torn(monkeypatch, grid)
    assert whole(systems[0]) and not whole(systems[1])
    names = ("r3.R", "r10.R", "end.R")

    def loss(values, system):
        system = system.with_parameters(dict(zip(names, values, strict=True)))
        x = system.initialize()
        return jnp.sum(system.vector_field(0.0, x) * jnp.array([1.0, -2.0, 0.5]))

    at = jnp.array([0.8, 1.3, 0.6])
    found = [
        [jax.jit(lambda at, f=f, s=s: f(at, s))(at) for f in (loss, jax.jacrev(loss), jax.jacfwd(loss))]
        for s in systems
    ]
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(found[0][1], found[0][2], rtol=1e-11)
    h = 1e-4  # the differences' error is h² ~ 1e-8
    value = jax.jit(lambda at: loss(at, systems[0]))
    for k, e in enumerate(np.eye(3)):
        slope = (value(at + h * e) - value(at - h * e)) / (2 * h)
        np.testing.assert_allclose(found[0][1][k], slope, rtol=1e-6, atol=1e-9)


def test_nonlinear_grid():
    """All unknowns of the block lie in the state array."""
    grid = Grid(7, cubic=0.5)
    system = grid.system()
    (block,) = whole(system)
    assert not block.linear and len(system.carried) == block.n > schedule.TORN
    found = currents(system)
    np.testing.assert_allclose(found, grid.reference(), rtol=1e-8)


def test_learned_terms_in_a_whole_block(monkeypatch):
    grid = Grid(3, cubic=0.5, law=LearnedVaristor)
    system = whole_whatever_size(monkeypatch, grid)
    blocks = [block for block in whole(system) if not block.linear]
    assert blocks and len(system.carried) == sum(block.n for block in blocks)
    np.testing.assert_allclose(currents(system), grid.reference(), rtol=1e-8)


def test_gradients_of_a_nonlinear_grid(monkeypatch):
    grid = Grid(3, cubic=0.5)
    system = whole_whatever_size(monkeypatch, grid)
    assert system.carried and whole(system)
    x0 = jax.jit(lambda: system.initialize())()

    def slopes(G, k=5):
        """Read at the old state: the unknowns are refined from there."""
        changed = system.with_parameters({f"r{k}.G": G})
        return changed.observe([f"c{k}.i" for k in range(3)], 0.0, x0)

    def reference(G, k=5):
        other = Grid(3, cubic=0.5)
        other.G[k] = G
        return other.reference()

    at, h = float(grid.G[5]), 1e-4
    np.testing.assert_allclose(jax.jit(slopes)(at), grid.reference(), rtol=1e-8)
    forward, reverse = jax.jit(jax.jacfwd(slopes))(at), jax.jit(jax.jacrev(slopes))(at)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    differences = (reference(at + h) - reference(at - h)) / (2 * h)
    np.testing.assert_allclose(forward, differences, rtol=1e-6, atol=1e-9)  # h² ~ 1e-8


@pytest.mark.slow
def test_nonlinear_grid_over_time():
    """The rates of the algebraic unknowns keep them on the solution."""
    grid = Grid(7, cubic=0.5)
    system = grid.system()
    solution = simulate(system, 0.5, ts=jnp.array([0.5]), rtol=1e-8, atol=1e-10)
    residual = system.constraint_residual(0.5, solution.states[0])
    np.testing.assert_allclose(residual, 0.0, atol=1e-8)
    moved = Grid(7, cubic=0.5)
    moved.v0 = np.array([float(solution[f"c{k}.v"][0]) for k in range(3)])
    end = np.array([float(solution[f"c{k}.i"][0]) for k in range(3)])
    np.testing.assert_allclose(end, moved.reference(), rtol=1e-6)


def test_without_the_package_small_blocks_are_dense(monkeypatch):
    monkeypatch.setattr(sparse, "available", lambda: False)
    grid = Grid(6)
    np.testing.assert_allclose(currents(grid.system()), grid.reference(), rtol=1e-9, atol=1e-12)
    with pytest.raises(ModelError, match=r'simultaneous equations.*pip install "jaxonomy_dae\[sparse\]"'):
        Grid(20).system()
