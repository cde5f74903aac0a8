"""The reference tutorial, reproduced: `inject="row"`, minimal states (vx, x), 25 steps of Adam."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import (
    HORIZONS,
    INITIAL_GRADIENT_NORM,
    INITIAL_LOSS,
    ROW,
    TRAINING,
    drag_on,
    pendulum,
    quadratic,
    tutorial_network,
)

from jaxonomy_dae import NeuralDAEBlock, simulate

MINIMAL = {"state_selection": "dummy_derivatives", "prefer_states": ("pend.vx", "pend.x")}
TS = jnp.array(HORIZONS)


def vx_and_x(system):
    solution = simulate(system, HORIZONS[-1], ts=TS, rtol=1e-7, atol=1e-9)  # the tutorial's tolerances
    return jnp.stack([solution["pend.vx"], solution["pend.x"]], axis=1)


@pytest.mark.slow
def test_truth_is_the_tutorials():
    system = pendulum(drag_on("vx", network=quadratic, inject="row"), compiler=MINIMAL)
    assert sorted(system.states) == ["pend.vx", "pend.x"]
    # Eight decimals of a hand-written solve at these tolerances; 2e-6 is the tutorial's five digits with its rounding.
    np.testing.assert_allclose(vx_and_x(system), ROW, rtol=0, atol=2e-6)


@pytest.fixture(scope="module")
def training():
    """Losses before each of 25 updates, on the tutorial's data, and the first gradient."""
    network, weights = tutorial_network()
    system = pendulum(
        lambda bob: NeuralDAEBlock(network, weights, targets=[(bob, "vx")], name="drag", inject="row"),
        compiler=MINIMAL,
    )
    assert system.neural["drag"].shape == (19,)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def loss(trainable, frozen):
        return jnp.sum((vx_and_x(eqx.combine(trainable, frozen)) - ROW) ** 2)

    trainable, frozen = system.partition("drag")
    optimizer = optax.adam(0.02)
    state = optimizer.init(trainable)
    losses, first = [], None
    for _ in range(25):
        value, gradient = loss(trainable, frozen)
        losses.append(float(value))
        first = gradient if first is None else first
        with jax.numpy_dtype_promotion("standard"):  # Optax mixes precisions
            updates, state = optimizer.update(gradient, state)
        trainable = eqx.apply_updates(trainable, updates)
    return losses, first


@pytest.mark.slow
def test_initial_loss_and_gradient_are_the_tutorials(training):
    # 1e-4 relative throughout: the tutorial's BDF at rtol 1e-7 against Tsit5 at 1e-7 differ by some 1e-5.
    losses, gradient = training
    assert losses[0] == pytest.approx(INITIAL_LOSS, rel=1e-4)
    assert float(jnp.linalg.norm(gradient.neural["drag"])) == pytest.approx(INITIAL_GRADIENT_NORM, rel=1e-4)


@pytest.mark.parametrize("step", TRAINING)
def test_training_trace_is_the_tutorials(training, step):
    losses, _ = training
    assert losses[step - 1] == pytest.approx(TRAINING[step], rel=1e-4)  # the loss before the step-th update
