"""Values and Jacobians of blocks at a point, in NumPy."""

import functools
from collections.abc import Callable

import numpy as np

from ..expressions.errors import KNOWN
from ..lowering.plan import SystemPlan
from ..lowering.schedule import Step, StepEquation
from ..model.evaluate_numpy import Networks
from ..model.typical_sizes import error_sizes


def local_slots(equation: StepEquation) -> list[int]:
    return [k for k, s in enumerate(equation.slots) if s.local >= 0]


def slots_of_partials(equation: StepEquation) -> list[int]:
    """The slots on which the equation's local partial derivatives depend."""
    return sorted(frozenset().union(*(equation.template.slots_of_partial(p) for p in local_slots(equation))))


def _in_blocks(step: Step, values: Callable[[StepEquation], np.ndarray]) -> np.ndarray:
    """Arrays (n, slots) of a step's equations as matrices of its n blocks, shape (n, k, k)."""
    k = len(step.unknown)
    out = np.zeros((step.n, k, k))
    for e, equation in enumerate(step.equations):
        found = values(equation)
        for slot in local_slots(equation):
            out[:, e, equation.slots[slot].local] += found[:, slot]
    return out


class BlockValues:
    """All quantities known so far, and the kernels in NumPy."""

    def __init__(self, plan: SystemPlan, parameters, networks: tuple, t: float, x, inputs: Callable[[], np.ndarray]):
        self.plan = plan
        self.parameters = parameters
        self.networks = Networks(networks)
        self.t = t
        self.quantities = np.append(np.full(plan.extended.quantities.n, np.nan), 0.0)  # ZERO is −1: the last entry
        self.quantities[plan.states] = x[: len(plan.states)]
        self.quantities[plan.carried] = x[len(plan.states) :]
        self._inputs = inputs
        self._have_inputs = False

    def slots(self, equation: StepEquation) -> list[np.ndarray]:
        first = self.plan.extended.quantities.n_unknown
        if not self._have_inputs and any((s.quantity >= first).any() for s in equation.slots):
            self.quantities[first:-1] = self._inputs()
            self._have_inputs = True
        return [s.factor * self.quantities[s.quantity] for s in equation.slots]

    def partials(self, equation: StepEquation, parameters: np.ndarray | None = None) -> np.ndarray:
        """∂(residual)/∂(slot), factors included, shape (n, slots)."""
        slots = self.slots(equation)
        n = equation.parameter.shape[0]
        factors = np.stack([s.factor for s in equation.slots], axis=-1)
        p = list((self.parameters if parameters is None else parameters)[equation.parameter].T)
        c = list(equation.coefficient.T)
        with np.errstate(all="ignore"):
            out = equation.template.partial_values(slots, p, c, self.t, self.networks, backend="numpy")
            return np.stack([np.broadcast_to(np.asarray(v, float), (n,)) for v in out], axis=-1) * factors

    def partial_errors(self, equation: StepEquation) -> np.ndarray:
        """Bounds of the errors of these partial derivatives."""
        factors = np.abs(np.stack([s.factor for s in equation.slots], axis=-1))
        errors = [np.abs(s.factor) * self.errors[s.quantity] for s in equation.slots]
        p, c = list(self.parameters[equation.parameter].T), list(equation.coefficient.T)
        with np.errstate(all="ignore"):
            out = equation.template.partial_errors(self.slots(equation), errors, p, c, self.t, self.networks)
            return np.stack([np.broadcast_to(np.asarray(e, float), factors.shape[:1]) for e in out], axis=-1) * factors

    @property
    def errors(self) -> np.ndarray:
        """How well quantities are known: a position is one of Newton's method, so to rounding of its typical size."""
        known = _error_sizes(self.plan, np.asarray(self.parameters, float).tobytes())
        return KNOWN * (np.abs(self.quantities) + np.append(known, 0.0))

    def residual(self, equation: StepEquation) -> np.ndarray:
        slots = self.slots(equation)
        p, c = list(self.parameters[equation.parameter].T), list(equation.coefficient.T)
        with np.errstate(all="ignore"):
            out = equation.template.residual(slots, p, c, self.t, self.networks, backend="numpy")
        return np.broadcast_to(np.asarray(out, float), (equation.parameter.shape[0],))

    def jacobian(self, step: Step, parameters: np.ndarray | None = None) -> np.ndarray:
        """Of a step's n blocks, shape (n, k, k)."""
        return _in_blocks(step, lambda equation: self.partials(equation, parameters))

    def jacobian_errors(self, step: Step) -> np.ndarray:
        """Bounds of the errors of its entries."""
        return _in_blocks(step, self.partial_errors)

    def follow(self, step: Step):
        """What the tearing variables in the state determine."""
        for e, u in step.tearing.sequence:
            equation = step.equations[e]
            (k,) = [k for k in local_slots(equation) if equation.slots[k].local == u]
            slots, n = self.slots(equation), step.n
            p, c = list(self.parameters[equation.parameter].T), list(equation.coefficient.T)
            out = equation.template.solve(k, slots, p, c, self.t, self.networks, backend="numpy")
            self.quantities[step.unknown[u]] = np.broadcast_to(np.asarray(out, float), (n,)) / equation.slots[k].factor

    def solve(self, step: Step):
        """The unknowns of a linear step."""
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


@functools.lru_cache(maxsize=64)
def _error_sizes(plan: SystemPlan, parameters: bytes) -> np.ndarray:
    """The sizes to whose rounding all quantities are known."""
    return error_sizes(plan.flat, plan.variable_map, plan.extended, np.frombuffer(parameters))
