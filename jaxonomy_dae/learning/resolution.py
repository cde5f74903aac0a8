"""Whether runs are integrated finely enough for what the data tell.

A fit minimises a sum over runs, whose integration has an error of its own. Where the noise is small, or the record is
long, that error moves estimates by several of their standard deviations, and residuals show it as a form that no model
would have. At a minimum, the same runs with a tenth of the tolerance measure it, in units of the noise. If it counts,
the search goes on with the tolerance that it asks for.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from .descent import Minimum
from .objective import Objective

# The errors of an integration may be so large, as the root of their sum of squares in units of the noise. No estimate
# then moves by more of its standard deviations, and most move by far less, because errors share but a part of any one's
# direction.
NOTICED = 0.5
EXACT = 1e-9  # of an output's size: the 30th bit, beyond what instruments tell. Errors below are those of exact data.
# A run at this part of the tolerance shows the error of a run at the tolerance.
BESIDE = 0.1
# The next tolerance is this part of the one that would just do.
SAFE = 0.3
ROUNDS = 4  # from 1e-6 to rounding


def resolved(objective: Objective, found: Minimum, steps: int) -> tuple[Objective, Minimum]:
    """(the objective with the tolerance that the data ask for, its minimum with its `resolution`), from a minimum."""
    here = objective.at_tolerance(found.tolerance)
    # Where a search got stuck, the error says nothing about the minimum.
    for _ in range(ROUNDS if found.converged else 0):
        error = integration_error(here, found)
        if error is None:
            break
        found = dataclasses.replace(found, resolution=error)
        if error <= NOTICED:
            break
        # Errors fall about in proportion to the tolerance.
        finer = here.finer(float(np.clip(SAFE * NOTICED / error, 1e-4, 0.5 * BESIDE)))
        again = None if finer is None else finer.lowest(found.z, steps, first=found.weights)
        if finer is None or again is None:
            break
        history = [*found.history, *again.history]
        evaluations = found.evaluations + again.evaluations
        found = dataclasses.replace(again, history=history, evaluations=evaluations)
        here = here.at_tolerance(found.tolerance)
    return here, found


def integration_error(objective: Objective, found: Minimum) -> float | None:
    """√Σ (error of a prediction / σ)² at a minimum, with σ at least `EXACT` of the output; None if runs cannot be
    integrated more finely."""
    finer = objective.finer(BESIDE)
    beside = None if finer is None else finer.evaluate(found.z)
    if beside is None:
        return None
    scale = 1 / np.maximum(1 / found.weights.scale, EXACT * sizes(objective))
    return float(np.linalg.norm(found.weights.share * scale * (beside.residual - found.found.residual)))


def sizes(objective: Objective) -> Float[np.ndarray, " m"]:
    """The greatest magnitude of the output that each sample is of, in its experiment."""
    s, (experiment, _, output) = objective.stacked, objective.rows
    greatest = np.max(np.abs(s.values), axis=1, where=s.observed, initial=0.0)
    return greatest[experiment, output]
