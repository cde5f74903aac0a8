"""Laws that rise with their inputs, or fall."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import ModelError, whole_number
from .network import divided, multiplied, sizes


class Monotone(eqx.Module):
    """No output falls when an input rises; with `increasing=False`, no output rises.

    Hidden layers are h ← tanh(W h + b). The outputs are V h + S u + b, with the inputs u. All entries of W, V and S are
    squares of trained numbers, so they are ≥ 0. Sums with such weights, tanh, and their compositions do not fall where
    their arguments rise, so ∂f/∂u ≥ 0 for all weights. With k hidden layers it approximates all continuous monotone
    functions of k variables on a bounded region (Daniels & Velikova 2010, IEEE Trans. Neural Networks 21:906).

    **Arguments:**

    - `in_size`, `out_size`: the numbers of inputs and outputs.
    - `increasing`: whether outputs rise with an input or fall, one for all or one for each input.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`, `outputs`: typical sizes in their units, one number or one for each.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive, and for an `increasing` of another length.
    """

    roots: list[Float[Array, "to from"]]  # of the hidden layers' weights, then of V
    skip: Float[Array, "outputs inputs"]  # the roots of S
    biases: list[Float[Array, " to"]]
    signs: tuple[float, ...] = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    outputs: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, in_size: int = 1, out_size: int = 1, increasing: bool | tuple[bool, ...] = True, *,
                 key: PRNGKeyArray, width: int = 8, depth: int = 1, inputs: Any = 1.0,
                 outputs: Any = 1.0):  # fmt: skip
        in_size, out_size = whole_number(in_size, "Monotone: in_size"), whole_number(out_size, "Monotone: out_size")
        width, depth = whole_number(width, "Monotone: width"), whole_number(depth, "Monotone: depth")
        directions = (increasing,) * in_size if isinstance(increasing, bool) else tuple(increasing)
        if len(directions) != in_size or not all(isinstance(d, bool) for d in directions):
            raise ModelError(
                f"Monotone: increasing is True or False, or one for each of {in_size} inputs; got {increasing!r}"
            )
        self.signs = tuple(1.0 if d else -1.0 for d in directions)
        self.inputs = sizes(inputs, in_size, "Monotone: inputs")
        self.outputs = sizes(outputs, out_size, "Monotone: outputs")
        layers = [in_size, *[width] * depth, out_size]
        *keys, skip_key = jax.random.split(key, 2 * len(layers) - 1)
        pairs = list(zip(layers, layers[1:], strict=False))
        # Weights of mean 1/fan-in: what a layer returns is as large as what it is given. Biases spread the steps over
        # the typical inputs.
        self.roots = [
            jax.random.normal(k, (b, a)) / math.sqrt(a) for k, (a, b) in zip(keys[: len(pairs)], pairs, strict=True)
        ]
        hidden = [
            jax.random.uniform(k, (b,), minval=-1.5, maxval=1.5)
            for k, b in zip(keys[len(pairs) :], layers[1:-1], strict=False)
        ]
        self.biases = [*hidden, jnp.zeros(out_size)]
        self.skip = jax.random.normal(skip_key, (out_size, in_size)) / (2 * math.sqrt(in_size))

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        scaled = multiplied(divided(u, self.inputs), self.signs)
        h = scaled
        for root, bias in zip(self.roots[:-1], self.biases[:-1], strict=True):
            h = jnp.tanh(root**2 @ h + bias)
        return multiplied(self.roots[-1] ** 2 @ h + self.skip**2 @ scaled + self.biases[-1], self.outputs)
