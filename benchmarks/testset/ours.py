"""jaxonomy_dae on the test problems: index-1 equations as a `DAETerm`, models through `simulate`.

The tolerances are arguments of the compiled program, so that one program serves all of them.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae import AcausalSystem, simulate

from .outcome import Outcome, timed
from .problem import Problem

MAX_STEPS = 200_000


def raw_program(problem: Problem, solver: Any, semi_explicit: bool = False) -> Callable[[Any, Any], Any]:
    """(rtol, atol) to a `diffrax.Solution` of M·dy/dt = F(t, y), or of dx/dt = f, 0 = g; jitted."""
    from jaxonomy_dae.solvers import DAETerm, solve_dae

    one = problem.index_one()
    args, y0 = one.args(), jnp.asarray(one.y0)
    if semi_explicit:
        n = one.split()
        term, start = DAETerm(one.f, one.g), (y0[:n], y0[n:])
    else:
        term, start = DAETerm(one.F, mass=one.mass), y0

    @eqx.filter_jit
    def solve(start, args, rtol, atol):
        return solve_dae(
            term, problem.t1, start, t0=problem.t0, solver=solver, rtol=rtol, atol=atol, args=args,
            max_steps=MAX_STEPS, throw=False, ts=jnp.array([problem.t1]),
        )  # fmt: skip

    return lambda rtol, atol: solve(start, args, jnp.asarray(rtol, float), jnp.asarray(atol, float))


def raw_values(problem: Problem, solution: diffrax.Solution) -> dict[str, float]:
    """The end values by the model's names."""
    ys = solution.ys
    last = np.concatenate([np.asarray(part)[-1] for part in (ys if isinstance(ys, tuple) else (ys,))])
    return problem.index_one().values(last)


def model_program(problem: Problem, solver: Any, system: AcausalSystem | None = None) -> Callable[[Any, Any], Any]:
    """(rtol, atol) to (end values by name, statistics, result) of the compiled model; jitted."""
    compiled = problem.compile() if system is None else system

    @eqx.filter_jit
    def solve(system, rtol, atol):
        solution = simulate(
            system, problem.t1, t0=problem.t0, ts=jnp.array([problem.t1]), solver=solver, rtol=rtol, atol=atol,
            max_steps=MAX_STEPS, throw=False,
        )  # fmt: skip
        return {name: solution[name][-1] for name in problem.reference}, solution.stats, solution.result

    return lambda rtol, atol: solve(compiled, jnp.asarray(rtol, float), jnp.asarray(atol, float))


def _count(stats: Any, *names: str) -> int:
    return next((int(stats[name]) for name in names if name in stats), -1)


def outcome(
    problem: Problem, program: Callable[[Any, Any], Any], rtol: float, atol: float, repeat: Callable[[float], int]
) -> Outcome:
    """Runs a program at one tolerance."""

    def call():
        return jax.block_until_ready(program(rtol, atol))

    found, first, _ = timed(call, 0)
    _, again, _ = timed(call, 0)
    _, _, steady = timed(call, repeat(again))
    if isinstance(found, diffrax.Solution):
        values, stats, result = raw_values(problem, found), found.stats, found.result
    else:
        values, stats, result = found
        values = {name: float(value) for name, value in values.items()}
    okay = bool(diffrax.is_okay(result))
    return Outcome(
        values,
        steps=_count(stats, "num_accepted_steps", "num_steps"),
        rejected=_count(stats, "num_rejected_steps"),
        jacobians=_count(stats, "num_jacobians"),
        factorisations=_count(stats, "num_factorisations"),
        first=first,
        steady=min(steady, again),
        failure="" if okay else str(result),
    )
