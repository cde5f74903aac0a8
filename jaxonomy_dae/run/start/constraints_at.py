"""A model at an initial point, for questions about its constraints."""

from collections.abc import Callable

import numpy as np

from ...compile.diagnosis.redundant_constraints import ModelAt
from ...compile.lowering.plan import SystemPlan
from ...compile.model.consistent_point import consistent_point
from ...compile.model.declared import start_guess
from ...compile.model.group import Point
from ...compile.model.opaque import Networks


def constraints_at(
    plan: SystemPlan,
    parameters: np.ndarray,
    networks: tuple,
    t: float,
    x: np.ndarray,
    inputs: Callable[[], np.ndarray],
) -> ModelAt | None:
    """The values of all quantities where the states are `x`; None if nothing was differentiated."""
    quantities = plan.extended.quantities
    if not plan.extended.level.any() or not np.isfinite(x).all():
        return None
    guess, _ = start_guess(plan.model, parameters, plan.leading)
    pins = dict(zip([*plan.states.tolist(), *plan.carried.tolist()], x.tolist(), strict=True))
    guess[list(pins)] = list(pins.values())
    if quantities.n > quantities.n_unknown:
        guess[quantities.n_unknown :] = inputs()
    found = consistent_point(plan.extended, Point.of(guess, parameters, t, Networks(networks)), list(pins.items()))
    return ModelAt(plan.model, plan.selection.settled, found)
