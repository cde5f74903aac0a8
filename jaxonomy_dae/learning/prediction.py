"""Predictions of any variable, with bands."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import ModelError, nearest
from .figures import plot_prediction
from .objective import Objective, Predicted
from .program import Conditions, predict_and_differentiate

if TYPE_CHECKING:
    from .estimate import Estimate


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Variables by name at `ts`: `mean`, the standard deviation `spread` that the estimate's uncertainty makes, and the
    band from `low` to `high`, each of shape `(n,)`. The noise of measurements comes on top."""

    ts: Float[np.ndarray, " n"]
    mean: dict[str, np.ndarray]
    spread: dict[str, np.ndarray]
    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]

    def plot(self, names: str | Sequence[str] | None = None, *, axes: Any = None) -> Any:
        """Draws variables with their bands, one below the other; returns Matplotlib axes."""
        return plot_prediction(self, names, axes)


def under(
    estimate: "Estimate", names: list[str], ts: Any, experiment: int | str
) -> tuple[Objective, int, list[str], Conditions]:
    """(objective whose outputs are the variables named, the experiment's place, these names, its conditions)."""
    objective = estimate.objective
    s, plan = objective.stacked, objective.system.plan
    k = s.labels.index(experiment) if experiment in s.labels else experiment
    if not isinstance(k, int) or not -len(s.labels) <= k < len(s.labels):
        raise ModelError(f"there is no experiment {experiment!r}: " + nearest(str(experiment), s.labels))
    names = [n for name in names for n in ([name] if name in objective.observers else plan.entry_names([name]))]
    for name in names:
        if name not in objective.observers:
            plan.resolve([name])
    times = s.times[k, : s.counts[k]] if ts is None else np.asarray(ts, float)
    if times.ndim != 1 or not len(times) or (np.diff(times) < 0).any() or times[0] < s.t0[k] or times[-1] <= s.t0[k]:
        raise ModelError(f"ts must be increasing times, of shape (n,), that start at {s.t0[k]:g} or later")
    layout = dataclasses.replace(objective.layout, outputs=tuple(names), mesh=None)
    one = Objective(
        objective.system, objective.observers, layout,
        s, objective.coordinates, {}, objective.counted,
    )  # fmt: skip
    conditions = jax.tree.map(lambda a: a[k][None], one.conditions)
    conditions = dataclasses.replace(conditions, times=jnp.asarray(times[None], conditions.times.dtype))
    return one, k % len(s.labels), names, conditions


def prediction(estimate: "Estimate", names: list[str], ts: Any, experiment: int | str, factor: float) -> Prediction:
    """Predictions under the conditions of an experiment, linearized around the estimate."""
    one, k, names, conditions = under(estimate, names, ts, experiment)
    c, times = one.coordinates, np.asarray(conditions.times[0], np.float64)
    shared, own = one.numbers(c.natural(estimate.point))
    found = predict_and_differentiate(one.system, one.observers, one.layout, shared, own[k][None], conditions)
    alone = Predicted(*(np.asarray(a, np.float64) for a in found))
    n, j = len(times), len(names)
    rows = tuple(a.ravel() for a in np.meshgrid([0], np.arange(n), np.arange(j), indexing="ij"))
    place = c.n_shared + k * c.n_own
    columns = np.concatenate([np.arange(c.n_shared), place + np.arange(c.n_own)])
    slope = alone.jacobian(rows) * c.slope(estimate.point)[columns]
    spread = np.linalg.norm(slope @ estimate.root[columns], axis=1).reshape(n, j)
    mean = alone.outputs[0]
    by = [dict(zip(names, a.T, strict=True)) for a in (mean, spread, mean - factor * spread, mean + factor * spread)]
    return Prediction(times, *by)


def at_samples(estimate: "Estimate") -> tuple[Float[np.ndarray, "e n k"], Float[np.ndarray, "e n k"]]:
    """All outputs at the samples' times, by the program of the fit, and their standard deviations."""
    c, found = estimate.objective.coordinates, estimate.objective.predicted(estimate.point)
    scale = c.slope(estimate.point)
    shared = scale[: c.n_shared, None] * estimate.root[: c.n_shared]
    own = scale[c.n_shared :, None] * estimate.root[c.n_shared :]
    own = own.reshape(c.experiments, c.n_own, estimate.root.shape[1])
    moves = found.by_shared @ shared + np.einsum("enko,eor->enkr", found.by_own, own)
    return found.outputs, np.linalg.norm(moves, axis=-1)
