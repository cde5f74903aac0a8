"""Laws whose values are above zero."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import divided, multiplied, sizes, tanh_network


class Positive(eqx.Module):
    """f(u) > 0 for all u and all weights: f = (g + √(g² + 4))/2 of a tanh network g (Barron 2021, arXiv:2112.11687).

    It is positive because √(g² + 4) > |g|. For negative g it is computed as 2/(√(g² + 4) − g), a quotient of positive
    numbers, so it is positive in floating-point numbers, too. An exponential or softplus would underflow to zero; this
    function decreases only as 1/|g|.

    **Arguments:**

    - `in_size`, `out_size`: the numbers of inputs and outputs.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`, `outputs`: typical sizes in their units, one number or one for each.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP
    inputs: tuple[float, ...] = eqx.field(static=True)
    outputs: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, in_size: int = 1, out_size: int = 1, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Any = 1.0, outputs: Any = 1.0):  # fmt: skip
        in_size, out_size = whole_number(in_size, "Positive: in_size"), whole_number(out_size, "Positive: out_size")
        self.network = tanh_network(in_size, out_size, whole_number(width, "Positive: width"), depth, key)
        self.inputs = sizes(inputs, in_size, "Positive: inputs")
        self.outputs = sizes(outputs, out_size, "Positive: outputs")

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        g = self.network(divided(u, self.inputs))
        root = jnp.sqrt(g**2 + 4)
        above = g >= 0
        # Each branch is given what it is meant for, so that the other's derivative is finite too.
        return multiplied(jnp.where(above, (g + root) / 2, 2 / (root - jnp.where(above, 0, g))), self.outputs)
