"""Large simultaneous blocks stay whole and sparse: against nodal analysis in SciPy, and against torn blocks."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from problems import compiled

from jaxonomy_dae import Component, EqnEnv, ModelError, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.linear import sparse
from jaxonomy_dae.lowering import schedule
from jaxonomy_dae.lowering.schedule import SparseStep
from jaxonomy_dae.modeling import Electrical

needs_klu = pytest.mark.skipif(importlib.util.find_spec("klujax") is None, reason='needs the extra "sparse"')


class Varistor(Component):
    """i = G·(v + a·v³): a conductance that grows with the voltage."""

    def __init__(self, ev, name, G=1.0, a=0.5):
        super().__init__(ev, name)
        G, a = self.parameter("G", G), self.parameter("a", a)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v, i = self.variable("v"), self.variable("i")
        self.add_equations(v - (p.v - n.v), i - p.i, p.i + n.i, i - G * (v + a * v**3))


class LearnedVaristor(Component):
    """The same law as a network that the compiler does not look into, in the block's matrix by its derivative."""

    def __init__(self, ev, name, G=1.0, a=0.5):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v, i = self.variable("v"), self.variable("i")
        law = self.learned("law", lambda u: G * (u + a * u**3), inputs=[v])
        self.add_equations(v - (p.v - n.v), i - p.i, p.i + n.i, i - law[0])


class Grid:
    """n × n nodes, neighbours joined by random conductances; a source of 1 V at one corner, 1 Ω to ground at the other,
    and capacitors at some nodes. `cubic` makes the conductances nonlinear."""

    def __init__(self, n: int, *, capacitors: int = 3, cubic: float = 0.0, law=Varistor, seed: int = 0):
        rng = np.random.default_rng(seed)
        number = np.arange(n * n).reshape(n, n)
        self.edges = np.concatenate(
            [
                np.stack([number[1:].ravel(), number[:-1].ravel()]),
                np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()]),
            ],
            axis=1,
        ).T
        self.G = rng.uniform(0.5, 2.0, len(self.edges))
        self.n_nodes, self.cubic, self.law = n * n, cubic, law
        self.stored = rng.choice(np.arange(1, n * n - 1), capacitors, replace=False)
        self.v0 = rng.uniform(0.0, 1.0, capacitors)

    def system(self):
        ev = EqnEnv()
        source, ground, end = VoltageSource(ev, "source", 1.0), Ground(ev, "ground"), Resistor(ev, "end", 1.0)
        pins = [[] for _ in range(self.n_nodes)]
        parts = [source, ground, end]
        for k, ((a, b), G) in enumerate(zip(self.edges.tolist(), self.G.tolist(), strict=True)):
            part = self.law(ev, f"r{k}", G, self.cubic) if self.cubic else Resistor(ev, f"r{k}", 1 / G)
            parts.append(part)
            pins[a].append(part.p)
            pins[b].append(part.n)
        low = [ground.p, source.n, end.n]
        pins[0].append(source.p)
        pins[-1].append(end.p)
        for k, (node, v0) in enumerate(zip(self.stored.tolist(), self.v0.tolist(), strict=True)):
            part = Capacitor(ev, f"c{k}", 1.0, initial_voltage=v0)
            parts.append(part)
            pins[node].append(part.p)
            low.append(part.n)
        return compiled(*parts, connect=[low, *pins])

    def reference(self) -> np.ndarray:
        """The capacitors' currents at the start, by Newton's method on the nodes' balances with a sparse Jacobian."""
        known = np.concatenate([[0], self.stored])
        free = np.setdiff1d(np.arange(self.n_nodes), known)
        v = np.zeros(self.n_nodes)
        v[known] = [1.0, *self.v0]
        a, b = self.edges.T
        difference = sp.coo_array(
            (np.repeat([1.0, -1.0], len(a)), (np.tile(np.arange(len(a)), 2), np.concatenate([a, b]))),
            shape=(len(a), self.n_nodes),
        ).tocsc()
        drain = np.zeros(self.n_nodes)
        drain[-1] = 1.0
        for _ in range(30):
            u = difference @ v
            balance = difference.T @ (self.G * (u + self.cubic * u**3)) + drain * v
            matrix = difference.T @ sp.diags_array(self.G * (1 + 3 * self.cubic * u**2)) @ difference
            matrix = (matrix + sp.diags_array(drain)).tocsc()[:, free][free]
            v[free] -= sp.linalg.spsolve(matrix, balance[free])
        return -balance[self.stored]


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
