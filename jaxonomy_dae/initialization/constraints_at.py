"""A model at an initial point, for questions about its constraints."""

from collections.abc import Callable

import numpy as np

from ..diagnosis.redundant_constraints import ModelAt
from ..lowering.plan import SystemPlan
from ..model.consistent_point import consistent_point
from ..model.group import Point
from ..model.networks import Networks
from ..model.quantities import start_guess

LARGEST = 1500  # unknown quantities: up to there, positions that are not states are found by dense algebra


def constraints_at(
    plan: SystemPlan,
    parameters: np.ndarray,
    networks: tuple,
    t: float,
    x: np.ndarray,
    inputs: Callable[[], np.ndarray],
) -> ModelAt | None:
    """The values of all quantities where the states are `x`; None if nothing was differentiated, or too much."""
    quantities = plan.extended.quantities
    if not plan.extended.level.any() or quantities.n_unknown > LARGEST or not np.isfinite(x).all():
        return None
    guess, _ = start_guess(plan.flat, plan.variable_map, quantities.n)
    pins = dict(zip([*plan.states.tolist(), *plan.carried.tolist()], x.tolist(), strict=True))
    guess[list(pins)] = list(pins.values())
    if quantities.n > quantities.n_unknown:
        guess[quantities.n_unknown :] = inputs()
    found = consistent_point(plan.extended, Point.of(guess, parameters, t, Networks(networks)), list(pins.items()))
    settled = plan.selection.settled
    return ModelAt(plan.flat, plan.alias, plan.variable_map, plan.groups, plan.extended, settled, found)
