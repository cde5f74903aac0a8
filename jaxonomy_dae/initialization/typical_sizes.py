"""Sizes of unknowns of which nothing is declared, by what their equations say."""

import functools

import numpy as np
from jaxtyping import Float

from ..lowering.plan import SystemPlan
from ..model.evaluate_numpy import start_values
from ..model.natural_sizes import natural_sizes
from ..model.quantities import declared_scale

DENSE_LIMIT = 600  # quantities up to which sizes are looked for
DECADES = 30  # that they may span: single precision has 38


@functools.lru_cache(maxsize=64)
def typical_sizes(plan: SystemPlan) -> Float[np.ndarray, " quantities"]:
    """Of all quantities, at the parameter values the model was compiled with; powers of two, by which numbers are
    multiplied without rounding. They say where a search begins to look and what may be rounding, and decide nothing
    else."""
    if plan.extended.quantities.n_unknown > DENSE_LIMIT:
        return np.ones(plan.extended.quantities.n)
    size = declared_scale(plan.flat, plan.variable_map, plan.extended)
    value_of = start_values(plan.flat.variables.start, plan.flat.parameters.values)
    for v, start in enumerate(plan.flat.variables.start):
        quantity, factor = plan.quantity_of(v)
        if start is not None and quantity >= 0 and size[quantity] == 0.0:
            value = value_of(v) / factor
            size[quantity] = value if np.isfinite(value) else 0.0
    size[size == 0.0] = 1.0
    found, _ = natural_sizes(plan.extended.groups, plan.extended.n_equations, size, plan.flat.parameters.values)
    decades = np.clip(np.log10(np.abs(found)), -DECADES, DECADES)
    return 2.0 ** np.round(decades / np.log10(2.0))
