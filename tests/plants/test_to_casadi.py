"""Functions of CasADi beside those of JAX, and an optimal control by IPOPT beside its closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from fmu_models import buck
from hybrid_models import compiled
from problems import drag_on, mlp, pendulum

from jaxonomy_dae import Component, der
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi.content import Content
from jaxonomy_dae.write import Eq

casadi = pytest.importorskip("casadi", reason="CasADi is not installed (extra casadi)")


class Cart(Component):
    """A mass that a force pushes, braked by a function."""

    def __init__(self, ev, name, brake=lambda v: 0.7 * v):
        super().__init__(ev, name)
        force, m = self.input("force", default=0.0), self.parameter("m", 2.0)
        s, v = self.variable("s", start=0.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        (drag,) = self.function("brake", brake, inputs=[v])
        self.add_equations(Eq(der(s), v), Eq(m * der(v), force - drag))


def both(system, seed=0):
    """The function, that of JAX of the same arguments without time, and a point near the start."""
    merged = system.merged().without_stiffness
    programs, rng = Content(merged, None, ("unsolved",)).programs, np.random.default_rng(seed)
    weights = [jnp.asarray(w.value) for w in programs.weights]
    found = system.initialize()
    x = found + 0.01 * rng.normal(size=len(found))
    q = np.nan_to_num(np.asarray(merged.discrete_values)[: programs.nq], nan=0.3)
    point = x[: programs.nx], x[programs.nx :], q, programs.p, rng.normal(size=len(system.inputs))
    return (
        system.to_casadi(),
        lambda *given: programs.unsolved(jnp.asarray(0.3), *given, *weights),
        [*map(jnp.asarray, point)],
    )


def test_values_and_derivatives_of_a_cart():
    function, ours, point = both(compiled(Cart, "cart"))
    assert function.name_in() == ["t", "x", "z", "q", "p", "u"]
    for name, a, b in zip(function.name_out(), ours(*point), function(0.3, *point), strict=True):
        np.testing.assert_allclose(np.ravel(b.full()), a, rtol=1e-14, err_msg=name)
    jacobian = function.factory("j", function.name_in(), ["jac:slopes:x", "jac:slopes:u"])(0.3, *point)
    np.testing.assert_allclose(jacobian[0].full(), [[0, 1], [0, -0.35]], rtol=1e-14)
    np.testing.assert_allclose(jacobian[1].full(), [[0], [0.5]], rtol=1e-14)


def test_functions_without_an_expression_are_refused_by_name():
    def settled(v):
        return jax.lax.while_loop(lambda a: a > 1.0, lambda a: a / 2, v)

    class Settled(Cart):
        def __init__(self, ev, name):
            super().__init__(ev, name, settled)

    with pytest.raises(ModelError, match=r"the JAX primitive 'while' .*test_to_casadi.py:\d+, in .*settled"):
        compiled(Settled, "cart").to_casadi()


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        lambda: pendulum(drag_on("vx", "vy", network=mlp(2, 2))),
        lambda: pendulum(drag_on("vx", "vy", network=mlp(2, 2)), compiler={"state_selection": "dummy_derivatives"}),
        buck,
    ],
    ids=["projection", "dummy derivatives", "switches"],
)
def test_functions_are_those_of_jax(make):
    """Values, and products of Jacobians with vectors; a nonlinear block's residuals where its equations do not hold."""
    function, ours, point = both(make())
    for name, a, b in zip(function.name_out(), jax.jit(ours)(*point), function(0.3, *point), strict=True):
        np.testing.assert_allclose(np.ravel(b.full()), a, rtol=1e-12, atol=1e-12, err_msg=name)
    rng = np.random.default_rng(1)
    along = [jnp.asarray(rng.normal(size=v.shape)) for v in point]
    expected = jax.jit(lambda v, a: jax.jvp(ours, tuple(v), tuple(a))[1])(point, along)
    forward = function.forward(1)(0.3, *point, *function(0.3, *point), 0.0, *along)
    for name, a, b in zip(function.name_out(), expected, forward, strict=True):
        size = max(1.0, float(jnp.max(jnp.abs(a), initial=0.0)))
        np.testing.assert_allclose(np.ravel(b.full()) / size, a / size, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_the_least_effort_from_rest_to_rest():
    """min ∫F² dt from 0 m to 1 m in 2 s, at rest at both ends: with A and B of the cart, the effort is dᵀW⁻¹d, where W
    is the Gramian of controllability and d the way (Kalman, Ho and Narendra 1963)."""
    duration, n = 2.0, 40
    function = compiled(Cart, "cart").to_casadi()
    x, force = casadi.MX.sym("x", 2), casadi.MX.sym("force")
    slopes = function(t=0, x=x, p=[2.0], u=force)["slopes"]
    whole = {"x": x, "p": force, "ode": slopes, "quad": force**2}
    step = casadi.integrator("step", "rk", whole, 0, duration / n, {"number_of_finite_elements": 4})

    problem = casadi.Opti()
    states, forces = problem.variable(2, n + 1), problem.variable(1, n)
    effort = 0
    for k in range(n):
        over = step(x0=states[:, k], p=forces[k])
        problem.subject_to(states[:, k + 1] == over["xf"])
        effort += over["qf"]
    problem.subject_to(states[:, 0] == [0, 0])
    problem.subject_to(states[:, n] == [1, 0])
    problem.minimize(effort)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    found = problem.solve()

    # Forces that are constant in steps: the same formula with the matrices of a step.
    a, b, h = np.array([[0, 1], [0, -0.35]]), np.array([[0], [0.5]]), duration / n
    block = scipy.linalg.expm(h * np.block([[a, b], [np.zeros((1, 3))]]))
    phi, gamma = block[:2, :2], block[:2, 2:]
    columns = np.hstack([np.linalg.matrix_power(phi, n - 1 - k) @ gamma for k in range(n)])
    way = np.array([1.0, 0.0])
    multiplier = np.linalg.solve(columns @ columns.T, way)
    np.testing.assert_allclose(found.value(forces), columns.T @ multiplier, rtol=1e-6)
    assert found.value(effort) == pytest.approx(h * way @ multiplier, rel=1e-6)
