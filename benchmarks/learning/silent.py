"""A small network that is silent to begin with: what stands around it starts as if there were none."""

import equinox as eqx
import jax
import jax.numpy as jnp


def silent_network(inputs):
    """Six hidden units, one output, which is zero until the last layer has learned something."""
    net = eqx.nn.MLP(inputs, 1, 6, 1, jnp.tanh, key=jax.random.key(0))
    return eqx.tree_at(lambda n: n.layers[-1], net, jax.tree.map(jnp.zeros_like, net.layers[-1]))
