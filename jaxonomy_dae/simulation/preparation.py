"""A system as Diffrax sees it: its term, and a solver filled in with what the system knows."""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from ..aliases import Args, Controller, Solver, State, Time, Tolerance
from ..linear.choice import SPARSE_FROM
from ..solvers import BDF, DAETerm, Tsit5
from ..solvers.choice_guard import ChoiceGuard
from ..solvers.projected import with_projection
from ..solvers.switching import Watch
from ..system.system import AcausalSystem


def term_of(system: AcausalSystem, implicit: bool) -> diffrax.AbstractTerm:
    """The system as a Diffrax term: an ODE, or with `implicit` a differential-algebraic equation."""
    if not implicit:
        return diffrax.ODETerm(system.vector_field)
    plan = system.plan
    field = system.semi_explicit if len(plan.carried) else system.vector_field
    return DAETerm(field, mass=system.mass, pattern=plan.dae_pattern if plan.n_state >= SPARSE_FROM else None)


def prepared(system: AcausalSystem, solver: Solver, implicit: bool, watch: Watch | None, atol: Tolerance) -> Any:
    """The solver with what the system supplies filled in: projections and the determinants to watch."""
    if isinstance(solver, Tsit5) and watch is not None:
        solver = Tsit5(looped=solver.looped, watch=watch)
    # A minimal set of states may become a singular choice on the way.
    guard = ChoiceGuard(system.dummy_determinants, atol) if system.plan.dummy_blocks else None
    if system.is_constrained and not implicit:
        return with_projection(solver, system.project, strict=bool(system.carried), guard=guard)
    if isinstance(solver, BDF):
        if solver.algebraic_errors is None:
            solver = dataclasses.replace(solver, algebraic_errors=False)
        if system.plan.n_projected and solver.projection is None:
            solver = dataclasses.replace(solver, projection=system.project)
        return dataclasses.replace(solver, guard=guard)
    if implicit and system.plan.n_projected:
        return with_projection(solver, system.project, strict=False, guard=guard)
    if implicit and guard is not None:
        return with_projection(solver, _unchanged, strict=False, guard=guard)
    return solver


def largest_tolerance(system: AcausalSystem, controller: Controller) -> Any:
    """The largest absolute tolerance in units of the nominal values; zero for steps of prescribed sizes."""
    while isinstance(controller, diffrax.ClipStepSizeController):
        controller = controller.controller
    return jax.lax.stop_gradient(
        jnp.max(jnp.asarray(getattr(controller, "atol", 0.0)) / system.plan.nominal, initial=0.0)
    )


def _unchanged(t: Time, x: State, args: Args) -> Any:
    """The projection for an implicit solver of a system without constraints: it solves nonlinear blocks itself."""
    return x
