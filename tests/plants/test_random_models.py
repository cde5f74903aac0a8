"""Random circuits and chains of masses, against nodal analysis and matrix exponentials in NumPy and SciPy."""

import functools

import diffrax
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


def parts_of(ev, circuit, place):
    """The circuit as components r0, c1, …, named by their place among the edges behind that of the circuit; and what is
    connected."""
    n, voltage, edges = circuit
    source, ground = VoltageSource(ev, f"{place}_source", voltage), Ground(ev, f"{place}_ground")
    pins = [[source.n, ground.p], [source.p], *([] for _ in range(n - 2))]
    parts = [source, ground]
    for k, (kind, a, b, value) in enumerate(edges):
        part = Resistor(ev, f"{place}_r{k}", value) if kind == "r" else Capacitor(ev, f"{place}_c{k}", value)
        parts.append(part)
        pins[a].append(part.p)
        pins[b].append(part.n)
    return parts, [p for p in pins if len(p) > 1]  # a loose pin carries no current


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


def check_circuits(circuits, seed):
    """Several circuits in one model, which costs one compilation."""
    ev, rng = EqnEnv(), np.random.default_rng(seed)
    built = [parts_of(ev, circuit, f"k{j}") for j, circuit in enumerate(circuits)]
    system = compiled(*(p for parts, _ in built for p in parts), connect=[ends for _, c in built for ends in c])
    given, names, expected, rates = {}, [], [], {}
    for j, circuit in enumerate(circuits):
        _, voltage, edges = circuit
        independent = independent_capacitors(circuit)
        charged = dict(zip(independent, rng.normal(size=len(independent)), strict=True))
        given |= {f"k{j}_c{k}.v": jnp.asarray(u) for k, u in charged.items()}
        v, rate, current = nodal_analysis(circuit, charged)
        names += [f"k{j}_source.i", f"k{j}_source.v"]
        expected += [current, voltage]
        for k, (kind, a, b, x) in enumerate(edges):
            names += [f"k{j}_{kind}{k}.{n}" for n in ("v", "i", "p.v")]
            expected += [v[a] - v[b], (v[a] - v[b]) / x if kind == "r" else x * (rate[a] - rate[b]), v[a]]
            rates[f"k{j}_{kind}{k}.v"] = rate[a] - rate[b]
            rates[f"k{j}_{kind}{k}.p.v"] = rate[a]  # beside a source of 1e-151 V, potentials are states
    assert len(system.states) == len(given)
    found, slope = _point(system, names, given)
    # Two different elimination orders of well-conditioned systems with values between 0.2 and 5.
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slope, [rates[name] for name in system.states], rtol=1e-9, atol=1e-9)


def several(strategy):
    return st.lists(strategy, min_size=6, max_size=6)


@pytest.mark.slow
@pytest.mark.long("three programs, of six circuits each")
@hypothesis.settings(max_examples=3, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(several(circuits()), st.integers(0, 100))
def test_resistors_and_capacitors(circuits, seed):
    check_circuits(circuits, seed)


@pytest.mark.slow
@hypothesis.settings(max_examples=5, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(several(circuits(kinds="r")))
def test_resistors(circuits):
    check_circuits(circuits, 0)


@pytest.mark.slow
@hypothesis.settings(max_examples=15, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(several(circuits()), st.integers(0, 100))
@hypothesis.example(
    [(3, 2.0, [("r", 1, 0, 1.0), ("r", 2, 1, 2.0), ("c", 1, 2, 1.5), ("c", 0, 2, 0.5), ("c", 2, 1, 3.0)])], 0
)
def test_many_circuits(circuits, seed):
    check_circuits(circuits, seed)


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


def chain_parts(ev, masses, links, left, right, at=""):
    """The chain with walls at −1 and at +1 as far as there are any, the masses anywhere between; and what is
    connected."""
    bodies = [Mass(ev, f"{at}m{k}", m, initial_position=0.1 * k, initial_velocity=0.0) for k, m in enumerate(masses)]
    ends = [body.flange for body in bodies]
    if left:
        ends.insert(0, FixedPosition(ev, f"{at}left", -1.0).flange)
    if right:
        ends.append(FixedPosition(ev, f"{at}right", 1.0).flange)
    used = links[0 if left else 1 :][: len(ends) - 1]
    connect = []
    for g, ((stiffness, damping, length), a, b) in enumerate(zip(used, ends[:-1], ends[1:], strict=True)):
        end = a
        for s, k in enumerate(stiffness):
            spring = Spring(ev, f"{at}s{g}_{s}", k, length=length)
            connect.append((end, spring.flange_a))
            end = spring.flange_b
        connect.append((end, b))
        if damping is not None:
            damper = Damper(ev, f"{at}d{g}", damping)
            connect += [(a, damper.flange_a), (b, damper.flange_b)]
    return bodies, connect


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


def check_chains(chains):
    """Several chains in one model, whose Jacobian is block diagonal."""
    ev = EqnEnv()
    built = [chain_parts(ev, *chain, at=f"k{j}_") for j, chain in enumerate(chains)]
    system = compiled(*(p for parts, _ in built for p in parts), connect=[ends for _, c in built for ends in c])
    place = {name: k for k, name in enumerate(system.states)}
    order = [
        place[f"k{j}_m{k}.{v}"] for j, (masses, *_) in enumerate(chains) for v in ("s", "v") for k in range(len(masses))
    ]
    assert len(place) == len(order)
    jacobian, slope = _affine(system, jnp.zeros(len(order)))
    a, b = zip(*(chain_equations(*chain) for chain in chains), strict=True)
    expected = scipy.linalg.block_diag(*a)
    np.testing.assert_allclose(np.asarray(jacobian)[np.ix_(order, order)], expected, rtol=1e-9, atol=1e-9)  # rounding
    np.testing.assert_allclose(np.asarray(slope)[order], np.concatenate(b), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@hypothesis.settings(max_examples=2, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(several(chains()))
def test_equations_of_chains(chains):
    check_chains(chains)


@pytest.mark.slow
@hypothesis.settings(max_examples=12, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(several(chains()))
def test_equations_of_many_chains(chains):
    check_chains(chains)


@functools.cache
def three_masses():
    """The motion from masses, stiffnesses and initial values."""
    links = [([1.0, 1.0], 0.5, 0.2), ([1.0], None, 0.1), ([1.0], 0.3, 0.0), ([1.0], None, 0.0)]
    parts, connect = chain_parts(EqnEnv(), [1.0] * 3, links, True, False)
    system = compiled(*parts, connect=connect)
    states = [f"m{i}.{v}" for v in ("s", "v") for i in range(3)]

    @jax.jit
    def moved(values, start):
        changed = system.with_parameters(dict(zip(VARIED, values, strict=True)))
        initial = dict(zip(states, start, strict=True))
        options = {"rtol": 1e-9, "atol": 1e-11, "adjoint": diffrax.ForwardMode()}
        return simulate(changed, 1.5, ts=TS, initial=initial, **options)[states]

    return moved


TS = np.array([0.7, 1.5])
VARIED = ["m0.m", "m1.m", "m2.m", "s0_0.c", "s0_1.c", "s1_0.c", "s2_0.c"]


@pytest.mark.slow
@hypothesis.settings(max_examples=15)
@hypothesis.given(
    st.lists(values, min_size=3, max_size=3),
    st.lists(values, min_size=4, max_size=4),
    st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
)
def test_motions_are_matrix_exponentials(masses, k, start):
    """One structure, compiled once; its parameters and initial values vary."""
    found = three_masses()(np.array([*masses, *k]), np.array(start))
    links = [([k[0], k[1]], 0.5, 0.2), ([k[2]], None, 0.1), ([k[3]], 0.3, 0.0), ([1.0], None, 0.0)]
    a, b = chain_equations(masses, links, True, False)
    augmented = np.block([[a, b[:, None]], [np.zeros((1, 7))]])
    expected = [(scipy.linalg.expm(augmented * t) @ [*start, 1.0])[:6] for t in TS]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)  # a hundred times the tolerance
