"""Dead time: inputs that act late, and sensors that show late what is measured.

A late input is u(t − τ), and where its samples do not reach back so far, the first of them. A late sensor shows
y(t − τ), and until t₀ + τ, what it would show at the start. Times of samples, at which integration steps end, move with
τ. So derivatives by τ are those of the equations, jumps of held samples included.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..base.aliases import Time
from ..run.system.inputs import CURVED, SampledInput, interpolated

Delays = Mapping[str, Float[Array, ""]]  # s, by names of inputs and of outputs


class Continued(eqx.Module):
    """A curve, and before its beginning the first value."""

    path: Any
    before: Float[Array, " 1"]  # a time from which on this is read

    @property
    def ts(self) -> Float[Array, " n"]:
        """The times at which it has kinks."""
        return jnp.concatenate([self.before, self.path.ts])

    def evaluate(self, t: Time) -> Any:
        """The value at a time."""
        return self.path.evaluate(jnp.maximum(t, self.path.ts[0]))


def late(times: Float[Array, " n"], values: Float[Array, " n"], kind: str, delay: Float[Array, ""]) -> SampledInput:
    """Samples of an input that acts late. The first one holds for as long before as the samples are long."""
    before = times[:1] - (times[-1:] - times[:1])
    if kind in CURVED:
        curve = interpolated(times + delay, values, kind)
        return SampledInput(Continued(curve.path, before), curve.smoothness)
    return interpolated(jnp.concatenate([before, times + delay]), jnp.concatenate([values[:1], values]), kind)


def merged(
    times: Float[Array, " n"], t0: Float[Array, ""], delays: list[Float[Array, ""]]
) -> tuple[Float[Array, " m"], list[Int[Array, " n"]]]:
    """(times in order, to which sensors with these delays look back; where in them those of each sensor stand)."""
    each = jnp.concatenate([jnp.maximum(times - delay, t0) for delay in delays])
    order = jnp.argsort(jax.lax.stop_gradient(each), stable=True)
    place = jnp.zeros_like(order).at[order].set(jnp.asarray(np.arange(len(order)), order.dtype))
    return each[order], list(place.reshape(len(delays), len(times)))
