"""The network inside a law, and the sizes that it is measured in.

Networks see and return numbers of order one; a law multiplies by what its inputs and outputs typically are. These sizes
are settings, no weights: no training moves them.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ...base.errors import ModelError, whole_number

if TYPE_CHECKING:
    Sizes: TypeAlias = float | Sequence[float] | np.ndarray  # one for all, or one for each
else:
    Sizes = object  # others are refused by `sizes`, which says what was given


def tanh_network(law: str, inputs: int, outputs: int, width: int, depth: int, key: PRNGKeyArray) -> eqx.nn.MLP:
    """inputs → width → … → outputs with `depth` hidden layers of tanh: smooth, and bounded for given weights. Errors
    name the `law`."""
    width = whole_number(width, f"{law}: width")
    return eqx.nn.MLP(inputs, outputs, width, depth, jnp.tanh, key=key)


def sizes(given: Sizes, count: int, what: str) -> tuple[float, ...]:
    """The typical sizes of `count` values, from one number for all or one for each.

    **Raises:**

    - `ModelError` for another count, and for sizes that are not positive.
    """
    values = each(given, count)
    if values is None or not (np.isfinite(values) & (values > 0)).all():
        raise ModelError(f"{what} is a typical size > 0, or one for each of {count}; got {given!r}")
    return tuple(values.tolist())


def each(given: Sizes, count: int) -> Float[np.ndarray, " count"] | None:
    """One number for each of `count`, from one for all or one for each; None if it is neither."""
    try:
        values = np.asarray(given, float)
    except (TypeError, ValueError):
        return None
    return np.broadcast_to(values, (count,)) if values.shape in ((), (count,)) else None


def typical(given: Sizes, what: str) -> float:
    """One typical size."""
    return sizes(given, 1, what)[0]


def divided(u: Float[Array, "*batch n"], by: tuple[float, ...]) -> Float[Array, "*batch n"]:
    """Values in units of their typical sizes."""
    return u / jnp.asarray(by, u.dtype)


def multiplied(y: Float[Array, "*batch n"], by: tuple[float, ...]) -> Float[Array, "*batch n"]:
    """Values from those in units of their typical sizes."""
    return y * jnp.asarray(by, y.dtype)
