"""Values and Jacobians of blocks at a point, in NumPy."""

import functools
from collections.abc import Callable

import numpy as np

from ..lowering.plan import SystemPlan
from ..lowering.schedule import Step, StepEquation
from ..model.group import Point
from ..model.networks import Networks
from ..model.typical_sizes import typical_sizes
from ..tolerances import KNOWN


def slots_of_partials(equation: StepEquation) -> list[int]:
    """The slots on which the equation's local partial derivatives depend."""
    return sorted(frozenset().union(*(equation.template.slots_of_partial(k) for k in equation.inside)))


def _in_blocks(step: Step, values: Callable[[StepEquation], np.ndarray]) -> np.ndarray:
    """Arrays (n, slots) of a step's equations as matrices of its n blocks, shape (n, k, k)."""
    k = len(step.unknown)
    out = np.zeros((step.n, k, k))
    for e, equation in enumerate(step.equations):
        found = values(equation)
        for slot in equation.inside:
            out[:, e, equation.local[slot]] += found[:, slot]
    return out


class BlockValues:
    """All quantities known so far, and the numbers of steps there; `quantities` are changed as more become known."""

    def __init__(self, plan: SystemPlan, parameters, networks: tuple, t: float, x, inputs: Callable[[], np.ndarray]):
        self.plan = plan
        self.quantities = np.append(np.full(plan.extended.quantities.n, np.nan), 0.0)  # ZERO is −1: the last entry
        self.quantities[plan.states] = x[: len(plan.states)]
        self.quantities[plan.carried] = x[len(plan.states) :]
        self._networks = Networks(networks)
        self._t = t
        self.parameters = parameters
        self._inputs = inputs
        self._have_inputs = False

    @property
    def point(self) -> Point:
        """Where equations are evaluated."""
        return Point(self.quantities, self.parameters, self._t, self._networks)

    def _at(self, equation: StepEquation, parameters: np.ndarray | None = None) -> Point:
        """The point, with what the equation reads of the inputs."""
        first = self.plan.extended.quantities.n_unknown
        if not self._have_inputs and (equation.quantity >= first).any():
            self.quantities[first:-1] = self._inputs()
            self._have_inputs = True
        at = self.point
        return at if parameters is None else Point(at.values, parameters, at.t, at.networks)

    def partials(self, equation: StepEquation, parameters: np.ndarray | None = None) -> np.ndarray:
        """∂(residual)/∂(quantity) by slots, (n, slots), with other `parameters` than those of the point if given."""
        return equation.partials(self._at(equation, parameters))

    def partial_errors(self, equation: StepEquation) -> np.ndarray:
        """Bounds of the errors of these partial derivatives."""
        return equation.partial_errors(self._at(equation), self.errors)

    @property
    def errors(self) -> np.ndarray:
        """Bounds of the errors of quantities: they are found by Newton's method, so to rounding of themselves and of
        their typical sizes."""
        return KNOWN * (np.abs(self.quantities) + np.append(self._typical, 0.0))

    @functools.cached_property
    def _typical(self) -> np.ndarray:
        return typical_sizes(self.plan.model, np.asarray(self.parameters, float))

    def residual(self, equation: StepEquation) -> np.ndarray:
        """The residuals of an equation, (n,)."""
        return equation.residual(self._at(equation))

    def jacobian(self, step: Step, parameters: np.ndarray | None = None) -> np.ndarray:
        """The Jacobian of each of the step's n blocks, shape (n, k, k)."""
        return _in_blocks(step, lambda equation: self.partials(equation, parameters))

    def jacobian_errors(self, step: Step) -> np.ndarray:
        """Bounds of the errors of their entries."""
        return _in_blocks(step, self.partial_errors)

    def follow(self, step: Step):
        """Computes the unknowns that follow from the tearing variables in the state."""
        for e, u in step.tearing.sequence:
            equation = step.equations[e]
            (slot,) = [k for k in equation.inside if equation.local[k] == u]
            self.quantities[step.unknown[u]] = equation.solved(slot, self._at(equation))

    def solve(self, step: Step):
        """Computes the unknowns of a linear step."""
        for quantities in step.unknown:
            self.quantities[quantities] = 0.0
        residual = np.stack([self.residual(e) for e in step.equations], axis=-1)
        try:
            with np.errstate(all="ignore"):
                found = np.linalg.solve(self.jacobian(step), -residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            found = np.full(residual.shape, np.nan)
        for u, quantities in enumerate(step.unknown):
            self.quantities[quantities] = found[:, u]
