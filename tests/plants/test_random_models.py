"""Random circuits and chains of masses, against nodal analysis and matrix exponentials in NumPy and SciPy."""

import functools

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from problems import compiled

from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Spring
from jaxonomy_dae.linear.written_out import solve

values = st.floats(0.2, 5.0)


# --- circuits ----------------------------------------------------------------------------------------------------


@st.composite
def circuits(draw, kinds="rc"):
    """(number of nodes, source voltage, edges (kind, from, to, value)); node 0 is ground, node 1 the source's.

    A tree of resistors joins all nodes, so that every voltage is determined; further resistors and capacitors lie
    anywhere, in any direction, in loops and in parallel.
    """
    n = draw(st.integers(2, 6))
    edges = [("r", *draw(st.permutations([k, draw(st.integers(0, k - 1))])), draw(values)) for k in range(1, n)]
    node = st.integers(0, n - 1)
    for _ in range(draw(st.integers(1, 5))):
        a, b = draw(st.tuples(node, node).filter(lambda p: p[0] != p[1]))
        edges.append((draw(st.sampled_from(kinds)), a, b, draw(values)))
    return n, draw(st.floats(-3.0, 3.0)), edges


def build(circuit):
    """The circuit as components r0, c1, …, named by their place among the edges."""
    n, voltage, edges = circuit
    ev = EqnEnv()
    source, ground = VoltageSource(ev, "source", voltage), Ground(ev, "ground")
    pins = [[source.n, ground.p], [source.p], *([] for _ in range(n - 2))]
    parts = [source, ground]
    for k, (kind, a, b, value) in enumerate(edges):
        part = Resistor(ev, f"r{k}", value) if kind == "r" else Capacitor(ev, f"c{k}", value)
        parts.append(part)
        pins[a].append(part.p)
        pins[b].append(part.n)
    return compiled(*parts, connect=[p for p in pins if len(p) > 1])  # a loose pin carries no current


def independent_capacitors(circuit):
    """Edges of capacitors that close no loop with the source and those before."""
    n, _, edges = circuit
    island = list(range(n))
    island[1] = 0
    chosen = []
    for k, (kind, a, b, _) in enumerate(edges):
        if kind == "c" and island[a] != island[b]:
            chosen.append(k)
            island = [island[a] if i == island[b] else i for i in island]
    return chosen


def nodal_analysis(circuit, charged):
    """Voltages and their rates at all nodes, and the source's current, from Kirchhoff's laws.

    Unknown are v, dv/dt and i; known the voltages of independent capacitors. The rates of nodes without capacitors do
    not matter and are not determined: the least-squares solution leaves them 0.
    """
    n, voltage, edges = circuit
    rows, right = [], []

    def row(terms, value):
        rows.append(np.zeros(2 * n + 1))
        for place, factor in terms:
            rows[-1][place] += factor
        right.append(value)

    for node in range(1, n):
        terms = [(2 * n, 1.0)] if node == 1 else []
        for kind, a, b, x in edges:
            for here, there in ((a, b), (b, a)):
                if here == node:
                    first, factor = (0, 1 / x) if kind == "r" else (n, x)
                    terms += [(first + here, factor), (first + there, -factor)]
        row(terms, 0.0)
    row([(0, 1.0)], 0.0)
    row([(n, 1.0)], 0.0)
    row([(1, 1.0)], voltage)
    row([(n + 1, 1.0)], 0.0)
    for k, v in charged.items():
        _, a, b, _ = edges[k]
        row([(a, 1.0), (b, -1.0)], v)
    found = np.linalg.lstsq(np.array(rows), np.array(right), rcond=1e-12)[0]
    np.testing.assert_allclose(np.array(rows) @ found, right, atol=1e-9)  # the reference is a solution
    return found[:n], found[n : 2 * n], found[2 * n]


@eqx.filter_jit
def _point(system, names, initial):
    x = system.initialize(initial=initial)
    return system.observe(names, 0.0, x), system.vector_field(0.0, x)


def check_circuit(circuit, seed):
    n, voltage, edges = circuit
    system = build(circuit)
    independent = independent_capacitors(circuit)
    assert len(system.states) == len(independent)
    charged = dict(zip(independent, np.random.default_rng(seed).normal(size=len(independent)), strict=True))
    v, rate, current = nodal_analysis(circuit, charged)
    names, expected = ["source.i", "source.v"], [current, voltage]
    for k, (kind, a, b, x) in enumerate(edges):
        names += [f"{kind}{k}.v", f"{kind}{k}.i", f"{kind}{k}.p.v"]
        expected += [v[a] - v[b], (v[a] - v[b]) / x if kind == "r" else x * (rate[a] - rate[b]), v[a]]
    found, slope = _point(system, names, {f"c{k}.v": jnp.asarray(u) for k, u in charged.items()})
    # Two different elimination orders of well-conditioned systems with values between 0.2 and 5.
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    for name, d in zip(system.states, slope, strict=True):
        part, variable = name.split(".")
        _, a, b, _ = edges[int(part[1:])]
        assert variable == "v"
        assert float(d) == pytest.approx(rate[a] - rate[b], rel=1e-9, abs=1e-9)


@hypothesis.settings(max_examples=12)
@hypothesis.given(circuits(), st.integers(0, 100))
@hypothesis.example(
    (3, 2.0, [("r", 1, 0, 1.0), ("r", 2, 1, 2.0), ("c", 1, 2, 1.5), ("c", 0, 2, 0.5), ("c", 2, 1, 3.0)]), 0
)
def test_resistors_and_capacitors(circuit, seed):
    check_circuit(circuit, seed)


@pytest.mark.slow
@hypothesis.settings(max_examples=40)
@hypothesis.given(circuits(kinds="r"))
def test_resistors(circuit):
    check_circuit(circuit, 0)


@pytest.mark.slow
@hypothesis.settings(max_examples=150)
@hypothesis.given(circuits(), st.integers(0, 100))
def test_many_circuits(circuit, seed):
    check_circuit(circuit, seed)


# --- chains of masses --------------------------------------------------------------------------------------------


@st.composite
def chains(draw):
    """Masses in a row; between neighbours one spring or two in series, maybe a damper; walls at the ends, or none."""
    masses = draw(st.lists(values, min_size=1, max_size=4))
    gaps = len(masses) + 1
    links = [
        (draw(st.lists(values, min_size=1, max_size=2)), draw(st.none() | values), draw(st.floats(0.0, 1.0)))
        for _ in range(gaps)
    ]
    return masses, links, draw(st.booleans()), draw(st.booleans())


def build_chain(masses, links, left, right):
    """The chain with walls at −1 and at +1 as far as there are any, the masses anywhere between."""
    ev = EqnEnv()
    bodies = [Mass(ev, f"m{k}", m, initial_position=0.1 * k, initial_velocity=0.0) for k, m in enumerate(masses)]
    ends = [body.flange for body in bodies]
    if left:
        ends.insert(0, FixedPosition(ev, "left", -1.0).flange)
    if right:
        ends.append(FixedPosition(ev, "right", 1.0).flange)
    used = links[0 if left else 1 :][: len(ends) - 1]
    connect = []
    for g, ((stiffness, damping, length), a, b) in enumerate(zip(used, ends[:-1], ends[1:], strict=True)):
        at = a
        for s, k in enumerate(stiffness):
            spring = Spring(ev, f"s{g}_{s}", k, length=length)
            connect.append((at, spring.flange_a))
            at = spring.flange_b
        connect.append((at, b))
        if damping is not None:
            damper = Damper(ev, f"d{g}", damping)
            connect += [(a, damper.flange_a), (b, damper.flange_b)]
    return compiled(*bodies, connect=connect)


def chain_equations(masses, links, left, right):
    """(A, b) of d(x, v)/dt = A·(x, v) + b, from the forces of each link."""
    n = len(masses)
    a, b = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    a[:n, n:] = np.eye(n)
    for g, (stiffness, damping, length) in enumerate(links):
        if (g == 0 and not left) or (g == n and not right):
            continue
        k, rest = 1 / sum(1 / s for s in stiffness), length * len(stiffness)
        pull = np.zeros(2 * n)  # of the link, as a function of (x, v), and a constant
        constant = -k * rest
        for body, sign in ((g, 1.0), (g - 1, -1.0)):
            if 0 <= body < n:
                pull[body] += sign * k
                pull[n + body] += sign * (damping or 0.0)
            else:
                constant += sign * k * (1.0 if body == n else -1.0)
        for body, sign in ((g, -1.0), (g - 1, 1.0)):
            if 0 <= body < n:
                a[n + body] += sign * pull / masses[body]
                b[n + body] += sign * constant / masses[body]
    return a, b


@eqx.filter_jit
def _affine(system, x):
    return jax.jacfwd(lambda x: system.vector_field(0.0, x))(x), system.vector_field(0.0, x)


def check_chain(chain):
    masses = chain[0]
    n = len(masses)
    system = build_chain(*chain)
    place = {name: k for k, name in enumerate(system.states)}
    order = [place[f"m{k}.{v}"] for v in ("s", "v") for k in range(n)]
    assert len(place) == 2 * n
    jacobian, slope = _affine(system, jnp.zeros(2 * n))
    a, b = chain_equations(*chain)
    np.testing.assert_allclose(np.asarray(jacobian)[np.ix_(order, order)], a, rtol=1e-9, atol=1e-9)  # rounding
    np.testing.assert_allclose(np.asarray(slope)[order], b, rtol=1e-9, atol=1e-9)


@hypothesis.settings(max_examples=12)
@hypothesis.given(chains())
def test_equations_of_chains(chain):
    check_chain(chain)


@pytest.mark.slow
@hypothesis.settings(max_examples=100)
@hypothesis.given(chains())
def test_equations_of_many_chains(chain):
    check_chain(chain)


@functools.cache
def three_masses():
    return build_chain([1.0] * 3, [([1.0, 1.0], 0.5, 0.2), ([1.0], None, 0.1), ([1.0], 0.3, 0.0), ([1.0], None, 0.0)],
                       True, False)  # fmt: skip


@hypothesis.settings(max_examples=15)
@hypothesis.given(
    st.lists(values, min_size=3, max_size=3),
    st.lists(values, min_size=4, max_size=4),
    st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
)
def test_motions_are_matrix_exponentials(masses, k, start):
    """One structure, compiled once; its parameters and initial values vary."""
    names = ["m0.M", "m1.M", "m2.M", "s0_0.K", "s0_1.K", "s1_0.K", "s2_0.K"]
    system = three_masses().with_parameters(dict(zip(names, [*masses, *k], strict=True)))
    states = [f"m{i}.{v}" for v in ("s", "v") for i in range(3)]
    ts = np.array([0.7, 1.5])
    initial = dict(zip(states, start, strict=True))
    solution = simulate(system, 1.5, ts=ts, initial=initial, rtol=1e-9, atol=1e-11)
    links = [([k[0], k[1]], 0.5, 0.2), ([k[2]], None, 0.1), ([k[3]], 0.3, 0.0), ([1.0], None, 0.0)]
    a, b = chain_equations(masses, links, True, False)
    augmented = np.block([[a, b[:, None]], [np.zeros((1, 7))]])
    expected = [(scipy.linalg.expm(augmented * t) @ [*start, 1.0])[:6] for t in ts]
    found = np.stack([solution[n] for n in states], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)  # a hundred times the tolerance


# --- small linear systems ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 4, 6])
@pytest.mark.parametrize("positive", [False, True])
def test_unrolled_elimination(n, positive):
    rng = np.random.default_rng(n)
    a = rng.normal(size=(n, n, 5))  # a batch of five
    if positive:
        a = np.einsum("ikb,jkb->ijb", a, a) + np.eye(n)[:, :, None]
    elif n > 1:
        a[0, 0] = 0.0  # a pivot that must be avoided
    b = rng.normal(size=(n, 5))
    found = solve([[jnp.asarray(x) for x in row] for row in a], [jnp.asarray(x) for x in b], positive=positive)
    expected = np.linalg.solve(np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)[..., None])[..., 0].T
    # Rounding times the condition of random 6 by 6 matrices, some hundreds.
    np.testing.assert_allclose(np.stack(found), expected, rtol=1e-9)
