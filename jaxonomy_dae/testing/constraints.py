"""Whether saved states lie on the constraints of their model."""

import jax
import numpy as np

from ..base.errors import ModelError
from ..host.cache import compiled
from ..host.staging import is_traced
from ..run.simulation.solution import Solution
from .certificate import Certificate


def assert_constraints(solution: Solution, rtol: float = 1e-6, atol: float = 1e-8) -> Certificate:
    """Asserts that the saved states satisfy all constraints of the model, the hidden ones included.

    Residuals of constraints have different units and say little by themselves. Therefore the check measures the
    distance of the state from the constraints: the Gauss–Newton step of least norm onto the hidden constraints, and for
    unknowns of nonlinear blocks the step to their root (`AcausalSystem.project`). No variable may move by more than
    `atol·nominal + rtol·size`, with its nominal value and its largest size in the solution.

    **Arguments:**

    - `solution`: a solution that reached all its saved times.
    - `rtol`, `atol`: relative to the variables' sizes, and to their nominal values.

    **Returns:**

    A `Certificate`; its error is relative to the allowed distance.

    **Raises:**

    - `AssertionError` with the variable that is furthest from the constraints, the time, the distance, and the
        constraints.
    - `ModelError` for a batch, inside jit, and for rows that were not reached.
    """
    system = solution.system
    if is_traced(solution):
        raise ModelError("assert_constraints needs numbers: call it outside jit, grad and vmap")
    if solution.ts.ndim != 1:
        raise ModelError(f"assert_constraints takes one solution; this is a batch of shape {solution.ts.shape[:-1]}")
    states = np.asarray(solution.states, float)
    missed = ~np.isfinite(states).all(axis=1)
    if missed.any():
        k = int(np.argmax(missed))
        raise ModelError(
            f"row {k} of the solution, t={float(solution.ts[k]):.6g}, was not reached: the run failed, see its result"
        )
    claim = "the saved states satisfy the constraints of the model"
    names = [*system.states, *system.carried]
    constraints = system.report.constraints
    # A check of nothing says so, rather than pass without a word.
    if not system.is_constrained or not len(states):
        return Certificate(claim, "nothing: the model has no hidden constraints", 0.0, 1.0, "")
    moves = np.abs(np.asarray(_moves(system, solution.ts, solution.states, solution.inputs, solution.discrete), float))
    allowed = atol * np.asarray(system.plan.nominal, float) + rtol * np.abs(states).max(axis=0)
    # A singular Jacobian of constraints gives steps that are no numbers, and must not pass.
    error = np.where(np.isfinite(moves), moves / allowed, np.inf)
    row, column = np.unravel_index(np.argmax(error), error.shape)
    found = [f"hidden constraint: {text}" for text in constraints[:4]]
    found += [f"and {len(constraints) - 4} more"] * (len(constraints) > 4)
    what = f"{len(constraints)} hidden constraints" if len(constraints) != 1 else "1 hidden constraint"
    what += f" and {len(system.carried)} unknowns of nonlinear blocks" if len(system.carried) else ""
    return Certificate(
        claim,
        f"{what} at {len(states)} saved times, by how far states would have to move",
        float(error[row, column]),
        1.0,
        f"'{names[column]}' at t={float(solution.ts[row]):.6g}, which would move by {moves[row, column]:.3g}",
        tuple(found),
    ).asserted()


@compiled
def _moves(system, ts, states, inputs, discrete):
    """The distance by which projection onto the constraints moves each state, shape (n, states)."""

    def one(t, x, values):
        here = system if values is None else system.holding(values)
        return here.project(t, x, inputs) - x

    return jax.vmap(one)(ts, states, discrete)
