"""Laws whose values have a sign, bounds, a symmetry or a direction, for all weights and all inputs."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ...base.errors import ModelError, explained_keywords, whole_number
from .network import Sizes, divided, each, multiplied, sizes, tanh_network


class _Scaled(eqx.Module):
    """A tanh network with inputs and outputs in units of their typical sizes."""

    network: eqx.nn.MLP
    inputs: tuple[float, ...] = eqx.field(static=True)
    outputs: tuple[float, ...] = eqx.field(static=True)

    @explained_keywords()
    def __init__(self, in_size: int = 1, out_size: int = 1, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Sizes = 1.0, outputs: Sizes = 1.0):  # fmt: skip
        law = type(self).__name__
        in_size, out_size = whole_number(in_size, f"{law}: in_size"), whole_number(out_size, f"{law}: out_size")
        self.network = tanh_network(law, in_size, out_size, width, depth, key)
        self.inputs = sizes(inputs, in_size, f"{law}: inputs")
        self.outputs = sizes(outputs, out_size, f"{law}: outputs")


class Odd(_Scaled):
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

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        scaled = divided(u, self.inputs)
        return multiplied((self.network(scaled) - self.network(-scaled)) / 2, self.outputs)


class Positive(_Scaled):
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

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        g = self.network(divided(u, self.inputs))
        root = jnp.sqrt(g**2 + 4)
        above = g >= 0
        # Each branch is given what it is meant for, so that the other's derivative is finite too.
        return multiplied(jnp.where(above, (g + root) / 2, 2 / (root - jnp.where(above, 0, g))), self.outputs)


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

    def __init__(self, low: Sizes, high: Sizes, in_size: int = 1, out_size: int = 1, *, key: PRNGKeyArray,
                 width: int = 8, depth: int = 2, inputs: Sizes = 1.0):  # fmt: skip
        in_size, out_size = whole_number(in_size, "Bounded: in_size"), whole_number(out_size, "Bounded: out_size")
        self.network = tanh_network("Bounded", in_size, out_size, width, depth, key)
        self.low, self.high = _ends(low, out_size), _ends(high, out_size)
        if any(not (math.isfinite(a) and math.isfinite(b) and a < b) for a, b in zip(self.low, self.high, strict=True)):
            raise ModelError(f"Bounded: low and high are finite and ascend, for each output; got {low!r} and {high!r}")
        self.inputs = sizes(inputs, in_size, "Bounded: inputs")

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        g = self.network(divided(u, self.inputs))
        low, high = jnp.asarray(self.low, g.dtype), jnp.asarray(self.high, g.dtype)
        width = high - low
        return jnp.where(g < 0, low + width * jax.nn.sigmoid(g), high - width * jax.nn.sigmoid(-g))


def _ends(given: Sizes, outputs: int) -> tuple[float, ...]:
    found = each(given, outputs)
    if found is None:
        raise ModelError(f"Bounded: a bound is a number, or one for each of {outputs} outputs; got {given!r}")
    return tuple(found.tolist())


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
                 key: PRNGKeyArray, width: int = 8, depth: int = 1, inputs: Sizes = 1.0,
                 outputs: Sizes = 1.0):  # fmt: skip
        in_size, out_size = whole_number(in_size, "Monotone: in_size"), whole_number(out_size, "Monotone: out_size")
        width, depth = whole_number(width, "Monotone: width"), whole_number(depth, "Monotone: depth")
        rises = np.asarray(increasing)
        if rises.dtype != bool or rises.shape not in ((), (in_size,)):
            raise ModelError(
                f"Monotone: increasing is True or False, or one for each of {in_size} inputs; got {increasing!r}"
            )
        self.signs = tuple(np.where(np.broadcast_to(rises, (in_size,)), 1.0, -1.0).tolist())
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
