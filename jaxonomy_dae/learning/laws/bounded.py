"""Laws whose values lie between bounds."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import ModelError, whole_number
from .network import divided, sizes, tanh_network


class Bounded(eqx.Module):
    """low ≤ f(u) ≤ high for all u and all weights: f = low + (high − low)·σ(g(u)), with the logistic σ of a tanh
    network g.

    The bounds hold because 0 < σ < 1. They hold in floating-point numbers, too, because each half of the range is
    computed from its own bound, with σ(−g) = 1 − σ(g).

    **Arguments:**

    - `low`, `high`: the bounds, in the outputs' units, one number or one for each output.
    - `in_size`, `out_size`: the numbers of inputs and outputs.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`: typical sizes of the inputs, one number or one for each.

    **Raises:**

    - `ModelError` for bounds that are not finite or not in ascending order, and for counts and sizes that are not
        positive.
    """

    network: eqx.nn.MLP
    low: tuple[float, ...] = eqx.field(static=True)
    high: tuple[float, ...] = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, low: Any, high: Any, in_size: int = 1, out_size: int = 1, *, key: PRNGKeyArray, width: int = 8,
                 depth: int = 2, inputs: Any = 1.0):  # fmt: skip
        in_size, out_size = whole_number(in_size, "Bounded: in_size"), whole_number(out_size, "Bounded: out_size")
        self.network = tanh_network(in_size, out_size, whole_number(width, "Bounded: width"), depth, key)
        self.low, self.high = _ends(low, out_size), _ends(high, out_size)
        if any(not (math.isfinite(a) and math.isfinite(b) and a < b) for a, b in zip(self.low, self.high, strict=True)):
            raise ModelError(f"Bounded: low and high are finite and ascend, for each output; got {low!r} and {high!r}")
        self.inputs = sizes(inputs, in_size, "Bounded: inputs")

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        g = self.network(divided(u, self.inputs))
        low, high = jnp.asarray(self.low, g.dtype), jnp.asarray(self.high, g.dtype)
        width = high - low
        return jnp.where(g < 0, low + width * jax.nn.sigmoid(g), high - width * jax.nn.sigmoid(-g))


def _ends(given: Any, outputs: int) -> tuple[float, ...]:
    try:
        found = tuple(float(v) for v in given) if isinstance(given, tuple | list) else (float(given),) * outputs
    except (TypeError, ValueError):
        found = ()
    if len(found) != outputs:
        raise ModelError(f"Bounded: a bound is a number, or one for each of {outputs} outputs; got {given!r}")
    return found
