"""Laws that are the same in both directions."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import divided, multiplied, sizes, tanh_network


class Odd(eqx.Module):
    """f(−u) = −f(u) for all u and all weights: f(u) = (g(u) − g(−u))/2 with a tanh network g.

    It is odd because f(−u) = (g(−u) − g(u))/2 = −f(u), also in floating-point numbers. So f(0) = 0. Every odd f has
    this form, with g = f.

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
        in_size, out_size = whole_number(in_size, "Odd: in_size"), whole_number(out_size, "Odd: out_size")
        self.network = tanh_network(in_size, out_size, whole_number(width, "Odd: width"), depth, key)
        self.inputs = sizes(inputs, in_size, "Odd: inputs")
        self.outputs = sizes(outputs, out_size, "Odd: outputs")

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        scaled = divided(u, self.inputs)
        return multiplied((self.network(scaled) - self.network(-scaled)) / 2, self.outputs)
