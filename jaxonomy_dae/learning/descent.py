"""Steps of Levenberg and Marquardt inside bounds, for sums of squares and for likelihoods: one Jacobian and one
factorization each.

Bounds are kept by projection: a coordinate that lies on one, and would be pushed out, is left out of the step (Moré
1978 for the scaling by columns, Madsen, Nielsen & Tingleff 2004 for the damping, Bertsekas 1982 for the active set).
What is descended on, an `AbstractMerit`, says what a point costs, how much is left to go, and what gain is not noticed.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .evaluation import Evaluation, Rows, Weights
from .factors import Factors

TRIALS = 12  # dampings tried from one point: the last is 6¹² times the first
PATIENCE = 3  # steps in a row without gain
OFFSET = 1e-3  # of the confidence region's radius, what may be left to go (Bates & Watts 1981, Technometrics 23:179)


@dataclasses.dataclass(frozen=True)
class Minimum:
    """The end of a descent."""

    z: Float[np.ndarray, " p"]
    found: Evaluation
    weights: Weights
    cost: float
    history: list[float]  # of the cost before each step, and the last
    evaluations: int
    converged: bool
    message: str
    noise: float  # relative error of the Jacobian: directions within it count as not determined


Reweigh = Callable[[np.ndarray, Evaluation, Weights, Factors, np.ndarray], tuple[Weights, bool]]


class Reached(NamedTuple):
    """A point that costs less, with what was found there, its weights and its cost."""

    z: Float[np.ndarray, " p"]
    found: Evaluation
    weights: Weights
    cost: float


@dataclasses.dataclass(frozen=True)
class AbstractMerit(abc.ABC):
    """The function that a descent decreases.

    - `evaluate`: residuals and Jacobian at a point; None where they cannot be found, so that a trial is rejected.
    - `weights`: those of a point that was evaluated: the first ones, at the start.
    """

    evaluate: Callable[[Float[np.ndarray, " p"]], Evaluation | None]
    weights: Callable[[Float[np.ndarray, " p"], Evaluation], Weights]

    @abc.abstractmethod
    def reach(self, z: Float[np.ndarray, " p"], weights: Weights, below: float) -> Reached | None:
        """A point, if it costs less than `below`."""

    @abc.abstractmethod
    def left(self, factors: Factors, cost: float, rows: int, noise: float) -> float:
        """The remaining step in radii of the confidence region."""

    @abc.abstractmethod
    def unnoticed(self, cost: float, rows: int, columns: int) -> float:
        """A gain by a step that counts as none."""

    @abc.abstractmethod
    def next_weights(self, here: Weights, better: Weights) -> Weights:
        """The weights for the next step: `here` are those at the current point, `better` those found with the last
        step."""

    def shortened(self, step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """A step, no longer than the linearization goes."""
        return step


def can_move(
    z: Float[np.ndarray, " p"],
    gradient: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
) -> Bool[np.ndarray, " p"]:
    """True for coordinates that do not lie on a bound across which descent would push them."""
    low, high = bounds
    return ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))


def damping_after(damping: float, ratio: float) -> float:
    """The damping after a step that gained this part of what its linearization promised."""
    if ratio > 0.7:
        damping /= 5
    elif ratio < 0.3:
        damping *= 3
    return max(damping, 1e-12)


def descend(
    merit: AbstractMerit,
    start: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    reweigh: Reweigh | None,
    steps: int,
    noise: float,
) -> Minimum | None:
    """Descends from a start.

    **Arguments:**

    - `reweigh`: `(z, found, weights, factors, free)` to better weights, and whether they have settled; called once for
        each factorization, for the next step.
    - `noise`: the relative error of the Jacobian: directions within it are not followed.

    **Returns:**

    The point; None if the start itself cannot be evaluated.
    """
    z = np.clip(start, *bounds)
    found = merit.evaluate(z)
    if found is None:
        return None
    weights = merit.weights(z, found)
    damping, history, count, idle = 1e-3, [], 1, 0
    converged, message = False, f"stopped after {steps} steps, not yet converged; steps= allows more"
    for k in range(steps + 1):
        rows, cost = weights.applied(z, found), weights.cost(z, found.residual)
        history.append(cost)
        free = can_move(z, rows.jacobian.T @ rows.residual, bounds)
        factors = Factors.of(rows.residual, rows.jacobian[:, free], noise)
        following, settled = (weights, True) if reweigh is None else reweigh(z, found, weights, factors, free)
        if settled and (merit.left(factors, cost, len(rows.residual), noise) <= OFFSET or idle >= PATIENCE):
            converged, message = True, f"converged after {k} steps"
            break
        if k == steps:
            break
        better, tried, damping = _better(merit, z, weights, cost, rows, factors, free, bounds, damping, noise)
        count += tried
        if better is None:
            idle += 1
            if settled or idle > PATIENCE:
                converged, message = True, f"converged after {k} steps: no step gains more"
                break
        else:
            z, found, weights = better[:3]
            if cost - better.cost > merit.unnoticed(cost, len(rows.residual), len(z)):
                idle = 0
            elif damping <= 1:  # the columns have norm one: beyond, damping alone keeps steps short
                idle += 1
        weights = merit.next_weights(weights, following)
    return Minimum(z, found, weights, weights.cost(z, found.residual), history, count, converged, message, noise)


def _better(
    merit: AbstractMerit, z: np.ndarray, weights: Weights, cost: float, rows: Rows, factors: Factors, free: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray], damping: float, noise: float,
) -> tuple[Reached | None, int, float]:  # fmt: skip
    """A point that costs less, how many were tried, and the next damping."""
    rank = factors.rank(noise)
    for trial in range(TRIALS):
        step = np.zeros_like(z)
        step[free] = factors.step(damping, rank)
        new = np.clip(z + merit.shortened(step), *bounds)
        if np.array_equal(new, z):
            return None, trial, damping
        reached = merit.reach(new, weights, cost)
        if reached is not None:
            promised = 0.5 * float(np.sum(rows.residual**2) - np.sum((rows.residual + rows.jacobian @ (new - z)) ** 2))
            ratio = (cost - reached.cost) / max(promised, np.finfo(float).eps * abs(cost), np.finfo(float).tiny)
            return reached, trial + 1, damping_after(damping, ratio)
        damping *= 6
    return None, TRIALS, damping
