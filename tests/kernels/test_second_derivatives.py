"""Forward mode over `StoredAdjoint`: second derivatives against closed forms and against forward mode alone."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der, simulate
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, StoredAdjoint, Tsit5, consistent_start, solve_dae

TS = jnp.array([0.5, 1.0])
PID = diffrax.PIDController(rtol=1e-9, atol=1e-9)


def logistic(p, solver, adjoint):
    """y' = a·y·(1 − y), y(t0) = b at two times: a vector of a, b and t0."""
    a, b, t0 = p
    term = diffrax.ODETerm(lambda t, y, a: a * y * (1 - y))
    saveat = diffrax.SaveAt(ts=TS)
    solution = diffrax.diffeqsolve(
        term, solver, t0, 1.0, 0.01, b, a, saveat=saveat, stepsize_controller=PID, adjoint=adjoint, throw=False
    )
    return jnp.sum(solution.ys * jnp.array([1.0, 2.0]))


def logistic_exact(p):
    a, b, t0 = p
    return jnp.sum(jnp.array([1.0, 2.0]) / (1 + (1 / b - 1) * jnp.exp(-a * (TS - t0))))


P = jnp.array([1.5, 0.2, 0.1])


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(Tsit5(), id="own"),
        pytest.param(diffrax.Dopri5(scan_kind="bounded"), id="diffrax", marks=pytest.mark.slow),
    ],
)
def test_hessian_of_the_logistic_equation(solver):
    hessian = jax.jit(jax.hessian(lambda p: logistic(p, solver, StoredAdjoint())))(P)
    np.testing.assert_allclose(hessian, jax.hessian(logistic_exact)(P), rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_the_same_as_forward_mode_twice():
    """Both differentiate the same formulas, so they agree to rounding (t0 shifts the steps: left out)."""

    def f(adjoint):
        return lambda ab: logistic(jnp.append(ab, 0.1), Tsit5(), adjoint)

    twice = jax.jit(jax.jacfwd(jax.jacfwd(f(diffrax.ForwardMode()))))(P[:2])
    np.testing.assert_allclose(jax.jit(jax.hessian(f(StoredAdjoint())))(P[:2]), twice, rtol=1e-10)


@pytest.mark.slow
def test_batches_of_second_derivatives():
    """Members of a batch wait for the slowest one: their second derivatives are those they have alone."""

    def second(p, v):
        return jax.jvp(jax.grad(lambda p: logistic(p, Tsit5(), StoredAdjoint())), (p,), (v,))[1]

    many = jnp.stack([P, jnp.array([15.0, 0.01, 0.3]), jnp.array([0.1, 0.9, 0.0])])
    v = jnp.array([1.0, -0.5, 0.25])
    found = jax.jit(jax.vmap(second, (0, None)))(many, v)
    alone = jax.jit(second)
    for row, p in zip(found, many, strict=True):
        np.testing.assert_allclose(row, alone(p, v), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [Rodas5P(), BDF()], ids=["rodas5p", "bdf"])
def test_differential_algebraic(solver):
    """x' = −a·x·z, z² = x: x(1) = (1 + a/2)⁻²."""
    term = DAETerm(lambda t, x, z, a: -a * x * z, lambda t, x, z, a: z**2 - x)
    start = jnp.ones(1), jnp.ones(1)

    def final(a):
        return solve_dae(term, 1.0, start, solver=solver, args=a, rtol=1e-9, atol=1e-11, throw=False).ys[0][0, 0]

    found = eqx.filter_jit(jax.jacfwd(jax.grad(final)))(0.7)
    assert found == pytest.approx(1.5 * (1 + 0.35) ** -4, rel=1e-6)


@pytest.mark.slow
def test_of_a_model():
    """A pendulum in Cartesian coordinates, by its rod's length: against second differences of the values."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(PlanarPendulum(ev, name="pend", m=1.0, L=1.0, initial_theta=-1.2, initial_omega=0.0))
    system = AcausalCompiler(ev, diagram)()

    def x(length):
        changed = system.with_parameters({"pend.L": length})
        return simulate(changed, 1.0, ts=TS, rtol=1e-11, atol=1e-12)["pend.x"].sum()

    found = jax.jit(jax.hessian(x))(1.0)
    h = 1e-3
    value = jax.jit(x)
    weights = {-2: -1, -1: 16, 0: -30, 1: 16, 2: -1}
    second = sum(w * value(1.0 + k * h) for k, w in weights.items()) / (12 * h**2)
    np.testing.assert_allclose(found, second, rtol=1e-4)


class Cubic(Component):
    """y = x³ + x with y fixed at the start."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p = self.parameter("p", 10.0)
        x, y = self.variable("x"), self.variable("y", start=p, fixed=True)
        self.add_equations(Eq(der(x), -x), Eq(y, x**3 + x))


def test_of_a_start():
    """x³ + x = p has x' = 1/(3x² + 1), x'' = −6x x'²/(3x² + 1)."""
    system = compiled(Cubic(EqnEnv(), "c"))

    def x(p):
        return system.with_parameters({"c.p": p}).initialize()[0]

    for second in (jax.hessian(x), jax.jacfwd(jax.jacfwd(x))):
        np.testing.assert_allclose(jax.jit(second)(10.0), -6 * 2 / 13**3, rtol=1e-12)  # at x = 2


def test_of_a_nearest_point():
    """Guesses a and b for a point of the unit circle: the nearest one has the angle atan2(b, a)."""

    class Circle(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            a, b = self.parameter("a", 2.0), self.parameter("b", 1.0)
            x, y = self.variable("x", start=a), self.variable("y", start=b)
            k = self.variable("k")
            self.add_equations(Eq(x**2 + y**2, 1), Eq(der(der(x)), k * x), Eq(der(der(y)), k * y))

    system = compiled(Circle(EqnEnv(), "c"))

    def angle(p):
        at = system.with_parameters({"c.a": p[0], "c.b": p[1]})
        x, y = at.observe(["c.x", "c.y"], 0.0, at.initialize())
        return jnp.arctan2(y, x)

    p = jnp.array([2.0, 1.0])
    found, exact = jax.jit(jax.hessian(angle))(p), jax.hessian(lambda p: jnp.arctan2(p[1], p[0]))(p)
    np.testing.assert_allclose(found, exact, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("solver", [Rodas5P(), pytest.param(BDF(), marks=pytest.mark.slow)], ids=["rodas5p", "bdf"])
def test_of_algebraic_unknowns(solver):
    """z³ + z = a·x, x' = 0 from a start that solves for z: z'' as above."""
    term = DAETerm(lambda t, x, z, a: 0 * x, lambda t, x, z, a: z**3 + z - a * x)

    def end(a):
        y0 = consistent_start(term, (jnp.ones(1), jnp.ones(1)), args=a)
        return solve_dae(term, 1.0, y0, args=a, ts=jnp.array([0.5]), solver=solver, rtol=1e-8, atol=1e-8).ys[1][0, 0]

    np.testing.assert_allclose(jax.jit(jax.hessian(end))(10.0), -6 * 2 / 13**3, rtol=1e-9)
