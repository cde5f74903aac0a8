"""How fast a compiled system decays at its declared start: eigenvalues of its equations, whatever the index."""

import numpy as np
import pytest
import scipy.sparse.linalg
from problems import compiled, oscillator, pendulum, rc_circuit

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Eq, EqnEnv, der
from jaxonomy_dae.compile.model.consistent_point import initial_point
from jaxonomy_dae.compile.model.jacobian import residual_and_jacobian
from jaxonomy_dae.compile.model.tables import Declared
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.run.system.solver_choice import fastest_decay as fastest_decay_of
from jaxonomy_dae.solve.linear.sparse_least_squares import SparseLeastSquares, regular_factors


class Follower(Component):
    """x' = −k·x."""

    def __init__(self, ev, k):
        super().__init__(ev, "f")
        k, x = self.parameter("k", k), self.variable("x", start=1.0, fixed=True)
        self.add_equations(der(x) + k * x)


def fastest_decay(system):
    return fastest_decay_of(system.plan.model, system.plan.flat.parameters.everything(system.parameters.known))


def test_eigenvalues_at_the_start():
    """Against closed forms: 1/(R·C), the larger root of an overdamped oscillator, none where all oscillates."""
    assert fastest_decay(rc_circuit(R=2e-3, C=0.5)) == pytest.approx(1e3, rel=1e-9)
    assert fastest_decay(compiled(Follower(EqnEnv(), 1e6))) == pytest.approx(1e6, rel=1e-9)
    overdamped = oscillator(M=2.0, D=600.0, K=5.0)
    assert fastest_decay(overdamped) == pytest.approx((600 + np.sqrt(600**2 - 4 * 2 * 5)) / 4, rel=1e-9)
    for system in (oscillator(), pendulum()):
        assert fastest_decay(system) == 0.0


def test_eigenvalues_are_those_of_the_values_not_the_structure():
    assert [fastest_decay(rc_circuit(R=r, C=1.0)) for r in (1.0, 1e-3)] == pytest.approx([1.0, 1e3], rel=1e-9)


class Rod(Component):
    """n cells that exchange heat with their neighbours, the first and the last with what is at 0."""

    def __init__(self, ev, n, k):
        super().__init__(ev, "rod")
        k, T = self.parameter("k", k), self.vector("T", n, start=1.0, fixed=True)
        q = self.vector("q", n + 1)
        for i in range(n + 1):
            self.add_equations(Eq(q[i], (T[i - 1] if i else 0) - (T[i] if i < n else 0)))
        self.add_equations(*(Eq(der(T[i]), k * (q[i] - q[i + 1])) for i in range(n)))


@pytest.mark.parametrize("n", [20, 300])
def test_eigenvalues_of_large_models(n):
    """Kind: a verdict that hangs on the size of the model. Above 300 quantities nothing decayed: a stiff model took
    explicit steps inside jit. −4k·sin²(j·π/(2(n + 1))) are the eigenvalues; of large models the fastest is found to
    some per cent."""
    system = compiled(Rod(EqnEnv(), n, 1e4))
    assert fastest_decay(system) == pytest.approx(4e4 * np.sin(n * np.pi / (2 * (n + 1))) ** 2, rel=1e-2)


def by_singular_values(system):
    """The fastest decay among all eigenvalues of c' = N_v⁺ N_v' c, N a basis of the null space of ∂F/∂q."""
    model, quantities = system.plan.model, system.plan.extended.quantities
    parameters = system.plan.flat.parameters.everything(system.parameters.known)
    at = initial_point(model, Declared(parameters, {}))
    matrix = residual_and_jacobian(model.extended, at)[1].toarray()[:, : quantities.n_unknown]
    below = np.flatnonzero(quantities.order < quantities.highest[quantities.owner])
    free = scipy.linalg.null_space(matrix / np.abs(matrix).max(axis=1, keepdims=True), rcond=1e-12)
    found = np.linalg.eigvals(np.linalg.lstsq(free[below], free[below + 1], rcond=1e-12)[0])
    return (-found.real[-found.real > np.abs(found.imag)]).max(initial=0.0)


def test_the_fastest_of_all_eigenvalues():
    """Whatever the index, and in an oscillator and a pendulum that do not decay."""
    systems = [
        rc_circuit(R=2e-3, C=0.5),
        oscillator(M=2.0, D=600.0, K=5.0),
        pendulum(),
        oscillator(),
        compiled(Rod(EqnEnv(), 40, 1.0)),
    ]
    for system in systems:
        assert fastest_decay(system) == pytest.approx(by_singular_values(system), rel=1e-6, abs=1e-6)


class Coil(Component):
    """A coil between two open switches: i/(2·g·L) is how fast its current stops."""

    def __init__(self, ev):
        super().__init__(ev, "coil")
        g, L = self.parameter("g", 1e-9), self.parameter("L", 1e-3)
        i, v = self.variable("i", start=0.0, fixed=True), self.variable("v")
        above, below = self.variable("above"), self.variable("below")
        self.add_equations(
            Eq(above, g * (24 - v)), Eq(below, g * v), Eq(above, below + i), Eq(L * der(i), v)
        )  # fmt: skip


@pytest.mark.parametrize("beside", ["nothing", "constraints", "many cells"])
def test_open_switches(beside):
    """Kind: a verdict that hangs on what stands beside. Equations that an open switch makes nearly singular were left
    out above 300 quantities, and where constraints hold the states; a gradient of a buck converter took explicit steps
    until `max_steps`."""
    ev = EqnEnv()
    others = {"nothing": [], "constraints": [PlanarPendulum(ev, "pend")], "many cells": [Rod(ev, 300, 1.0)]}
    assert fastest_decay(compiled(Coil(ev), *others[beside])) == pytest.approx(1 / (2 * 1e-9 * 1e-3), rel=1e-6)


@pytest.mark.parametrize("least", [1.0, 1e-3, 1e-7, 0.0])
def test_square_matrices_near_singular_are_left_to_least_squares(least):
    """The factors of a square matrix serve where its singular values are those that least squares solve, too."""
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(60, 60)))[0]
    matrix, x = basis * np.append(np.ones(59), least) @ basis.T, rng.normal(size=60)
    solve = regular_factors(scipy.sparse.csr_array(matrix))
    assert (solve is None) == (least < 1e-5)
    if least != 1e-7:  # of which a regularized solution has a part
        expected = x if least else x - basis[:, 59] @ x * basis[:, 59]
        np.testing.assert_allclose(SparseLeastSquares(matrix).solve(matrix @ x), expected, rtol=1e-6, atol=1e-6)


def test_factors_of_a_node_where_all_meets_stay_sparse(monkeypatch):
    """Kind: fill-in by one full row. The ground of a ladder of 20,000 cells made choosing a solver inside jit take 33 s
    and 6.5 GB."""
    ev, diagram, n = EqnEnv(), AcausalDiagram(), 400
    source, ground = VoltageSource(ev, "source"), Ground(ev, "ground")
    r = diagram.add_array(ev, "r", Resistor, n)
    c = diagram.add_array(ev, "c", Capacitor, n, initial_voltage=0.0)
    diagram.connect(source.p, r[0].p)
    diagram.connect(r[:-1].n, r[1:].p)
    diagram.connect(r.n, c.p)
    diagram.connect(c.n, source.n, ground.p)
    factors, factorize = [], scipy.sparse.linalg.splu

    def noted(matrix, *args, **options):
        factors.append((factorize(matrix, *args, **options), matrix.nnz))
        return factors[-1][0]

    monkeypatch.setattr(scipy.sparse.linalg, "splu", noted)
    system = AcausalCompiler(ev, diagram)()
    factors.clear()
    assert fastest_decay(system) == pytest.approx(4 * np.sin(n * np.pi / (2 * n + 1)) ** 2, rel=1e-2)
    assert factors and all(found.L.nnz + found.U.nnz < 4 * nnz for found, nnz in factors)
