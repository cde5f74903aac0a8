"""Values inside bounds: projections onto intervals, and coordinates in which there are no bounds.

Each parameter has an `Interval`. The gradient steps of `minimize` are projected onto it. Loops of users, whose steps
know no bounds, work in unbounded coordinates z instead, by `constrained` and `unconstrained`: a logarithm of the
distance from one bound, the logit between two. They depend on the bounds alone, so that z means the same wherever it
is read.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...write.interval import Interval, distinct_intervals

KEPT = 0.1  # of the distance to an open end, at least, after one update


def project(
    new: Float[Array, "*batch k"], old: Float[Array, "*batch k"], intervals: Sequence[Interval]
) -> Float[Array, "*batch k"]:
    """`new` moved into the intervals that hold `old`: onto closed ends, before open ones."""

    def end(sign: int, at: str) -> tuple[np.ndarray, np.ndarray]:
        ends = np.array([getattr(i, at) for i in intervals], np.float64)
        opened = np.array([getattr(i, f"open_{at}") for i in intervals], bool)
        return np.where(np.isfinite(ends), ends, sign * np.inf), opened & np.isfinite(ends)

    for sign, at in ((-1, "low"), (1, "high")):
        bound, opened = end(sign, at)
        bound = jnp.asarray(bound, new.dtype)
        # Where there is no open end the difference is zero: an infinite one would leave not-a-number in gradients.
        limit = jnp.where(opened, bound + jnp.asarray(KEPT, new.dtype) * (old - jnp.where(opened, bound, old)), bound)
        new = jnp.maximum(new, limit) if sign < 0 else jnp.minimum(new, limit)
    return new


class Ends(NamedTuple):
    """The ends of intervals, all of one shape: infinite where there is none, and whether they are open."""

    low: np.ndarray
    high: np.ndarray
    open_low: np.ndarray
    open_high: np.ndarray

    @classmethod
    def of(cls, intervals: Sequence[Interval]) -> "Ends":
        """The ends of a list of intervals, shape (n,)."""
        distinct, which = distinct_intervals(intervals)
        columns = zip(*((i.low, i.high, i.open_low, i.open_high) for i in distinct), strict=True)
        ends = map(np.array, columns) if distinct else (*np.zeros((2, 0)), *np.zeros((2, 0), bool))
        return cls(*ends).take(which)

    def take(self, chosen: np.ndarray) -> "Ends":
        """The ends at indices, in their shape."""
        return Ends(*(end[chosen] for end in self))

    @property
    def are_none(self) -> bool:
        """True if no interval excludes a finite number."""
        return not (np.isfinite(self.low) | np.isfinite(self.high)).any()

    def admit(self, x: Any) -> Any:
        """True for values x (NumPy's or JAX', with the intervals' shape as trailing axes) that are finite and inside
        the intervals."""
        xp: Any = np if isinstance(x, np.ndarray) else jnp
        low, high = (xp.asarray(end, x.dtype) for end in (self.low, self.high))
        above = (x > low) | ((x == low) & ~self.open_low)
        below = (x < high) | ((x == high) & ~self.open_high)
        return above & below & xp.isfinite(x)


def constrained(z: Float[Array, "*n"], ends: Ends) -> Float[Array, "*n"]:
    """The values x inside their intervals at the free numbers z, whose trailing axes have the intervals' shape:

        x = low + exp(z),  x = high − exp(−z),  x = low + (high − low)·σ(z),  x = z

    for a lower, an upper, both and no bounds; σ is the logistic function. All increase with z."""
    has_low, has_high = np.isfinite(ends.low), np.isfinite(ends.high)
    low, high = (np.where(has, end, 0).astype(z.dtype) for has, end in ((has_low, ends.low), (has_high, ends.high)))
    # Half of the exponents that floating-point numbers have: beyond, values would be zero or infinite.
    most_z = 0.5 * float(np.log(np.finfo(z.dtype).max))
    distance = jnp.clip(z, -most_z, most_z)
    up, down = low + jnp.exp(distance), high - jnp.exp(-distance)
    part = (high - low) * jax.nn.sigmoid(jnp.where(z < 0, z, -z))  # from the nearer end: 1 − σ(40) has no digits
    between = jnp.where(z < 0, low + part, high - part)
    x = jnp.where(has_low & has_high, between, jnp.where(has_low, up, jnp.where(has_high, down, z)))
    # Rounding must not leave the bounds, nor the clip the gradient.
    least = np.where(ends.open_low, np.nextafter(low, high.dtype.type(np.inf)), np.where(has_low, low, -np.inf))
    most = np.where(ends.open_high, np.nextafter(high, low.dtype.type(-np.inf)), np.where(has_high, high, np.inf))
    inside = jnp.clip(x, jnp.asarray(least, z.dtype), jnp.asarray(most, z.dtype))
    return x + jax.lax.stop_gradient(inside - x)


def unconstrained(x: Float[Array, "*n"], ends: Ends) -> Float[Array, "*n"]:
    """The free numbers z at values x inside their intervals: the inverse of `constrained`. Infinite on an end; zero for
    an interval of one number."""
    is_point = ends.low == ends.high
    has_low, has_high = np.isfinite(ends.low) & ~is_point, np.isfinite(ends.high) & ~is_point
    # Where an end is missing, one stands for the distance from it, so that its logarithm adds nothing. Two logarithms,
    # not that of a ratio, which overflows next to an end.
    above = jnp.where(has_low, x - jnp.asarray(np.where(has_low, ends.low, 0), x.dtype), 1)
    below = jnp.where(has_high, jnp.asarray(np.where(has_high, ends.high, 0), x.dtype) - x, 1)
    bounded = jnp.log(above) - jnp.log(below)
    return jnp.where(has_low | has_high | is_point, bounded, x)
