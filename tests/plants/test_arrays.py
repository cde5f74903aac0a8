"""Arrays of components: the same results as single components, from one object; names, values and errors."""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from cell_arrays import Cell, Gated, array_of, ladder, times
from sympy import Eq

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    Electrical,
    EqnEnv,
    ModelError,
    simulate,
    steady_state,
)
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.thermal import HeatCapacitor, ThermalConductor

RTOL, ATOL = 1e-9, 1e-12
R_EACH, C_EACH = np.random.default_rng(0).uniform(0.5, 2.0, (2, 6))
R_ROWS = np.array([0.5, 2.0])
T_START = 300.0 + np.arange(12.0).reshape(3, 4)
LIMIT = np.array([0.3, 0.8, 1.5])


def exact(R: np.ndarray, C: np.ndarray, t: float) -> np.ndarray:
    """The capacitors' voltages, by the matrix exponential of the nodal equations."""
    n, G = len(R), 1 / R
    a = np.diag(-(G + np.append(G[1:], 0.0))) + np.diag(G[1:], 1) + np.diag(G[1:], -1)
    a, b = a / C[:, None], np.eye(n)[0] * G[0] / C[0]
    return np.linalg.solve(a, (scipy.linalg.expm(a * t) - np.eye(n)) @ b)


class Row(Component):
    """An array of cells in a component, itself in an array."""

    def __init__(self, ev, name, n=7, R=1.0):
        super().__init__(ev, name)
        a, ground = self.port("a", Electrical), self.port("ground", Electrical)
        r0 = self.parameter("R", R)
        cells = self.add_array("cell", Cell, n, R=2 * r0, C=1.0 + np.arange(n))
        self.connect(a, cells[0].a)
        self.connect(cells[:-1].b, cells[1:].a)
        self.connect(cells.ground, ground)
        total = self.variable("total")
        self.add_equations(Eq(total, sum(cell.c.v for cell in cells)))


@pytest.fixture(scope="module")
def system():
    """On one source of 1 V: a ladder of six cells with values of their own, and two rows of seven cells, arrays in an
    array; beside them a plate of 3 × 4 nodes, joined by conductors in both directions."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", V=1.0), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    cells = diagram.add_array(ev, "cell", Cell, 6, R_EACH, C=C_EACH)
    diagram.connect(source.p, cells[0].a)
    diagram.connect(cells[:-1].b, cells[1:].a)
    diagram.connect(cells.ground, ground.p)
    rows = diagram.add_array(ev, "row", Row, 2, R=R_ROWS)
    diagram.connect(source.p, rows.a)
    diagram.connect(rows.ground, ground.p)
    nodes = diagram.add_array(ev, "node", HeatCapacitor, (3, 4), initial_temperature=T_START)
    down = diagram.add_array(ev, "down", ThermalConductor, (2, 4))
    right = diagram.add_array(ev, "right", ThermalConductor, (3, 3))
    diagram.connect(nodes[:-1].heat, down.port_a)
    diagram.connect(nodes[1:].heat, down.port_b)
    diagram.connect(nodes[:, :-1].heat, right.port_a)
    diagram.connect(nodes[:, 1:].heat, right.port_b)
    return AcausalCompiler(ev, diagram)()


@pytest.fixture(scope="module")
def solution(system):
    return simulate(system, t1=2.0, ts=jnp.array([0.0, 1.0, 2.0]), rtol=RTOL, atol=ATOL)


@pytest.mark.slow
def test_a_ladder_with_values_for_each(system, solution):
    voltages = solution["cell.c.v"]
    assert voltages.shape == (3, 6)
    for k in (1, 2):
        np.testing.assert_allclose(voltages[k], exact(R_EACH, C_EACH, k), atol=20 * RTOL)  # a few steps' errors of rtol
    np.testing.assert_array_equal(voltages[:, 3], solution["cell[3].c.v"])
    np.testing.assert_allclose(solution["cell.r.i"][:, 0], solution["cell[0].r.i"])
    np.testing.assert_array_equal(system.parameters["cell.r.R"], R_EACH)
    assert system.parameters["cell[2].c.C"] == C_EACH[2]
    assert "cell.c.v" in solution and "cell.c.x" not in solution and "cell[6].c.v" not in solution


def test_a_grid_of_two_dimensions(system, solution):
    assert solution["node.T"].shape == (3, 3, 4)
    np.testing.assert_allclose(solution["node.T"][0], T_START, rtol=1e-14)
    path = [np.diag([1.0] * (n - 1), 1) + np.diag([1.0] * (n - 1), -1) for n in (3, 4)]
    joined = np.kron(path[0], np.eye(4)) + np.kron(np.eye(3), path[1])
    G, C = float(system.parameters["down.G"][0, 0]), float(system.parameters["node[1,2].C"])
    a = (joined - np.diag(joined.sum(axis=0))) * G / C
    np.testing.assert_allclose(solution["node.T"][1].ravel(), scipy.linalg.expm(a) @ T_START.ravel(), rtol=10 * RTOL)
    np.testing.assert_array_equal(solution["node[2,1].T"], solution["node.T"][:, 2, 1])


def test_arrays_in_arrays(system, solution):
    """Parameters passed down, symbols of entries in equations, names with some of the indices."""
    found = solution["row.cell.c.v"]
    assert found.shape == (3, 2, 7)
    for k in range(2):
        expected = exact(np.full(7, 2 * R_ROWS[k]), 1.0 + np.arange(7), 1.0)
        np.testing.assert_allclose(found[1, k], expected, atol=20 * RTOL)
        np.testing.assert_array_equal(solution[f"row[{k}].cell.c.v"], found[:, k])
    np.testing.assert_array_equal(solution["row.cell[1].c.v"], found[:, :, 1])
    np.testing.assert_allclose(solution["row.total"], found.sum(axis=2), rtol=1e-14)
    changed = system.with_parameters({"row[1].R": 0.5})
    np.testing.assert_array_equal(changed.parameters["row.cell.r.R"], np.full((2, 7), 1.0))
    with pytest.raises(ModelError, match=r"'row\[0\].cell\[0\].r.R' is 2\*row\[0\].R, computed from others"):
        system.with_parameters({"row.cell.r.R": 3.0})
    with pytest.raises(ModelError, match=r"'cell\[0\].r.R' is given twice, by its own name and as part of an array"):
        system.with_parameters({"cell[0].r.R": 7.0, "cell.r.R": 1.0})


def test_plots(solution):
    """Each entry of a small array is a line with its name; a large one has one name."""
    pytest.importorskip("matplotlib")
    axes = solution.plot("cell.c.v", "source.v")
    assert [line.get_label() for line in axes.lines] == [*(f"cell[{k}].c.v" for k in range(6)), "source.v"]
    axes = solution.plot("row.cell.c.v")
    assert len(axes.lines) == 14 and axes.lines[0].get_label() == "row.cell.c.v"
    assert axes.get_ylabel() == "row.cell.c.v / V"


@pytest.mark.parametrize("n", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 11))])
def test_the_same_as_single_components(n):
    """The same states and counts, slopes, and gradients by every parameter."""
    R = np.random.default_rng(n).uniform(0.5, 2.0, n)
    one, other = ladder(n, True, R), ladder(n, False, R)
    assert [s.replace("[", "").replace("]", "") for s in one.states] == list(other.states)
    assert len(one.variables) == len(other.variables) and len(one.parameters) == len(other.parameters)

    x, weights = jnp.asarray(np.linspace(0.2, 0.9, n)), np.linspace(1.0, 2.0, n)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def weighed(values, system):
        return weights @ system.with_parameters(values).vector_field(0.0, x)

    together, all_at_once = weighed({"cell.r.R": jnp.asarray(R)}, one)
    apart, singles = weighed({f"cell{k}.r.R": jnp.asarray(R[k]) for k in range(n)}, other)
    np.testing.assert_allclose(together, apart, rtol=1e-13)
    np.testing.assert_allclose(all_at_once["cell.r.R"], [singles[f"cell{k}.r.R"] for k in range(n)], atol=1e-10)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 12))])
def test_random_networks(seed):
    """Resistors, capacitors and inductors between random nodes: connections by element and at one node, with indices in
    random order, against the same network of single components."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 8))
    kinds = {"r": Resistor, "l": Inductor, "c": Capacitor}
    values = {k: rng.uniform(0.5, 2.0, n) for k in kinds}
    order = {k: rng.permutation(n) for k in kinds}
    arrays, singles = (EqnEnv(), AcausalDiagram()), (EqnEnv(), AcausalDiagram())

    def build(ev, diagram, in_array: bool):
        source, ground = VoltageSource(ev, "source", V=1.0), Ground(ev, "ground")
        starts = {"c": {"initial_voltage": 0.1}, "l": {"initial_current": 0.2}, "r": {}}
        parts = {
            k: diagram.add_array(ev, k, kind, n, values[k], **starts[k])
            if in_array
            else [kind(ev, f"{k}{j}", float(values[k][j]), **starts[k]) for j in range(n)]
            for k, kind in kinds.items()
        }
        diagram.connect(source.n, ground.p)
        if in_array:
            r, li, c = parts["r"], parts["l"], parts["c"]
            diagram.connect(source.p, r[order["r"][: n - 1]].p)
            diagram.connect(r[order["r"]].n, li[order["l"]].p, c[order["c"]].p)
            diagram.connect(r[int(order["r"][-1])].p, r[int(order["r"][0])].n)
            diagram.connect(li.n, c.n)
            diagram.connect(c[::2].n, ground.p)
            if n > 3:
                diagram.connect(c[1].n, c[3].n)
            diagram.connect(c[1].n, ground.p)
            return
        for j in range(n):
            a, b, d = (parts[k][order[k][j]] for k in ("r", "l", "c"))
            diagram.connect(a.n, b.p, d.p)
            if j < n - 1:
                diagram.connect(source.p, a.p)
            diagram.connect(parts["l"][j].n, parts["c"][j].n)
            if j % 2 == 0 or j == 1:
                diagram.connect(parts["c"][j].n, ground.p)
        diagram.connect(parts["r"][order["r"][-1]].p, parts["r"][order["r"][0]].n)
        if n > 3:
            diagram.connect(parts["c"][1].n, parts["c"][3].n)

    build(*arrays, True)
    build(*singles, False)
    one, other = AcausalCompiler(*arrays)(), AcausalCompiler(*singles)()

    @eqx.filter_jit
    def started(system):
        return system.vector_field(0.0, system.initialize())

    def slopes(system):
        return {s.replace("[", "").replace("]", ""): v for s, v in zip(system.states, started(system), strict=True)}

    found, expected = slopes(one), slopes(other)
    assert set(found) == set(expected)
    np.testing.assert_allclose([found[k] for k in expected], list(expected.values()), rtol=1e-10, atol=1e-10)


@pytest.fixture(scope="module")
def gates():
    """One network for all, an event for each: its model, and a run."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    network = jax.tree_util.Partial(times, jnp.array(0.5))
    diagram.add_array(ev, "gate", Gated, 3, network, limit=LIMIT)
    system = AcausalCompiler(ev, diagram)()
    return system, simulate(system, t1=3.0, ts=jnp.array([0.5, 3.0]), rtol=RTOL, atol=ATOL)


@pytest.mark.slow
@pytest.mark.long("a run with events, whose program is large")
def test_networks_events_and_inputs_in_arrays(gates):
    """x reaches its limit at 2·log(1 + limit/2), from x' = 1 + x/2."""
    system, solution = gates
    assert list(system.neural) == ["gate.rate"]
    np.testing.assert_allclose(solution["gate.x"][-1], LIMIT, atol=20 * RTOL)
    np.testing.assert_allclose(solution.events.ts[:3], 2 * np.log(1 + LIMIT / 2), atol=20 * RTOL)
    np.testing.assert_array_equal(solution["gate.on"], [[0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    started = system.initialize(initial={"gate.x": np.array([0.1, 0.2, 0.25])})
    np.testing.assert_array_equal(system.observe("gate.x", 0.0, started), [0.1, 0.2, 0.25])
    again = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(again.parameters["gate.limit"], LIMIT)


@pytest.mark.slow
def test_frames_preferences_and_chains_of_one(gates):
    """Names of arrays in `to_pandas`, `prefer_states` and `in`; slices that are empty; ports by index."""
    pytest.importorskip("pandas")
    for n in (1, 3):
        ev, diagram = EqnEnv(), AcausalDiagram()
        network = jax.tree_util.Partial(times, jnp.array(0.5))
        chain = diagram.add_array(ev, "gate", Gated, n, network)
        diagram.connect(chain[:-1].x, chain[1:].u)
        system = AcausalCompiler(ev, diagram, prefer_states=["gate.x"])()
        assert list(system.states) == [f"gate[{k}].x" for k in range(n)]
        assert "gate.limit" in system.parameters and "gate.u" not in system.parameters
    assert list(gates[1].to_pandas("gate.x").columns) == [f"gate[{k}].x" for k in range(3)]
    _, diagram, cells = array_of(Cell, 3)
    assert len(cells.a) == 3 and repr(cells.a[1]) == repr(cells[1].a) == "cell[1].a: Electrical port"


@pytest.mark.slow
def test_the_steady_state_of_an_array():
    """Inputs and starts by the array's name: 0 = 1 + x/2 + u."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "gate", Gated, 3, jax.tree_util.Partial(times, jnp.array(0.5)), limit=9.0)
    system = AcausalCompiler(ev, diagram)()
    u = np.array([-1.5, -2.0, -3.0])
    found = steady_state(system, inputs={"gate.u": u}, initial={"gate.x": np.ones(3)})
    np.testing.assert_allclose(system.observe("gate.x", 0.0, found.x), -2 * (1 + u), rtol=1e-9)


def test_training_an_array():
    """`partition` by the array's name sets all its entries apart."""
    system = ladder(3, True, np.ones(3))
    trainable, frozen = system.partition("cell.r.R", "cell[1].c.C")
    assert trainable.parameters.free.shape == (4,)
    joined = jax.tree.map(lambda a, b: a if b is None else b, trainable, frozen, is_leaf=lambda leaf: leaf is None)
    np.testing.assert_array_equal(joined.parameters["cell.r.R"], np.ones(3))


class Sum(Component):
    """y is the sum of some numbers."""

    def __init__(self, ev, name, a):
        super().__init__(ev, name)
        self.add_equations(Eq(self.variable("y"), sum(self.parameter(f"a{k}", v) for k, v in enumerate(a))))


def test_values_in_a_list():
    ev, diagram, _ = array_of(Sum, 3, a=[np.array([1.0, 2.0, 3.0]), 10.0])
    system = AcausalCompiler(ev, diagram)()
    np.testing.assert_array_equal(system.observe("cell.y", 0.0, system.initialize()), [11.0, 12.0, 13.0])
    np.testing.assert_array_equal(system.parameters["cell.a0"], [1.0, 2.0, 3.0])


@pytest.mark.slow
def test_a_hundred_thousand_cells():
    """1.2 million equations: the first cells' voltages are those of a short ladder until the far end is felt."""
    system = ladder(100_000, True)
    solution = simulate(system, t1=1.0, ts=jnp.array([1.0]), rtol=1e-6)
    found = solution["cell.c.v"][0]
    assert found.shape == (100_000,)
    np.testing.assert_allclose(found[:30], exact(np.ones(60), np.ones(60), 1.0)[:30], atol=1e-5)
