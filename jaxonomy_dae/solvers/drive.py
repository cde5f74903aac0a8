"""One integration by Diffrax, as `solve_dae` and `simulate` need it."""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from ..adjoint.host_checks import no_progress_meter, without_host_checks
from .bdf import BDF
from .projected import Projected
from .rodas5p import Rodas5P


class Run(NamedTuple):
    """What an integration returns: saved times and values, the last accepted point (t, y), counts, a result code."""

    ts: Any
    ys: Any
    last: tuple[Any, Any]
    stats: dict[str, Any]
    result: Any


def inner(solver: Any) -> Any:
    """The solver without the projection around it."""
    return solver.solver if isinstance(solver, Projected) else solver


def is_implicit(solver: Any) -> bool:
    """Whether the solver takes differential-algebraic equations."""
    return isinstance(inner(solver), BDF | Rodas5P)


def right_between_steps(solver: Any) -> Any:
    """The solver with an error test that covers its dense output, where values within steps are saved."""
    if isinstance(solver, Projected):
        return dataclasses.replace(solver, solver=right_between_steps(solver.solver))
    return dataclasses.replace(solver, dense_errors=True) if isinstance(solver, Rodas5P) else solver


def is_multistep(solver: Any) -> bool:
    """Whether the solver chooses step sizes itself."""
    return isinstance(inner(solver), BDF)


def integrate(
    term: Any, solver: Any, t0: Any, t1: Any, dt0: Any, y0: Any, args: Any, *,
    save: diffrax.SubSaveAt, controller: Any, adjoint: Any, max_steps: int, progress: bool = False,
    host_checks: bool = False,
) -> Run:  # fmt: skip
    """Integrates, saves what is asked for and the last accepted point, and counts Jacobians.

    Diffrax' own checks of the times are left out unless `host_checks`: see `without_host_checks`.
    """
    counted = isinstance(solver, BDF)
    with without_host_checks(not host_checks):
        solved: Any = diffrax.diffeqsolve(
            term,
            solver,
            t0,
            t1,
            dt0,
            y0,
            args,
            saveat=diffrax.SaveAt(subs={"out": save, "last": diffrax.SubSaveAt(t1=True)}, solver_state=counted),
            stepsize_controller=controller,
            adjoint=adjoint,
            max_steps=max_steps,
            throw=False,
            progress_meter=diffrax.TqdmProgressMeter() if progress else no_progress_meter(),
        )
    stats = dict(solved.stats)
    if counted:
        state = solved.solver_state
        while isinstance(state, tuple):  # of solvers around BDF, which comes first
            state = state[0]
        stats["num_jacobians"], stats["num_newton_iterations"] = jax.lax.stop_gradient(state.counts)
    elif is_implicit(solver):
        stats["num_jacobians"] = stats["num_steps"]
    last = jax.tree.map(lambda v: v[0], (solved.ts["last"], solved.ys["last"]))
    return Run(jax.tree.map(jnp.asarray, solved.ts["out"]), solved.ys["out"], last, stats, solved.result)
