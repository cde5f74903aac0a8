"""Nonlinear blocks give a root of their equations or not-a-number; a run that ends there names the block.

References: closed forms, and the equations themselves evaluated in NumPy.
"""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled
from sympy import Abs, atan, exp

from jaxonomy_dae import Component, EqnEnv, SimulationError, der, simulate
from jaxonomy_dae.lowering import schedule
from jaxonomy_dae.lowering.schedule import SparseStep
from jaxonomy_dae.solvers import Rodas5P


class Implicit(Component):
    """x' = −1 from x0, and 0 = g(x, z, u) for z, which is read from the state."""

    def __init__(self, ev, name, law, x0, *starts):
        super().__init__(ev, name)
        x, u = self.variable("x", start=x0, fixed=True), self.input("u", default=0.0)
        z = [self.variable(f"z{k}", start=s) for k, s in enumerate(starts)]
        self.add_equations(der(x) + 1, *law(x, u, *z))


def implicit(law, x0, *starts):
    system = compiled(Implicit(EqnEnv(), "m", law, x0, *starts))
    assert len(system.carried) == len(starts)
    return system


def at(x, *z):
    return jnp.array([x, *z], float)


@pytest.fixture(scope="module")
def cubic():
    """z³ − 2z + 2 = x: Newton's method goes from 0 to 1 and back where x = 0."""
    return implicit(lambda x, u, z: [z**3 - 2 * z + 2 - x], -2.0, -2.0)


@pytest.mark.parametrize(
    "law, state",
    [
        (lambda x, u, z: [z**3 - 2 * z + 2 - x], at(0.0, 0.0)),  # a cycle
        (lambda x, u, z: [z**2 + 1 - x], at(0.5, 1.0)),  # no root: a minimum of |r|
        (lambda x, u, z: [z**2 + 1 - x], at(0.5, 1e-9)),
        (lambda x, u, z: [atan(z) - x], at(0.0, 3.0)),  # divergence
    ],
)
def test_what_does_not_converge_is_not_a_number(law, state):
    """These came out as numbers: the fourth iterate, whatever it was."""
    system = implicit(law, 2.0, 1.0)
    for value in (system.observe("m.z0", 0.0, state), system.vector_field(0.0, state)[1]):
        assert np.isnan(value)
    assert np.isnan(system.project(0.0, state, iterations=3)[1])


def test_random_states_give_roots_or_nothing(cubic):
    """1,000 states far from the root and near it, over twelve decades."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=1000) * 10 ** rng.uniform(-6, 6, 1000)
    z = rng.normal(size=1000) * 10 ** rng.uniform(-6, 6, 1000)
    states = jnp.asarray(np.stack([x, z], axis=1))
    found = np.asarray(jax.jit(jax.vmap(lambda s: cubic.observe("m.z0", 0.0, s)))(states))
    good = np.isfinite(found)
    terms = np.abs(found) ** 3 + 2 * np.abs(found) + 2 + np.abs(x)
    assert (np.abs(found**3 - 2 * found + 2 - x) <= 1e-12 * terms)[good].all()
    assert 500 < good.sum() < 1000  # otherwise this shows nothing
    rough = np.asarray(jax.jit(jax.vmap(lambda s: cubic.project(0.0, s)))(states))[:, 1]
    assert np.isnan(rough).sum() > 100
    root = np.array([min(np.roots([1, 0, -2, 2 - a]), key=lambda r: (abs(r.imag) > 1e-9, r.real)).real for a in x])
    near = np.stack([x, root * (1 + 1e-5 * rng.normal(size=1000))], axis=1)
    again = np.asarray(jax.jit(jax.vmap(lambda s: cubic.observe("m.z0", 0.0, s)))(jnp.asarray(near)))
    np.testing.assert_allclose(again, root, rtol=1e-9)


def test_units_decide_nothing():
    """z² + 1 = x, the equation multiplied by 1e9 or 1e-9, z in units of 1e-6 to 1e6: a root where x > 1."""
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0, 2, 50), rng.uniform(0.5, 2, 50)
    expected = np.sqrt(np.where(x > 1, x - 1, np.nan))
    for k, u in ((1, 1), (10**9, 1), (10**-9, 1), (1, 10**6), (10**9, 10**-6)):
        system = implicit(lambda x, _, z, k=k, u=u: [k * ((z / u) ** 2 + 1 - x)], 2.0, u)
        states = jnp.asarray(np.stack([x, u * z], axis=1))
        found = np.asarray(jax.jit(jax.vmap(lambda s, system=system: system.observe("m.z0", 0.0, s)))(states)) / u
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_double_roots_are_reached():
    """z·|z| = x next to x = 0, where Newton's method halves its distance in a step."""
    system = implicit(lambda x, u, z: [z * Abs(z) - x], 1.0, 1.0)
    for x in (1e-8, -1e-8, 1e-12):
        found = system.observe("m.z0", 0.0, at(x, np.copysign(1e-1, x)))
        np.testing.assert_allclose(found, np.copysign(np.sqrt(abs(x)), x), rtol=1e-6)


def test_small_terms_beside_constants():
    """A diode without current: exp(z) − 1 leaves rounding errors that are large beside z."""
    system = implicit(lambda x, u, z: [exp(z) - 1 - x + u], 1.0, 0.5)
    for x in (0.0, 1e-18, 1e-12):
        np.testing.assert_allclose(system.observe("m.z0", 0.0, at(x, x)), np.log1p(x), atol=1e-15)


def pair(x, u, a, b):
    """a² + b² = 2x, a·b = u: no solution where u > x."""
    return [a**2 + b**2 - 2 * x, a * b - u]


def test_two_equations():
    system = implicit(pair, 1.0, 2.0, 0.1)
    found = system.observe(["m.z0", "m.z1"], 0.0, at(1.0, 1.3, 0.1), {"m.u": 0.5})
    # (a ± b)² = 2x ± 2u
    plus, minus = np.sqrt(3.0), np.sqrt(1.0)
    np.testing.assert_allclose(found, [(plus + minus) / 2, (plus - minus) / 2], rtol=1e-14)
    assert np.isnan(system.observe(["m.z0", "m.z1"], 0.0, at(1.0, 1.3, 0.1), {"m.u": 1.5})).all()
    assert np.isnan(system.vector_field(0.0, at(1.0, 1.3, 0.1), {"m.u": 30.0})[1:]).all()


def test_whole_blocks(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(schedule, "WRITTEN_OUT", {True: 1, False: 1})
        system = implicit(pair, 1.0, 2.0, 0.1)
    assert any(isinstance(step, SparseStep) for step in system.plan.steps)
    found = system.observe(["m.z0", "m.z1"], 0.0, at(1.0, 1.3, 0.1), {"m.u": 0.5})
    np.testing.assert_allclose(found, [(np.sqrt(3) + 1) / 2, (np.sqrt(3) - 1) / 2], rtol=1e-14)
    assert np.isnan(system.observe(["m.z0", "m.z1"], 0.0, at(1.0, 1.3, 0.1), {"m.u": 1.5})).all()


def test_first_and_second_derivatives_of_a_root():
    """z² = x read from a rough state: dz/dx = 1/(2z), d²z/dx² = −1/(4z³)."""
    system = implicit(lambda x, u, z: [z**2 - x], 1.0, 1.0)

    def z(x):
        return system.observe("m.z0", 0.0, jnp.stack([x, jnp.asarray(1.3)]))

    x = jnp.asarray(2.0)
    np.testing.assert_allclose(jax.jit(jax.grad(z))(x), 0.5 / np.sqrt(2), rtol=1e-14)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.grad(z)))(x), -0.25 / 2**1.5, rtol=1e-13)


# --- runs ----------------------------------------------------------------------------------------------------------


def failure(system, end=2.0, **options):
    with pytest.raises(SimulationError) as caught:
        simulate(system, end, ts=jnp.array([end]), max_steps=400, **options)
    return str(caught.value)


@pytest.mark.parametrize("solver", [None, pytest.param(diffrax.Tsit5(), marks=pytest.mark.slow)])
def test_a_turning_point_is_named(solver):
    """z² = x ends where x = 0, at t = 1."""
    message = failure(implicit(lambda x, u, z: [z**2 - x], 1.0, 1.0), solver=solver)
    assert "The nonlinear equation for 'm.z0' = " in message and "has no solution just beyond" in message
    assert "m: 0 = " in message and "turning point" in message
    assert abs(float(message.split("stopped at t=")[1].split(":")[0]) - 1) < 1e-3


def test_saved_times_at_which_a_block_has_no_solution():
    """z² = u, u negative in a pulse that the steps pass over: the saved value there was a number."""
    system = implicit(lambda x, u, z: [z**2 - u], 1.0, 1.0)
    pulse = {"m.u": lambda t: jnp.where(jnp.abs(t - 0.7) < 1e-3, -1.0, 1.0)}
    options = dict(ts=jnp.array([0.5, 0.7, 1.0]), inputs=pulse, solver=Rodas5P())
    found = simulate(system, 1.0, throw=False, **options)
    assert found.result != diffrax.RESULTS.successful
    np.testing.assert_array_equal(np.isnan(found["m.z0"]), [False, True, False])
    with pytest.raises(SimulationError, match=r"stopped at t=0\.7: .*'m\.z0'.* has no solution there"):
        simulate(system, 1.0, **options)


class Linear(Component):
    """a·x + b·y = 1 + w, b·x − a·y = 1: eliminated in the order that suits the values of a and b."""

    def __init__(self, ev, name, a, b):
        super().__init__(ev, name)
        x, y, w = self.variable("x"), self.variable("y"), self.variable("w", start=0.0, fixed=True)
        a, b = self.parameter("a", a), self.parameter("b", b)
        self.add_equations(a * x + b * y - 1 - w, b * x - a * y - 1, der(w) + x + y)


def test_an_order_of_elimination_that_fails_is_named():
    system = compiled(Linear(EqnEnv(), "m", 0.0, 1.0)).with_parameters({"m.a": 1.0, "m.b": 0.0})
    try:
        found = simulate(system, 1.0, ts=jnp.array([1.0]))
    except SimulationError as error:
        assert "The block of equations for 'm.x', 'm.y' has no accurate solution at the start" in str(error)
        assert "Compile the model with these values" in str(error) and "m: 0 = a*x + b*y - w - 1" in str(error)
    else:  # x = 1 + w, y = −1, w' = −w
        np.testing.assert_allclose(found["m.w"], 0.0, atol=1e-6)


class Meeting(Component):
    """x + y = 1, x + w·y = 2 with w = t: singular at t = 1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x"), self.variable("y")
        w, q = self.variable("w", start=0.0, fixed=True), self.variable("q", start=0.0, fixed=True)
        self.add_equations(x + y - 1, x + w * y - 2, der(w) - 1, der(q) - x)


def test_a_block_that_becomes_singular_is_named():
    message = failure(compiled(Meeting(EqnEnv(), "m")))
    # How near the last step comes is a matter of rounding.
    assert re.search(
        r"The block of 2 equations that is to determine 'm\.[xy]', 'm\.[xy]' is (nearly )?singular .*there", message
    )
    assert "m: 0 = w*y + x - 2" in message and "'m.w' = 1" in message


class Row(Component):
    """Cells in a row: 0 = D (z[i−1] − 2 z[i] + z[i+1]) − z[i]³ + (1 + i/10) u, and u' = −u."""

    def __init__(self, ev, n, diffusion):
        super().__init__(ev, "c")
        d, k = self.parameter("D", diffusion), self.parameter("k", 1.0)
        u = self.variable("u", start=1.0, fixed=True)
        z = [self.variable(f"z{i}", start=0.9) for i in range(n)]
        self.add_equations(der(u) + u)
        for i in range(n):
            left, right = z[max(i - 1, 0)], z[min(i + 1, n - 1)]
            self.add_equations(d * (left - 2 * z[i] + right) - k * z[i] ** 3 + u * (1 + 0.1 * i))


LONGER = [pytest.param(n, d, marks=pytest.mark.slow) for n, d in ((10, 0.01), (20, 1.0))]


@pytest.mark.parametrize("n, diffusion", [(3, 1.0), *LONGER])
def test_a_row_of_cells(n, diffusion):
    system = compiled(Row(EqnEnv(), n, diffusion))
    solution = simulate(system, 1.0, ts=[0.0, 1.0], rtol=1e-9, atol=1e-12)
    u, z = np.asarray(solution["c.u"]), np.stack([solution[f"c.z{i}"] for i in range(n)])
    np.testing.assert_allclose(u, np.exp([0.0, -1.0]), rtol=1e-8)
    padded = np.concatenate([z[:1], z, z[-1:]])
    residual = diffusion * (padded[:-2] - 2 * z + padded[2:]) - z**3 + u * (1 + 0.1 * np.arange(n)[:, None])
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)  # blocks are solved to rounding, of terms of size 1
