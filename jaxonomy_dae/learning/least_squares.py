"""Levenberg–Marquardt with bounds: one Jacobian and one factorization a step.

Given residuals r(z) and their Jacobian, finds the least of ½ |W r|² + ½ Σ precision·(z − mean)² inside bounds. Bounds
are kept by projection: a coordinate that lies on one, and would be pushed out, is left out of the step (Moré 1978 for
the scaling by columns, Madsen, Nielsen & Tingleff 2004 for the damping, Bertsekas 1982 for the active set).

It stops where the remaining step is a thousandth of the confidence region's radius, which the residuals themselves set
(the relative offset of Bates & Watts 1981); or where, along a curved valley of which the data tell next to nothing,
steps in a row each lower the cost by less than a thousandth of the residuals' variance for each coordinate.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .factors import Factors

OFFSET = 1e-3  # Bates & Watts 1981, Technometrics 23:179
GAIN = 1e-9  # relative decrease of the sum of squares below which it is the integration's noise: rtol² is less
TRIALS = 12  # dampings tried from one point: the last is 6¹² times the first
PATIENCE = 3  # steps in a row without gain


class Evaluation(NamedTuple):
    """Residuals as they are, not weighted, and their Jacobian; and where the model says how large they should be, their
    variance and the derivatives of its logarithm."""

    residual: Float[np.ndarray, " m"]
    jacobian: Float[np.ndarray, "m p"]
    variance: Float[np.ndarray, " m"] | None = None
    log_slope: Float[np.ndarray, "m p"] | None = None


class Rows(NamedTuple):
    """Weighted residuals and Jacobian, with those of priors."""

    residual: Float[np.ndarray, " r"]
    jacobian: Float[np.ndarray, "r p"]


@dataclasses.dataclass(frozen=True)
class Weights:
    """How much each residual and each prior counts."""

    row: Float[np.ndarray, " m"]  # 1/σ
    precision: Float[np.ndarray, " p"]  # of the normal prior of each coordinate; 0 where there is none
    mean: Float[np.ndarray, " p"]

    @property
    def log_rows(self) -> float:
        """Σ ln (1/σ), which is not in the cost."""
        return float(np.sum(np.log(self.row)))

    def applied(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Rows:
        """Weighted residuals and Jacobian, with a row for each prior."""
        chosen = np.flatnonzero(self.precision)
        root = np.sqrt(self.precision[chosen])
        prior = np.zeros((len(chosen), len(z)))
        prior[np.arange(len(chosen)), chosen] = root
        return Rows(
            np.concatenate([self.row * found.residual, root * (z - self.mean)[chosen]]),
            np.concatenate([self.row[:, None] * found.jacobian, prior]),
        )

    def cost(self, z: Float[np.ndarray, " p"], residual: Float[np.ndarray, " m"]) -> float:
        """½ |W r|² + ½ Σ precision·(z − mean)²."""
        return 0.5 * float(np.sum((self.row * residual) ** 2) + np.sum(self.precision * (z - self.mean) ** 2))


@dataclasses.dataclass(frozen=True)
class Minimum:
    """Where a descent ended."""

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


def minimise(
    evaluate: Callable[[Float[np.ndarray, " p"]], Evaluation | None],
    residual: Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " m"] | None],
    start: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    weights: Callable[[Float[np.ndarray, " p"], Evaluation], Weights],
    reweigh: Reweigh | None = None,
    steps: int = 200,
    noise: float = float(np.sqrt(np.finfo(float).eps)),
) -> Minimum | None:
    """Descends from a start.

    **Arguments:**

    - `evaluate`, `residual`: residuals and Jacobian, and residuals alone, at a point; None where they cannot be found,
        so that a trial is rejected. Trials that fail are dear: without the Jacobian, a hundred times less.
    - `weights`: the first weights, from the start.
    - `reweigh`: `(z, found, weights, factors, free)` to better weights, and whether they have settled; called once for
        each factorization, for the next step.

    - `noise`: the relative error of the Jacobian: directions within it are not followed.

    **Returns:**

    The point; None if the start itself cannot be evaluated.
    """
    low, high = bounds
    z = np.clip(start, low, high)
    found = evaluate(z)
    if found is None:
        return None
    scheme = weights(z, found)
    damping, history, count, idle = 1e-3, [], 1, 0
    converged, message = False, f"stopped after {steps} steps, not yet converged; steps= allows more"
    for k in range(steps + 1):
        r, jacobian = scheme.applied(z, found)
        cost = 0.5 * float(r @ r)
        history.append(cost)
        gradient = jacobian.T @ r
        free = ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))
        factors = Factors.of(r, jacobian[:, free], noise)
        following, settled = (scheme, True) if reweigh is None else reweigh(z, found, scheme, factors, free)
        if settled and (offset(factors, cost, len(r), noise) <= OFFSET or idle >= PATIENCE):
            converged, message = True, f"converged after {k} steps"
            break
        if k == steps:
            break
        better, tried, damping = _better(
            evaluate, residual, z, found, scheme, (r, jacobian, factors, free), bounds, damping, noise
        )
        count += tried
        if better is None:
            idle += 1
            if settled or idle > PATIENCE:
                converged, message = True, f"converged after {k} steps: no step gains more"
                break
        else:
            z, found, new_cost = better
            gain, freedom = cost - new_cost, len(r) - len(z)
            noticed = OFFSET * len(z) * cost / freedom if freedom > 0 else 0.0
            if gain > max(noticed, GAIN * cost):
                idle = 0
            elif damping <= 1:  # the columns have norm one: beyond, damping alone keeps steps short
                idle += 1
        scheme = following
    return Minimum(z, found, scheme, scheme.cost(z, found.residual), history, count, converged, message, noise)


def offset(factors: Factors, cost: float, rows: int, noise: float) -> float:
    """The remaining step in radii of the confidence region; infinite where there are no degrees of freedom."""
    determined = factors.rank(noise)
    explained = float(np.sum(factors.projected[:determined] ** 2))
    if explained == 0:
        return 0.0
    freedom, rest = rows - determined, 2 * cost - explained
    if freedom <= 0 or rest <= 0:
        return np.inf
    return float(np.sqrt((explained / determined) / (rest / freedom)))


def _better(evaluate, residual, z, found, scheme, linear, bounds, damping, noise):
    """A point of less cost, as (z, evaluation, cost), or None; how many were tried; and the next damping."""
    r, jacobian, factors, free = linear
    cost = 0.5 * float(r @ r)
    for trial in range(TRIALS):
        step = np.zeros_like(z)
        step[free] = factors.step(damping, factors.rank(noise))
        new = np.clip(z + step, *bounds)
        if np.array_equal(new, z):
            return None, trial, damping
        promised = cost - 0.5 * float(np.sum((r + jacobian @ (new - z)) ** 2))
        tried = residual(new)
        new_cost = np.inf if tried is None else scheme.cost(new, tried)
        at_new = evaluate(new) if new_cost < cost else None
        if at_new is not None:
            ratio = (cost - new_cost) / max(promised, np.finfo(float).tiny)
            if ratio > 0.7:
                damping /= 5
            elif ratio < 0.3:
                damping *= 3
            return (new, at_new, new_cost), trial + 1, max(damping, 1e-12)
        damping *= 6
    return None, TRIALS, damping
