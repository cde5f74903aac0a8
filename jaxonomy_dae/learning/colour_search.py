"""The search for correlations of noise, beside all other estimates.

ρ is that of greatest restricted likelihood (Harville 1977, J. Am. Stat. Assoc. 72:320), which counts what the fit takes
from the noise: that of greatest likelihood is too small by several times its share of degrees of freedom. ρ and all
other estimates do not depend on each other to first order, so they are found in turn.
"""

import dataclasses

import numpy as np
import scipy.optimize
from jaxtyping import Float

from ..host.threads import one_thread
from .colour import Colour
from .descent import Minimum
from .evaluation import Weights
from .objective import Objective

# The bound of ρ. Beyond it, a thousand samples say less than one.
LARGEST = 0.999
# How often ρ and the estimates are found in turn, at most.
ROUNDS = 20
SETTLED = 1e-7  # change of ρ at which these end


def correlated(objective: Objective, found: Minimum, steps: int) -> tuple[Objective, Minimum]:
    """(the objective with correlations of noise that are estimated, its minimum), from a minimum with the present
    ones."""
    unknown = np.flatnonzero(
        np.isnan(objective.stacked.rho) & np.isin(np.arange(len(objective.rho)), objective.rows[2])
    )
    here = objective.at_tolerance(found.tolerance)
    for _ in range(ROUNDS if len(unknown) else 0):
        bare = here.white.evaluate(found.z)
        if bare is None or (here.clock is not None and here.clock.is_over):
            break
        rho = np.array(here.rho)
        for j in unknown:
            rho[j] = _best(here, found.weights, bare.residual, bare.jacobian, rho, int(j))
        moved = float(np.max(np.abs(rho - here.rho)))
        here = here.with_rho(rho)
        again = here.lowest(found.z, steps, first=found.weights)
        if again is None:
            break
        history = [*found.history, *again.history]
        found = dataclasses.replace(again, history=history, evaluations=found.evaluations + again.evaluations + 1)
        here = here.at_tolerance(found.tolerance)
        if moved <= SETTLED:
            break
    return here, found


def _best(
    here: Objective, weights: Weights, residual: np.ndarray, jacobian: np.ndarray, rho: Float[np.ndarray, " k"], j: int
) -> float:
    """ρ of one output of greatest restricted likelihood, all other numbers as they are but for its noise level."""
    own = here.rows[2] == j
    level = here.stacked.level_of[j]
    is_estimated = level in here.evidence.labels
    alike = np.isin(here.rows[2], [k for k, name in enumerate(here.stacked.level_of) if name == level])
    count = float(np.sum(weights.share[alike if is_estimated else own] ** 2))
    prior = weights.prior(np.zeros(jacobian.shape[1])).jacobian

    def surprise(value: float) -> float:
        rho[j] = value
        colour = Colour.of(here.stacked, here.rows, rho)
        rows = np.concatenate([weights.row[:, None] * colour.whitened(jacobian), prior])
        r = weights.row * colour.whitened(residual)
        triangle = np.linalg.qr(rows, mode="r")
        size = np.abs(np.diag(triangle))
        taken = float(np.sum(np.log(size[size > 0])))
        # Residuals at the best estimates for this ρ, to first order, of which degrees of freedom are left.
        whole = np.concatenate([r, np.zeros(len(prior))])
        left = whole - rows @ np.linalg.lstsq(rows, whole, rcond=None)[0]
        squares = left[: len(r)] ** 2
        scale = colour.log_scale(weights.share)
        if not is_estimated:
            return 0.5 * float(np.sum(squares)) + scale + taken
        free = max(count - rows.shape[1], 1.0)
        chosen = float(np.sum(squares[alike]))
        return (
            0.5 * free * np.log(max(chosen, np.finfo(float).tiny))
            + 0.5 * float(np.sum(squares[~alike]))
            + scale
            + taken
        )

    gaps = here.colour.gaps[own]
    low = -LARGEST if np.array_equal(gaps, np.rint(gaps)) else 0.0  # between samples, only ρ > 0 has a meaning
    with one_thread(len(residual) * jacobian.shape[1] ** 2):
        found = scipy.optimize.minimize_scalar(
            surprise, bounds=(low, LARGEST), method="bounded", options={"xatol": 1e-9}
        )
    return float(found.x)  # pyright: ignore[reportAttributeAccessIssue]
