"""Networks of which one property is known: the same numbers, used so that the property holds for all of them."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Property(eqx.Module):
    """A network g, used with a property."""

    network: eqx.AbstractVar[Any]

    def asked(self, points: Float[np.ndarray, "m inputs"]) -> Float[np.ndarray, "n inputs"]:
        """Where g is evaluated for a law at these points."""
        return points


class ZeroAtZero(Property):
    """f(u) = g(u) − g(0)."""

    network: Any

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        return self.network(u) - self.network(jnp.zeros_like(u))

    def asked(self, points: Float[np.ndarray, "m inputs"]) -> Float[np.ndarray, "n inputs"]:
        """The points, and zero."""
        return np.concatenate([points, np.zeros_like(points[:1])])


class OddPart(Property):
    """f(u) = (g(u) − g(−u))/2."""

    network: Any

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        return (self.network(u) - self.network(-u)) / 2

    def asked(self, points: Float[np.ndarray, "m inputs"]) -> Float[np.ndarray, "n inputs"]:
        """The points, and those opposite."""
        return np.concatenate([points, -points])


class AlongInput(Property):
    """f(u) = g₁(s) u/s with the size s = |u|, rounded off where it is small: the direction of u, and a function of its
    size alone. f(0) = 0."""

    network: Any
    small: float = eqx.field(static=True)

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        size = jnp.sqrt(jnp.sum(u**2) + jnp.asarray(self.small, u.dtype) ** 2)
        return self.network(jnp.zeros_like(u).at[0].set(size))[0] * u / size

    def asked(self, points: Float[np.ndarray, "m inputs"]) -> Float[np.ndarray, "n inputs"]:
        """Sizes, as the first input."""
        out = np.zeros_like(points)
        out[:, 0] = np.linalg.norm(points, axis=1)
        return out


def raw(network: Any) -> Any:
    """The network inside a property."""
    return network.network if isinstance(network, Property) else network


def is_raw(network: Any) -> bool:
    """True for an `equinox.nn.MLP`, also inside a property. Searches measure its weights by ranges; modules of a user's
    own bring their scales along."""
    return type(raw(network)) is eqx.nn.MLP
