"""How predictions answer to a learned law that changes as a function, whatever its weights can do.

The network of a law is changed by

    δ(u) = Σₖ hₖ k((u − c)/s, xₖ),

with the kernel k of a process (`process.py`), places xₖ, and inputs of centre c and half range s. Answers are the
derivatives of predictions by the heights h at h = 0, forwards, through the same runs as a fit takes.
"""

import dataclasses
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from ..base.aliases import PyTree
from ..host.cache import compiled
from .laws.properties import Property, raw
from .process import Kernel
from .program import AbstractPredictor, Outputs, Own, Setting, Shared, predict_and_differentiate

if TYPE_CHECKING:
    from .estimate import Estimate

NEAR = 1e-6  # half ranges, to which distances are rounded off: at zero, their slope would be 0/0


class Bumps(eqx.Module):
    """Where the inputs of a law have their centre and half range, the places of the heights, and a², b², ℓ of the
    kernel."""

    centre: Float[Array, " d"]
    spread: Float[Array, " d"]
    places: Float[Array, "k d"]
    kernel: Float[Array, "3"]

    @classmethod
    def of(cls, centre: Any, spread: Any, places: Any, kernel: Kernel, dtype: Any) -> "Bumps":
        """Bumps of a kernel at some places, in half ranges from the centre."""
        numbers = np.array([kernel.size**2, kernel.trend**2, kernel.length])
        return cls(*(jnp.asarray(a, dtype) for a in (centre, spread, places, numbers)))

    def at(self, u: Float[Array, " d"]) -> Float[Array, " k"]:
        """k((u − c)/s, xₖ) of each place."""
        x, (a, b, length) = (u - self.centre) / self.spread, self.kernel
        d = jnp.sqrt(3 * jnp.sum((x - self.places) ** 2, axis=1) + NEAR**2) / length
        return a * (1 + d) * jnp.exp(-d) + b * (1 + self.places @ x)


class Changed(eqx.Module):
    """A network with δ of each output added."""

    network: Any
    bumps: Bumps
    heights: Float[Array, "o k"]

    def __call__(self, u: Float[Array, " d"]) -> Float[Array, " o"]:
        found = self.network(u)
        delta = self.heights @ self.bumps.at(jnp.ravel(u))
        return found + delta.reshape(jnp.shape(found)).astype(found.dtype)


def changed(module: Any, bumps: Bumps, heights: Float[Array, " h"]) -> Any:
    """The law of a module whose raw network is changed: a property that it has, it keeps."""
    network = Changed(raw(module), bumps, heights.reshape(-1, len(bumps.places)))
    return eqx.tree_at(lambda m: m.network, module, network) if isinstance(module, Property) else network


class WithHeights(AbstractPredictor):
    """Predictions as a function of the heights of one law. All other numbers that experiments share are `rest`."""

    inner: AbstractPredictor
    name: str = eqx.field(static=True)
    bumps: Bumps
    rest: Shared

    def __call__(self, setting: Setting, shared: Shared, own: Own, told: PyTree) -> Outputs:
        module = changed(setting.system.neural[self.name], self.bumps, shared)
        system = eqx.tree_at(lambda s: s.neural[self.name], setting.system, module)
        return self.inner(setting._replace(system=system), self.rest, own, told)


def answers(estimate: "Estimate", name: str, bumps: Bumps, kernel: Kernel, outputs: int) -> Float[np.ndarray, "m h"]:
    """The derivatives of residuals by the law's values at the places, by output and then by place. Between places the
    law changes as the kernel of the bumps interpolates."""
    o = estimate.objective
    shared, own = o.numbers(o.coordinates.natural(estimate.point))
    rest = shared[len(shared) - len(o.layout.shared) - len(o.layout.extra) :]
    layout = dataclasses.replace(o.layout, parameters=(), modules=())
    setting = o.setting._replace(system=estimate.system, observers=estimate.observers, layout=layout)
    heights = jnp.zeros(outputs * len(bumps.places), shared.dtype)
    _, found, _ = predict_and_differentiate(setting, WithHeights(o.predictor, name, bumps, rest), heights, own, o.told)
    columns = np.asarray(found.values, np.float64)[o.rows]
    if o.rho.any():
        columns = o.colour.whitened(columns)
    root = kernel.root(np.asarray(bumps.places, float))
    by_place = columns.reshape(-1, len(root)).T
    return scipy.linalg.cho_solve((root, True), by_place).T.reshape(columns.shape)


@compiled
def slopes_by_heights(
    module: Any, law: Any, bumps: Bumps, heights: Float[Array, " h"], points: Any
) -> Float[Array, "n h"]:
    """The derivatives of a law at n points by heights."""

    def value(heights, u):
        return jnp.asarray(law(changed(module, bumps, heights), u)).reshape(())

    return jax.vmap(jax.grad(value), in_axes=(None, 0))(heights, points)
