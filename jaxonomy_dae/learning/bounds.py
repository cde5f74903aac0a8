"""Training inside bounds.

Each trained parameter has an `Interval`. Gradient steps are projected onto it. Least squares, which knows no bounds,
works in unbounded coordinates z instead: x(z) is smooth, close to x = z + constant well inside, and has the bounds as
its range (closed ends as in MINUIT, James & Roos 1975; open ends by hyperbolas that approach them).
"""

import dataclasses
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..modeling.interval import Interval, closed_ends

KEPT = 0.1  # of the distance to an open end, at least, after one update
INSIDE = 1e-4  # how far a start on a closed end is moved inside, relative to its scale: x(z) is stationary on the end


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
        limit = jnp.where(opened, bound + jnp.asarray(KEPT, new.dtype) * (old - jnp.where(opened, bound, old)), bound)
        new = jnp.maximum(new, limit) if sign < 0 else jnp.minimum(new, limit)
    return new


@dataclasses.dataclass(frozen=True)
class _Coordinate:
    """One parameter's x(z); z is measured in the unit of x."""

    interval: Interval
    scale: float

    def value(self, z):
        i, s = self.interval, self.scale
        low, high = math.isfinite(i.low), math.isfinite(i.high)
        if not (low or high):
            return z
        if low and high:
            middle, half = 0.5 * (i.low + i.high), 0.5 * (i.high - i.low)
            if i.low == i.high:
                return 0 * z + i.low
            u = z / half
            if i.open_low or i.open_high:
                return middle + half * u / jnp.sqrt(1 + u * u)
            return middle + half * jnp.sin(u)
        if high:
            z = -z
        if i.open_low or i.open_high:
            wide = jnp.sqrt(z * z + 4 * s * s) + jnp.where(z > 0, z, -z)
            distance = jnp.where(z > 0, wide / 2, 2 * s * s / wide)
        else:
            distance = jnp.sqrt(z * z + s * s) - s
        return i.low + distance if low else i.high - distance

    def start(self, x: float) -> float:
        """z for which x(z) = x, or a point just inside for an x on a closed end."""
        i, s = self.interval, self.scale
        low, high = math.isfinite(i.low), math.isfinite(i.high)
        if not (low or high) or i.low == i.high:
            return x
        if low and high:
            half = 0.5 * (i.high - i.low)
            u = (x - 0.5 * (i.low + i.high)) / half
            u = min(max(u, INSIDE - 1), 1 - INSIDE) if not (i.open_low or i.open_high) else u
            return half * (u / math.sqrt((1 - u) * (1 + u)) if i.open_low or i.open_high else math.asin(u))
        distance = x - i.low if low else i.high - x
        if i.open_low or i.open_high:
            z = distance - s * s / distance
        else:
            distance = max(distance, INSIDE * s)
            z = math.sqrt(distance * (distance + 2 * s))
        return z if low else -z


class Unbounded:
    """Unbounded coordinates for the parameters x, shape (k,)."""

    def __init__(self, x: Float[Array, " k"], intervals: Sequence[Interval]):
        values = np.asarray(x, np.float64)
        ends = [i.low if math.isfinite(i.low) else i.high for i in intervals]
        scales = [abs(v - e) or abs(v) or 1.0 if math.isfinite(e) else 1.0 for v, e in zip(values, ends, strict=True)]
        self._coordinates = [_Coordinate(i, float(s)) for i, s in zip(intervals, scales, strict=True)]
        self._ends = closed_ends(intervals)
        starts = [c.start(float(v)) for c, v in zip(self._coordinates, values, strict=True)]
        self.start: Float[Array, " k"] = jnp.asarray(starts, x.dtype)

    def values(self, z: Float[Array, " k"]) -> Float[Array, " k"]:
        """The parameters at z, inside their bounds."""
        if not self._coordinates:
            return z
        x = jnp.stack([c.value(z[k]) for k, c in enumerate(self._coordinates)]).astype(z.dtype)
        low, high = (jnp.asarray(end, z.dtype) for end in self._ends.T)
        return x + jax.lax.stop_gradient(jnp.clip(x, low, high) - x)  # rounding must not leave the bounds
