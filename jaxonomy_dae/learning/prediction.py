"""Predictions of any variable, with bands."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..base.errors import ModelError, nearest
from .axes import AxesGiven, chosen_names, grid_of_axes
from .objective import Objective, Predicted
from .program import Conditions, predict_and_differentiate


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Variables by name at `ts`: `mean`, the standard deviation `spread` from the uncertainty of the estimate, and the
    band from `low` to `high`, each of shape `(n,)`. The noise of measurements is not included."""

    ts: Float[np.ndarray, " n"]
    mean: dict[str, np.ndarray]
    spread: dict[str, np.ndarray]
    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]

    @classmethod
    def of(
        cls, ts: np.ndarray, names: Sequence[str], mean: np.ndarray, spread: np.ndarray, factor: float
    ) -> "Prediction":
        """Variables of which mean and standard deviation are known, shape (n, names), with bands that go `factor`
        standard deviations to each side."""
        columns = mean, spread, mean - factor * spread, mean + factor * spread
        return cls(ts, *(dict(zip(names, column.T, strict=True)) for column in columns))

    def plot(self, names: str | Sequence[str] | None = None, *, axes: AxesGiven = None) -> np.ndarray:
        """Draws variables with their bands, one below the other; returns Matplotlib axes."""
        chosen = chosen_names(names, list(self.mean), "predictions of")
        axes = grid_of_axes(axes, len(chosen), 1, "a plot of predictions")
        for ax, name in zip(axes[:, 0], chosen, strict=True):
            ax.fill_between(self.ts, self.low[name], self.high[name], color="C0", alpha=0.3, linewidth=0)
            ax.plot(self.ts, self.mean[name], color="C0", linewidth=1.5)
            ax.set_ylabel(name)
            ax.grid(True, alpha=0.3)
        axes[-1, 0].set_xlabel("Time / s")
        return axes[:, 0]


def named(objective: Objective, names: str | Sequence[str], experiment: int | str) -> tuple[list[str], int]:
    """(names of variables and sensor laws, those of arrays by their entries; the place of an experiment)."""
    labels, plan = objective.stacked.labels, objective.system.plan
    k = labels.index(experiment) if experiment in labels else experiment
    if isinstance(k, bool) or not isinstance(k, int | np.integer) or not -len(labels) <= k < len(labels):
        raise ModelError(f"there is no experiment {experiment!r}: " + nearest(str(experiment), labels))
    chosen = [names] if isinstance(names, str) else names
    found = [n for name in chosen for n in ([name] if name in objective.observers else plan.entry_names([name]))]
    plan.resolve([name for name in found if name not in objective.observers])
    return found, int(k) % len(labels)


def under(
    objective: Objective, names: str | Sequence[str], ts: Any, experiment: int | str
) -> tuple[Objective, int, list[str], Conditions]:
    """(objective whose outputs are the variables named, the experiment's place, these names, its conditions)."""
    s = objective.stacked
    names, k = named(objective, names, experiment)
    times = s.times[k, : s.counts[k]] if ts is None else np.asarray(ts, float)
    # A comparison with NaN is false.
    if times.ndim != 1 or not len(times) or not (np.diff(times, prepend=s.t0[k]) >= 0).all() or np.isinf(times[-1]):
        raise ModelError(f"ts must be increasing times, of shape (n,), that start at {s.t0[k]:g} or later")
    layout = dataclasses.replace(objective.layout, outputs=tuple(names), mesh=None, lengths=())
    system, observers = objective.system, objective.observers
    one = Objective(
        system, observers, layout, objective.fine, s, objective.coordinates, {}, counted=objective.counted
    )  # fmt: skip
    conditions = jax.tree.map(lambda a: a[k][None], one.conditions)
    conditions = dataclasses.replace(conditions, times=jnp.asarray(times[None], conditions.times.dtype))
    return one, k, names, conditions


def prediction(
    objective: Objective, point: Float[np.ndarray, " p"], root: Float[np.ndarray, "p r"], names: str | Sequence[str],
    ts: Any, experiment: int | str, factor: float,
) -> Prediction:  # fmt: skip
    """Predictions under the conditions of an experiment, linearized around a point with the covariance `root`·rootᵀ."""
    one, k, names, conditions = under(objective, names, ts, experiment)
    c, times = one.coordinates, np.asarray(conditions.times[0], np.float64)
    shared, own = one.numbers(c.natural(point))
    found = predict_and_differentiate(one.setting, one.predictor, shared, own[k][None], conditions)
    alone = Predicted(*(np.asarray(part.values, np.float64) for part in found))
    n, j = len(times), len(names)
    rows = tuple(a.ravel() for a in np.meshgrid([0], np.arange(n), np.arange(j), indexing="ij"))
    place = c.n_shared + k * c.n_own
    columns = np.concatenate([np.arange(c.n_shared), place + np.arange(c.n_own)])
    spread = np.linalg.norm(alone.jacobian(rows) @ c.moved(point, root)[columns], axis=1).reshape(n, j)
    return Prediction.of(times, names, alone.outputs[0], spread, factor)


def at_samples(
    objective: Objective, point: Float[np.ndarray, " p"], root: Float[np.ndarray, "p r"]
) -> tuple[Float[np.ndarray, "e n k"], Float[np.ndarray, "e n k"]]:
    """All outputs at the samples' times, by the program of the fit, and their standard deviations."""
    c, found = objective.coordinates, objective.predicted(point)
    moves = c.moved(point, root)
    shared, own = moves[: c.n_shared], moves[c.n_shared :].reshape(c.experiments, c.n_own, root.shape[1])
    along = found.by_shared @ shared + np.einsum("enko,eor->enkr", found.by_own, own)
    return found.outputs, np.linalg.norm(along, axis=-1)
