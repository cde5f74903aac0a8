"""Forces that have a potential."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import divided, multiplied, sizes, tanh_network, typical


class Conservative(eqx.Module):
    """F(x) = −∇V(x), with the potential V from a tanh network.

    The work of F along a path is V at its beginning minus V at its end. It is zero around a closed path, because F is a
    gradient (its Jacobian, minus the Hessian of V, is symmetric). V is bounded: |V| ≤ 2 · energy · Σ|weights of the
    last layer|, because |tanh| ≤ 1 and V(0) = 0. So no path can extract more energy.

    **Arguments:**

    - `size`: the number of entries of x and F.
    - `key`: for the weights. `width`, `depth`: of the hidden layers; depth ≥ 1.
    - `inputs`: typical sizes of x, one number or one for each. `energy`: the typical size of V (joule for forces and
        positions in SI units).

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    energy: float = eqx.field(static=True)

    def __init__(self, size: int, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Any = 1.0, energy: Any = 1.0):  # fmt: skip
        self.size = whole_number(size, "Conservative: size")
        depth = whole_number(depth, "Conservative: depth")
        self.network = tanh_network(size, 1, whole_number(width, "Conservative: width"), depth, key)
        self.inputs = sizes(inputs, size, "Conservative: inputs")
        self.energy = typical(energy, "Conservative: energy")

    def potential(self, x: Float[Array, " size"]) -> Float[Array, ""]:
        """V(x), zero at x = 0."""
        scaled = divided(x, self.inputs)
        return (self.network(scaled)[0] - self.network(jnp.zeros_like(scaled))[0]) * self.energy

    def __call__(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        slope = jax.grad(lambda scaled: self.network(scaled)[0])(divided(u, self.inputs))
        return multiplied(slope, tuple(-self.energy / s for s in self.inputs))
