"""One integration by Diffrax, as `solve_dae` and `simulate` need it."""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from ...base.aliases import Numeric, PyTree, Result, Solver, State, Time, Times
from ..adjoint.ends import Ending
from ..adjoint.late_times import Integration, diffeqsolve, times_fit
from ..adjoint.resting import HeldBack, Resting
from ..adjoint.stored_adjoint import StoredAdjoint
from .bdf import BDF
from .projected import Projected
from .rodas5p import Rodas5P

BAD_TIMES: Result = diffrax.RESULTS.nonlinear_divergence  # Diffrax has no code of its own for them
TIMES = (
    "times do not fit: t0 and t1 must be finite, ts sorted from t0 to t1 and inside, and the times of StepTo must lead "
    "from t0 to t1"
)


class Run(NamedTuple):
    """The raw result of an integration: saved times and values, the last accepted point (t, y), counts, a result
    code."""

    ts: Times
    ys: State
    last: tuple[PyTree, PyTree]
    stats: dict[str, PyTree]
    result: Result


def inner(solver: Solver) -> Solver:
    """The solver without the projection around it."""
    return solver.solver if isinstance(solver, Projected) else solver


def is_implicit(solver: Solver) -> bool:
    """True if the solver, or the one it wraps, takes differential-algebraic equations."""
    return isinstance(inner(solver), BDF | Rodas5P)


def right_between_steps(solver: Solver) -> Solver:
    """The solver with an error test that covers its dense output, if values are saved within steps."""
    if isinstance(solver, Projected):
        return dataclasses.replace(solver, solver=right_between_steps(solver.solver))
    return dataclasses.replace(solver, dense_errors=True) if isinstance(solver, Rodas5P) else solver


def is_multistep(solver: Solver) -> bool:
    """True if the solver, or the one it wraps, chooses its step sizes itself."""
    return isinstance(inner(solver), BDF)


def integrate(
    of: Integration, progress: bool = False, checked: bool = False, goes_on: Numeric = True, before_jumps: bool = True
) -> Run:
    """Integrates; returns the values asked for, the last accepted point, and counts, Jacobians included. With
    `before_jumps`, a jump at the end is not seen any more."""
    term, solver, controller, t0, t1 = of.term, of.solver, of.controller, of.t0, of.t1
    # `StoredAdjoint` holds steps back by itself, where it is differentiated.
    if not isinstance(of.adjoint, StoredAdjoint) and Resting.of(term, solver, controller, of.y0, of.args, t1 - t0):
        controller = Ending(controller, (HeldBack(term, solver, controller),))  # pyright: ignore[reportCallIssue]
    fits = times_fit(t0, t1, of.save.ts, controller)
    if checked and fits is not True:
        t1 = eqx.error_if(t1, jnp.logical_not(fits), TIMES)
    counted = isinstance(solver, BDF)
    end = t1
    of, short = _short_of_jumps(of, t1) if before_jumps else (of, t1)
    t1 = short
    # An interval of length zero: the loop over the steps ends before the first one.
    if goes_on is not True:
        t1 = jnp.where(goes_on, t1, t0)
    meter = diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter()
    solved: Any = diffeqsolve(of._replace(t1=t1, controller=controller), counted, meter)
    stats = dict(solved.stats)
    if counted:
        state = solved.solver_state
        while isinstance(state, tuple):  # of solvers around BDF, which comes first
            state = state[0]
        stats["num_jacobians"], stats["num_newton_iterations"] = jax.lax.stop_gradient(state.counts)
    elif is_implicit(solver):
        # A Rosenbrock method forms its Jacobian anew in every step (Hairer & Wanner 1996, section IV.7).
        stats["num_jacobians"] = stats["num_steps"]
    last = jax.tree.map(lambda v: v[0], (solved.ts["last"], solved.ys["last"]))
    ts, result = jnp.asarray(solved.ts["out"]), solved.result
    # The end was moved by one rounding, and users compare times with those they asked for.
    if short is not end:
        ts, last = jnp.where(ts == short, end, ts), (jnp.where(last[0] == short, end, last[0]), last[1])
    if fits is not True:
        ts, result = jnp.where(fits, ts, jnp.inf), diffrax.RESULTS.where(jnp.asarray(fits), result, BAD_TIMES)
    return Run(ts, solved.ys["out"], last, stats, result)


def _short_of_jumps(of: Integration, t1: Time) -> tuple[Integration, Time]:
    """Ends the run just before a jump at its end, as before any other. Stages at the end of the last step would read
    the values from after the jump: at rtol 1e-6 that took 85 steps instead of 5."""
    held = jax.tree.leaves(of.controller, is_leaf=_clips)
    jumps = [c.jump_ts for c in held if _clips(c) and c.jump_ts is not None]
    if not jumps:
        return of, t1
    at_end = jnp.any(jnp.stack([jnp.any(jnp.asarray(ts) == t1) for ts in jumps]))
    moved = jax.lax.stop_gradient(jnp.where(at_end, jnp.nextafter(t1, of.t0) - t1, 0.0))
    short = t1 + moved
    if of.save.ts is None:
        return of, short
    inside = of.save.ts + jnp.where(of.save.ts == t1, moved, 0.0)  # derivatives by the times stay theirs
    return of._replace(save=dataclasses.replace(of.save, ts=inside)), short


def _clips(controller: Any) -> bool:
    return isinstance(controller, diffrax.ClipStepSizeController)
