"""A system as Diffrax sees it: its term, and a solver filled in with what the system knows."""

import dataclasses
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp

from ...base.aliases import Args, Controller, Solver, State, Time, Tolerance
from ...solve.linear.choice import SPARSE_FROM
from ...solve.methods import BDF, DAETerm, Tsit5
from ...solve.methods.choice_guard import ChoiceGuard
from ...solve.methods.projected import with_projection
from ...solve.methods.switching import Watch
from ..system.system import AcausalSystem

# Gauss–Newton steps by which states are moved onto the constraints where no error estimate vouches for them: saved
# ones, and those at the ends of prescribed steps. Dense output starts them within some tolerances of a constraint, and
# each step squares that distance.
SAVED_ITERATIONS = 3


def term_of(system: AcausalSystem, implicit: bool) -> diffrax.AbstractTerm:
    """The system as a Diffrax term: an ODE, or with `implicit` a differential-algebraic equation."""
    if not implicit:
        return diffrax.ODETerm(system.vector_field)
    plan = system.plan
    field = system.semi_explicit if len(plan.carried) else system.vector_field
    return DAETerm(field, mass=system.mass, pattern=plan.dae_pattern if plan.n_state >= SPARSE_FROM else None)


def prepared(
    system: AcausalSystem, solver: Solver, implicit: bool, watch: Watch | None, atol: Tolerance, judged: bool = True
) -> Solver:
    """The solver with what the system supplies filled in: projections and the determinants to watch.

    How far a projection moves counts as an error of the step, so that steps which end where the constraints have no
    solution are rejected. Where steps are not `judged` by their errors, the projection itself must converge.
    """
    # Only that class itself: one that a user has derived from it may step in another way.
    if type(solver) is diffrax.Tsit5 and watch is not None:
        solver = Tsit5(solver.scan_kind)
    if isinstance(solver, Tsit5) and watch is not None:
        solver = dataclasses.replace(solver, watch=watch)
    # A minimal set of states may become a singular choice on the way.
    guard = ChoiceGuard(system.dummy_determinants, atol) if system.plan.dummy_blocks else None
    project = system.project if judged else _converged(system)
    if system.is_constrained and not implicit:
        return with_projection(solver, project, strict=True, guard=guard)
    if isinstance(solver, BDF):
        # Saved values are solved for anew, so errors of algebraic unknowns inside of steps do not show.
        if solver.algebraic_errors is None:
            solver = dataclasses.replace(solver, algebraic_errors=False)
        if system.plan.n_projected and solver.projection is None:
            solver = dataclasses.replace(solver, projection=project)
        # A predictor extrapolates over a branch point of a nonlinear block as if nothing were there. A change of sign
        # of the determinant shows that.
        if guard is None and system.plan.written_blocks:
            guard = ChoiceGuard(system.block_determinants, atol, ends_near=False)
        return dataclasses.replace(solver, guard=guard)
    if implicit and system.plan.n_projected:
        return with_projection(solver, project, strict=True, guard=guard)
    if implicit and guard is not None:
        return with_projection(solver, _unchanged, strict=False, guard=guard)
    return solver


def _converged(system: AcausalSystem) -> Callable[..., State]:
    """The projection, not-a-number where it does not converge."""
    return lambda t, x, args: system.project_fully(t, x, args, SAVED_ITERATIONS)


def largest_tolerance(system: AcausalSystem, controller: Controller) -> Tolerance:
    """The largest absolute tolerance in units of the nominal values; zero for steps of prescribed sizes."""
    while isinstance(controller, diffrax.ClipStepSizeController):
        controller = controller.controller
    return jax.lax.stop_gradient(
        jnp.max(jnp.asarray(getattr(controller, "atol", 0.0)) / system.plan.nominal, initial=0.0)
    )


def _unchanged(t: Time, x: State, args: Args) -> State:
    """The projection for an implicit solver of a system without constraints: it solves nonlinear blocks itself."""
    return x
