"""One run of a compiled system: a consistent start, the integration, and saved states on the constraints."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ..initialization.initialize import InitialPoint, check, initialize, is_consistent
from ..linear.choice import SPARSE_FROM
from ..solvers import BDF, DAETerm, Tsit5
from ..solvers.choice_guard import ChoiceGuard
from ..solvers.drive import integrate, is_implicit, right_between_steps
from ..solvers.projected import with_projection
from ..solvers.rows import not_a_number, padded
from ..solvers.switching import STIFF, Watch
from ..system.system import AcausalSystem
from .step_sizes import first_step

SAVED_ITERATIONS = 3


class Options(eqx.Module):
    """How to integrate."""

    solver: Any
    adjoint: Any
    controller: Any
    max_steps: int = eqx.field(static=True)
    progress: bool = eqx.field(static=True)


class Outcome(eqx.Module):
    """What a run gave: the initial point, saved times and states, the last accepted point (t, x), counts, a result
    code, and whether it was given up because stability limits explicit steps."""

    found: InitialPoint
    ts: Any
    x: Any
    last: tuple[Any, Any]
    stats: dict[str, Any]
    result: Any
    is_stiff: Any

    def numbers(self) -> dict[str, Any]:
        """The counts as Python integers."""
        return {name: int(value) for name, value in self.stats.items() if jnp.ndim(value) == 0}


def term_of(system: AcausalSystem, implicit: bool) -> diffrax.AbstractTerm:
    """The system as Diffrax sees it: explicit, or differential-algebraic."""
    if not implicit:
        return diffrax.ODETerm(system.vector_field)
    plan = system.plan
    field = system.semi_explicit if len(plan.carried) else system.vector_field
    return DAETerm(field, mass=system.mass, pattern=plan.dae_pattern if plan.n_state >= SPARSE_FROM else None)


def run(given: tuple[Any, ...], options: Options, watch: Watch | None, throw: bool = False) -> Outcome:
    """Integrates `(system, t0, t1, ts, inputs, initial)`; `watch` is for Tsit5. With `throw`, an inconsistent start is
    an error while running."""
    system, t0, t1, ts, inputs, initial = given
    found = initialize(system, t0, inputs, initial)
    if throw:
        found = check(system, found, t0, inputs, initial)
    x0, controller = found.x, options.controller
    implicit = is_implicit(options.solver)
    term = term_of(system, implicit)
    chosen = options.solver if ts is None else right_between_steps(options.solver)
    solver = _prepared(system, chosen, implicit, watch, _atol(system, controller))
    own_start = implicit and not isinstance(controller, diffrax.StepTo)
    dt0 = None if own_start else first_step(system, t0, t1, x0, inputs, solver.order(term), controller)
    save = diffrax.SubSaveAt(t0=True, steps=True) if ts is None else diffrax.SubSaveAt(ts=ts)
    done = integrate(
        term, solver, t0, t1, dt0, x0, inputs,
        save=save, controller=controller, adjoint=options.adjoint, max_steps=options.max_steps,
        progress=options.progress, host_checks=throw,
    )  # fmt: skip
    consistent = is_consistent(found)
    saved, x = done.ts, jnp.asarray(done.ys)
    filled = jnp.isfinite(saved)
    last, okay = done.last, diffrax.is_okay(done.result)
    if system.is_constrained:
        safe, times = jnp.where(filled[:, None], x, x0), jnp.where(filled, saved, t0)
        projected = jax.vmap(lambda t, y: system.project(t, y, inputs, iterations=SAVED_ITERATIONS))(times, safe)
        # The run counts as failed at the first row at which nonlinear blocks have no solution.
        lost = filled & jnp.all(jnp.isfinite(x), axis=1) & ~jnp.all(jnp.isfinite(projected), axis=1)
        found_all, k = ~jnp.any(lost), jnp.argmax(lost)
        last = jax.tree.map(lambda a, b: jnp.where(found_all, a, b), last, (times[k], safe[k]))
        okay = okay & found_all
        x = jnp.where(filled[:, None], projected, x)
    if ts is None:
        steps = done.stats["num_accepted_steps"]
        saved, x = padded(saved, x, steps)
        filled = filled | okay
    else:
        saved = ts
    x = not_a_number(x, filled & consistent, x0, system, inputs)
    failure: Any = diffrax.RESULTS.nonlinear_divergence
    result = diffrax.RESULTS.where(okay | ~diffrax.is_okay(done.result), done.result, failure)
    result = diffrax.RESULTS.where(consistent, result, failure)
    stiff = consistent & (done.result == STIFF) if watch is not None else jnp.array(False)
    return Outcome(found._replace(jacobian=None), saved, x, last, done.stats, result, stiff)


run_compiled = eqx.filter_jit(run)


def _prepared(system: AcausalSystem, solver: Any, implicit: bool, watch: Watch | None, atol: Any) -> Any:
    """The solver with what the system fills in: projections, what to watch."""
    if isinstance(solver, Tsit5) and watch is not None:
        solver = Tsit5(looped=solver.looped, watch=watch)
    # A minimal set of states may become a singular choice on the way.
    guard = ChoiceGuard(system.dummy_determinants, atol) if system.plan.dummy_blocks else None
    if system.is_constrained and not implicit:
        return with_projection(solver, system.project, strict=bool(system.carried), guard=guard)
    if isinstance(solver, BDF):
        if solver.algebraic_errors is None:
            solver = dataclasses.replace(solver, algebraic_errors=False)
        if system.plan.n_constraints and solver.projection is None:
            solver = dataclasses.replace(solver, projection=system.project)
        return dataclasses.replace(solver, guard=guard)
    if implicit and system.plan.n_constraints:
        return with_projection(solver, system.project, strict=False, guard=guard)
    if implicit and guard is not None:
        return with_projection(solver, _unchanged, strict=False, guard=guard)
    return solver


def _atol(system: AcausalSystem, controller: Any) -> Any:
    """The largest absolute tolerance in units of the nominal values; zero for steps of prescribed sizes."""
    while isinstance(controller, diffrax.ClipStepSizeController):
        controller = controller.controller
    return jax.lax.stop_gradient(
        jnp.max(jnp.asarray(getattr(controller, "atol", 0.0)) / system.plan.nominal, initial=0.0)
    )


def _unchanged(t: Any, x: Any, args: Any) -> Any:
    """The projection of an implicit solver that has no constraint left: it solves nonlinear blocks itself."""
    return x
