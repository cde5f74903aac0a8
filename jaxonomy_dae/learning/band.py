"""A learned law with its spread, and where the data explored it."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from ..base.errors import ModelError, nearest
from ..base.optional import Axes, new_axes
from ..compile.model.opaque import OpaqueFunction
from ..host.cache import compiled
from .blocks import block_of
from .program import weights_of, with_weights
from .runs import run

if TYPE_CHECKING:
    from .estimate import Estimate


@dataclasses.dataclass(frozen=True)
class Band:
    """A law at the points of a `grid`: `mean`, the standard deviation `spread`, the band from `low` to `high`, shape
    `(n,)`; `explored`: the range of values in the experiments for each input, shape `(inputs, 2)`; `between`: in an
    ensemble, the standard deviation of its members, which is a part of the `spread`."""

    grid: Float[np.ndarray, " n *inputs"]
    mean: Float[np.ndarray, " n"]
    spread: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    explored: Float[np.ndarray, "inputs 2"]
    between: Float[np.ndarray, " n"] | None = None

    @property
    def inside(self) -> np.ndarray:
        """True for grid points within the explored region, shape `(n,)`."""
        points = self.grid.reshape(len(self.grid), -1)
        return np.all((points >= self.explored[:, 0]) & (points <= self.explored[:, 1]), axis=1)

    def plot(
        self,
        ax: Axes | None = None,
        *,
        truth: ArrayLike | Sequence[float] | Callable[[np.ndarray], ArrayLike] | None = None,
        label: str = "learned",
    ) -> Axes:
        """Draws the law with its band and the region explored; returns Matplotlib axes.

        - `truth`: the true law, if it is known: a function of the grid, or values, shape `(n,)`.
        """
        ax = new_axes(ax)
        points = self.grid.reshape(len(self.grid), -1)
        moving = [k for k in range(points.shape[1]) if np.ptp(points[:, k]) > 0]
        if len(moving) > 1:
            raise ModelError(f"a band is drawn along one input; this grid moves {len(moving)} of them")
        column = moving[0] if moving else 0
        x = points[:, column]
        if len(self.explored):
            low, high = self.explored[min(column, len(self.explored) - 1)]
            ax.axvspan(low, high, color="C2", alpha=0.12, linewidth=0, label="explored")
        ax.fill_between(x, self.low, self.high, color="C0", alpha=0.3, linewidth=0)
        ax.plot(x, self.mean, color="C0", linewidth=1.6, label=label)
        if truth is not None:
            values = truth(self.grid) if callable(truth) else truth
            ax.plot(x, np.asarray(values, float), "--", color="C3", linewidth=1.4, label="true")
        inside = self.inside if len(self.explored) else np.ones(len(x), bool)
        if inside.any():  # a band that is wide elsewhere would leave nothing to be seen
            low, high = self.low[inside].min(), self.high[inside].max()
            room = max(high - low, np.ptp(self.mean)) * 0.4 or 1.0
            ax.set_ylim(min(low, self.mean.min()) - room, max(high, self.mean.max()) + room)
        ax.set_xlabel("Input")
        ax.set_ylabel("Output")
        ax.grid(True, alpha=0.3)
        ax.legend()
        return ax


def band(
    estimate: "Estimate", name: str, grid: Any, law: Callable | None, along: Any, factor: float
) -> Band:  # fmt: skip
    """The band of a network's or sensor law's values: linearized around its weights, and of raw networks as functions
    (`law_process.py`)."""
    objective = estimate.objective
    module, law, points = law_of(estimate, name, grid, law)
    flat = jnp.concatenate([jnp.ravel(leaf).astype(points.dtype) for leaf in weights_of(module)])
    mean, slope = (np.asarray(a, float) for a in _law_and_slope(module, law, flat, points))
    c = objective.coordinates
    columns = np.array([g == name for g in c.group]) & c.is_weight
    variance = np.sum((slope @ c.moved(estimate.point, estimate.root)[columns]) ** 2, axis=1)
    # The middle is the network's. With the squared distance of the models' means added, bands of gaps covered one per
    # cent more than without, beyond the 95 that they state.
    process = estimate.law_process(name)
    if process is not None:
        variance += process.share * (process.variance(module, law, points, np.asarray(grid, float)) - variance)
    spread = np.sqrt(variance)
    ends = explored(estimate, name, along)
    return Band(np.asarray(grid, float), mean, spread, mean - factor * spread, mean + factor * spread, ends)


def law_of(estimate: "Estimate", name: str, grid: Any, law: Callable | None) -> tuple[Any, Callable, Any]:
    """(module, law of it at one point, points) of a network or sensor law that was trained."""
    objective = estimate.objective
    if name not in objective.layout.modules:
        raise ModelError(f"'{name}' was not trained: " + nearest(name, objective.layout.modules))
    module = estimate.system.neural[name] if name in estimate.system.neural else estimate.observers[name]
    points = np.asarray(grid, float)
    block = block_of(estimate.system.plan, name)
    if not points.ndim:
        raise ModelError(f"a grid has shape (n,) or (n, inputs); got one number, {points:g}")
    if law is None:
        law = _first_output if block is None else _FirstOutput(block.opaque)
        if block is not None:
            count = block.opaque.n_inputs
            points = points[:, None] if points.ndim == count == 1 else points
            if points.shape[1:] != (count,):
                raise ModelError(
                    f"'{name}' has {count} inputs, {', '.join(block.inputs[0])}: the grid is of shape (n, {count}); "
                    f"got {points.shape}. For another quantity give law=, a function of the network and of a grid point"
                )
    return module, law, jnp.asarray(points, objective.system.parameters.values.dtype)


def _first_output(network: Any, u: Any) -> Any:
    return jnp.ravel(network(u))[0]


@dataclasses.dataclass(frozen=True)
class _FirstOutput:
    """The law of a network's first output, called as the equations call the network."""

    opaque: OpaqueFunction

    def __call__(self, weights: Any, u: Any) -> Any:
        times = [u[j] for j in self.opaque.time_positions]
        return self.opaque(weights, times[0] if times else jnp.zeros((), u.dtype), u)[0]


@compiled
def _law_and_slope(module: Any, law: Callable, flat: Any, points: Any) -> tuple[Any, Any]:
    """The law at each point, shape (n,), and its derivatives by the weights, shape (n, weights)."""

    def value(flat, u):
        return jnp.asarray(law(with_weights(module, flat), u)).reshape(())

    return jax.vmap(jax.value_and_grad(value), in_axes=(None, 0))(flat, points)


@compiled
def law_values(module: Any, law: Callable, flat: Any, points: Any) -> Any:
    """The law at each of n points for each of d sets of weights, shape (d, n)."""

    def value(flat, u):
        return jnp.asarray(law(with_weights(module, flat), u)).reshape(())

    return jax.vmap(lambda flat: jax.vmap(value, in_axes=(None, 0))(flat, points))(flat)


def explored(estimate: "Estimate", name: str, along: Any) -> np.ndarray:
    """The least and the greatest of each input of a law over the experiments that were fitted."""
    block = block_of(estimate.system.plan, name)
    if along is None:
        if block is None:
            return np.zeros((0, 2))
        seen = estimate.objective.seen(estimate.point)[name]
    else:
        runs = (run(estimate.objective, estimate.point, int(k)) for k in np.flatnonzero(estimate.objective.counted))
        columns = [np.asarray(run[along] if isinstance(along, str) else along(run), float) for run in runs]
        seen = np.concatenate(columns)[:, None]
    return np.stack([seen.min(axis=0), seen.max(axis=0)], axis=1)
