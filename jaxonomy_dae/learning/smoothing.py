"""What samples tell of states: filtered, smoothed, and predicted some steps ahead."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from ..base.errors import ModelError, whole_number
from .filter_data import Told
from .filter_program import Ahead, Track, go_on, read_states
from .objective import Objective
from .prediction import Prediction, named
from .program import Owns, Shared

SINGULAR = 1e-12  # eigenvalues of a scaled covariance, relative to the largest, that count as none


def followed(
    objective: Objective, point: Float[np.ndarray, " p"], names: str | Sequence[str], experiment: int | str, how: str,
    steps: int, factor: float,
) -> Prediction:  # fmt: skip
    """Variables of an experiment: `"filtered"`, `"smoothed"` or `"ahead"` by a number of steps."""
    ahead = objective.predictor
    if not isinstance(ahead, Ahead) or not (ahead.has_variances or how == "ahead"):
        needed = "learning.Filter" if how != "ahead" else "learning.Filter or learning.Innovations"
        raise ModelError(f"{how} variables are those of Problem(method={needed}(...))")
    s = objective.stacked
    names, k = named(objective, names, experiment)
    count = s.counts[k]
    steps = whole_number(steps, "steps")
    if steps > count:
        raise ModelError(f"steps is a whole number from 1 to the {count} samples of this experiment; got {steps!r}")
    found = jax.tree.map(lambda a: a[k, :count], objective.predictions(point))
    first = 0
    if how == "filtered":
        x, p, q = found.after, found.p_after, found.discrete
    elif how == "smoothed":
        x, p = smooth(found, len(objective.system.plan.states))
        q = found.discrete
    elif steps == 1:
        x, p, q = found.before, found.p_before, found.discrete
    else:
        x, p, q = _further(objective, ahead, point, k, found, steps)
        first = steps
    mean, spread = _read(objective, names, _numbers(objective, point, k, slice(first, count)), (x, p, q))
    times = s.times[k, :count]
    if first:  # nothing was predicted so far ahead of the first ones
        missing = np.full((first, len(names)), np.nan)
        mean, spread = np.concatenate([missing, mean]), np.concatenate([missing, spread])
    if not ahead.has_variances:
        spread = np.full_like(spread, np.nan)
    return Prediction.of(times, names, mean, spread, factor)


def smooth(found: Track, f: int) -> tuple[Float[np.ndarray, "n x"], Float[np.ndarray, "n f f"]]:
    """States and covariances from all samples, those after each time too (Rauch, Tung & Striebel 1965, AIAA J. 3:1445),
    of one experiment with f differential states."""
    before, p_before, after, p_after, flow = (
        np.asarray(a, np.float64) for a in (found.before, found.p_before, found.after, found.p_after, found.flow)
    )
    x, p = np.array(after), np.array(p_after)
    for t in range(len(x) - 2, -1, -1):
        gain = p_after[t] @ flow[t + 1].T @ _inverse(p_before[t + 1])
        x[t, :f] += gain @ (x[t + 1] - before[t + 1])[:f]
        p[t] += gain @ (p[t + 1] - p_before[t + 1]) @ gain.T
    return x, p


def _inverse(p: Float[np.ndarray, "f f"]) -> Float[np.ndarray, "f f"]:
    """The inverse of a covariance on the directions in which there is any."""
    size = np.sqrt(np.maximum(np.diag(p), 0.0))
    size = np.where(size > 0, size, 1.0)
    # Hidden constraints, and states that no noise reaches, make a covariance singular. It is scaled first, since units
    # of states would decide which of its eigenvalues count as zero.
    return np.linalg.pinv(p / np.outer(size, size), rcond=SINGULAR, hermitian=True) / np.outer(size, size)


def _numbers(objective: Objective, point: Float[np.ndarray, " p"], k: int, rows: slice) -> tuple[Shared, Owns, Told]:
    """(shared, own, what programs are told) of one experiment, at some of its times."""
    shared, own = objective.numbers(objective.coordinates.natural(point))
    told = jax.tree.map(lambda a: a[k][None], objective.told)
    names = ("times", "ends", "values", "observed", "inputs")
    chosen = {name: jax.tree.map(lambda a: a[:, rows], getattr(told, name)) for name in names}
    told = dataclasses.replace(told, **chosen)
    return shared, own[k][None], told


def _further(
    objective: Objective, ahead: Ahead, point: Float[np.ndarray, " p"], k: int, found: Track, steps: int
) -> tuple[ArrayLike, ArrayLike, ArrayLike | None]:
    """States, covariances and discrete values that follow `steps` samples after the filtered ones."""
    shared, own, told = _numbers(objective, point, k, slice(0, len(found.before)))
    told = jax.tree.map(lambda a: a[0], told)
    return go_on(objective.setting, ahead.structure, steps, shared, own[0], told, found)


def _read(
    objective: Objective, names: list[str], numbers: tuple[Shared, Owns, Told],
    states: tuple[ArrayLike, ArrayLike, ArrayLike | None],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Means and standard deviations of variables at states with covariances and discrete values."""
    shared, own, told = numbers
    setting = objective.setting._replace(layout=dataclasses.replace(objective.layout, outputs=tuple(names)))
    batch = jax.tree.map(lambda a: jnp.asarray(a, told.times.dtype)[None], states)
    found = read_states(setting, shared, own, told, *batch)
    mean, spread = (np.asarray(a[0], np.float64) for a in found)
    return mean, spread
