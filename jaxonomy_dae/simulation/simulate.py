"""`simulate`: a compiled system integrated by Diffrax."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..adjoint.default import default_adjoint
from ..errors import ModelError, SimulationError
from ..initialization.initialize import check, initialize, is_consistent
from ..linear.algebra import SPARSE_FROM
from ..solvers import BDF, DAETerm, Projected, Rodas5P, Tsit5
from ..solvers.failures import explain_failure
from ..solvers.projected import with_projection
from ..solvers.solve import check_tolerances, step_control
from ..system.solver_choice import solver_choice
from ..system.system import AcausalSystem
from .arguments import check_arguments, check_parameters
from .solution import Solution

SAVED_ITERATIONS = 3


def simulate(
    system: AcausalSystem,
    t1: Any,
    *,
    t0: Any = 0.0,
    ts: Any = None,
    solver: diffrax.AbstractSolver | None = None,
    rtol: Any = 1e-6,
    atol: Any = 1e-8,
    inputs: Mapping[str, Any] | None = None,
    initial: Mapping[str, Any] | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    jump_ts: Any = None,
    max_steps: int = 16384,
    progress: bool = False,
    throw: bool = True,
) -> Solution:
    """Integrates a system from a consistent initial point.

    **Arguments:**

    - `system`: from an `AcausalCompiler`.
    - `t0`, `t1`: the interval, `t0 < t1`.
    - `ts`: when to save, shape `(n,)`, increasing, inside the interval; None saves every step taken.
    - `solver`: any Diffrax solver for ordinary differential equations, or `solvers.BDF`, `solvers.Rodas5P` for stiff
        systems and those with nonlinear blocks. None chooses, and `solution.stats` says what and why. Systems with
        hidden constraints are projected onto them after every step and at every saved time.
    - `rtol`, `atol`: tolerances of the local error; `atol` is multiplied by the states' nominal values.
    - `inputs`: functions of time (callable pytrees such as Diffrax interpolations, or plain functions) or constants, by
        the inputs' names.
    - `initial`: values at `t0` by variables' names, which outrank the starts declared in components.
    - `adjoint`: how to differentiate; default `solvers.StoredAdjoint()`. `diffrax.ForwardMode()` for forward-mode
        differentiation (`jax.jvp`, `jax.jacfwd`).
    - `stepsize_controller`: instead of the controller made from the tolerances.
    - `jump_ts`: times at which inputs jump, shape `(n,)`: steps end there and the method starts anew.
    - `max_steps`: bounds the steps taken; with `ts=None` as many rows are reserved.
    - `progress`: shows a progress bar.
    - `throw`: whether to raise if the integration fails; otherwise see `solution.result`.

    **Returns:**

    A `Solution`: `solution["pend.x"]` has shape `(n,)`.

    Called with plain arrays, it is compiled once for each structure, set of options and shapes. Inside `jax.jit`,
    `grad` or `vmap` it is traced like any function.

    **Raises:**

    - `ModelError` for arguments that cannot work; `InitializationError`; `SimulationError`.
    """
    check_arguments(system, t0, t1, ts, inputs, initial, adjoint, solver, max_steps)
    dtype = system.parameters.values.dtype
    chosen, reason = solver_choice(system.plan)
    if solver is None:
        solver = {"Tsit5": Tsit5, "Rodas5P": Rodas5P, "BDF": BDF}[chosen]()
    else:
        chosen, reason = type(solver).__name__, "as asked for"
    if stepsize_controller is None:
        check_tolerances(rtol, atol, dtype)
        stepsize_controller = _step_sizes(system, solver, jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype))
    if isinstance(stepsize_controller, diffrax.ConstantStepSize):
        raise ModelError(
            "stepsize_controller=ConstantStepSize() needs a step: use diffrax.StepTo(ts=jnp.linspace(t0, t1, n))"
        )
    if jump_ts is not None:
        adaptive: Any = stepsize_controller
        stepsize_controller = diffrax.ClipStepSizeController(adaptive, jump_ts=jnp.asarray(jump_ts, dtype))
    options = (
        solver,
        adjoint if adjoint is not None else default_adjoint(),
        stepsize_controller,
        max_steps,
        progress,
    )
    # Numbers become arrays, so that a new value is no new program.
    inputs = {name: v if callable(v) else jnp.asarray(v, dtype) for name, v in (inputs or {}).items()}
    initial = {name: jnp.asarray(v, dtype) for name, v in sorted((initial or {}).items())}
    t0, t1 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
    if ts is not None:
        ts = jnp.asarray(ts, dtype)
        if not _is_traced((t0, t1, ts)):
            ts = jnp.clip(ts, t0, t1)  # `_check_interval` lets rounding pass, Diffrax does not
    arguments = (system, t0, t1, ts, inputs, initial, options)
    outcome = None if _is_traced(arguments) else _compiled(arguments)
    # An input's function may close over a traced value, which shows in the outcome only.
    if outcome is None or _is_traced(outcome):
        found = initialize(system, t0, inputs, initial)
        found = check(system, found, t0, inputs, initial) if throw else found
        saved, x, _, stats, result = _integrate(found.x, *arguments)
        result = _with_start(found, result)
        if throw:
            x = result.error_if(x, ~diffrax.is_okay(result))
        return Solution(saved, x, system, inputs, stats, result, chosen, reason)
    last: Any
    found, (saved, x, last, stats, result) = outcome
    if throw:
        check_parameters(system)
        check(system, found, t0, inputs, initial)
    stats = {name: int(value) for name, value in stats.items() if jnp.ndim(value) == 0}
    if ts is None:
        taken = int(np.isfinite(np.asarray(saved)).sum())
        saved, x = saved[:taken], x[:taken]
    solution = Solution(saved, x, system, inputs, stats, result, chosen, reason)
    if throw and not bool(diffrax.is_okay(result)):
        names = [*system.states, *system.carried]
        if _is_implicit(solver):
            t, y = last
            term = _term(system, solver)
            text = explain_failure(term, inputs, t, y, solution, names, max_steps, rtol, atol)
            raise SimulationError(f"{text} {_chart_hint(system)}".rstrip())
        raise SimulationError(_explain(solution, found.x, float(t0), float(t1), max_steps, rtol, atol))
    return solution


def _is_implicit(solver: Any) -> bool:
    """Whether the solver takes differential-algebraic equations."""
    return isinstance(solver.solver if isinstance(solver, Projected) else solver, BDF | Rodas5P)


def _step_sizes(system: AcausalSystem, solver: Any, rtol: Any, atol: Any) -> diffrax.AbstractStepSizeController:
    """The controller for tolerances: absolute ones in units of the nominal values."""
    nominal = system.plan.nominal
    if len(nominal) and (nominal != 1).any():
        atol = atol * jnp.asarray(nominal, atol.dtype)
    if _is_implicit(solver):
        return step_control(solver, rtol, atol)
    return diffrax.PIDController(rtol=rtol, atol=atol)


def _term(system: AcausalSystem, solver: Any) -> diffrax.AbstractTerm:
    if not _is_implicit(solver):
        return diffrax.ODETerm(system.vector_field)
    plan = system.plan
    field = system.semi_explicit if len(plan.carried) else system.vector_field
    return DAETerm(field, mass=system.mass, pattern=plan.dae_pattern if plan.n_state >= SPARSE_FROM else None)


@eqx.filter_jit
def _compiled(arguments):
    system, t0, _, _, inputs, initial, _ = arguments
    found = initialize(system, t0, inputs, initial)._replace(jacobian=None)
    saved, x, last, stats, result = _integrate(found.x, *arguments)
    return found, (saved, x, last, stats, _with_start(found, result))


def _with_start(found, result):
    """The result of an integration, a failure if it began at an inconsistent point."""
    failure: Any = diffrax.RESULTS.nonlinear_divergence
    return diffrax.RESULTS.where(is_consistent(found), result, failure)


def _integrate(x0, system: AcausalSystem, t0, t1, ts, inputs, initial, options):
    solver, adjoint, controller, max_steps, progress = options
    term = _term(system, solver)
    implicit = _is_implicit(solver)
    if system.is_constrained and not implicit:
        solver = with_projection(solver, system.project, strict=bool(system.carried))
    if isinstance(solver, BDF) and solver.algebraic_errors is None:
        solver = dataclasses.replace(solver, algebraic_errors=False)
    if system.plan.n_constraints and isinstance(solver, BDF):
        solver = solver if solver.projection is not None else _with_field(solver, "projection", system.project)
    elif system.plan.n_constraints and implicit:
        solver = with_projection(solver, system.project, strict=False)
    own_start = implicit and not isinstance(controller, diffrax.StepTo)
    dt0 = None if own_start else _first_step(system, t0, t1, x0, inputs, solver.order(term), controller)
    main = diffrax.SubSaveAt(t0=True, steps=True) if ts is None else diffrax.SubSaveAt(ts=ts)
    subs = {"out": main, "last": diffrax.SubSaveAt(t1=True)} if implicit else {"out": main}
    counted = isinstance(solver, BDF)
    solved: Any = diffrax.diffeqsolve(
        term,
        solver,
        t0,
        t1,
        dt0,
        x0,
        args=inputs,
        saveat=diffrax.SaveAt(subs=subs, solver_state=counted),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter(),
    )
    stats = dict(solved.stats)
    if counted:
        stats["num_jacobians"], stats["num_newton_iterations"] = jax.lax.stop_gradient(solved.solver_state.counts)
    elif implicit:
        stats["num_jacobians"] = stats["num_steps"]
    saved, x = jnp.asarray(solved.ts["out"]), jnp.asarray(solved.ys["out"])
    last = jax.tree.map(lambda v: v[0], (solved.ts["last"], solved.ys["last"])) if implicit else None
    if system.is_constrained:
        filled = jnp.isfinite(x).all(axis=-1)
        safe = jnp.where(filled[:, None], x, x0)
        times = jnp.where(filled, saved, t0)
        projected = jax.vmap(lambda t, y: system.project(t, y, inputs, iterations=SAVED_ITERATIONS))(times, safe)
        x = jnp.where(filled[:, None], projected, x)
    return saved, x, last, stats, solved.result


def _with_field(module: Any, name: str, value: Any) -> Any:
    return eqx.tree_at(lambda m: getattr(m, name), module, value, is_leaf=lambda v: v is None)


def _first_step(system, t0, t1, x0, inputs, order, controller):
    """The size of the first step (Hairer, Nørsett & Wanner 1993, II.4), kept out of differentiation."""
    if isinstance(controller, diffrax.StepTo) or not x0.shape[0]:
        return None if isinstance(controller, diffrax.StepTo) else t1 - t0
    rtol, atol = getattr(controller, "rtol", 1e-6), getattr(controller, "atol", 1e-8)
    frozen, t0, t1 = jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, ((system, x0, inputs), t0, t1)
    )
    system, x0, inputs = frozen
    scale = atol + rtol * jnp.abs(x0)

    def size(v):
        return jnp.sqrt(jnp.mean((v / scale) ** 2))

    f0 = system.vector_field(t0, x0, inputs)
    d0, d1 = size(x0), size(f0)
    tiny = 1e-5
    h0 = jnp.where((d0 < tiny) | (d1 < tiny), 1e-6, 0.01 * d0 / jnp.maximum(d1, tiny))
    h0 = jnp.minimum(h0, t1 - t0)
    d2 = size(system.vector_field(t0 + h0, x0 + h0 * f0, inputs) - f0) / h0
    largest = jnp.maximum(d1, d2)
    power = 1.0 / ((order or 1) + 1)
    h1 = jnp.where(largest <= 1e-15, jnp.maximum(1e-6, h0 * 1e-3), (0.01 / jnp.maximum(largest, 1e-15)) ** power)
    h = jnp.minimum(jnp.minimum(100 * h0, h1), t1 - t0)
    h = jnp.where(jnp.isfinite(h) & (h > 0), h, 1e-6 * (t1 - t0))
    return jax.lax.stop_gradient(h)  # inputs may close over what is differentiated


def _is_traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _explain(solution: Solution, x0: Any, t0: float, t1: float, max_steps: int, rtol: Any, atol: Any) -> str:
    system, x = solution.system, np.asarray(solution.states)
    slope = np.asarray(system.vector_field(t0, x0, solution.inputs))
    if not np.isfinite(slope).all():
        name = [*system.states, *system.carried][int(np.flatnonzero(~np.isfinite(slope))[0])]
        return (
            f"the derivative of '{name}' is not finite at the start, t={t0:g}: the equations divide by zero there, or "
            "take the root or logarithm of what has none. Start elsewhere, with initial={...} or new parameters."
        )
    filled = np.isfinite(x).all(axis=1)
    reached = float(np.asarray(solution.ts)[filled][-1]) if filled.any() else math.nan
    taken = solution.stats.get("num_steps", 0)
    if taken >= max_steps or solution.result == diffrax.RESULTS.max_steps_reached:
        reason = (
            f"the integration stopped after max_steps={max_steps} steps. Raise max_steps, loosen rtol={rtol:g} and "
            f"atol={atol:g}, or, if the steps are small because the system is stiff, use an implicit solver"
        )
    else:
        reason = f"the integration failed: {solution.result}"
    hint = _chart_hint(system)
    last = f"The last saved time is {reached:g} of {t1:g}" if filled.any() else f"Nothing was saved before t={t1:g}"
    return f"{reason}. {hint} {last}.".replace("  ", " ")


def _chart_hint(system: AcausalSystem) -> str:
    if system.plan.mode != "dummy_derivatives" or not system.carried:
        return ""
    return (
        f"Perhaps the states {', '.join(system.states[:4])} have become a singular choice, which "
        'state_selection="auto" avoids.'
    )
