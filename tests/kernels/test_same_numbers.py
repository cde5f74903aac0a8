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


@pytest.mark.parametrize("mode", ["dummy_derivatives", pytest.param("auto", marks=pytest.mark.slow)])
def test_a_components_name_changes_no_number(mode):
    options = {"compiler": {"state_selection": mode}}
    assert digits(pendulum(drag_on("vx"), name="lambda", **options)) == digits(pendulum(drag_on("vx"), **options))
