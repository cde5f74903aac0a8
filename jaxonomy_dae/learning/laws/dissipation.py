"""The dissipation and interconnection of a port-Hamiltonian system, without its energy."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import divided, multiplied, sizes, tanh_network, typical
from .passive import AbstractPassive
from .structure import dissipation, interconnection, response


class Dissipation(AbstractPassive):
    """f(e, x) = (J(x) − R(x)) e, linear in the efforts e, with R(x) symmetric and positive semidefinite and J(x) skew
    (van der Schaft & Jeltsema 2014, Port-Hamiltonian systems theory).

    Efforts are velocities, voltages or pressures; f are the resulting forces, currents or flows, with signs such that
    f·e is the power into the model. From the numbers W(x) of a tanh network, R = L D Lᵀ with L unit lower triangular
    and D = diag(softplus(…)) ≥ 0, and J = U − Uᵀ. So eᵀ R e = Σ D (Lᵀ e)² ≥ 0 and eᵀ J e = 0, and f·e = −eᵀ R e ≤ 0
    whatever the weights. All positive definite R and all skew J are of this form. In floating-point numbers, f·e
    exceeds zero by no more than the rounding errors of its summands.

    **Arguments:**

    - `size`: the number of efforts, which are the first inputs.
    - `states`: the number of inputs x after them. Without any, R and J are constant.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`: typical sizes of e and x, one number or one for each. `power`: the typical size of |f·e|.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP | Float[Array, " sizes"]  # numbers, if nothing moves them
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, size: int, states: int = 0, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Any = 1.0, power: Any = 1.0):  # fmt: skip
        self.size = whole_number(size, "Dissipation: size")
        total = size + whole_number(states, "Dissipation: states", 0)
        width = whole_number(width, "Dissipation: width")
        self.network = (
            tanh_network(states, size * size, width, depth, key) if states else jax.random.normal(key, (size * size,))
        )
        self.inputs = sizes(inputs, total, "Dissipation: inputs")
        self.power = typical(power, "Dissipation: power")

    def _matrix(self, x: Float[Array, " states"]) -> Float[Array, "size size"]:
        network = self.network
        w = network(divided(x, self.inputs[self.size :])) if isinstance(network, eqx.nn.MLP) else network
        return w.reshape(self.size, self.size)

    def _per_effort(self, scaled: Float[Array, "size size"]) -> Float[Array, "size size"]:
        """A matrix in units of flow per effort: scaled[i, j]·power/(eᵢ eⱼ), a congruence, which keeps signs."""
        own = np.array(self.inputs[: self.size])
        return scaled * jnp.asarray(self.power / np.outer(own, own), scaled.dtype)

    def R(self, x: Float[Array, " states"]) -> Float[Array, "size size"]:
        """The dissipation, symmetric and positive semidefinite."""
        return self._per_effort(dissipation(self._matrix(x)))

    def J(self, x: Float[Array, " states"]) -> Float[Array, "size size"]:
        """The interconnection, skew-symmetric."""
        return self._per_effort(interconnection(self._matrix(x)))

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " size"]:
        e, x = u[: self.size], u[self.size :]
        own = self.inputs[: self.size]
        found = response(self._matrix(x), divided(e, own))
        return multiplied(found, tuple(self.power / s for s in own))
