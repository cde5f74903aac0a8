"""Descent on a likelihood whose noise levels depend on what is estimated.

Residuals r, of variances s, cost ½ Σ (r²/s + ln s). With u = r/√s, its gradient is Jᵀρ, exactly, for the rows

    ρ = [u; (1 − u²)/√2],    J = [(∂r/∂z)/√s; (∂ ln s/∂z)/√2],

and JᵀJ is the Fisher information, expected over the innovations (Gupta & Mehra 1974, IEEE Trans. Autom. Control
19:774). So steps are those of Levenberg and Marquardt, from one factorization, and intervals follow as for least
squares; only whether a step is better is for the likelihood to say.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from .factors import Factors
from .least_squares import OFFSET, PATIENCE, TRIALS, Evaluation, Minimum, Reweigh, Rows, Weights

GAIN = 1e-5  # decrease of −ln L for each coordinate that is not noticed: that of a step of 0.004 standard deviations
LONGEST = (
    2.0  # change of a coordinate by one step, a factor of 7: far away, the expected information is not the curvature
)


@dataclasses.dataclass(frozen=True)
class Likelihood(Weights):
    """How much each innovation counts: `row` is √(w/s), with `share` √w for the weight w of its experiment."""

    share: Float[np.ndarray, " m"]

    @property
    def log_rows(self) -> float:
        """Nothing, since the cost has the logarithms of noise levels in it."""
        return 0.0

    def applied(self, z: Float[np.ndarray, " p"], found: Evaluation) -> Rows:
        """The rows above and below, with one for each prior."""
        assert found.log_slope is not None
        plain = super().applied(z, found)
        u = self.row * found.residual / self.share
        return Rows(
            np.concatenate([plain.residual, self.share * (1 - u**2) / np.sqrt(2)]),
            np.concatenate([plain.jacobian, self.share[:, None] * found.log_slope / np.sqrt(2)]),
        )

    def cost(self, z: Float[np.ndarray, " p"], residual: Float[np.ndarray, " m"]) -> float:
        """½ Σ w (r²/s + ln s) + ½ Σ precision·(z − mean)²."""
        return super().cost(z, residual) - float(np.sum(self.share**2 * np.log(self.row / self.share)))


def score(
    evaluate: Callable[[Float[np.ndarray, " p"]], Evaluation | None],
    start: Float[np.ndarray, " p"],
    bounds: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    limited: Bool[np.ndarray, " p"],
    weights: Callable[[Float[np.ndarray, " p"], Evaluation], Weights],
    reweigh: Reweigh | None = None,
    steps: int = 200,
    noise: float = 1e-6,
) -> Minimum | None:
    """Descends from a start; arguments as of `least_squares.minimise`, and which coordinates are logarithms, of which a
    step is `limited`.

    It stops where the remaining step is a thousandth of the confidence region's radius: gᵀF⁻¹g ≤ 10⁻⁶ for each
    coordinate, with the gradient g and the Fisher information F; or where steps in a row gain nothing.
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
        cost = scheme.cost(z, found.residual)
        history.append(cost)
        r, jacobian = scheme.applied(z, found)
        gradient = jacobian.T @ r
        free = ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))
        factors = Factors.of(r, jacobian[:, free], noise)
        rank = factors.rank(noise)
        left = float(np.sqrt(np.mean(factors.projected[:rank] ** 2))) if rank else 0.0
        following, settled = (scheme, True) if reweigh is None else reweigh(z, found, scheme, factors, free)
        if settled and (left <= OFFSET or idle >= PATIENCE):
            converged, message = True, f"converged after {k} steps"
            break
        if k == steps:
            break
        better = None
        for _ in range(TRIALS):
            step = np.zeros_like(z)
            step[free] = factors.step(damping, rank)
            step[limited] = np.clip(step[limited], -LONGEST, LONGEST)
            new = np.clip(z + step, low, high)
            if np.array_equal(new, z):
                break
            tried = evaluate(new)
            count += 1
            gain = -np.inf
            if tried is not None:
                trial = dataclasses.replace(weights(new, tried), precision=scheme.precision, mean=scheme.mean)
                gain = cost - trial.cost(new, tried.residual)
            if tried is not None and gain > 0:
                promised = 0.5 * float(np.sum(r**2) - np.sum((r + jacobian @ (new - z)) ** 2))
                ratio = gain / max(promised, np.finfo(float).eps * max(1.0, abs(cost)))
                damping = max(damping / 5 if ratio > 0.7 else damping * 3 if ratio < 0.3 else damping, 1e-12)
                better = new, tried, trial
                if gain > GAIN * len(z):
                    idle = 0
                elif damping <= 1:  # the columns have norm one: beyond, damping alone keeps steps short
                    idle += 1
                break
            damping *= 6
        if better is None:
            idle += 1
            if settled or idle > PATIENCE:
                converged, message = True, f"converged after {k} steps: no step gains more"
                break
        else:
            z, found, scheme = better
        scheme = dataclasses.replace(scheme, precision=following.precision)
    return Minimum(z, found, scheme, scheme.cost(z, found.residual), history, count, converged, message, noise)
