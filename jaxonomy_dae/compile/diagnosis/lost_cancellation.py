"""Combinations of equations that hold for other parameters only.

Where highest derivatives cancel for the parameters that a model is compiled with, and not for all, the equation that
follows has no value for others (`compile/passes/combine_equations.py`).
"""

from collections.abc import Sequence

import numpy as np

from ..model.opaque import Networks
from ..model.tables import EquationGroup
from .wording import some

# Values of all quantities at which an equation is tried. One that has a value at none of them asks for other
# parameters.
POINTS = (0.7, -1.3, 0.2)


@np.errstate(all="ignore")
def lost_cancellation(
    groups: Sequence[EquationGroup], parameters: np.ndarray, names: Sequence[str], t: float
) -> str | None:
    """What to say if a combination of equations has no value whatever the quantities are; None if all have."""
    for group in groups:
        if not group.parameter.shape[1] or group.template.opaque is not None:
            continue
        given = *group.numbers(parameters), t, Networks(())
        lost = np.ones(len(group), bool)
        for value in POINTS:
            residual = group.template.residual(list((group.factor * value).T), *given, backend="numpy")
            lost &= np.isnan(np.broadcast_to(np.asarray(residual, float), (len(group),)))
        for k in np.flatnonzero(lost).tolist():
            if group.provenance[k].sources:
                shown = some([f"{names[p]} = {parameters[p]:g}" for p in dict.fromkeys(group.parameter[k].tolist())])
                return (
                    "the model was compiled with parameters for which highest derivatives cancel in the "
                    f"{group.provenance[k]}; for {shown} they do not, and the structure is another one. Compile the "
                    "model with these values"
                )
    return None
