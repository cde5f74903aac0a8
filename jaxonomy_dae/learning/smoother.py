"""A second look at a fit of networks: with a prior of smoothness, where runs led them."""

import dataclasses

from .descent import Minimum
from .evidence import log_evidence
from .objective import Objective

# Steps of the second look at most: single laws took 5 to 60 from the first minimum; where more are needed, the first
# look is the better start of another fit.
SECOND = 100


def smoother(objective: Objective, found: Minimum, steps: int) -> tuple[Objective, Minimum] | None:
    """(the objective with a prior of smoothness, its minimum), from a minimum without it; None where the evidence is
    less, as it is for laws with steep parts, which weights say more simply."""
    if not found.converged:
        return None
    here = objective.explored(found.z).at_tolerance(found.tolerance)
    if here.bends is None:
        return None
    first = dataclasses.replace(found.weights, bends=here.bends, stiffness=here.bends.first(found.z))
    again = here.lowest(found.z, min(steps, SECOND), first=first)
    if again is None or not again.converged:
        return None
    before = log_evidence(found.z, found.found, found.weights)
    after = log_evidence(again.z, again.found, again.weights)
    return (here, again) if after > before else None
