"""Arrays of components: the same results as single components, from one object; names, values and errors."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from sympy import Eq

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    Electrical,
    EqnEnv,
    ModelError,
    assign,
    der,
    simulate,
    steady_state,
)
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor, VoltageSource
from jaxonomy_dae.library.thermal import HeatCapacitor, ThermalConductor

RTOL, ATOL = 1e-9, 1e-12


class Cell(Component):
    """A resistor in line and a capacitor to ground."""

    def __init__(self, ev, name, R=1.0, C=1.0, v0=0.0):
        super().__init__(ev, name)
        a, b, ground = (self.port(n, Electrical) for n in ("a", "b", "ground"))
        r, c = self.add(Resistor(ev, "r", R)), self.add(Capacitor(ev, "c", C, initial_voltage=v0))
        self.connect(a, r.p)
        self.connect(r.n, c.p, b)
        self.connect(c.n, ground)


def ladder(n: int, in_array: bool, R=1.0, C=1.0):
    """n cells on a source of 1 V; the cells as an array or as single components `cell0`, …"""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", v=1.0), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    if in_array:
        cells = diagram.add_array(ev, "cell", Cell, n, R, C=C)
        diagram.connect(source.p, cells[0].a)
        diagram.connect(cells[:-1].b, cells[1:].a)
        diagram.connect(cells.ground, ground.p)
        return AcausalCompiler(ev, diagram)()
    R, C = np.broadcast_to(R, n), np.broadcast_to(C, n)
    singles = [Cell(ev, f"cell{k}", float(R[k]), float(C[k])) for k in range(n)]
    diagram.connect(source.p, singles[0].a)
    for before, after in zip(singles, singles[1:], strict=False):
        diagram.connect(before.b, after.a)
    for cell in singles:
        diagram.connect(cell.ground, ground.p)
    return AcausalCompiler(ev, diagram)()


def exact(R: np.ndarray, C: np.ndarray, t: float) -> np.ndarray:
    """The capacitors' voltages, by the matrix exponential of the nodal equations."""
    n, G = len(R), 1 / R
    a = np.diag(-(G + np.append(G[1:], 0.0))) + np.diag(G[1:], 1) + np.diag(G[1:], -1)
    a, b = a / C[:, None], np.eye(n)[0] * G[0] / C[0]
    return np.linalg.solve(a, (scipy.linalg.expm(a * t) - np.eye(n)) @ b)


def test_a_ladder_with_values_for_each():
    rng = np.random.default_rng(0)
    R, C = rng.uniform(0.5, 2.0, 6), rng.uniform(0.5, 2.0, 6)
    system = ladder(6, True, R, C)
    solution = simulate(system, t1=2.0, ts=jnp.array([1.0, 2.0]), rtol=RTOL, atol=ATOL)
    voltages = solution["cell.c.v"]
    assert voltages.shape == (2, 6)
    for k, t in enumerate((1.0, 2.0)):
        np.testing.assert_allclose(voltages[k], exact(R, C, t), atol=20 * RTOL)  # a few steps' errors of rtol
    np.testing.assert_array_equal(voltages[:, 3], solution["cell[3].c.v"])
    np.testing.assert_allclose(solution["cell.r.i"][:, 0], solution["cell[0].r.i"])
    np.testing.assert_array_equal(system.parameters["cell.r.R"], R)
    assert system.parameters["cell[2].c.C"] == C[2]
    assert "cell.c.v" in solution and "cell.c.x" not in solution and "cell[6].c.v" not in solution


@pytest.mark.parametrize("n", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 11))])
def test_the_same_as_single_components(n):
    """The same states, values and counts, and gradients by every parameter."""
    R = np.random.default_rng(n).uniform(0.5, 2.0, n)
    one, other = ladder(n, True, R), ladder(n, False, R)
    assert [s.replace("[", "").replace("]", "") for s in one.states] == list(other.states)
    assert len(one.variables) == len(other.variables) and len(one.parameters) == len(other.parameters)

    def end(values, system):
        system = system.with_parameters(values)
        return simulate(system, t1=1.0, ts=jnp.array([1.0]), rtol=RTOL, atol=ATOL).states[0].sum()

    all_at_once = jax.grad(end)({"cell.r.R": jnp.asarray(R)}, one)["cell.r.R"]
    singles = jax.grad(end)({f"cell{k}.r.R": R[k] for k in range(n)}, other)
    np.testing.assert_allclose(all_at_once, [singles[f"cell{k}.r.R"] for k in range(n)], atol=1e-10)


def test_a_grid_of_two_dimensions():
    """A plate of 3 × 4 nodes, joined by conductors in both directions, with the corner held by a large capacity."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    start = 300.0 + np.arange(12.0).reshape(3, 4)
    nodes = diagram.add_array(ev, "node", HeatCapacitor, (3, 4), initial_temperature=start)
    down = diagram.add_array(ev, "down", ThermalConductor, (2, 4))
    right = diagram.add_array(ev, "right", ThermalConductor, (3, 3))
    diagram.connect(nodes[:-1].heat, down.port_a)
    diagram.connect(nodes[1:].heat, down.port_b)
    diagram.connect(nodes[:, :-1].heat, right.port_a)
    diagram.connect(nodes[:, 1:].heat, right.port_b)
    system = AcausalCompiler(ev, diagram)()
    solution = simulate(system, t1=1.0, ts=jnp.array([0.0, 1.0]), rtol=RTOL, atol=ATOL)
    assert solution["node.T"].shape == (2, 3, 4)
    np.testing.assert_allclose(solution["node.T"][0], start, rtol=1e-14)
    path = [np.diag([1.0] * (n - 1), 1) + np.diag([1.0] * (n - 1), -1) for n in (3, 4)]
    joined = np.kron(path[0], np.eye(4)) + np.kron(np.eye(3), path[1])
    G, C = float(system.parameters["down.G"][0, 0]), float(system.parameters["node[1,2].C"])
    a = (joined - np.diag(joined.sum(axis=0))) * G / C
    np.testing.assert_allclose(solution["node.T"][1].ravel(), scipy.linalg.expm(a) @ start.ravel(), rtol=10 * RTOL)
    np.testing.assert_array_equal(solution["node[2,1].T"], solution["node.T"][:, 2, 1])


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(k, marks=pytest.mark.slow) for k in range(4, 40))])
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
        source, ground = VoltageSource(ev, "source", v=1.0), Ground(ev, "ground")
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

    def slopes(system):
        x = system.initialize()
        return {
            s.replace("[", "").replace("]", ""): v
            for s, v in zip(system.states, system.vector_field(0.0, x), strict=True)
        }

    found, expected = slopes(one), slopes(other)
    assert set(found) == set(expected)
    np.testing.assert_allclose([found[k] for k in expected], list(expected.values()), rtol=1e-10, atol=1e-10)


class Row(Component):
    """An array of cells in a component, itself in an array."""

    def __init__(self, ev, name, n=3, R=1.0):
        super().__init__(ev, name)
        a, ground = self.port("a", Electrical), self.port("ground", Electrical)
        r0 = self.parameter("R", R)
        cells = self.add_array("cell", Cell, n, R=2 * r0, C=1.0 + np.arange(n))
        self.connect(a, cells[0].a)
        self.connect(cells[:-1].b, cells[1:].a)
        self.connect(cells.ground, ground)
        total = self.variable("total")
        self.add_equations(Eq(total, sum(cell.c.v for cell in cells)))


def test_arrays_in_arrays():
    """Parameters passed down, symbols of entries in equations, names with some of the indices."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", v=1.0), Ground(ev, "ground")
    R = np.array([0.5, 2.0])
    rows = diagram.add_array(ev, "row", Row, 2, R=R)
    diagram.connect(source.p, rows.a)
    diagram.connect(source.n, rows.ground, ground.p)
    system = AcausalCompiler(ev, diagram)()
    solution = simulate(system, t1=1.0, ts=jnp.array([1.0]), rtol=RTOL, atol=ATOL)
    found = solution["row.cell.c.v"]
    assert found.shape == (1, 2, 3)
    for k in range(2):
        expected = exact(np.full(3, 2 * R[k]), 1.0 + np.arange(3), 1.0)
        np.testing.assert_allclose(found[0, k], expected, atol=20 * RTOL)
        np.testing.assert_array_equal(solution[f"row[{k}].cell.c.v"], found[:, k])
    np.testing.assert_array_equal(solution["row.cell[1].c.v"], found[:, :, 1])
    np.testing.assert_allclose(solution["row.total"], found.sum(axis=2), rtol=1e-14)
    changed = system.with_parameters({"row[1].R": 0.5})
    np.testing.assert_array_equal(changed.parameters["row.cell.r.R"], np.full((2, 3), 1.0))
    with pytest.raises(ModelError, match=r"'row\[0\].cell\[0\].r.R' is 2\*row\[0\].R, computed from others"):
        system.with_parameters({"row.cell.r.R": 3.0})


class Gated(Component):
    """x grows at the rate of a network until it reaches its limit, an event."""

    def __init__(self, ev, name, network, limit=1.0):
        super().__init__(ev, name)
        limit = self.parameter("limit", limit)
        x, u = self.variable("x", start=0.0, fixed=True), self.input("u", default=0.0)
        on = self.discrete("on", 1.0)
        (y,) = self.learned("rate", network, inputs=[x])
        self.add_equations(Eq(der(x), on * (1.0 + y) + u))
        self.when(x >= limit, assign(on, 0.0))


def times(weight, x):
    return weight * x


def test_networks_events_and_inputs_in_arrays():
    """One network for all; an event for each; x reaches its limit at 2·log(1 + limit/2), from x' = 1 + x/2."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    limit = np.array([0.3, 0.8, 1.5])
    network = jax.tree_util.Partial(times, jnp.array(0.5))
    diagram.add_array(ev, "gate", Gated, 3, network, limit=limit)
    system = AcausalCompiler(ev, diagram)()
    assert list(system.neural) == ["gate.rate"]
    solution = simulate(system, t1=3.0, ts=jnp.array([0.5, 3.0]), rtol=RTOL, atol=ATOL)
    np.testing.assert_allclose(solution["gate.x"][-1], limit, atol=20 * RTOL)
    np.testing.assert_allclose(solution.events.ts[:3], 2 * np.log(1 + limit / 2), atol=20 * RTOL)
    np.testing.assert_array_equal(solution["gate.on"], [[0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    pushed = simulate(system, t1=0.1, ts=jnp.array([0.1]), inputs={"gate.u": np.array([0.0, 1.0, 2.0])}, rtol=RTOL)
    single = simulate(system, t1=0.1, ts=jnp.array([0.1]), inputs={"gate[1].u": 1.0, "gate[2].u": 2.0}, rtol=RTOL)
    np.testing.assert_array_equal(pushed["gate.x"], single["gate.x"])
    samples = (np.array([0.0, 1.0]), np.array([[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]))
    sampled = simulate(system, t1=0.1, ts=jnp.array([0.1]), inputs={"gate.u": samples}, rtol=RTOL, atol=ATOL)
    np.testing.assert_allclose(sampled["gate.x"], pushed["gate.x"], atol=1e-7)
    started = system.initialize(initial={"gate.x": np.array([0.1, 0.2, 0.25])})
    np.testing.assert_array_equal(system.observe("gate.x", 0.0, started), [0.1, 0.2, 0.25])
    again = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(again.parameters["gate.limit"], limit)


def test_the_steady_state_of_an_array():
    """Inputs and starts by the array's name: 0 = 1 + x/2 + u."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "gate", Gated, 3, jax.tree_util.Partial(times, jnp.array(0.5)), limit=9.0)
    system = AcausalCompiler(ev, diagram)()
    u = np.array([-1.5, -2.0, -3.0])
    found = steady_state(system, inputs={"gate.u": u}, initial={"gate.x": np.ones(3)})
    np.testing.assert_allclose(system.observe("gate.x", 0.0, found.x), -2 * (1 + u), rtol=1e-9)


def test_frames_preferences_and_chains_of_one():
    """Names of arrays in `to_pandas`, `prefer_states` and `in`; slices that are empty; ports by index."""
    pytest.importorskip("pandas")
    for n in (1, 3):
        ev, diagram = EqnEnv(), AcausalDiagram()
        network = jax.tree_util.Partial(times, jnp.array(0.5))
        gates = diagram.add_array(ev, "gate", Gated, n, network)
        diagram.connect(gates[:-1].x, gates[1:].u)
        system = AcausalCompiler(ev, diagram, prefer_states=["gate.x"])()
        assert list(system.states) == [f"gate[{k}].x" for k in range(n)]
        assert "gate.limit" in system.parameters and "gate.u" not in system.parameters
        frame = simulate(system, t1=0.1, ts=jnp.array([0.0, 0.1])).to_pandas("gate.x")
        assert list(frame.columns) == [f"gate[{k}].x" for k in range(n)]
    _, diagram, cells = array_of(Cell, 3)
    assert len(cells.a) == 3 and repr(cells.a[1]) == repr(cells[1].a) == "cell[1].a: Electrical port"


def test_plots():
    """Each entry of a small array is a line with its name; a large one has one name."""
    pytest.importorskip("matplotlib")
    few, many = (simulate(ladder(n, True), t1=1.0, ts=jnp.linspace(0.0, 1.0, 5)) for n in (3, 20))
    axes = few.plot("cell.c.v", "source.v")
    assert [line.get_label() for line in axes.lines] == [*(f"cell[{k}].c.v" for k in range(3)), "source.v"]
    axes = many.plot("cell.c.v")
    assert len(axes.lines) == 20 and axes.lines[0].get_label() == "cell.c.v"
    assert axes.get_ylabel() == "cell.c.v [V]"


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


class Careless(Component):
    """Uses its argument without declaring it."""

    def __init__(self, ev, name, a=1.0):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), -a * x))


def array_of(kind, *args, **kwargs):
    ev, diagram = EqnEnv(), AcausalDiagram()
    array = diagram.add_array(ev, "cell", kind, *args, **kwargs)
    return ev, diagram, array


def wrong_shape():
    array_of(Cell, 4, R=np.ones(3))


def not_positive():
    array_of(Cell, 0)


def out_of_bounds():
    array_of(Cell, 3, R=np.array([1.0, 2.0, -1.0]), C=np.array([1.0, -1.0, 1.0]))


def not_finite():
    array_of(Cell, 2, R=np.array([1.0, np.nan]))


def undeclared():
    ev, diagram, _ = array_of(Careless, 2, a=np.array([1.0, 2.0]))
    AcausalCompiler(ev, diagram)()


def lengths_disagree():
    _, diagram, cells = array_of(Cell, 4)
    diagram.connect(cells[1:].a, cells[:-2].b)


def beyond():
    _, _, cells = array_of(Cell, 4)
    cells[4]


def itself():
    _, diagram, cells = array_of(Cell, 4)
    diagram.connect(cells.a, cells[:].a)


def other_domain():
    ev, diagram, cells = array_of(Cell, 4)
    nodes = diagram.add_array(ev, "node", HeatCapacitor, 4)
    diagram.connect(cells.a, nodes.heat)


def a_list():
    array_of(Gated, 2, times, limit=[1.0, 2.0])


class Choosing(Component):
    """Chooses an equation by its argument."""

    def __init__(self, ev, name, mode=1.0):
        super().__init__(ev, name)
        x = self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(der(x), 1.0 if mode is None else -x))


def unused():
    array_of(Choosing, 2, mode=np.array([0.0, 1.0]))


def texts():
    array_of(Cell, 2, R=np.array(["a", "b"]))


def expressions():
    array_of(Cell, 2, R=np.array([object(), object()]))


def given_twice():
    ladder(3, True).with_parameters({"cell[0].r.R": 7.0, "cell.r.R": 1.0})


def started_twice():
    ladder(3, True).initialize(initial={"cell.c.v": 1.0, "cell[0].c.v": 2.0})


def used_twice():
    ev, diagram, _ = array_of(Cell, 4)
    diagram.add_array(ev, "cell", Cell, 2)


def wrong_values():
    ladder(3, True).with_parameters({"cell.r.R": np.ones(4)})


def value_out_of_bounds():
    ladder(3, True).with_parameters({"cell.c.C": np.array([1.0, 1.0, -2.0])})


def every_step_of_many():
    simulate(ladder(100, True), t1=1.0, max_steps=10_000_000)


def wrong_start():
    ladder(3, True).initialize(initial={"cell.c.v": np.zeros(2)})


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (wrong_shape, r"array 'cell' has shape \(4,\), but the values of R have shape \(3,\): give one for each"),
        (not_positive, r"array 'cell': its shape is a positive integer or a tuple of them; got 0"),
        (out_of_bounds, r"parameter 'cell\[1\].c.C' must lie in \(0, inf\); got -1"),
        (not_finite, r"array 'cell': the values of R must be finite; got nan at position 1"),
        (undeclared, r"array 'cell': 'a' has a value for each component, and Careless uses it in an equation"),
        (lengths_disagree, r"arrays of one shape join element by element.*'cell.a \(3\)', 'cell.b \(2\)'"),
        (beyond, r"array 'cell' has shape \(4,\): index 4 is out of bounds"),
        (itself, r"'cell.a' is connected to itself"),
        (other_domain, r"a connection joins ports of one domain"),
        (a_list, r"must be a number; got list.*Values of limit for each component are given as a NumPy array"),
        (unused, r"'mode' has a value for each component, but Choosing does not use it in a parameter or an equation"),
        (texts, r"the values of R must be real numbers; got texts"),
        (expressions, r"the values of R must be real numbers; got entries of type object"),
        (given_twice, r"parameter 'cell\[0\].r.R' is given twice, by its own name and as part of an array"),
        (started_twice, r"initial: 'cell\[0\].c.v' is given twice"),
        (used_twice, r"the diagram has 'cell' already: give the array another name"),
        (
            wrong_values,
            r"parameter 'cell.r.R' is an array of shape \(3,\): give a number or that shape; got shape \(4,\)",
        ),
        (value_out_of_bounds, r"parameter 'cell\[2\].c.C' must lie in \(0, inf\); got -2"),
        (every_step_of_many, r"reserves max_steps \+ 1 = 10000001 rows for 100 states, 7.5 GiB: say when to save, ts="),
        (wrong_start, r"initial: 'cell.c.v' is an array of shape \(3,\): give a number or an array of that shape"),
    ],
)
def test_bad_input(attempt, message):
    with pytest.raises(ModelError, match=message):
        attempt()


def test_symbolic_work_is_done_once(monkeypatch):
    """Ten and a thousand cells read as many expressions."""
    from jaxonomy_dae.compiler import read_equations

    counts = []
    read = read_equations.read
    for n in (10, 1000):
        seen = []
        monkeypatch.setattr(read_equations, "read", lambda *a, seen=seen: (seen.append(a), read(*a))[1])
        ladder(n, True)
        counts.append(len(seen))
    assert counts[0] == counts[1]


@pytest.mark.slow
def test_a_hundred_thousand_cells():
    """1.2 million equations: the first cells' voltages are those of a short ladder until the far end is felt."""
    system = ladder(100_000, True)
    solution = simulate(system, t1=1.0, ts=jnp.array([1.0]), rtol=1e-6)
    found = solution["cell.c.v"][0]
    assert found.shape == (100_000,)
    np.testing.assert_allclose(found[:30], exact(np.ones(60), np.ones(60), 1.0)[:30], atol=1e-5)
