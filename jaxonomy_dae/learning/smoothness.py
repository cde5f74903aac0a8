"""Smoothness of learned laws: a prior in the space of functions, for what the data leave open.

Weights of which the data say the same may say different laws, and a prior on weights leaves the choice among them to
the weights that the search began with. A prior on the law itself does not. At points u that the experiments explored,
and along directions d as long as half of what they explored, it takes the second and third derivatives of an output f,

    h = ∂ᵏ f(u + τ d)/∂τᵏ at τ = 0,    k = 2, 3,

as normal around zero, with a precision for each output and order that the evidence chooses (`evidence.py`). Constant
and linear laws cost nothing; what bends smoothly costs little by the third derivatives, and a kink little by the
second: a smoothing spline of either order (Wahba 1990, "Spline Models for Observational Data"), for networks of any
number of inputs.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..compile.model.opaque import OpaqueFunction
from ..host.cache import compiled
from .coordinates import Coordinates
from .program import with_weights

ORDERS = (2, 3)  # of derivatives: those of a piecewise linear law, and of a parabola, cost nothing or little
POINTS = 48  # at which derivatives are taken: the law of a smoothing spline changes by less than its band beyond thirty


class Law(NamedTuple):
    """A network in the equations, and where its derivatives are taken."""

    module: Any
    opaque: OpaqueFunction
    columns: Int[np.ndarray, " w"]  # of its trained weights among all coordinates
    points: Float[np.ndarray, "n inputs"]
    size: Float[np.ndarray, " inputs"]  # half of the explored range


@dataclasses.dataclass(frozen=True, eq=False)
class Bends:
    """The derivatives h of some laws as functions of all coordinates, row by row.

    - `coordinates`, `free`: all coordinates, and which of them are searched.
    - `group`: the group of each row, of which each has a precision; `owner`: the law of each group.
    """

    laws: tuple[Law, ...]
    coordinates: Coordinates
    free: Int[np.ndarray, " f"]
    group: Int[np.ndarray, " r"]
    owner: Int[np.ndarray, " g"]
    last: dict[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, laws: tuple[Law, ...], coordinates: Coordinates, free: Int[np.ndarray, " f"]) -> "Bends":
        """The derivatives of these laws."""
        counts = [len(law.points) * len(directions(len(law.size))) for law in laws]
        outputs = [_outputs(law) for law in laws]
        owner = np.repeat(np.arange(len(laws)), [n * len(ORDERS) for n in outputs])
        group = np.repeat(np.arange(len(owner)), [counts[k] for k in owner])
        return cls(laws, coordinates, free, group, owner)

    def at(self, z: Float[np.ndarray, " f"]) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r f"]]:
        """(h, its derivatives by the free coordinates), each divided by the root of the number of its group's rows."""
        if self.last and np.array_equal(self.last["z"], z):
            return self.last["found"]
        full = self.coordinates.z_start
        full[self.free] = z
        natural = self.coordinates.natural(full)
        values, slopes = [], []
        for law in self.laws:
            dtype = jnp.asarray(law.points).dtype
            given = (jnp.asarray(a, dtype) for a in (natural[law.columns], law.points, law.size))
            found, slope = (np.asarray(a, np.float64) for a in _bends(law.module, law.opaque, *given))
            wide = np.zeros((*slope.shape[:-1], len(full)))
            wide[..., law.columns] = slope
            wide = self.coordinates.pulled(full, wide)
            root = np.sqrt(np.prod(found.shape[:-2]))
            rows = np.moveaxis(found, (-2, -1), (0, 1)).reshape(-1)  # by output, then order
            values.append(rows / root)
            slopes.append(np.moveaxis(wide, (-3, -2), (0, 1)).reshape(len(rows), -1)[:, self.free] / root)
        found = np.concatenate(values), np.concatenate(slopes)
        self.last.update(z=np.array(z), found=found)
        return found

    def first(self, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, " g"]:
        """Precisions to begin with: so weak that derivatives as large as those at a point cost next to nothing."""
        squares = np.bincount(self.group, self.at(z)[0] ** 2, len(self.owner))
        return 1 / np.where(squares > 0, squares, 1.0)


def directions(inputs: int) -> Float[np.ndarray, "d inputs"]:
    """Unit vectors along which derivatives are taken: axes, and diagonals between neighbours, so that mixed derivatives
    of these count too."""
    axes = np.eye(inputs)
    if inputs == 1:
        return axes
    diagonals = (axes + np.roll(axes, -1, axis=0)) / np.sqrt(2)
    if inputs == 2:
        diagonals[1] = (axes[0] - axes[1]) / np.sqrt(2)
    return np.concatenate([axes, diagonals])


def spread_out(seen: Float[np.ndarray, "m inputs"], count: int = POINTS) -> Float[np.ndarray, "n inputs"]:
    """Up to `count` of the points seen, each as far from those chosen before as can be (Gonzalez 1985), with each input
    in units of its range."""
    scaled = (seen - seen.min(axis=0)) / np.where(np.ptp(seen, axis=0) > 0, np.ptp(seen, axis=0), 1.0)
    chosen = [int(np.argmin(scaled.sum(axis=1)))]
    distance = np.linalg.norm(scaled - scaled[chosen[0]], axis=1)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(scaled - scaled[chosen[-1]], axis=1))
    return seen[chosen]


def _call(law_module: Any, opaque: OpaqueFunction, u: Any) -> Any:
    times = [u[j] for j in opaque.time_positions]
    return jnp.ravel(opaque(law_module, times[0] if times else jnp.zeros((), u.dtype), u))


def _outputs(law: Law) -> int:
    u = jax.ShapeDtypeStruct((law.points.shape[1],), jnp.asarray(law.points).dtype)
    return jax.eval_shape(lambda u: _call(law.module, law.opaque, u), u).shape[0]


@compiled
def _bends(
    module: Any, opaque: OpaqueFunction, flat: Float[Array, " w"], points: Any, size: Any
) -> tuple[Float[Array, "n d outputs orders"], Float[Array, "n d outputs orders w"]]:
    """Derivatives of each order at each point and along each direction, and their derivatives by the weights."""

    def one(flat, u, d):
        def f(tau):
            return _call(with_weights(module, flat), opaque, u + tau * d)

        def next_order(g):
            return lambda tau: jax.jvp(g, (tau,), (jnp.ones_like(tau),))[1]

        found, g, tau = [], f, jnp.zeros((), u.dtype)
        for order in range(1, max(ORDERS) + 1):
            g = next_order(g)
            if order in ORDERS:
                found.append(g(tau))
        h = jnp.stack(found, axis=-1)
        return h, h

    along = jnp.asarray(directions(len(size)), points.dtype) * size
    # Backwards, because there are more weights than derivatives.
    each = jax.vmap(jax.jacrev(one, has_aux=True), in_axes=(None, None, 0))
    slope, value = jax.vmap(each, in_axes=(None, 0, None))(flat, points, along)
    return value, slope
