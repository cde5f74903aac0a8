"""A run that ends at a nonlinear or linear block names the block; until then its equations hold to rounding.

References: closed forms, and the equations themselves evaluated in NumPy.
"""

import re

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import compiled

from jaxonomy_dae import Component, EqnEnv, SimulationError, der, simulate
from jaxonomy_dae.solvers import Rodas5P


class Implicit(Component):
    """x' = −1 from x0, and 0 = g(x, z, u) for z, which is read from the state."""

    def __init__(self, ev, name, law, x0, start):
        super().__init__(ev, name)
        x, u = self.variable("x", start=x0, fixed=True), self.input("u", default=0.0)
        z = self.variable("z0", start=start)
        self.add_equations(der(x) + 1, *law(x, u, z))


def implicit(law, x0, start):
    system = compiled(Implicit(EqnEnv(), "m", law, x0, start))
    assert len(system.carried) == 1
    return system


def failure(system, end=2.0, **options):
    with pytest.raises(SimulationError) as caught:
        simulate(system, end, ts=np.array([end]), max_steps=400, **options)
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Tsit5()])
def test_a_turning_point_is_named(solver):
    """z² = x ends where x = 0, at t = 1."""
    message = failure(implicit(lambda x, u, z: [z**2 - x], 1.0, 1.0), solver=solver)
    assert "The nonlinear equation for 'm.z0' = " in message and "has no solution just beyond" in message
    assert "m: 0 = " in message and "turning point" in message
    assert abs(float(message.split("stopped at t=")[1].split(":")[0]) - 1) < 1e-3


@pytest.mark.slow
def test_saved_times_at_which_a_block_has_no_solution():
    """z² = u, u negative in a pulse that the steps pass over: the saved value there was a number. A run ends there."""
    system = implicit(lambda x, u, z: [z**2 - u], 1.0, 1.0)
    pulse = {"m.u": lambda t: jnp.where(jnp.abs(t - 0.7) < 1e-3, -1.0, 1.0)}
    options = dict(ts=np.array([0.5, 0.7, 1.0]), inputs=pulse, solver=Rodas5P())
    found = simulate(system, 1.0, throw=False, **options)
    assert found.result != diffrax.RESULTS.successful
    np.testing.assert_array_equal(np.isnan(found["m.z0"]), [False, True, True])
    with pytest.raises(SimulationError, match=r"stopped at t=0\.7: .*'m\.z0'.* has no solution there"):
        simulate(system, 1.0, **options)


class Linear(Component):
    """a·x + b·y = 1 + w, b·x − a·y = 1: eliminated in the order that suits the values of a and b."""

    def __init__(self, ev, name, a, b):
        super().__init__(ev, name)
        x, y, w = self.variable("x"), self.variable("y"), self.variable("w", start=0.0, fixed=True)
        a, b = self.parameter("a", a), self.parameter("b", b)
        self.add_equations(a * x + b * y - 1 - w, b * x - a * y - 1, der(w) + x + y)


@pytest.mark.slow
def test_an_order_of_elimination_that_fails_is_named():
    system = compiled(Linear(EqnEnv(), "m", 0.0, 1.0)).with_parameters({"m.a": 1.0, "m.b": 0.0})
    try:
        found = simulate(system, 1.0, ts=np.array([1.0]))
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_row_of_cells():
    n, diffusion = 3, 1.0
    system = compiled(Row(EqnEnv(), n, diffusion))
    solution = simulate(system, 1.0, ts=[0.0, 1.0], rtol=1e-9, atol=1e-12)
    u, z = np.asarray(solution["c.u"]), np.stack([solution[f"c.z{i}"] for i in range(n)])
    np.testing.assert_allclose(u, np.exp([0.0, -1.0]), rtol=1e-8)
    padded = np.concatenate([z[:1], z, z[-1:]])
    residual = diffusion * (padded[:-2] - 2 * z + padded[2:]) - z**3 + u * (1 + 0.1 * np.arange(n)[:, None])
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)  # blocks are solved to rounding, of terms of size 1
