"""Motions that lose their own energy, or keep it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import divided, multiplied, sizes, tanh_network, typical
from .structure import response


class PortHamiltonian(eqx.Module):
    """f(x) = (J(x) − R(x)) ∇H(x): the right-hand side of an autonomous system with a learned energy H, a learned
    dissipation R (symmetric, positive semidefinite) and a learned interconnection J (skew).

    Along x' = f(x), dH/dt = ∇H·f = −∇Hᵀ R ∇H ≤ 0 for all weights, as for `Dissipation`, whose efforts ∇H is. And with
    H(x) = energy·(½|x/inputs|² + network(x/inputs) − network(0)), whose network is bounded, H → ∞ with |x|: as H never
    rises, no solution leaves the bounded set {H ≤ H(x(0))}. With R = 0 the energy is conserved.

    **Arguments:**

    - `size`: the number of states x.
    - `key`: for the weights. `width`, `depth`: of the hidden layers; depth ≥ 1.
    - `inputs`: typical sizes of x, one number or one for each. `energy`: the typical size of H. `time`: the time in
        which x changes by its typical size.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    storage: eqx.nn.MLP
    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    scale: float = eqx.field(static=True)
    time: float = eqx.field(static=True)

    def __init__(self, size: int, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Any = 1.0, energy: Any = 1.0, time: Any = 1.0):  # fmt: skip
        self.size = whole_number(size, "PortHamiltonian: size")
        width, depth = whole_number(width, "PortHamiltonian: width"), whole_number(depth, "PortHamiltonian: depth")
        storage_key, key = jax.random.split(key)
        self.storage = tanh_network(size, 1, width, depth, storage_key)
        self.network = tanh_network(size, size * size, width, depth, key)
        self.inputs = sizes(inputs, size, "PortHamiltonian: inputs")
        self.scale = typical(energy, "PortHamiltonian: energy")
        self.time = typical(time, "PortHamiltonian: time")

    def _energy(self, scaled: Float[Array, " size"]) -> Float[Array, ""]:
        learned = self.storage(scaled)[0] - self.storage(jnp.zeros_like(scaled))[0]
        return 0.5 * jnp.sum(scaled**2) + learned

    def energy(self, x: Float[Array, " size"]) -> Float[Array, ""]:
        """H(x), zero at x = 0."""
        return self._energy(divided(x, self.inputs)) * self.scale

    def __call__(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        scaled = divided(u, self.inputs)
        matrix = self.network(scaled).reshape(self.size, self.size)
        return multiplied(response(matrix, jax.grad(self._energy)(scaled)), tuple(s / self.time for s in self.inputs))
