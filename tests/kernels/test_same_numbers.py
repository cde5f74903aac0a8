"""Equal models compute equal numbers, to the last bit."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from problems import drag_on, pendulum


@eqx.filter_jit
def numbers(system, x):
    """A consistent start and a slope."""
    return system.initialize(), system.vector_field(0.25, x)


def digits(system) -> list[str]:
    x = 0.3 + 0.1 * jnp.arange(system.plan.n_state, dtype=float)
    return [value.hex() for array in numbers(system, x) for value in np.asarray(array).tolist()]


@pytest.mark.slow
def test_a_components_name_changes_no_number():
    assert digits(pendulum(drag_on("vx"), name="lambda")) == digits(pendulum(drag_on("vx")))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lambda", "0", "I", "q-1"])
def test_a_components_name_changes_no_minimal_state(name):
    """The choice of states evaluates the model where it starts."""
    options = {"compiler": {"state_selection": "dummy_derivatives"}}
    expected, renamed = pendulum(drag_on("vx"), **options), pendulum(drag_on("vx"), name=name, **options)
    assert str(renamed.report) == str(expected.report).replace("pend", name)
    assert renamed.states == [state.replace("pend", name) for state in expected.states]
    assert digits(renamed) == digits(expected)
