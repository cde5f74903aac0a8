"""`simulate`: a compiled system integrated by Diffrax."""

import math
from collections.abc import Mapping
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .errors import ModelError, SimulationError, nearest
from .lowering.initialize import check, initialize
from .lowering.system import AcausalSystem
from .solution import Solution
from .solvers.projected import with_projection
from .solvers.stored_adjoint import StoredAdjoint
from .solvers.tsit5 import Tsit5

SAVED_ITERATIONS = 3


def simulate(
    system: AcausalSystem,
    t1: Any,
    *,
    t0: Any = 0.0,
    ts: Any = None,
    solver: diffrax.AbstractSolver | None = None,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    inputs: Mapping[str, Any] | None = None,
    initial: Mapping[str, Any] | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    max_steps: int = 16384,
    progress: bool = False,
    throw: bool = True,
) -> Solution:
    """Integrates a system from a consistent initial point.

    **Arguments:**

    - `system`: from an `AcausalCompiler`.
    - `t0`, `t1`: the interval, `t0 < t1`.
    - `ts`: when to save, shape `(n,)`, increasing, inside the interval; None saves every step taken.
    - `solver`: any Diffrax solver for ordinary differential equations; default `solvers.Tsit5`. Systems with hidden
        constraints are projected onto them after every step and at every saved time.
    - `rtol`, `atol`: tolerances of the local error.
    - `inputs`: functions of time (callable pytrees such as Diffrax interpolations, or plain functions) or constants, by
        the inputs' names.
    - `initial`: values at `t0` by variables' names, which outrank the starts declared in components.
    - `adjoint`: how to differentiate; default `solvers.StoredAdjoint()`. `diffrax.ForwardMode()` for forward-mode
        differentiation (`jax.jvp`, `jax.jacfwd`).
    - `stepsize_controller`: instead of the proportional–integral controller made from the tolerances.
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
    _check_arguments(system, t0, t1, ts, inputs, initial, adjoint, solver, max_steps)
    dtype = system.parameters.values.dtype
    if stepsize_controller is None:
        _check_tolerances(rtol, atol, dtype)
        stepsize_controller = diffrax.PIDController(rtol=rtol, atol=atol)
    if isinstance(stepsize_controller, diffrax.ConstantStepSize):
        raise ModelError(
            "stepsize_controller=ConstantStepSize() needs a step: use diffrax.StepTo(ts=jnp.linspace(t0, t1, n))"
        )
    options = (
        solver if solver is not None else Tsit5(),
        adjoint if adjoint is not None else StoredAdjoint(),
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
        x0, residual = initialize(system, t0, inputs, initial)
        x0 = check(system, x0, residual, initial) if throw else x0
        saved, x, stats, result = _integrate(x0, *arguments)
        if throw:
            x = result.error_if(x, ~diffrax.is_okay(result))
        return Solution(saved, x, system, inputs, stats, result)
    (x0, residual), (saved, x, stats, result) = outcome
    if throw:
        _check_parameters(system)
        check(system, x0, residual, initial)
    stats = {name: int(value) for name, value in stats.items() if jnp.ndim(value) == 0}
    if ts is None:
        taken = int(np.isfinite(np.asarray(saved)).sum())
        saved, x = saved[:taken], x[:taken]
    solution = Solution(saved, x, system, inputs, stats, result)
    if throw and not bool(diffrax.is_okay(result)):
        raise SimulationError(_explain(solution, x0, float(t0), float(t1), max_steps, rtol, atol))
    return solution


@eqx.filter_jit
def _compiled(arguments):
    system, t0, _, _, inputs, initial, _ = arguments
    x0, residual = initialize(system, t0, inputs, initial)
    return (x0, residual), _integrate(x0, *arguments)


def _integrate(x0, system: AcausalSystem, t0, t1, ts, inputs, initial, options):
    solver, adjoint, controller, max_steps, progress = options
    if system.is_constrained:
        solver = with_projection(solver, system.project, strict=bool(system.carried))
    term = diffrax.ODETerm(system.vector_field)
    dt0 = _first_step(system, t0, t1, x0, inputs, solver.order(term), controller)
    saveat = diffrax.SaveAt(t0=True, steps=True) if ts is None else diffrax.SaveAt(ts=ts)
    solved = diffrax.diffeqsolve(
        term,
        solver,
        t0,
        t1,
        dt0,
        x0,
        args=inputs,
        saveat=saveat,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter(),
    )
    saved, x = jnp.asarray(solved.ts), jnp.asarray(solved.ys)
    if system.is_constrained:
        filled = jnp.isfinite(x).all(axis=-1)
        safe = jnp.where(filled[:, None], x, x0)
        times = jnp.where(filled, saved, t0)
        projected = jax.vmap(lambda t, y: system.project(t, y, inputs, iterations=SAVED_ITERATIONS))(times, safe)
        x = jnp.where(filled[:, None], projected, x)
    return saved, x, solved.stats, solved.result


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


# --- arguments ---------------------------------------------------------------------------------------------------


def _check_arguments(system, t0, t1, ts, inputs, initial, adjoint, solver, max_steps):
    if not isinstance(system, AcausalSystem):
        raise ModelError(f"simulate needs an AcausalSystem (call the AcausalCompiler); got {type(system).__name__}")
    if system.parameters.values.ndim != 1:
        raise ModelError(
            f"the system is a batch, its parameters have shape {system.parameters.values.shape}: simulate each with "
            "equinox.filter_vmap(lambda s: simulate(s, ...))(system)"
        )
    if solver is not None and not isinstance(solver, diffrax.AbstractSolver):
        raise ModelError(f"solver must be a Diffrax solver such as diffrax.Tsit5(); got {solver!r}")
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ModelError(
            "adjoint=BacksolveAdjoint() is wrong for constrained systems: it integrates the state backwards without "
            "its constraints and leaves the algebraic variables out. Use the default StoredAdjoint(), "
            "RecursiveCheckpointAdjoint(), or ForwardMode() for few parameters"
        )
    if not isinstance(max_steps, int) or max_steps < 1:
        raise ModelError(f"max_steps must be a positive integer; got {max_steps!r}")
    _check_interval(t0, t1, ts)
    known = system.inputs
    for name, value in (inputs or {}).items():
        if name not in known:
            raise ModelError(f"'{name}' is no input of this system: " + nearest(name, known))
        if not callable(value) and np.shape(value) != ():
            raise ModelError(
                f"input '{name}' must be a function of time or a constant; got shape {np.shape(value)}. For samples "
                "use diffrax.LinearInterpolation(ts, ys).evaluate"
            )
    for name, default in zip(known, system.plan.inputs.defaults, strict=True):
        if default is None and name not in (inputs or {}):
            raise ModelError(f"input '{name}' has no default: give it with inputs={{'{name}': function_of_time}}")
    for name, value in (initial or {}).items():
        if name in system.parameters.names:
            raise ModelError(f"initial: '{name}' is a parameter; use system.with_parameters({{'{name}': value}})")
        quantity = system.plan.resolve([name])[0][0]
        if quantity < 0:
            raise ModelError(f"initial: '{name}' is identically zero in this model")
        if np.shape(value) != ():
            raise ModelError(f"initial: '{name}' needs a scalar; got shape {np.shape(value)}")


def _concrete(value: Any) -> np.ndarray | None:
    return None if isinstance(value, Tracer) else np.asarray(value, float)


def _check_interval(t0, t1, ts):
    a, b = _concrete(t0), _concrete(t1)
    for name, value in (("t0", a), ("t1", b)):
        if value is not None and (value.shape != () or not math.isfinite(value)):
            raise ModelError(f"{name} must be a finite number; got {value}")
    if a is not None and b is not None and not a < b:
        raise ModelError(f"the interval needs t0 < t1; got t0={float(a)}, t1={float(b)}")
    if ts is None:
        return
    if np.ndim(ts) != 1 or not np.shape(ts)[0]:
        raise ModelError(f"ts must have shape (n,), n ≥ 1; got {np.shape(ts)}")
    saved = _concrete(ts)
    if saved is None:
        return
    if not np.isfinite(saved).all():
        raise ModelError("ts must be finite")
    backwards = np.flatnonzero(np.diff(saved) < 0)
    if len(backwards):
        k = int(backwards[0])
        raise ModelError(
            f"ts must be sorted; ts[{k}]={saved[k]} is followed by ts[{k + 1}]={saved[k + 1]}: use jnp.sort(ts)"
        )
    slack = 1e-6 if np.asarray(ts).dtype == np.float32 else 1e-12
    low = -math.inf if a is None else float(a) - slack * (1 + abs(float(a)))
    high = math.inf if b is None else float(b) + slack * (1 + abs(float(b)))
    outside = saved[(saved < low) | (saved > high)]
    if len(outside):
        raise ModelError(
            f"ts must lie between t0={t0} and t1={t1}; {outside[0]} does not. Extend the interval or drop it"
        )


def _check_tolerances(rtol, atol, dtype):
    for name, value in (("rtol", rtol), ("atol", atol)):
        number = _concrete(value)
        if number is not None and not (number.shape == () and math.isfinite(number) and number >= 0):
            raise ModelError(f"{name} must be a number ≥ 0; got {value}")
    eps = float(jnp.finfo(dtype).eps)
    number = _concrete(rtol)
    if number is not None and float(number) < 10 * eps:
        switch = (
            ' Switch to double precision with jax.config.update("jax_enable_x64", True) before the model is '
            "compiled, or"
            if dtype == jnp.float32
            else ""
        )
        raise ModelError(
            f"rtol={float(number):g} cannot be reached in {dtype} (eps {eps:.1e}).{switch} use rtol ≥ {10 * eps:.0e}."
        )


def _check_parameters(system: AcausalSystem):
    values = np.asarray(system.parameters.array)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        name = system.parameters.names[bad[0]]
        raise ModelError(f"parameter '{name}' is not finite: {values[bad[0]]}. Set it with with_parameters")
    for name, network in system.neural.items():
        for leaf in jax.tree.leaves(eqx.filter(network, eqx.is_inexact_array)):
            if not np.isfinite(np.asarray(leaf)).all():
                raise ModelError(f"a weight of network '{name}' is not finite: go back to an earlier iterate")


def _explain(solution: Solution, x0: Any, t0: float, t1: float, max_steps: int, rtol: float, atol: float) -> str:
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
    if system.plan.mode == "dummy_derivatives" and system.carried:
        reason += (
            f"; or the states {', '.join(system.states[:4])} have become a singular choice, which "
            'state_selection="auto" avoids'
        )
    last = f"The last saved time is {reached:g} of {t1:g}" if filled.any() else f"Nothing was saved before t={t1:g}"
    return f"{reason}. {last}."
