"""Drag that knows no direction but the velocity's."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import tanh_network, typical
from .passive import AbstractPassive

REST = 0.01  # of the typical input: below it, |v| is rounded off, so that N is smooth at rest


class IsotropicPassive(AbstractPassive):
    """N(v) = −k(|v|) v with k > 0 from a tanh network: the drag of still air, friction on a plane without grain.

    It is passive because N·v = −k |v|² ≤ 0. This also holds exactly in floating-point numbers, where each entry of N
    has the opposite sign of its entry of v. Rotating v rotates N. In place of |v|, the network gets √(|v|² + δ²) − δ
    with δ = 0.01·`inputs`, so that N has derivatives of all orders at rest, too.

    **Arguments:**

    - `size`: the number of entries of v and N.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`, `power`: typical sizes of |v| and |N·v|.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: float = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, size: int = 1, *, key: PRNGKeyArray, width: int = 8, depth: int = 2, inputs: Any = 1.0,
                 power: Any = 1.0):  # fmt: skip
        self.size = whole_number(size, "IsotropicPassive: size")
        self.network = tanh_network(1, 1, whole_number(width, "IsotropicPassive: width"), depth, key)
        self.inputs = typical(inputs, "IsotropicPassive: inputs")
        self.power = typical(power, "IsotropicPassive: power")

    def rate(self, speed: Any) -> Float[Array, ""]:
        """k at a speed |v|, in units of N per v."""
        scaled = jnp.asarray(speed) / self.inputs
        rounded = scaled**2 / (jnp.sqrt(scaled**2 + REST**2) + REST)  # √(s² + δ²) − δ without cancellation
        return self._rate(rounded)

    def _rate(self, rounded: Float[Array, ""]) -> Float[Array, ""]:
        return jax.nn.softplus(self.network(rounded[None])[0]) * (self.power / self.inputs**2)

    def __call__(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        square = jnp.sum((u / self.inputs) ** 2)
        return -self._rate(square / (jnp.sqrt(square + REST**2) + REST)) * u
