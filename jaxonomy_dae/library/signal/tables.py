"""Tables as functions of signals; the values in them are arrays of the system, and trainable."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.interpolate import RegularGridInterpolator
from jax.typing import DTypeLike
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from sympy import floor

from ...base.errors import ModelError
from ...write import Component, Eq, EqnEnv
from ..arguments import finite, increasing, yes_or_no
from ..interpolation import known_kind


class _Grid:
    """Increasing points: constants of a model, not arrays of a system, which are trained."""

    def __init__(self, points: np.ndarray):
        self.points = np.asarray(points, float)
        self._bytes = self.points.tobytes()  # which know their hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Grid) and self._bytes == other._bytes

    def __hash__(self) -> int:
        return hash(self._bytes)

    def __len__(self) -> int:
        return len(self.points)

    def array(self, dtype: DTypeLike) -> Array:
        """The points as an array of JAX."""
        return jnp.asarray(self.points, dtype)


class _Curve(eqx.Module):
    """Values at grid points, interpolated anew where they are trained."""

    x: _Grid = eqx.field(static=True)
    y: Float[Array, " n"]
    kind: str = eqx.field(static=True)

    def __call__(self, u):
        x = self.x.array(self.y.dtype)
        if self.kind == "linear":
            return diffrax.LinearInterpolation(x, self.y).evaluate(u)
        return diffrax.CubicInterpolation(x, diffrax.backward_hermite_coefficients(x, self.y)).evaluate(u)


class _Place(eqx.Module):
    """The number of the piece that a point is on, and how far along it is: increasing, whole at the grid points."""

    x: _Grid = eqx.field(static=True)

    def __call__(self, u):
        x = self.x.array(u.dtype)
        # Pieces are numbered by interpolation, whose kinks are at the points: `floor` of it changes there.
        return jnp.interp(u, x, jnp.arange(len(self.x), dtype=u.dtype), left="extrapolate", right="extrapolate")


class _Piece(eqx.Module):
    """A line through two neighbouring points, by the number of the first."""

    x: _Grid = eqx.field(static=True)
    y: Float[Array, " n"]

    def __call__(self, u, piece):
        # The piece is held between events, so that stages of a step that pass a point go on along one line.
        k = jnp.clip(piece, 0, len(self.x) - 2).astype(int)
        x = self.x.array(self.y.dtype)
        return self.y[k] + (self.y[k + 1] - self.y[k]) / (x[k + 1] - x[k]) * (u - x[k])


class _Surface(eqx.Module):
    x: _Grid = eqx.field(static=True)
    y: _Grid = eqx.field(static=True)
    z: Float[Array, "n m"]

    def __call__(self, u1, u2):
        grid = self.x.array(self.z.dtype), self.y.array(self.z.dtype)
        beyond: Any = None  # the last piece goes on
        table: Callable[[Any], Any] = RegularGridInterpolator(grid, self.z, bounds_error=False, fill_value=beyond)
        return table(jnp.stack([u1, u2])[None])[0]


class Table1D(Component):
    """y = f(u), interpolated between the points (x, y).

    **Arguments:**

    - `x`: increasing, shape (n,), n ≥ 2. `values`: shape (n,).
    - `kind`: 'linear', or 'cubic': Hermite splines with backward differences, once differentiable (Morrill et al. 2022,
        arXiv:2106.11028). Outside of the points the last piece goes on.
    - `events`: whether steps end where `u` passes a point of a linear table: the solver then sees one line at a time.
        Worth it for tables of time and where points are far apart. Without, a run is off by what step sizes leave of
        each kink: some tens of tolerances, hundreds in the worst cases.

    **Raises:**

    - `ModelError` if the points are not increasing, not finite, or their numbers disagree, or if events are asked for
        of a cubic table, which has no kinks.
    """

    def __init__(
        self, ev: EqnEnv, name: str, x: ArrayLike, values: ArrayLike, kind: str = "linear", events: bool = False
    ):
        super().__init__(ev, name)
        points, found = increasing(x, name, "x"), finite(values, name, "values")
        if found.shape != points.shape:
            raise ModelError(f"'{name}': values has shape {found.shape}, x has {points.shape}: they must agree")
        known_kind(kind, name)
        u, grid, y = self.input("u"), _Grid(points), jnp.asarray(found, float)
        if not yes_or_no(events, name, "events"):
            (value,) = self.function("table", _Curve(grid, y, kind), inputs=[u])
        elif kind == "linear":
            # The whole part of the place is what is an event: two guards, however many points there are.
            (place,) = self.function("place", _Place(grid), inputs=[u])
            piece = self.variable("piece", unit="1")
            self.add_equations(Eq(piece, floor(place)))
            (value,) = self.function("table", _Piece(grid, y), inputs=[u, piece])
        else:
            raise ModelError(f"'{name}': a cubic table has no kinks that could be events: leave events=True out")
        self.output("y", value)


class Table2D(Component):
    """y = f(u1, u2), bilinear between the points of a grid; outside of it the last piece goes on.

    **Arguments:**

    - `x`, `y`: increasing, shapes (n,) and (m,). `values`: shape (n, m).

    **Raises:**

    - `ModelError` if the points are not increasing, not finite, or shapes disagree.
    """

    def __init__(self, ev: EqnEnv, name: str, x: ArrayLike, y: ArrayLike, values: ArrayLike):
        super().__init__(ev, name)
        first, second = increasing(x, name, "x"), increasing(y, name, "y")
        found = finite(values, name, "values")
        if found.shape != (len(first), len(second)):
            raise ModelError(f"'{name}': values has shape {found.shape}; x and y ask for {(len(first), len(second))}")
        surface = _Surface(_Grid(first), _Grid(second), jnp.asarray(found, float))
        (value,) = self.function("table", surface, inputs=[self.input("u1"), self.input("u2")])
        self.output("y", value)
